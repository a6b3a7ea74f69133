//! What the controller says: replies to requests, and events of its own accord.

use super::fields::{Fields, is_word, wrong};
use super::request::{ArmSettings, read_arm, read_id};
use super::{TriggerError, line::seal};
use std::fmt;

/// Who a controller is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Identity {
    /// Version of the protocol.
    pub version: u16,
    /// Model, a word.
    pub model: String,
    /// Serial number, a word.
    pub serial: String,
    /// Shortest period it can keep, nanoseconds.
    pub min_period_nanos: u64,
}

impl Identity {
    /// Whether model and serial number are words that a line can carry.
    #[must_use]
    pub fn is_valid(&self) -> bool {
        is_word(&self.model) && is_word(&self.serial)
    }
}

/// What a controller is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum State {
    /// Not armed.
    Idle,
    /// Armed, and not fired, or done.
    Armed,
    /// Firing.
    Firing,
}

/// How it goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Status {
    /// What it is doing.
    pub state: State,
    /// Pulses since it was armed.
    pub fired: u32,
    /// Events since it was armed that found no room on the line.
    pub lost_events: u32,
    /// Its clock, nanoseconds.
    pub time_nanos: u64,
}

/// Why a request was refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refusal {
    /// A value that the controller cannot keep.
    Range(&'static str),
    /// Not now: fired before armed, armed while firing.
    State,
    /// Not understood.
    Syntax,
}

/// Content of a reply.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Answer {
    /// To `hello`.
    Hello(Identity),
    /// To `time`: the clock when the request was read, nanoseconds.
    Time(u64),
    /// To `arm`: what was really set.
    Arm(ArmSettings),
    /// To `fire`: the clock at the first pulse, nanoseconds.
    Fire(u64),
    /// To `disarm`: pulses since it was armed.
    Disarm(u32),
    /// To `status`.
    Status(Status),
    /// To any.
    Refused(Refusal),
}

/// What happens of itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Event {
    /// A pulse began.
    Pulse {
        /// Pulses before it since it was armed.
        counter: u32,
        /// When it began, nanoseconds of the controller's clock.
        time_nanos: u64,
    },
    /// As many pulses as asked for were fired.
    Done {
        /// Pulses since it was armed.
        fired: u32,
        /// End of the last one's period, nanoseconds of the controller's clock.
        time_nanos: u64,
    },
    /// The controller began anew; it is idle and knows of no request.
    Boot {
        /// Version of the protocol.
        version: u16,
    },
    /// A pulse came late or not at all.
    Overrun {
        /// Number of the pulse.
        counter: u32,
    },
    /// A line that could not be read.
    Reject,
}

/// A line from the controller.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Message {
    /// To the request of the same number.
    Reply {
        /// Number of the request.
        id: u16,
        /// Content.
        answer: Answer,
    },
    /// Of its own accord.
    Event(Event),
}

impl Message {
    /// The line, with checksum and line end.
    #[must_use]
    pub fn encode(&self) -> String {
        match self {
            Self::Reply { id, answer: Answer::Refused(refusal) } => seal(&format!("{id} no {refusal}")),
            Self::Reply { id, answer } => seal(&format!("{id} ok {answer}")),
            Self::Event(event) => seal(&format!("! {event}")),
        }
    }

    /// Reads the body of a line.
    ///
    /// # Errors
    /// [`TriggerError`] naming the field.
    pub fn decode(body: &str) -> Result<Self, TriggerError> {
        if let Some(event) = body.strip_prefix("! ") {
            return read_event(Fields::new(event)).map(Self::Event);
        }
        let mut fields = Fields::new(body);
        let id = read_id(&mut fields)?;
        let answer = match fields.text("result")? {
            "ok" => read_answer(&mut fields)?,
            "no" => Answer::Refused(read_refusal(&mut fields)?),
            other => return Err(wrong("result", other, "not ok or no")),
        };
        fields.end()?;
        Ok(Self::Reply { id, answer })
    }
}

