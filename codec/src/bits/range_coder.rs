//! Adaptive binary range coder: each bit is coded with the probability its own context has learned.
//!
//! Carry-less interval arithmetic as in G. N. N. Martin, "Range encoding" (1979), with the carry propagation and 32-bit
//! range of I. Pavlov's LZMA specification (2015, section "Range decoder"); probabilities mix a fast and a slow estimate
//! as in D. Marpe et al., "Transform and entropy coding in VVC" (2021, section V).

use crate::bits::bytes::ByteReader;
use crate::{CodecError, Result};

/// Probabilities are shares of 2^16.
const PROBABILITY_BITS: u32 = 16;
/// The range is refilled below this.
const TOP: u32 = 1 << 24;
/// Longest unary prefix of a number; the rest follows in equiprobable bits.
const MAX_UNARY: u32 = 14;
/// Most equiprobable bits of a number.
const MAX_ESCAPE_BITS: u32 = 31;

/// What a context has learned: the probability of a zero bit at two speeds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BitModel {
    fast: u16,
    slow: u16,
}

impl Default for BitModel {
    fn default() -> Self {
        Self::with_zero_share(1 << 15)
    }
}

impl BitModel {
    /// A model that expects zeros with a share of 65536.
    pub const fn with_zero_share(share: u16) -> Self {
        Self { fast: share, slow: share }
    }

    /// Probability of a zero, 1/65536, never 0 nor 1.
    fn zero_share(self) -> u32 {
        let mean = (u32::from(self.fast) + u32::from(self.slow)) >> 1;
        mean.clamp(1 << 5, (1 << PROBABILITY_BITS) - (1 << 5))
    }

    fn learn(&mut self, bit: bool) {
        if bit {
            self.fast -= self.fast >> 4;
            self.slow -= self.slow >> 7;
        } else {
            self.fast += (u16::MAX - self.fast) >> 4;
            self.slow += (u16::MAX - self.slow) >> 7;
        }
    }

    /// Cost of a bit in 1/256 bit, without learning it.
    pub fn cost(self, bit: bool) -> u32 {
        let zero = self.zero_share();
        let share = if bit { (1 << PROBABILITY_BITS) - zero } else { zero };
        cost_of_share(share)
    }
}

/// 256 log2(range), rounded down to a multiple of 8.
fn cost_exponent(range: u32) -> u32 {
    let exponent = range.ilog2();
    exponent * 256 + ((u64::from(range) << 5 >> exponent) as u32 - 32) * 8
}

/// -256 log2(share / 65536) by linear interpolation of the mantissa in 32 chords; within 0.1/256 bit.
fn cost_of_share(share: u32) -> u32 {
    let exponent = share.ilog2();
    let mantissa = (share << (PROBABILITY_BITS - exponent)) & 0xffff;
    let (i, rest) = ((mantissa >> 11) as usize, mantissa & 0x7ff);
    let log = u32::from(LOG2_CHORDS[i]) * (0x800 - rest) + u32::from(LOG2_CHORDS[i + 1]) * rest;
    (PROBABILITY_BITS - exponent) * 256 - (log >> (11 + 7))
}

/// 2^15 log2(1 + i/32), rounded.
const LOG2_CHORDS: [u16; 33] = [
    0, 1455, 2866, 4236, 5568, 6863, 8124, 9352, 10549, 11716, 12855, 13967, 15055, 16117, 17156, 18173, 19168, 20143,
    21098, 22034, 22952, 23852, 24736, 25604, 26455, 27292, 28114, 28922, 29717, 30498, 31267, 32024, 32768,
];

/// Writes bits.
#[derive(Debug)]
pub struct RangeEncoder {
    out: Vec<u8>,
    low: u64,
    range: u32,
    /// Last byte not yet written, and the 0xff bytes behind it that a carry would turn over.
    held: u8,
    held_ff: u64,
    started: bool,
}

