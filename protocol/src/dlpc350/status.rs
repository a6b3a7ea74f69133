//! What the projector reports of itself.

use super::{Register, Result};

/// A register of one byte of flags.
macro_rules! flag_register {
    ($(#[$doc:meta])* $name:ident, $command:literal, $title:literal, { $($(#[$field_doc:meta])* $field:ident: $bit:literal),+ $(,)? }) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
        pub struct $name { $($(#[$field_doc])* pub $field: bool),+ }

        impl Register for $name {
            const COMMAND: u16 = $command;
            const NAME: &'static str = $title;

            fn encode(&self) -> Vec<u8> {
                vec![0 $(| u8::from(self.$field) << $bit)+]
            }

            fn decode(data: &[u8]) -> Result<Self> {
                let [byte] = Self::bytes(data)?;
                Ok(Self { $($field: byte >> $bit & 1 == 1),+ })
            }
        }
    };
}

flag_register!(
    /// Health of the controller.
    HardwareStatus, 0x1A0A, "hardware status", {
        /// It started without a fault.
        is_initialized: 0,
        /// The mirror array's reset driver failed.
        has_reset_error: 2,
        /// A buffer was swapped before it was loaded.
        has_forced_swap: 3,
        /// The sequencer gave up.
        has_sequencer_abort: 6,
        /// The sequencer met an error.
        has_sequencer_error: 7,
    }
);

flag_register!(
    /// Health of the memory.
    SystemStatus, 0x1A0B, "system status", {
        /// The memory test passed.
        memory_ok: 0,
    }
);

flag_register!(
    /// What it does right now.
    MainStatus, 0x1A0C, "main status", {
        /// Mirrors parked: no light.
        is_parked: 0,
        /// The sequencer runs.
        is_running: 1,
        /// The frame buffer is frozen.
        is_frozen: 2,
    }
);

flag_register!(
    /// Verdict on the pattern tables, after [`Validate`].
    Validation, 0x1A1A, "validation", {
        /// Exposure or period cannot be kept.
        exposure_invalid: 0,
        /// A pattern number is beyond its image.
        pattern_invalid: 1,
        /// Warning: TRIG_OUT_1 stays high, or overlaps a black pattern.
        trigger_overlaps: 2,
        /// Warning: no black pattern before an external trigger.
        lacks_black: 3,
        /// Warning: less than 230 us from exposure to period.
        gap_too_short: 4,
        /// Not done yet; the other bits mean nothing.
        is_busy: 7,
    }
);

/// Begins the validation that [`Validation`] reports.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Validate;

impl Register for Validate {
    const COMMAND: u16 = Validation::COMMAND;
    const NAME: &'static str = "validate";

    fn encode(&self) -> Vec<u8> {
        vec![0]
    }

    fn decode(data: &[u8]) -> Result<Self> {
        Self::bytes::<1>(data).map(|_| Self)
    }
}

/// Versions of what runs in the controller, each major << 24 | minor << 16 | patch.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Version {
    /// Firmware.
    pub application: u32,
    /// Command interface.
    pub interface: u32,
    /// Software configuration.
    pub software: u32,
    /// Sequencer configuration.
    pub sequencer: u32,
}

impl Version {
    /// The firmware's version as people write it.
    pub fn firmware(&self) -> String {
        let v = self.application;
        format!("{}.{}.{}", v >> 24, v >> 16 & 0xff, v & 0xffff)
    }
}

impl Register for Version {
    const COMMAND: u16 = 0x0205;
    const NAME: &'static str = "version";

    fn encode(&self) -> Vec<u8> {
        [self.application, self.interface, self.software, self.sequencer].iter().flat_map(|v| v.to_le_bytes()).collect()
    }

    fn decode(data: &[u8]) -> Result<Self> {
        let bytes = Self::bytes::<16>(data)?;
        let at = |i: usize| u32::from_le_bytes([bytes[i], bytes[i + 1], bytes[i + 2], bytes[i + 3]]);
        Ok(Self { application: at(0), interface: at(4), software: at(8), sequencer: at(12) })
    }
}

/// Name of the firmware image, at most 32 ASCII characters.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FirmwareTag(pub String);

impl Register for FirmwareTag {
    const COMMAND: u16 = 0x1AFF;
    const NAME: &'static str = "firmware tag";

    fn encode(&self) -> Vec<u8> {
        self.0.bytes().take(32).collect()
    }

    fn decode(data: &[u8]) -> Result<Self> {
        let text = data.iter().take(32).take_while(|&&b| b != 0);
        // What is not printable would garble the terminal it is shown on.
        Ok(Self(text.map(|&b| if b == b' ' || b.is_ascii_graphic() { char::from(b) } else { '?' }).collect()))
    }
}

/// How many images are in flash.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FlashImageCount(pub u8);

impl Register for FlashImageCount {
    const COMMAND: u16 = 0x1A42;
    const NAME: &'static str = "number of flash images";

    fn encode(&self) -> Vec<u8> {
        vec![self.0]
    }

    fn decode(data: &[u8]) -> Result<Self> {
        Self::bytes(data).map(|[count]| Self(count))
    }
}
