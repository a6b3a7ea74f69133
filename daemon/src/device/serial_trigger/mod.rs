//! The serial trigger controller (`[trigger]`, protocol/TRIGGER.md).
//!
//! A thread of its own owns the port: it asks, repeats what is not answered, hands reports on, and opens the port again when the
//! controller was unplugged. Callers talk to the thread through channels and are never blocked longer than an answer may take.

mod link;

use super::{DeviceError, RigConfig, SequenceTiming, Trigger, TriggerEvent, TriggerInfo};
use gv3_protocol::trigger::{Answer, ArmSettings, Command, Identity, Refusal, request};
use link::{Link, Order};
use serde::{Deserialize, Serialize};
use std::sync::mpsc::{Receiver, Sender, channel, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;
use tracing::info;

/// Reports that wait for their reader: 20 s of 200 pulses a second.
const QUEUE: usize = 4096;
/// Longest time in which the thread answers: a controller that begins anew when its port is opened takes two seconds.
const PATIENCE: Duration = Duration::from_secs(8);

/// Kind of trigger controller.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TriggerBackend {
    /// Behind a serial port, by the protocol of TRIGGER.md.
    Serial,
}

/// The trigger controller of a rig.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TriggerConfig {
    /// Kind of controller.
    pub backend: TriggerBackend,
    /// The serial port, such as /dev/ttyACM0 or a link in /dev/serial/by-id. Either this or `serial`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub port: Option<String>,
    /// Serial number of the USB device behind the port.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub serial: Option<String>,
    /// Speed of the line, baud; USB devices do not mind it.
    #[serde(default = "default_baud")]
    pub baud: u32,
    /// Length of a pulse, nanoseconds.
    #[serde(default = "default_width_nanos")]
    pub width_nanos: u64,
    /// Every how many pulses one is reported; pictures wait for it.
    #[serde(default = "default_report_every")]
    pub report_every: u32,
}

fn default_baud() -> u32 {
    115_200
}

fn default_width_nanos() -> u64 {
    100_000
}

fn default_report_every() -> u32 {
    1
}

impl TriggerConfig {
    /// Checks ranges, and that the controller's protocol has them at this timing.
    ///
    /// # Errors
    /// [`DeviceError::Config`] naming the field.
    pub fn validate(&self, timing: &SequenceTiming) -> Result<(), DeviceError> {
        if self.port.is_some() == self.serial.is_some() {
            return Err(DeviceError::config("trigger.port", "give either port or serial"));
        }
        if !(1200..=12_000_000).contains(&self.baud) {
            return Err(DeviceError::config("trigger.baud", format!("{} is outside 1200 ..= 12000000", self.baud)));
        }
        self.settings(timing).validate().map_err(|field| match field {
            "period" => DeviceError::config("timing.picture_period_nanos", "the trigger's protocol has 0.1 ms to 10 s"),
            "width" => {
                let reason =
                    format!("{} does not fit into the period of {}", self.width_nanos, timing.picture_period_nanos);
                DeviceError::config("trigger.width_nanos", reason)
            }
            _ => {
                let reason = format!("{} is outside 1 ..= {}", self.report_every, request::MAX_REPORT_EVERY);
                DeviceError::config("trigger.report_every", reason)
            }
        })
    }

    fn settings(&self, timing: &SequenceTiming) -> ArmSettings {
        ArmSettings {
            period_nanos: timing.picture_period_nanos,
            width_nanos: self.width_nanos,
            report_every: self.report_every,
        }
    }
}

/// A controller behind a serial port.
pub struct SerialTrigger {
    config: TriggerConfig,
    identity: Identity,
    orders: Option<Sender<Order>>,
    thread: Option<JoinHandle<()>>,
}

/// Opens the controller that a configuration names, if it does.
pub(super) fn open(config: &RigConfig) -> Result<Option<Box<dyn Trigger>>, DeviceError> {
    let Some(config) = &config.trigger else { return Ok(None) };
    Ok(Some(Box::new(SerialTrigger::open(config)?)))
}