impl Default for RangeEncoder {
    fn default() -> Self {
        Self { out: Vec::new(), low: 0, range: u32::MAX, held: 0, held_ff: 0, started: false }
    }
}

impl RangeEncoder {
    /// Codes a bit and lets its model learn it.
    pub fn bit(&mut self, model: &mut BitModel, bit: bool) {
        let bound = (self.range >> PROBABILITY_BITS) * model.zero_share();
        if bit {
            self.low += u64::from(bound);
            self.range -= bound;
        } else {
            self.range = bound;
        }
        model.learn(bit);
        self.normalize();
    }

    /// Codes the `count` (<= 31) low bits of `value`, all equally likely, high bit first.
    pub fn raw(&mut self, value: u32, count: u32) {
        for i in (0..count).rev() {
            self.range >>= 1;
            if value >> i & 1 == 1 {
                self.low += u64::from(self.range);
            }
            self.normalize();
        }
    }

    fn normalize(&mut self) {
        while self.range < TOP {
            self.range <<= 8;
            self.shift();
        }
    }

    fn shift(&mut self) {
        if self.low < 0xff00_0000 || self.low > u64::from(u32::MAX) {
            let carry = (self.low >> 32) as u8;
            if self.started {
                self.out.push(self.held.wrapping_add(carry));
            }
            for _ in 0..self.held_ff {
                self.out.push(0xff_u8.wrapping_add(carry));
            }
            (self.held, self.held_ff, self.started) = ((self.low >> 24) as u8, 0, true);
        } else {
            self.held_ff += 1;
        }
        self.low = (self.low << 8) & 0xffff_ffff;
    }

    /// Ends the code with the fewest bytes that decode alike; the decoder reads zeros behind them.
    pub fn finish(mut self) -> Vec<u8> {
        // Any value in [low, low + range) will do: the one with the most zero bits at its end is the shortest.
        let high = self.low + u64::from(self.range) - 1;
        let mut value = high;
        for zeros in (1..32).rev() {
            let candidate = high >> zeros << zeros;
            if candidate >= self.low {
                value = candidate;
                break;
            }
        }
        self.low = value;
        for _ in 0..5 {
            self.shift();
        }
        for _ in 0..4 {
            if self.out.last() == Some(&0) {
                self.out.pop();
            }
        }
        self.out
    }

    /// Codes an unsigned number: unary with one model a step (the last one for all further steps), then Exp-Golomb.
    pub fn number(&mut self, models: &mut [BitModel], value: u32) {
        let last = models.len() - 1;
        for step in 0..MAX_UNARY {
            let more = value > step;
            self.bit(&mut models[(step as usize).min(last)], more);
            if !more {
                return;
            }
        }
        let rest = u64::from(value - MAX_UNARY) + 1;
        let bits = rest.ilog2();
        for _ in 0..bits {
            self.raw(1, 1);
        }
        self.raw(0, 1);
        self.raw((rest - (1 << bits)) as u32, bits);
    }

    /// Codes a number of any size: its count of bits by one model a step, then the bits below the first.
    pub fn wide(&mut self, models: &mut [BitModel], value: u32) {
        let bits = 32 - value.leading_zeros();
        self.number(models, bits);
        if bits > 1 {
            self.raw(value & ((1 << (bits - 1)) - 1), bits - 1);
        }
    }

    /// How much was coded so far, 1/256 bit, within a few bits: for reports and decisions.
    pub fn position(&self) -> u64 {
        let whole = self.out.len() as u64 + self.held_ff + u64::from(self.started);
        whole * 8 * 256 + u64::from(32 * 256 - cost_exponent(self.range))
    }

    /// Codes a signed number: its magnitude as [`Self::number`], then its sign.
    pub fn signed(&mut self, models: &mut [BitModel], sign: &mut BitModel, value: i32) {
        self.number(models, value.unsigned_abs());
        if value != 0 {
            self.bit(sign, value < 0);
        }
    }
}

