//! Probabilities of bits mixed from several contexts: each context counts what it has seen, a small online logistic
//! regression weighs them.
//!
//! M. Mahoney, "Adaptive weighing of context models for lossless data compression" (Florida Tech TR CS-2005-16), in
//! integers throughout.

use crate::bits::range_coder::{BitModel, RangeDecoder, RangeEncoder};

/// Contexts of a bit.
pub const INPUTS: usize = 4;
/// Fraction bits of a weight.
const WEIGHT_BITS: u32 = 16;
/// Bits taken off before weighted logits are summed.
const HEADROOM: u32 = 4;
/// Largest logit, 1/256 nat.
const MAX_LOGIT: i32 = 2047;
/// Weight of each input before anything is learned.
const FIRST_WEIGHT: i32 = 20_000;
/// Bound of a weight.
const MAX_WEIGHT: i32 = 1 << 19;
/// Step of the weights, and the shifts that scale it.
const RATE: i32 = 8;
const RATE_SHIFT: u32 = 10;
/// Bits that are counted before a context forgets the oldest.
const MAX_SEEN: u8 = 160;

/// 65536 / (1 + exp(-x)) at x = -8, -7.5 .. 8.
const LOGISTIC: [u16; 33] = [
    22, 36, 60, 98, 162, 267, 439, 720, 1179, 1921, 3108, 4971, 7812, 11955, 17625, 24742, 32768, 40794, 47911, 53581,
    57724, 60565, 62428, 63615, 64357, 64816, 65097, 65269, 65374, 65438, 65476, 65500, 65514,
];

/// Share (1/65536) of a logit (1/256 nat).
const fn share_of(logit: i32) -> i32 {
    let x = if logit > MAX_LOGIT {
        2 * MAX_LOGIT + 1
    } else if logit < -MAX_LOGIT {
        1
    } else {
        logit + MAX_LOGIT + 1
    };
    let (i, rest) = ((x >> 7) as usize, x & 127);
    (LOGISTIC[i] as i32 * (128 - rest) + LOGISTIC[i + 1] as i32 * rest + 64) >> 7
}

/// Logits of shares in steps of 1/4096: the inverse of [`share_of`].
static LOGITS: [i16; 4096] = logits();

const fn logits() -> [i16; 4096] {
    let mut table = [0; 4096];
    let (mut i, mut logit) = (0, -MAX_LOGIT);
    while i < 4096 {
        while logit < MAX_LOGIT && share_of(logit) < i as i32 * 16 + 8 {
            logit += 1;
        }
        table[i] = logit as i16;
        i += 1;
    }
    table
}

/// 2^15 / (n + 1.5), by how much a context that has seen n bits goes towards the next.
static RATES: [u16; MAX_SEEN as usize + 1] = rates();

const fn rates() -> [u16; MAX_SEEN as usize + 1] {
    let mut table = [0; MAX_SEEN as usize + 1];
    let mut n = 0;
    while n < table.len() {
        table[n] = ((1 << 16) / (2 * n + 3)) as u16;
        n += 1;
    }
    table
}

/// Share of ones that a context has seen.
#[derive(Debug, Clone, Copy)]
struct Counter {
    ones: u16,
    seen: u8,
}

/// A bit's contexts: one counter of each table, and the weights that apply.
#[derive(Debug, Clone, Copy)]
pub struct Contexts {
    /// Counter for each input.
    pub counters: [u32; INPUTS],
    /// Weights.
    pub weights: u32,
}

/// Counters and weights.
#[derive(Debug, Clone)]
pub struct Mixer {
    counters: Vec<Counter>,
    weights: Vec<[i32; INPUTS]>,
}

impl Mixer {
    /// So many counters and sets of weights that have seen nothing.
    pub fn new(counters: usize, weights: usize) -> Self {
        let counters = vec![Counter { ones: 1 << 15, seen: 0 }; counters];
        Self { counters, weights: vec![[FIRST_WEIGHT; INPUTS]; weights] }
    }

    fn logits(&self, at: &Contexts) -> [i32; INPUTS] {
        at.counters.map(|c| i32::from(LOGITS[usize::from(self.counters[c as usize].ones >> 4)]))
    }

    /// Share of a one, 1/65536.
    fn share(&self, at: &Contexts, logits: &[i32; INPUTS]) -> i32 {
        let weights = &self.weights[at.weights as usize];
        let sum: i32 = weights.iter().zip(logits).map(|(w, l)| (w * l) >> HEADROOM).sum();
        share_of(sum >> (WEIGHT_BITS - HEADROOM))
    }

