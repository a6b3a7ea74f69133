//! What happened beside the scans: events and telemetry, JSON in the file.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

pub(crate) const EVENT_SCHEMA: &str = r#"{"type":"object","required":["time_nanos","tick","event"],"properties":{"time_nanos":{"type":"integer"},"tick":{"type":"integer"},"event":{"type":"string"}}}"#;
pub(crate) const TELEMETRY_SCHEMA: &str = r#"{"type":"object","required":["time_nanos","values"],"properties":{"time_nanos":{"type":"integer"},"values":{"type":"object"}}}"#;

/// Something that happened during capture, at one sensor time.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Event {
    /// Sensor time, nanoseconds.
    pub time_nanos: u64,
    /// Tick nearest to that time.
    pub tick: u64,
    /// What happened.
    #[serde(flatten)]
    pub kind: EventKind,
}

/// Kinds of events; the field `event` of the JSON object names the kind.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum EventKind {
    /// Frame sets or scans left out.
    Drop {
        /// Stage and reason, such as `encode_queue_full`.
        cause: String,
        /// How many.
        count: u64,
    },
    /// Ticks for which the device delivered nothing.
    Gap {
        /// How many ticks are missing, the event's own tick being the first.
        ticks: u64,
    },
    /// A device or a stage failed.
    Fault {
        /// Which one.
        source: String,
        /// What it said.
        message: String,
    },
    /// A device came, went, or changed its settings.
    DeviceChange {
        /// Which one.
        device: String,
        /// What changed.
        change: String,
    },
    /// Somebody marked this moment.
    Mark {
        /// Why.
        text: String,
    },
    /// The recorder leaves out more or less, so as to keep up.
    Degradation {
        /// `none`, `no_between_correction` or `no_between_scans`.
        level: String,
    },
    /// A kind this version does not know.
    #[serde(other)]
    Other,
}

/// Named measurements at one sensor time: queue depths, temperatures, rates.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Telemetry {
    /// Sensor time, nanoseconds.
    pub time_nanos: u64,
    /// Value by name, the unit in the name; finite.
    pub values: BTreeMap<String, f64>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn json_is_flat_and_tagged() {
        let event =
            Event { time_nanos: 5, tick: 3, kind: EventKind::Drop { cause: "encode_queue_full".into(), count: 2 } };
        let json = serde_json::to_string(&event).unwrap();
        assert_eq!(json, r#"{"time_nanos":5,"tick":3,"event":"drop","cause":"encode_queue_full","count":2}"#);
        assert_eq!(serde_json::from_str::<Event>(&json).unwrap(), event);
    }

    #[test]
    fn unknown_kinds_and_fields_are_read() {
        let event: Event = serde_json::from_str(r#"{"time_nanos":1,"tick":2,"event":"eclipse","depth":0.5}"#).unwrap();
        assert_eq!(event.kind, EventKind::Other);
    }

    #[test]
    fn schemas_are_json() {
        for schema in [EVENT_SCHEMA, TELEMETRY_SCHEMA] {
            serde_json::from_str::<serde_json::Value>(schema).unwrap();
        }
    }
}