/// Reads what [`RangeEncoder`] wrote.
#[derive(Debug)]
pub struct RangeDecoder<'a> {
    bytes: &'a [u8],
    at: usize,
    code: u32,
    range: u32,
    section: &'static str,
}

impl<'a> RangeDecoder<'a> {
    /// A decoder over a whole section.
    pub fn new(bytes: &'a [u8], section: &'static str) -> Self {
        let mut decoder = Self { bytes, at: 0, code: 0, range: u32::MAX, section };
        for _ in 0..4 {
            decoder.pull();
        }
        decoder
    }

    fn pull(&mut self) {
        let byte = self.bytes.get(self.at).copied().unwrap_or(0);
        self.code = self.code << 8 | u32::from(byte);
        self.at += 1;
    }

    /// The next bit of a model.
    pub fn bit(&mut self, model: &mut BitModel) -> bool {
        let bound = (self.range >> PROBABILITY_BITS) * model.zero_share();
        let bit = self.code >= bound;
        if bit {
            self.code -= bound;
            self.range -= bound;
        } else {
            self.range = bound;
        }
        model.learn(bit);
        self.normalize();
        bit
    }

    /// `count` (<= 31) equally likely bits.
    pub fn raw(&mut self, count: u32) -> u32 {
        let mut value = 0;
        for _ in 0..count {
            self.range >>= 1;
            let bit = self.code >= self.range;
            if bit {
                self.code -= self.range;
            }
            value = value << 1 | u32::from(bit);
            self.normalize();
        }
        value
    }

    fn normalize(&mut self) {
        while self.range < TOP {
            self.range <<= 8;
            self.pull();
        }
    }

    /// An unsigned number.
    ///
    /// # Errors
    /// [`CodecError::Payload`] for a number of more than 32 bits.
    pub fn number(&mut self, models: &mut [BitModel]) -> Result<u32> {
        let last = models.len() - 1;
        for step in 0..MAX_UNARY {
            if !self.bit(&mut models[(step as usize).min(last)]) {
                return Ok(step);
            }
        }
        let mut bits = 0;
        while self.raw(1) == 1 {
            bits += 1;
            if bits > MAX_ESCAPE_BITS {
                return Err(self.error("a number of more than 32 bits"));
            }
        }
        let rest = (1u64 << bits) + u64::from(self.raw(bits)) - 1 + u64::from(MAX_UNARY);
        u32::try_from(rest).map_err(|_| self.error("a number of more than 32 bits"))
    }

    /// A number of any size.
    ///
    /// # Errors
    /// [`CodecError::Payload`] for a number of more than 32 bits.
    pub fn wide(&mut self, models: &mut [BitModel]) -> Result<u32> {
        match self.number(models)? {
            bits @ (0 | 1) => Ok(bits),
            bits @ 2..=32 => Ok(1 << (bits - 1) | self.raw(bits - 1)),
            _ => Err(self.error("a number of more than 32 bits")),
        }
    }

    /// A signed number.
    ///
    /// # Errors
    /// [`CodecError::Payload`] for a magnitude above 2^31 - 1.
    pub fn signed(&mut self, models: &mut [BitModel], sign: &mut BitModel) -> Result<i32> {
        let magnitude = i32::try_from(self.number(models)?).map_err(|_| self.error("a number of more than 31 bits"))?;
        Ok(if magnitude != 0 && self.bit(sign) { -magnitude } else { magnitude })
    }

    /// True when more bytes were needed than there are, beyond the zeros that the encoder leaves out.
    pub fn overran(&self) -> bool {
        self.at > self.bytes.len() + 4
    }

    /// An error at the present offset.
    pub fn error(&self, reason: impl Into<String>) -> CodecError {
        ByteReader::new(self.bytes, self.section).error_at(self.at.min(self.bytes.len()), reason)
    }

