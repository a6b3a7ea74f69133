//! WebSockets that carry a stream to a client: limits, pings, an end in words.

use super::connection::told_to_stop;
use super::problem::Problem;
use super::shared::Shared;
use axum::extract::ws::{CloseFrame, Message, WebSocket, WebSocketUpgrade};
use axum::http::StatusCode;
use axum::response::Response;
use bytes::Bytes;
use futures_util::stream::{SplitSink, SplitStream};
use futures_util::{SinkExt, StreamExt};
use std::future::Future;
use std::sync::Arc;
use std::time::Duration;
use tokio::time::Instant;

/// Largest message taken from a client, bytes.
const MAX_MESSAGE_BYTES: usize = 16 << 10;
/// A client that says nothing is asked for a sign of life this often, and given up after two.
const PING_PERIOD: Duration = Duration::from_secs(20);
/// Longest that a message may be on its way.
const SEND_LIMIT: Duration = Duration::from_secs(15);
/// Messages a second that a client may send.
const MAX_CLIENT_RATE: u32 = 200;

/// Close codes (RFC 6455, section 7.4.1 and the registry it names).
pub mod close {
    /// The server stops.
    pub const GOING_AWAY: u16 = 1001;
    /// The client does not keep to the protocol.
    pub const POLICY: u16 = 1008;
    /// The work failed.
    pub const ERROR: u16 = 1011;
    /// The client was too slow.
    pub const TRY_AGAIN: u16 = 1013;
}

/// Why a stream ended; told to the client.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct End {
    code: u16,
    reason: String,
}

impl End {
    /// An end with a code of [`close`] and one sentence.
    pub fn new(code: u16, reason: impl Into<String>) -> Self {
        Self { code, reason: reason.into() }
    }

    /// The client is gone already.
    fn gone() -> Self {
        Self::new(0, "")
    }
}

/// Takes a WebSocket if there is a place, and runs `stream` on it.
pub fn open<F: Future<Output = End> + Send + 'static>(
    shared: &Arc<Shared>,
    upgrade: WebSocketUpgrade,
    stream: impl FnOnce(Sender, Receiver) -> F + Send + 'static,
) -> Result<Response, Problem> {
    let place = Arc::clone(&shared.sockets).try_acquire_owned().map_err(|_| {
        Problem::new(StatusCode::SERVICE_UNAVAILABLE, "too many streams are open; close some, or try again later")
    })?;
    let mut stopping = shared.stopping.clone();
    let upgrade = upgrade.max_message_size(MAX_MESSAGE_BYTES).max_frame_size(MAX_MESSAGE_BYTES);
    let span = tracing::Span::current();
    Ok(upgrade.on_upgrade(move |socket: WebSocket| {
        let run = async move {
            let (sink, source) = socket.split();
            let (sink, now) = (Arc::new(tokio::sync::Mutex::new(sink)), Instant::now());
            let sender = Sender { sink: Arc::clone(&sink) };
            let receiver = Receiver {
                source,
                sink: Arc::clone(&sink),
                due: now + PING_PERIOD,
                is_asked: false,
                second: now,
                messages: 0,
            };
            let end = tokio::select! {
                end = stream(sender, receiver) => end,
                () = told_to_stop(&mut stopping) => End::new(close::GOING_AWAY, "the server stops"),
            };
            tracing::debug!(code = end.code, reason = end.reason, "stream ended");
            if end.code != 0 {
                let frame = CloseFrame { code: end.code, reason: shortened(&end.reason).into() };
                let farewell = async { sink.lock().await.send(Message::Close(Some(frame))).await };
                // A client that does not take it is gone for us too.
                let _ = tokio::time::timeout(Duration::from_secs(1), farewell).await;
            }
            drop(place);
        };
        tracing::Instrument::instrument(run, span)
    }))
}

/// Control frames hold 125 bytes, two of them the code.
fn shortened(reason: &str) -> &str {
    let end = (0..=reason.len().min(123)).rev().find(|&at| reason.is_char_boundary(at)).unwrap_or(0);
    &reason[..end]
}

type Sink = Arc<tokio::sync::Mutex<SplitSink<WebSocket, Message>>>;

/// Sends messages to one client.
pub struct Sender {
    sink: Sink,
}

impl Sender {
    /// Sends bytes.
    ///
    /// # Errors
    /// The end of the stream: the client is gone, or takes nothing.
    pub async fn bytes(&self, bytes: impl Into<Bytes>) -> Result<(), End> {
        send(&self.sink, Message::Binary(bytes.into())).await
    }

    /// Sends text.
    ///
    /// # Errors
    /// As [`Self::bytes`].
    pub async fn text(&self, text: &str) -> Result<(), End> {
        send(&self.sink, Message::Text(text.into())).await
    }
}

async fn send(sink: &Sink, message: Message) -> Result<(), End> {
    let sent = async { sink.lock().await.send(message).await };
    match tokio::time::timeout(SEND_LIMIT, sent).await {
        Ok(Ok(())) => Ok(()),
        Ok(Err(_)) => Err(End::gone()),
        Err(_) => Err(End::new(close::TRY_AGAIN, "the client takes nothing")),
    }
}

/// Hears one client.
pub struct Receiver {
    source: SplitStream<WebSocket>,
    sink: Sink,
    /// When the client is asked for a sign of life, or given up.
    due: Instant,
    is_asked: bool,
    second: Instant,
    messages: u32,
}

impl Receiver {
    /// The next text of the client. Safe to drop and call again.
    ///
    /// # Errors
    /// The end of the stream.
    pub async fn text(&mut self) -> Result<String, End> {
        loop {
            let message = match tokio::time::timeout_at(self.due, self.source.next()).await {
                Ok(Some(Ok(message))) => message,
                Err(_) if !self.is_asked => {
                    (self.is_asked, self.due) = (true, Instant::now() + PING_PERIOD);
                    send(&self.sink, Message::Ping(Bytes::new())).await?;
                    continue;
                }
                _ => return Err(End::gone()),
            };
            self.count()?;
            match message {
                Message::Text(text) => return Ok(text.as_str().to_owned()),
                Message::Binary(_) => return Err(End::new(close::POLICY, "commands are text")),
                Message::Close(_) => return Err(End::gone()),
                Message::Ping(_) | Message::Pong(_) => {}
            }
        }
    }

    /// Waits for the end of a client that has nothing to say.
    pub async fn end(&mut self) -> End {
        loop {
            if let Err(end) = self.text().await {
                return end;
            }
        }
    }

    fn count(&mut self) -> Result<(), End> {
        let now = Instant::now();
        (self.due, self.is_asked) = (now + PING_PERIOD, false);
        if now - self.second > Duration::from_secs(1) {
            (self.second, self.messages) = (now, 0);
        }
        self.messages += 1;
        match self.messages > MAX_CLIENT_RATE {
            true => Err(End::new(close::POLICY, "too many messages a second")),
            false => Ok(()),
        }
    }
}