impl SerialTrigger {
    /// Opens the port and waits until the controller has said who it is.
    ///
    /// # Errors
    /// [`DeviceError::Config`] when there is no such port or nothing answers.
    pub fn open(config: &TriggerConfig) -> Result<Self, DeviceError> {
        let (orders, inbox) = channel();
        let link = Link::new(config.clone(), inbox);
        let thread = std::thread::Builder::new().name("gv3-trigger".into()).spawn(move || link.run());
        let thread = thread.map_err(|e| DeviceError::Failed(format!("the trigger's thread: {e}")))?;
        let name = "trigger".to_owned();
        let unknown = Identity { version: 0, model: name, serial: String::new(), min_period_nanos: 0 };
        let mut new = Self { config: config.clone(), identity: unknown, orders: Some(orders), thread: Some(thread) };
        match new.ask(Command::Hello) {
            Ok(Answer::Hello(identity)) => new.identity = identity,
            Ok(_) => return Err(DeviceError::Failed("the trigger controller does not say who it is".into())),
            Err(DeviceError::Disconnected(reason)) => return Err(DeviceError::config("trigger", reason)),
            Err(error) => return Err(DeviceError::config("trigger", error.to_string())),
        }
        info!(model = new.identity.model, serial = new.identity.serial, "trigger controller found");
        Ok(new)
    }

    fn ask(&mut self, command: Command) -> Result<Answer, DeviceError> {
        let gone = || DeviceError::Disconnected("the trigger controller".into());
        let (reply, answer) = sync_channel(1);
        let orders = self.orders.as_ref().ok_or_else(gone)?;
        orders.send(Order::Ask { command, reply }).map_err(|_| gone())?;
        answer.recv_timeout(PATIENCE).map_err(|_| gone())?
    }
}

fn refused(answer: &Answer) -> DeviceError {
    match answer {
        Answer::Refused(Refusal::Range("period")) => {
            DeviceError::config("timing.picture_period_nanos", "the trigger controller cannot keep it")
        }
        Answer::Refused(Refusal::Range(field)) => {
            DeviceError::config(format!("trigger.{field}"), "the trigger controller refuses it")
        }
        other => DeviceError::Failed(format!("the trigger controller answers \"{other}\"")),
    }
}

impl Trigger for SerialTrigger {
    fn info(&self) -> TriggerInfo {
        let Identity { model, serial, min_period_nanos, .. } = self.identity.clone();
        TriggerInfo { model, serial, min_period_nanos }
    }

    fn arm(&mut self, timing: &SequenceTiming) -> Result<SequenceTiming, DeviceError> {
        timing.validate()?;
        self.config.validate(timing)?;
        self.ask(Command::Disarm)?;
        let set = match self.ask(Command::Arm(self.config.settings(timing)))? {
            Answer::Arm(set) => set,
            other => return Err(refused(&other)),
        };
        match self.ask(Command::Fire { count: 0 })? {
            Answer::Fire(start_nanos) => info!(start_nanos, period_nanos = set.period_nanos, "trigger fires"),
            other => return Err(refused(&other)),
        }
        Ok(SequenceTiming { picture_period_nanos: set.period_nanos, ..*timing })
    }

    fn events(&mut self) -> Receiver<TriggerEvent> {
        let (sender, receiver) = sync_channel(QUEUE);
        if let Some(orders) = &self.orders {
            // A thread that has ended drops the sender, which ends the receiver.
            let _ = orders.send(Order::Report(sender));
        }
        receiver
    }

    fn disarm(&mut self) -> Result<u64, DeviceError> {
        match self.ask(Command::Disarm)? {
            Answer::Disarm(fired) => Ok(fired.into()),
            other => Err(refused(&other)),
        }
    }
}

impl Drop for SerialTrigger {
    fn drop(&mut self) {
        self.orders = None;
        if let Some(thread) = self.thread.take() {
            // It disarms the controller and ends; a panic there has been told of by its own thread.
            let _ = thread.join();
        }
    }
}
