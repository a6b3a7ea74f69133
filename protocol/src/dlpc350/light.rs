//! Light and the wires to the camera.

use super::{Register, Result};

/// Which LEDs may shine, outside pattern tables.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LedEnable {
    /// Red, green, blue, when the sequencer does not decide.
    pub rgb: [bool; 3],
    /// The pattern table decides.
    pub by_sequencer: bool,
}

impl Register for LedEnable {
    const COMMAND: u16 = 0x1A07;
    const NAME: &'static str = "LED enable";

    fn encode(&self) -> Vec<u8> {
        let [r, g, b] = self.rgb.map(u8::from);
        vec![r | g << 1 | b << 2 | u8::from(self.by_sequencer) << 3]
    }

    fn decode(data: &[u8]) -> Result<Self> {
        let [byte] = Self::bytes(data)?;
        Ok(Self { rgb: [0, 1, 2].map(|bit| byte >> bit & 1 == 1), by_sequencer: byte >> 3 & 1 == 1 })
    }
}

/// Current of the LEDs: 0 is least, 255 is most.
///
/// The LightCrafter 4500 takes the number upside down, whatever the guide says: 255 - level goes over the cable.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LedCurrent {
    /// Red, green, blue.
    pub rgb: [u8; 3],
}

impl LedCurrent {
    /// Current of each LED while it shines, amperes (lines fitted to the evaluation board; a level of 0 is not off).
    pub fn amperes(&self) -> [f64; 3] {
        const LINES: [(f64, f64); 3] = [(0.0175, 0.4495), (0.0181, 0.3587), (0.0160, 0.1529)];
        std::array::from_fn(|i| LINES[i].0 * f64::from(self.rgb[i]) + LINES[i].1)
    }
}

impl Register for LedCurrent {
    const COMMAND: u16 = 0x0B01;
    const NAME: &'static str = "LED current";

    fn encode(&self) -> Vec<u8> {
        self.rgb.map(|level| 255 - level).to_vec()
    }

    fn decode(data: &[u8]) -> Result<Self> {
        Ok(Self { rgb: Self::bytes::<3>(data)?.map(|byte| 255 - byte) })
    }
}

/// When an edge of a trigger output comes, from its place at the start or end of the exposure.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TriggerDelay(u8);

impl TriggerDelay {
    /// No delay.
    pub const ZERO: Self = Self(0xBB);
    const LAST: u8 = 0xD5;
    const STEP_NANOS: f64 = 107.2;

    /// The nearest step, of 107.2 ns, to a delay.
    ///
    /// # Errors
    /// [`super::Dlpc350Error::Setting`] outside -20 046 ..= 2787 ns.
    pub fn from_nanos(nanos: i32) -> Result<Self> {
        let steps = (f64::from(nanos) / Self::STEP_NANOS).round() + f64::from(Self::ZERO.0);
        if !(0.0..=f64::from(Self::LAST)).contains(&steps) {
            return Err(TriggerOut1::setting_error(format!("a delay of {nanos} ns is outside -20046 to 2787 ns")));
        }
        Ok(Self(steps as u8))
    }

    /// The delay, nanoseconds, negative before its place.
    pub fn nanos(self) -> f64 {
        (f64::from(self.0) - f64::from(Self::ZERO.0)) * Self::STEP_NANOS
    }

    fn decode<R: Register>(offset: usize, byte: u8) -> Result<Self> {
        if byte > Self::LAST {
            return Err(R::value_error(offset, byte, "0 to 213"));
        }
        Ok(Self(byte))
    }
}

fn decode_invert<R: Register>(byte: u8) -> Result<bool> {
    match byte {
        0 | 1 => Ok(byte == 1),
        _ => Err(R::value_error(0, byte, "0 or 1")),
    }
}

/// TRIG_OUT_1: high while a pattern is exposed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TriggerOut1 {
    /// Low while a pattern is exposed instead.
    pub inverted: bool,
    /// From the start of the exposure.
    pub rising: TriggerDelay,
    /// From the end of the exposure.
    pub falling: TriggerDelay,
}

impl Register for TriggerOut1 {
    const COMMAND: u16 = 0x1A1D;
    const NAME: &'static str = "TRIG_OUT_1";

    fn encode(&self) -> Vec<u8> {
        vec![u8::from(self.inverted), self.rising.0, self.falling.0]
    }

    fn decode(data: &[u8]) -> Result<Self> {
        let [invert, rising, falling] = Self::bytes(data)?;
        Ok(Self {
            inverted: decode_invert::<Self>(invert)?,
            rising: TriggerDelay::decode::<Self>(1, rising)?,
            falling: TriggerDelay::decode::<Self>(2, falling)?,
        })
    }
}

/// TRIG_OUT_2: a pulse at the start of the sequence ([`super::LutControl::trigger_2_every`]).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TriggerOut2 {
    /// A low pulse instead.
    pub inverted: bool,
    /// From the start of the exposure.
    pub rising: TriggerDelay,
}

impl Register for TriggerOut2 {
    const COMMAND: u16 = 0x1A1E;
    const NAME: &'static str = "TRIG_OUT_2";

    fn encode(&self) -> Vec<u8> {
        vec![u8::from(self.inverted), self.rising.0]
    }

    fn decode(data: &[u8]) -> Result<Self> {
        let [invert, rising] = Self::bytes(data)?;
        Ok(Self { inverted: decode_invert::<Self>(invert)?, rising: TriggerDelay::decode::<Self>(1, rising)? })
    }
}