    /// Checks that the section held exactly the bytes that were needed.
    ///
    /// # Errors
    /// [`CodecError::Payload`] when bytes are missing or left.
    pub fn finish(self) -> Result<()> {
        if self.overran() {
            return Err(self.error("the section ends too early"));
        }
        if self.at < self.bytes.len() {
            return Err(self.error(format!("{} bytes are left", self.bytes.len() - self.at)));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[derive(Debug, Clone, Copy)]
    enum Symbol {
        Bit(usize, bool),
        Raw(u32, u32),
        Number(u32),
        Signed(i32),
        Wide(u32),
    }

    fn symbol() -> impl Strategy<Value = Symbol> {
        prop_oneof![
            4 => (0..3_usize, any::<bool>()).prop_map(|(m, b)| Symbol::Bit(m, b)),
            4 => (0..1_usize, Just(false)).prop_map(|(m, b)| Symbol::Bit(m, b)),
            1 => (any::<u32>(), 0..=31_u32).prop_map(|(v, n)| Symbol::Raw(v & ((1 << n) - 1), n)),
            1 => prop_oneof![0..20_u32, any::<u32>()].prop_map(Symbol::Number),
            1 => prop_oneof![-9..9_i32, (i32::MIN + 1)..i32::MAX].prop_map(Symbol::Signed),
            1 => prop_oneof![0..300_u32, any::<u32>()].prop_map(Symbol::Wide),
        ]
    }

    #[derive(Default)]
    struct Models {
        bits: [BitModel; 3],
        magnitude: [BitModel; 6],
        wide: [BitModel; 8],
        sign: BitModel,
    }

    fn coded(symbols: &[Symbol]) -> Vec<u8> {
        let (mut out, mut m) = (RangeEncoder::default(), Models::default());
        for s in symbols {
            match *s {
                Symbol::Bit(k, b) => out.bit(&mut m.bits[k], b),
                Symbol::Raw(v, n) => out.raw(v, n),
                Symbol::Number(v) => out.number(&mut m.magnitude, v),
                Symbol::Signed(v) => out.signed(&mut m.magnitude, &mut m.sign, v),
                Symbol::Wide(v) => out.wide(&mut m.wide, v),
            }
        }
        out.finish()
    }

    fn check(symbols: &[Symbol]) {
        let bytes = coded(symbols);
        let (mut reader, mut m) = (RangeDecoder::new(&bytes, "test"), Models::default());
        for (i, s) in symbols.iter().enumerate() {
            match *s {
                Symbol::Bit(k, b) => assert_eq!(reader.bit(&mut m.bits[k]), b, "{i}"),
                Symbol::Raw(v, n) => assert_eq!(reader.raw(n), v, "{i}"),
                Symbol::Number(v) => assert_eq!(reader.number(&mut m.magnitude).unwrap(), v, "{i}"),
                Symbol::Signed(v) => assert_eq!(reader.signed(&mut m.magnitude, &mut m.sign).unwrap(), v, "{i}"),
                Symbol::Wide(v) => assert_eq!(reader.wide(&mut m.wide).unwrap(), v, "{i}"),
            }
        }
        reader.finish().unwrap();
    }

    proptest! {
        #[test]
        fn what_was_coded_comes_back(symbols in prop::collection::vec(symbol(), 0..400)) {
            check(&symbols);
        }
    }

    #[test]
    fn likely_bits_cost_little_and_the_position_says_so() {
        let (mut out, mut model) = (RangeEncoder::default(), BitModel::default());
        (0..10_000).for_each(|i| out.bit(&mut model, i % 100 == 99));
        let position = out.position() as f64 / 2048.0;
        let bytes = out.finish().len();
        // Entropy of one in a hundred: 0.081 bits, 101 bytes; learning and two speeds cost the rest.
        assert!((100..140).contains(&bytes), "{bytes}");
        assert!((position - bytes as f64).abs() < 6.0, "{position} {bytes}");
    }
}
