//! What the host asks of the controller.

use super::fields::{Fields, wrong};
use super::{TriggerError, line::seal};
use std::fmt;

/// Shortest time from pulse to pulse, nanoseconds.
pub const MIN_PERIOD_NANOS: u64 = 100_000;
/// Longest time from pulse to pulse, nanoseconds.
pub const MAX_PERIOD_NANOS: u64 = 10_000_000_000;
/// Shortest pulse, nanoseconds; the longest is shorter than the period by as much.
pub const MIN_WIDTH_NANOS: u64 = 1_000;
/// Most pulses from report to report.
pub const MAX_REPORT_EVERY: u32 = 1_000;

/// How pulses are to be fired.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ArmSettings {
    /// From the beginning of a pulse to that of the next, nanoseconds.
    pub period_nanos: u64,
    /// Length of a pulse, nanoseconds.
    pub width_nanos: u64,
    /// Every how many pulses one is reported, the first always.
    pub report_every: u32,
}

impl ArmSettings {
    /// Checks ranges.
    ///
    /// # Errors
    /// Name of the field in TRIGGER.md.
    pub fn validate(&self) -> Result<(), &'static str> {
        if !(MIN_PERIOD_NANOS..=MAX_PERIOD_NANOS).contains(&self.period_nanos) {
            return Err("period");
        }
        if !(MIN_WIDTH_NANOS..=self.period_nanos - MIN_WIDTH_NANOS).contains(&self.width_nanos) {
            return Err("width");
        }
        if (1..=MAX_REPORT_EVERY).contains(&self.report_every) { Ok(()) } else { Err("report") }
    }
}

/// What is to be done.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Command {
    /// Say who you are.
    Hello,
    /// Say what time it is.
    Time,
    /// Set the counter to 0 and stand ready.
    Arm(ArmSettings),
    /// Fire pulses.
    Fire {
        /// How many; 0 goes on until disarmed.
        count: u32,
    },
    /// Stop.
    Disarm,
    /// Say how it goes.
    Status,
}

/// A numbered command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Request {
    /// From 1; the reply carries it. A request numbered like the one before is answered again, not done again.
    pub id: u16,
    /// What is to be done.
    pub command: Command,
}

impl Request {
    /// The line, with checksum and line end.
    #[must_use]
    pub fn encode(&self) -> String {
        seal(&format!("{} {}", self.id, self.command))
    }

    /// Number of a request, whatever follows it.
    pub(super) fn id_of(body: &str) -> Result<u16, TriggerError> {
        read_id(&mut Fields::new(body))
    }

    /// Reads the body of a line. Ranges of [`ArmSettings`] are the controller's to check.
    ///
    /// # Errors
    /// [`TriggerError`] naming the field.
    pub fn decode(body: &str) -> Result<Self, TriggerError> {
        let mut fields = Fields::new(body);
        let id = read_id(&mut fields)?;
        let command = match fields.text("verb")? {
            "hello" => Command::Hello,
            "time" => Command::Time,
            "arm" => Command::Arm(read_arm(&mut fields)?),
            "fire" => Command::Fire { count: fields.number("count")? },
            "disarm" => Command::Disarm,
            "status" => Command::Status,
            verb => return Err(wrong("verb", verb, "not hello, time, arm, fire, disarm or status")),
        };
        fields.end()?;
        Ok(Self { id, command })
    }
}

pub(super) fn read_id(fields: &mut Fields) -> Result<u16, TriggerError> {
    match fields.number("id")? {
        0 => Err(wrong("id", "0", "numbers begin with 1")),
        id => Ok(id),
    }
}

pub(super) fn read_arm(fields: &mut Fields) -> Result<ArmSettings, TriggerError> {
    Ok(ArmSettings {
        period_nanos: fields.number("period")?,
        width_nanos: fields.number("width")?,
        report_every: fields.number("report")?,
    })
}

impl fmt::Display for ArmSettings {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {} {}", self.period_nanos, self.width_nanos, self.report_every)
    }
}

impl fmt::Display for Command {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Hello => f.write_str("hello"),
            Self::Time => f.write_str("time"),
            Self::Arm(settings) => write!(f, "arm {settings}"),
            Self::Fire { count } => write!(f, "fire {count}"),
            Self::Disarm => f.write_str("disarm"),
            Self::Status => f.write_str("status"),
        }
    }
}
