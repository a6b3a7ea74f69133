//! Requests and their replies over a transport: numbered, repeated when something was lost, opened anew after a disconnection.

use super::transport::{UsbError, UsbOpener, UsbTransport};
use gv3_protocol::gv3::{BodyError, CONTROL_IDENTIFY, CONTROL_RESET, Decoder, Identity, Message, Reply, Request};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use tracing::{debug, warn};

/// How long a device may take over one request, as GV3.md allows it twice over.
const REPLY_TIME: Duration = Duration::from_secs(1);
/// How often a request is sent before it is given up.
const TRIES: u32 = 3;

/// What went wrong with a request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum LinkError {
    /// The transport.
    Usb(UsbError),
    /// The device.
    Body(BodyError),
}

impl From<UsbError> for LinkError {
    fn from(error: UsbError) -> Self {
        Self::Usb(error)
    }
}

/// An open device that was told to begin anew.
pub struct Link {
    transport: Arc<dyn UsbTransport>,
    identity: Identity,
    sequence: u16,
    decoder: Decoder,
}

impl Link {
    /// Finds and opens the device, asks who it is, and resets it.
    ///
    /// # Errors
    /// [`LinkError`] when there is none, or something else under its USB identifiers.
    pub fn open(opener: &UsbOpener) -> Result<Self, LinkError> {
        let transport = opener()?;
        let answer = match transport.control_in(CONTROL_IDENTIFY, Identity::BYTES as u16, REPLY_TIME) {
            Err(UsbError::Stall) => {
                let reason = format!("{}: does not speak the gv3 protocol", transport.place());
                return Err(UsbError::Failed(reason).into());
            }
            other => other?,
        };
        let identity = Identity::decode(&answer).map_err(|e| match e {
            BodyError::Version(_) => LinkError::Body(e),
            other => UsbError::Failed(format!("{}: no gv3 projector: {other}", transport.place())).into(),
        })?;
        transport.control_out(CONTROL_RESET, REPLY_TIME)?;
        debug!(place = %transport.place(), model = identity.model, "projector opened");
        Ok(Self { transport, identity, sequence: 0, decoder: Decoder::default() })
    }

    /// What the device says of itself.
    pub fn identity(&self) -> &Identity {
        &self.identity
    }

    /// Its transport, for events.
    pub fn transport(&self) -> Arc<dyn UsbTransport> {
        Arc::clone(&self.transport)
    }

    /// Asks and waits for the reply. A request whose reply is lost is sent again with the same number, so that the device
    /// does what it asks once.
    ///
    /// # Errors
    /// [`LinkError`] of the device, or of the last try.
    pub fn ask(&mut self, request: &Request) -> Result<Reply, LinkError> {
        self.sequence = self.sequence.wrapping_add(1);
        let bytes = request.message(self.sequence).encode();
        let mut last = UsbError::Timeout;
        for attempt in 1..=TRIES {
            match self.exchange(&bytes) {
                Ok(message) => return request.decode_reply(&message).map_err(LinkError::Body),
                Err(UsbError::Disconnected) => return Err(UsbError::Disconnected.into()),
                Err(error) => {
                    warn!(request = request.name(), attempt, %error, "request failed");
                    last = error;
                }
            }
            self.decoder.discard();
        }
        Err(last.into())
    }

    fn exchange(&mut self, bytes: &[u8]) -> Result<Message, UsbError> {
        let deadline = Instant::now() + REPLY_TIME;
        self.transport.write(bytes, REPLY_TIME)?;
        loop {
            while let Some(message) = self.decoder.next_message() {
                // Replies to requests that were given up may still come.
                if message.sequence == self.sequence {
                    return Ok(message);
                }
            }
            let left = deadline.checked_duration_since(Instant::now()).ok_or(UsbError::Timeout)?;
            self.decoder.push(&self.transport.read(left)?);
        }
    }
}

/// Where the thread that reads events finds the transport that is open now.
#[derive(Default)]
pub struct Current(Mutex<Option<Arc<dyn UsbTransport>>>);

impl Current {
    /// Another one was opened, or none is open.
    pub fn set(&self, transport: Option<Arc<dyn UsbTransport>>) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = transport;
    }

    /// The one that is open.
    pub fn get(&self) -> Option<Arc<dyn UsbTransport>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}
