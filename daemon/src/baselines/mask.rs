//! Lossless masks: an adaptive binary range coder whose context is what is already known around a pixel, in this picture
//! and in the one before.
//!
//! The coder is the carry-propagating one of LZMA (I. Pavlov, LZMA specification, public domain), with 16-bit
//! probabilities.

/// Pixels before this one in its picture that shape the context: columns and rows from it.
const HERE: [(i32, i32); 8] = [(-1, 0), (-2, 0), (-1, -1), (0, -1), (1, -1), (0, -2), (2, -1), (-2, -1)];
/// Pixels of the picture before.
const BEFORE: [(i32, i32); 6] = [(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (1, 1)];
const CONTEXTS: usize = 1 << (HERE.len() + BEFORE.len());
const HALF: u16 = 1 << 15;
/// A probability moves by this power of two of the way.
const RATE: u32 = 4;
const TOP: u32 = 1 << 24;

/// Masks of one size in a row; returns the bytes of all.
pub(super) fn encode(masks: &[Vec<bool>], width: usize) -> Vec<u8> {
    let mut coder = Encoder { low: 0, range: u32::MAX, cache: 0, pending: 1, bytes: Vec::new() };
    let mut probabilities = vec![HALF; CONTEXTS];
    let blank = vec![false; masks.first().map_or(0, Vec::len)];
    let mut before = &blank;
    for mask in masks {
        for at in 0..mask.len() {
            let probability = &mut probabilities[context(mask, before, width, at)];
            coder.bit(mask[at], probability);
        }
        before = mask;
    }
    coder.finish()
}

/// `count` masks of a size.
pub(super) fn decode(bytes: &[u8], count: usize, width: usize, height: usize) -> Vec<Vec<bool>> {
    let mut coder = Decoder { code: 0, range: u32::MAX, bytes, at: 1 };
    (0..4).for_each(|_| coder.code = coder.code << 8 | coder.byte());
    let mut probabilities = vec![HALF; CONTEXTS];
    let mut masks: Vec<Vec<bool>> = Vec::with_capacity(count);
    let blank = vec![false; width * height];
    for _ in 0..count {
        let mut mask = blank.clone();
        let before = masks.last().unwrap_or(&blank);
        for at in 0..mask.len() {
            let probability = &mut probabilities[context(&mask, before, width, at)];
            mask[at] = coder.bit(probability);
        }
        masks.push(mask);
    }
    masks
}

fn context(mask: &[bool], before: &[bool], width: usize, at: usize) -> usize {
    let (x, y) = ((at % width) as i32, (at / width) as i32);
    let look = |picture: &[bool], (dx, dy): (i32, i32)| {
        let (x, y) = (x + dx, y + dy);
        let inside = x >= 0 && y >= 0 && (x as usize) < width;
        inside && picture.get(y as usize * width + x as usize).copied().unwrap_or(false)
    };
    let here = HERE.iter().fold(0, |c, &d| c << 1 | usize::from(look(mask, d)));
    BEFORE.iter().fold(here, |c, &d| c << 1 | usize::from(look(before, d)))
}

/// Moves the probability of a zero towards what was seen.
fn adapt(probability: &mut u16, bit: bool) {
    if bit {
        *probability -= *probability >> RATE;
    } else {
        *probability += (u16::MAX - *probability) >> RATE;
    }
}

struct Encoder {
    low: u64,
    range: u32,
    cache: u8,
    pending: u64,
    bytes: Vec<u8>,
}

impl Encoder {
    fn bit(&mut self, bit: bool, probability: &mut u16) {
        let bound = split(self.range, *probability);
        if bit {
            self.low += u64::from(bound);
            self.range -= bound;
        } else {
            self.range = bound;
        }
        adapt(probability, bit);
        while self.range < TOP {
            self.range <<= 8;
            self.shift();
        }
    }

    fn shift(&mut self) {
        if self.low < 0xff00_0000 || self.low > u64::from(u32::MAX) {
            let carry = (self.low >> 32) as u8;
            for k in 0..self.pending {
                self.bytes.push(if k == 0 { self.cache.wrapping_add(carry) } else { 0xff_u8.wrapping_add(carry) });
            }
            self.pending = 0;
            self.cache = (self.low >> 24) as u8;
        }
        self.pending += 1;
        self.low = (self.low & 0x00ff_ffff) << 8;
    }

    fn finish(mut self) -> Vec<u8> {
        (0..5).for_each(|_| self.shift());
        self.bytes
    }
}

struct Decoder<'a> {
    code: u32,
    range: u32,
    bytes: &'a [u8],
    at: usize,
}

impl Decoder<'_> {
    /// The next byte; zeros after the end.
    fn byte(&mut self) -> u32 {
        let byte = self.bytes.get(self.at).copied().unwrap_or(0);
        self.at += 1;
        u32::from(byte)
    }

    fn bit(&mut self, probability: &mut u16) -> bool {
        let bound = split(self.range, *probability);
        let bit = self.code >= bound;
        if bit {
            self.code -= bound;
            self.range -= bound;
        } else {
            self.range = bound;
        }
        adapt(probability, bit);
        while self.range < TOP {
            self.range <<= 8;
            self.code = self.code << 8 | self.byte();
        }
        bit
    }
}

/// Part of the range for a zero, never empty and never all.
fn split(range: u32, probability: u16) -> u32 {
    (range >> 16) * u32::from(probability.clamp(32, u16::MAX - 32))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_still_disk_costs_little_after_the_first() {
        let disk: Vec<bool> = (0..128 * 128).map(|k| (k % 128 - 64i32).pow(2) + (k / 128 - 64).pow(2) < 2500).collect();
        let (one, many) = (encode(std::slice::from_ref(&disk), 128), encode(&vec![disk.clone(); 11], 128));
        assert_eq!(decode(&many, 11, 128, 128), vec![disk; 11]);
        assert!(one.len() < 200, "{}", one.len());
        assert!(many.len() - one.len() < 10 * 60, "{} after {}", many.len(), one.len());
    }

    proptest! {
        #[test]
        fn any_masks_come_back(pixels in proptest::collection::vec(prop::bool::weighted(0.7), 3 * 7 * 5..=3 * 7 * 5)) {
            let masks: Vec<Vec<bool>> = pixels.chunks(35).map(<[bool]>::to_vec).collect();
            prop_assert_eq!(decode(&encode(&masks, 7), 3, 7, 5), masks);
        }
    }
}
