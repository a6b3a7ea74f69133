//! The tables that say which bit planes are shown, in what order.

use super::{IMAGE_PLANES, MAX_IMAGES, MAX_MESSAGE_BYTES, MAX_PATTERNS, Register, Result};

/// Bits of a pattern's grey levels, 1 to 8.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BitDepth(u8);

impl BitDepth {
    /// A bit depth; `None` outside 1..=8.
    pub fn new(bits: u8) -> Option<Self> {
        (1..=8).contains(&bits).then_some(Self(bits))
    }

    /// Bits.
    pub fn bits(self) -> u8 {
        self.0
    }

    /// Patterns of this depth in one image of 24 bit planes.
    pub fn patterns_per_image(self) -> usize {
        IMAGE_PLANES / usize::from(self.0)
    }

    /// Shortest exposure, microseconds, as quoted from TI's programmer's guide; the controller's validation has the last word.
    pub fn min_exposure_us(self) -> u32 {
        [235, 700, 1570, 1700, 2000, 2500, 4500, 8333][usize::from(self.0) - 1]
    }
}

/// What starts a pattern.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StartTrigger {
    /// The projector's clock.
    Internal = 0,
    /// A rising edge at the input, or vertical sync.
    Rising = 1,
    /// A falling edge at the input.
    Falling = 2,
    /// The end of the pattern before.
    Continue = 3,
}

/// LEDs that shine for a pattern.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Leds {
    /// Red, green, blue.
    pub rgb: [bool; 3],
}

impl Leds {
    /// All three.
    pub const WHITE: Self = Self { rgb: [true; 3] };
}

/// One entry of the pattern table, 24 bits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LutEntry {
    /// What starts it.
    pub trigger: StartTrigger,
    /// Which of the image's patterns of this depth (0..=63), in the order of planes: green, red, blue.
    pub pattern: u8,
    /// Bits of its levels.
    pub depth: BitDepth,
    /// Light.
    pub leds: Leds,
    /// Shown inverted.
    pub inverted: bool,
    /// Followed by black until the next pattern.
    pub black_after: bool,
    /// The next image of the image table is taken first.
    pub swaps_buffer: bool,
    /// TRIG_OUT_1 stays high from the pattern before.
    pub shares_trigger: bool,
}

impl LutEntry {
    /// Bytes of an entry.
    pub const BYTES: usize = 3;

    /// The entry, little-endian.
    pub fn encode(&self) -> [u8; Self::BYTES] {
        let [r, g, b] = self.leds.rgb.map(u8::from);
        let flags = [self.inverted, self.black_after, self.swaps_buffer, self.shares_trigger];
        [
            self.trigger as u8 | (self.pattern & 63) << 2,
            self.depth.0 | (r | g << 1 | b << 2) << 4,
            flags.iter().rev().fold(0, |bits, &flag| bits << 1 | u8::from(flag)),
        ]
    }

    /// Reads entry number `index` of a table.
    ///
    /// # Errors
    /// [`super::Dlpc350Error::Value`] for a depth outside 1..=8 or reserved bits.
    pub fn decode(index: usize, bytes: [u8; Self::BYTES]) -> Result<Self> {
        let error = |byte: usize, expected| PatternLut::value_error(index * Self::BYTES + byte, bytes[byte], expected);
        let trigger = match bytes[0] & 3 {
            0 => StartTrigger::Internal,
            1 => StartTrigger::Rising,
            2 => StartTrigger::Falling,
            _ => StartTrigger::Continue,
        };
        let depth =
            BitDepth::new(bytes[1] & 15).ok_or_else(|| error(1, "a bit depth of 1 to 8 in its low four bits"))?;
        if bytes[1] & 0x80 != 0 || bytes[2] & 0xf0 != 0 {
            return Err(error(if bytes[1] & 0x80 != 0 { 1 } else { 2 }, "0 in its reserved bits"));
        }
        let [inverted, black_after, swaps_buffer, shares_trigger] = [0, 1, 2, 3].map(|bit| bytes[2] >> bit & 1 == 1);
        let leds = Leds { rgb: [4, 5, 6].map(|bit| bytes[1] >> bit & 1 == 1) };
        Ok(Self { trigger, pattern: bytes[0] >> 2, depth, leds, inverted, black_after, swaps_buffer, shares_trigger })
    }
}