fn read_answer(fields: &mut Fields) -> Result<Answer, TriggerError> {
    Ok(match fields.text("verb")? {
        "hello" => {
            let name = fields.text("protocol")?;
            if name != "gv3-trigger" {
                return Err(wrong("protocol", name, "not gv3-trigger: this is another device"));
            }
            Answer::Hello(Identity {
                version: fields.number("version")?,
                model: fields.word("model")?,
                serial: fields.word("serial")?,
                min_period_nanos: fields.number("min-period")?,
            })
        }
        "time" => Answer::Time(fields.number("time")?),
        "arm" => Answer::Arm(read_arm(fields)?),
        "fire" => Answer::Fire(fields.number("start")?),
        "disarm" => Answer::Disarm(fields.number("fired")?),
        "status" => Answer::Status(Status {
            state: read_state(fields)?,
            fired: fields.number("fired")?,
            lost_events: fields.number("lost")?,
            time_nanos: fields.number("time")?,
        }),
        verb => return Err(wrong("verb", verb, "not a verb of a request")),
    })
}

fn read_state(fields: &mut Fields) -> Result<State, TriggerError> {
    match fields.text("state")? {
        "idle" => Ok(State::Idle),
        "armed" => Ok(State::Armed),
        "firing" => Ok(State::Firing),
        state => Err(wrong("state", state, "not idle, armed or firing")),
    }
}

fn read_refusal(fields: &mut Fields) -> Result<Refusal, TriggerError> {
    Ok(match fields.text("reason")? {
        "range" => match fields.text("field")? {
            "period" => Refusal::Range("period"),
            "width" => Refusal::Range("width"),
            "report" => Refusal::Range("report"),
            field => return Err(wrong("field", field, "not period, width or report")),
        },
        "state" => Refusal::State,
        "syntax" => Refusal::Syntax,
        reason => return Err(wrong("reason", reason, "not range, state or syntax")),
    })
}

fn read_event(mut fields: Fields) -> Result<Event, TriggerError> {
    let event = match fields.text("event")? {
        "pulse" => Event::Pulse { counter: fields.number("counter")?, time_nanos: fields.number("time")? },
        "done" => Event::Done { fired: fields.number("fired")?, time_nanos: fields.number("time")? },
        "boot" => Event::Boot { version: fields.number("version")? },
        "overrun" => Event::Overrun { counter: fields.number("counter")? },
        "reject" => Event::Reject,
        event => return Err(wrong("event", event, "not pulse, done, boot, overrun or reject")),
    };
    fields.end()?;
    Ok(event)
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Range(field) => write!(f, "range {field}"),
            Self::State => f.write_str("state"),
            Self::Syntax => f.write_str("syntax"),
        }
    }
}

impl fmt::Display for State {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Idle => "idle",
            Self::Armed => "armed",
            Self::Firing => "firing",
        })
    }
}

impl fmt::Display for Answer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Hello(i) => {
                write!(f, "hello gv3-trigger {} {} {} {}", i.version, i.model, i.serial, i.min_period_nanos)
            }
            Self::Time(nanos) => write!(f, "time {nanos}"),
            Self::Arm(settings) => write!(f, "arm {settings}"),
            Self::Fire(nanos) => write!(f, "fire {nanos}"),
            Self::Disarm(fired) => write!(f, "disarm {fired}"),
            Self::Status(s) => write!(f, "status {} {} {} {}", s.state, s.fired, s.lost_events, s.time_nanos),
            Self::Refused(refusal) => refusal.fmt(f),
        }
    }
}

impl fmt::Display for Event {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Pulse { counter, time_nanos } => write!(f, "pulse {counter} {time_nanos}"),
            Self::Done { fired, time_nanos } => write!(f, "done {fired} {time_nanos}"),
            Self::Boot { version } => write!(f, "boot {version}"),
            Self::Overrun { counter } => write!(f, "overrun {counter}"),
            Self::Reject => f.write_str("reject"),
        }
    }
}
