//! Lossless masks: an adaptive binary range coder whose context is what is already known around a pixel, in this picture
//! and in the one before.

use gv3_codec::bits::range_coder::{BitModel, RangeDecoder, RangeEncoder};

/// Pixels before this one in its picture that shape the context: columns and rows from it.
const HERE: [(i32, i32); 8] = [(-1, 0), (-2, 0), (-1, -1), (0, -1), (1, -1), (0, -2), (2, -1), (-2, -1)];
/// Pixels of the picture before.
const BEFORE: [(i32, i32); 6] = [(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (1, 1)];
const CONTEXTS: usize = 1 << (HERE.len() + BEFORE.len());

/// Masks of one size in a row; returns the bytes of all.
pub(super) fn encode(masks: &[Vec<bool>], width: usize) -> Vec<u8> {
    let mut coder = RangeEncoder::default();
    let mut models = vec![BitModel::default(); CONTEXTS];
    let blank = vec![false; masks.first().map_or(0, Vec::len)];
    let mut before = &blank;
    for mask in masks {
        for at in 0..mask.len() {
            coder.bit(&mut models[context(mask, before, width, at)], mask[at]);
        }
        before = mask;
    }
    coder.finish()
}

/// `count` masks of a size.
pub(super) fn decode(bytes: &[u8], count: usize, width: usize, height: usize) -> Vec<Vec<bool>> {
    let mut coder = RangeDecoder::new(bytes, "masks");
    let mut models = vec![BitModel::default(); CONTEXTS];
    let mut masks: Vec<Vec<bool>> = Vec::with_capacity(count);
    let blank = vec![false; width * height];
    for _ in 0..count {
        let mut mask = blank.clone();
        let before = masks.last().unwrap_or(&blank);
        for at in 0..mask.len() {
            mask[at] = coder.bit(&mut models[context(&mask, before, width, at)]);
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