/// Mailbox data for [`super::Mailbox::Patterns`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PatternLut(pub Vec<LutEntry>);

impl Register for PatternLut {
    const COMMAND: u16 = 0x1A34;
    const NAME: &'static str = "pattern table";

    fn encode(&self) -> Vec<u8> {
        self.0.iter().flat_map(LutEntry::encode).collect()
    }

    fn decode(data: &[u8]) -> Result<Self> {
        let (entries, rest) = data.as_chunks::<{ LutEntry::BYTES }>();
        if !rest.is_empty() || entries.len() > MAX_PATTERNS {
            let reason = format!("{} bytes of data, expected up to {MAX_PATTERNS} entries of 3 bytes", data.len());
            return Err(Self::setting_error(reason));
        }
        entries.iter().enumerate().map(|(i, bytes)| LutEntry::decode(i, *bytes)).collect::<Result<_>>().map(Self)
    }
}

/// Mailbox data for [`super::Mailbox::Images`]: flash images in the order they are taken.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ImageLut(pub Vec<u8>);

impl ImageLut {
    /// As it goes over the cable: of exactly two images the controller takes the second entry first.
    fn swapped_pair(&self) -> Vec<u8> {
        match self.0[..] {
            [first, second] => vec![second, first],
            _ => self.0.clone(),
        }
    }
}

impl Register for ImageLut {
    const COMMAND: u16 = PatternLut::COMMAND;
    const NAME: &'static str = "image table";

    fn encode(&self) -> Vec<u8> {
        self.swapped_pair()
    }

    fn decode(data: &[u8]) -> Result<Self> {
        if data.len() > MAX_IMAGES {
            return Err(Self::setting_error(format!("{} images, expected up to {MAX_IMAGES}", data.len())));
        }
        Ok(Self(Self(data.to_vec()).swapped_pair()))
    }
}

/// Where the mailbox writes next.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MailboxOffset(pub u8);

impl Register for MailboxOffset {
    const COMMAND: u16 = 0x1A32;
    const NAME: &'static str = "mailbox offset";

    fn encode(&self) -> Vec<u8> {
        vec![self.0]
    }

    fn decode(data: &[u8]) -> Result<Self> {
        match Self::bytes(data)? {
            [offset @ 0..=127] => Ok(Self(offset)),
            [offset] => Err(Self::value_error(0, offset, "0 to 127")),
        }
    }
}

/// How much of the tables is used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LutControl {
    /// Entries of the pattern table, 1 to 128.
    pub patterns: u8,
    /// Over and over, or once.
    pub repeats: bool,
    /// TRIG_OUT_2 comes every so many patterns, 1 to 256.
    pub trigger_2_every: u16,
    /// Entries of the image table, 1 to 64; 1 for video.
    pub images: u8,
}

impl Register for LutControl {
    const COMMAND: u16 = 0x1A31;
    const NAME: &'static str = "table control";

    /// Counts go over the cable less one.
    fn encode(&self) -> Vec<u8> {
        let every = self.trigger_2_every.clamp(1, 256) - 1;
        let less_one = |count: u8| count.saturating_sub(1);
        vec![less_one(self.patterns), u8::from(self.repeats), every as u8, less_one(self.images)]
    }

    fn decode(data: &[u8]) -> Result<Self> {
        let [patterns @ 0..128, repeats @ 0..2, every, images @ 0..64] = Self::bytes(data)? else {
            let bytes = Self::bytes::<4>(data)?;
            let offset = if bytes[0] > 127 {
                0
            } else if bytes[1] > 1 {
                1
            } else {
                3
            };
            return Err(Self::value_error(offset, bytes[offset], "0 to 127 patterns, 0 or 1, any, 0 to 63 images"));
        };
        Ok(Self {
            patterns: patterns + 1,
            repeats: repeats == 1,
            trigger_2_every: u16::from(every) + 1,
            images: images + 1,
        })
    }
}

// The largest table fits into one message.
const _: () = assert!(2 + MAX_PATTERNS * LutEntry::BYTES <= MAX_MESSAGE_BYTES);
