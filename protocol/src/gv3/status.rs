//! How a device is.

use super::BodyError;
use crate::session::bytes::Bytes;

/// What a device is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum DeviceState {
    /// Dark, without an order of patterns.
    Idle = 0,
    /// Dark, with patterns and their order.
    Ready = 1,
    /// Dark, light source and clock ready, counters at 0.
    Armed = 2,
    /// Showing sets one after the other.
    Running = 3,
    /// Showing one pattern.
    Showing = 4,
    /// Dark because of a fault.
    Fault = 5,
}

impl DeviceState {
    fn from_code(code: u8) -> Option<Self> {
        [Self::Idle, Self::Ready, Self::Armed, Self::Running, Self::Showing, Self::Fault].into_iter().nth(code.into())
    }
}

/// Why a device went dark by itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DeviceFault {
    /// Too hot.
    Temperature,
    /// The light source.
    Light,
    /// An exposure could not be made on time.
    Timing,
    /// The pattern memory.
    Memory,
    /// Any other code: the maker's own.
    Other(u16),
}

impl DeviceFault {
    /// Its code, not 0.
    pub fn code(self) -> u16 {
        match self {
            Self::Temperature => 1,
            Self::Light => 2,
            Self::Timing => 3,
            Self::Memory => 4,
            Self::Other(code) => code,
        }
    }

    /// By code; 0 is no fault.
    pub fn from_code(code: u16) -> Option<Self> {
        Some(match code {
            0 => return None,
            1 => Self::Temperature,
            2 => Self::Light,
            3 => Self::Timing,
            4 => Self::Memory,
            other => Self::Other(other),
        })
    }
}

impl std::fmt::Display for DeviceFault {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Temperature => f.write_str("too hot"),
            Self::Light => f.write_str("light source"),
            Self::Timing => f.write_str("an exposure was not on time"),
            Self::Memory => f.write_str("pattern memory"),
            Self::Other(code) => write!(f, "fault {code:#06x} of the maker's own"),
        }
    }
}

/// Body of the reply to a status request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Status {
    /// What it is doing.
    pub state: DeviceState,
    /// What went wrong since the last clearing.
    pub fault: Option<DeviceFault>,
    /// Patterns stored.
    pub pattern_count: u16,
    /// Positions of a set.
    pub order_count: u16,
    /// Exposures since the last arming.
    pub triggers: u64,
    /// Now, on the device's clock, nanoseconds.
    pub device_time_nanos: u64,
    /// Events since the last arming for which its queue had no room.
    pub events_lost: u64,
    /// Temperature of the electronics, thousandths of a degree Celsius; `None` when it is not measured.
    pub board_millidegrees: Option<i32>,
    /// Temperature of the light source, thousandths of a degree Celsius; `None` when it is not measured.
    pub light_millidegrees: Option<i32>,
}

/// Stands for a temperature that is not measured.
const NOT_MEASURED: i32 = i32::MIN;

impl Status {
    pub(super) const BYTES: usize = 40;

    pub(super) fn encode(&self) -> Vec<u8> {
        let mut bytes = vec![self.state as u8, 0];
        let fault = self.fault.map_or(0, DeviceFault::code);
        bytes.extend([fault, self.pattern_count, self.order_count].into_iter().flat_map(u16::to_le_bytes));
        let counts = [self.triggers, self.device_time_nanos, self.events_lost];
        bytes.extend(counts.into_iter().flat_map(u64::to_le_bytes));
        let temperatures = [self.board_millidegrees, self.light_millidegrees];
        bytes.extend(temperatures.into_iter().flat_map(|t| t.unwrap_or(NOT_MEASURED).to_le_bytes()));
        bytes
    }

    pub(super) fn decode(bytes: &[u8]) -> Result<Self, BodyError> {
        let wrong = BodyError::Length { field: "status", found: bytes.len(), expected: Self::BYTES };
        let state = bytes.first().copied().unwrap_or(0);
        let state = DeviceState::from_code(state).ok_or_else(|| {
            let reason = format!("{state}, expected 0 to 5");
            BodyError::Field { offset: 0, field: "state", reason }
        })?;
        Self::fields(state, bytes).ok_or(wrong)
    }

    fn fields(state: DeviceState, bytes: &[u8]) -> Option<Self> {
        let mut fields = Bytes(bytes);
        fields.slice(2)?;
        let temperature = |bits: u32| Some(bits as i32).filter(|t| *t != NOT_MEASURED);
        let status = Self {
            state,
            fault: DeviceFault::from_code(fields.u16()?),
            pattern_count: fields.u16()?,
            order_count: fields.u16()?,
            triggers: fields.u64()?,
            device_time_nanos: fields.u64()?,
            events_lost: fields.u64()?,
            board_millidegrees: temperature(fields.u32()?),
            light_millidegrees: temperature(fields.u32()?),
        };
        fields.0.is_empty().then_some(status)
    }
}