    /// Cost of a bit, 1/256 bit.
    pub fn cost(&self, at: &Contexts) -> [u32; 2] {
        let model = BitModel::with_zero_share((65536 - self.share(at, &self.logits(at))) as u16);
        [model.cost(false), model.cost(true)]
    }

    fn learn(&mut self, at: &Contexts, logits: &[i32; INPUTS], share: i32, bit: bool) {
        let target = if bit { 65535 } else { 0 };
        let error = target - share;
        for (w, l) in self.weights[at.weights as usize].iter_mut().zip(logits) {
            let step = ((l * error) >> RATE_SHIFT) * RATE;
            *w = (*w + ((step + (1 << (RATE_SHIFT - 1))) >> RATE_SHIFT)).clamp(-MAX_WEIGHT, MAX_WEIGHT);
        }
        for c in at.counters {
            let counter = &mut self.counters[c as usize];
            let ones = i32::from(counter.ones);
            let rate = i32::from(RATES[usize::from(counter.seen)]);
            counter.ones = (ones + (((target - ones) * rate) >> 15)) as u16;
            counter.seen = (counter.seen + 1).min(MAX_SEEN);
        }
    }
}

/// A coder of bits in either direction.
pub trait Coder {
    /// Codes `bit`, or reads it.
    fn bit(&mut self, mixer: &mut Mixer, at: &Contexts, bit: bool) -> bool;
    /// Codes the low bits of `value`, or reads them.
    fn raw(&mut self, value: u32, count: u32) -> u32;
}

impl Coder for RangeEncoder {
    fn bit(&mut self, mixer: &mut Mixer, at: &Contexts, bit: bool) -> bool {
        let logits = mixer.logits(at);
        let share = mixer.share(at, &logits);
        RangeEncoder::bit(self, &mut BitModel::with_zero_share((65536 - share) as u16), bit);
        mixer.learn(at, &logits, share, bit);
        bit
    }

    fn raw(&mut self, value: u32, count: u32) -> u32 {
        RangeEncoder::raw(self, value, count);
        value
    }
}

impl Coder for RangeDecoder<'_> {
    fn bit(&mut self, mixer: &mut Mixer, at: &Contexts, _: bool) -> bool {
        let logits = mixer.logits(at);
        let share = mixer.share(at, &logits);
        let bit = RangeDecoder::bit(self, &mut BitModel::with_zero_share((65536 - share) as u16));
        mixer.learn(at, &logits, share, bit);
        bit
    }

    fn raw(&mut self, _: u32, count: u32) -> u32 {
        RangeDecoder::raw(self, count)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn logits_undo_the_logistic() {
        for share in (64..65_472).step_by(16) {
            let back = share_of(LOGITS[share as usize >> 4].into());
            assert!((back - share).abs() <= 40 + share.min(65_536 - share) / 64, "{share} became {back}");
        }
        let exact = |logit: i32| 65_536.0 / (1.0 + (-f64::from(logit) / 256.0).exp());
        assert!((-MAX_LOGIT..=MAX_LOGIT).all(|l| (f64::from(share_of(l)) - exact(l)).abs() < 400.0));
    }

    #[test]
    fn what_one_context_tells_is_found() {
        let mut mixer = Mixer::new(8, 1);
        let mut out = RangeEncoder::default();
        for i in 0..4000_u32 {
            let noise = i.wrapping_mul(2_654_435_761) >> 30;
            let known = i / 3 % 2;
            let at = Contexts { counters: [noise, 4 + known, 6, 7], weights: 0 };
            Coder::bit(&mut out, &mut mixer, &at, known == 1);
        }
        let bytes = out.finish();
        assert!(bytes.len() < 30, "{} bytes", bytes.len());
    }

    proptest! {
        #[test]
        fn bits_come_back_and_cost_what_is_said(bits in prop::collection::vec((any::<bool>(), 0_u32..5), 1..2000)) {
            let at = |c: u32| Contexts { counters: [c, 5, 6 + c / 2, 9], weights: c % 2 };
            let (mut mixer, mut out, mut cost) = (Mixer::new(10, 2), RangeEncoder::default(), 0);
            for (bit, c) in &bits {
                cost += u64::from(mixer.cost(&at(*c))[usize::from(*bit)]);
                Coder::bit(&mut out, &mut mixer, &at(*c), *bit);
            }
            let bytes = out.finish();
            prop_assert!((bytes.len() as f64 * 8.0 - cost as f64 / 256.0).abs() < 50.0);
            let (mut mixer, mut reader) = (Mixer::new(10, 2), RangeDecoder::new(&bytes, "bits"));
            for (bit, c) in &bits {
                prop_assert_eq!(Coder::bit(&mut reader, &mut mixer, &at(*c), false), *bit);
            }
            reader.finish().unwrap();
        }
    }
}
