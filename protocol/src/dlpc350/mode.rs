//! Registers of one byte: what the projector shows and from where.

use super::{Register, Result};

/// A register whose byte is one of a few values.
macro_rules! byte_register {
    ($(#[$doc:meta])* $name:ident, $command:literal, $title:literal, $expected:literal,
     { $($(#[$variant_doc:meta])* $variant:ident = $value:literal),+ $(,)? }) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        pub enum $name { $($(#[$variant_doc])* $variant = $value),+ }

        impl Register for $name {
            const COMMAND: u16 = $command;
            const NAME: &'static str = $title;

            fn encode(&self) -> Vec<u8> {
                vec![*self as u8]
            }

            fn decode(data: &[u8]) -> Result<Self> {
                let [byte] = Self::bytes(data)?;
                match byte {
                    $($value => Ok(Self::$variant),)+
                    _ => Err(Self::value_error(0, byte, $expected)),
                }
            }
        }
    };
}

byte_register!(
    /// Whether a pattern sequence runs.
    Playback, 0x1A24, "pattern start/stop", "0 stop, 1 pause or 2 start", {
        /// Dark.
        Stop = 0,
        /// Held at the current pattern.
        Pause = 1,
        /// Running.
        Start = 2,
    }
);

byte_register!(
    /// What the projector does with its input.
    DisplayMode, 0x1A1B, "display mode", "0 video or 1 pattern sequence", {
        /// Shows its input as pictures.
        Video = 0,
        /// Shows bit planes of its input as patterns.
        PatternSequence = 1,
    }
);

byte_register!(
    /// Where patterns come from.
    PatternSource, 0x1A22, "pattern source", "0 video or 3 flash", {
        /// The 24 bit planes of every video frame.
        Video = 0,
        /// Images in flash memory.
        Flash = 3,
    }
);

byte_register!(
    /// What advances a pattern sequence.
    TriggerMode, 0x1A23, "trigger mode", "0 to 4", {
        /// The video's vertical sync starts the sequence.
        VerticalSync = 0,
        /// The projector's clock, or TRIG_IN_1.
        Internal = 1,
        /// TRIG_IN_1 alternates two patterns, TRIG_IN_2 advances to the next pair.
        AlternateAdvance = 2,
        /// Exposures that differ, by clock or trigger.
        Variable = 3,
        /// Exposures that differ, by vertical sync.
        VariableVerticalSync = 4,
    }
);

byte_register!(
    /// Which table the mailbox writes.
    Mailbox, 0x1A33, "mailbox", "0 to 3", {
        /// None; what was written takes effect.
        Closed = 0,
        /// [`super::ImageLut`].
        Images = 1,
        /// [`super::PatternLut`].
        Patterns = 2,
        /// Entries with exposures of their own; gv3 does not use them.
        VariableExposure = 3,
    }
);

byte_register!(
    /// Whether the light engine is on; waking takes about two seconds.
    Power, 0x0200, "power", "0 normal or 1 standby", {
        /// On.
        Normal = 0,
        /// Mirrors parked, light off.
        Standby = 1,
    }
);

/// Input of the video mode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Input {
    /// Parallel RGB: the board's HDMI.
    Parallel = 0,
    /// Test patterns of the controller.
    TestPattern = 1,
    /// Flash images.
    Flash = 2,
    /// FPD-Link.
    FpdLink = 3,
}

/// The input and its width.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct InputSource {
    /// Which input.
    pub input: Input,
    /// Bits of the port, as the board has it set (0..=31); written back unchanged.
    pub port_width: u8,
}

impl Register for InputSource {
    const COMMAND: u16 = 0x1A00;
    const NAME: &'static str = "input source";

    fn encode(&self) -> Vec<u8> {
        vec![self.port_width << 3 | self.input as u8]
    }

    fn decode(data: &[u8]) -> Result<Self> {
        let [byte] = Self::bytes(data)?;
        let input = match byte & 7 {
            0 => Input::Parallel,
            1 => Input::TestPattern,
            2 => Input::Flash,
            3 => Input::FpdLink,
            _ => return Err(Self::value_error(0, byte, "0 to 3 in its low three bits")),
        };
        Ok(Self { input, port_width: byte >> 3 })
    }
}
