//! Which pixels are measured, and why the others are not.

use super::LightError;
use serde::{Deserialize, Serialize};

/// Why a pixel is no part of the scan.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[repr(u8)]
pub enum Rejection {
    /// Part of the scan.
    #[default]
    Kept = 0,
    /// A picture reached the top of its range.
    Saturated,
    /// Modulation B too small.
    LowModulation,
    /// Data modulation B/A too small.
    LowDataModulation,
    /// Neighbour of a rejected pixel.
    Eroded,
    /// The two frequencies disagree about the fringe order.
    FringeOrder,
    /// Outside the working range.
    DepthRange,
    /// Measured, but in no triangle that was kept.
    Unmeshed,
    /// Not lit by the projector: hardly brighter in white than in black.
    Shadow,
    /// Two or more bits of the Gray code cannot be told.
    UncertainBit,
    /// A Gray code of no projector pixel.
    CodeRange,
    /// Projector column and row are not on the pixel's epipolar line.
    Epipolar,
    /// In a piece of relative phase that the working range does not place.
    Unanchored,
}

/// Rejected pixels of one scan, by cause.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct RejectedPixels {
    /// A picture reached the top of its range.
    pub saturated: u64,
    /// Modulation B too small: background, hair, pupils.
    pub low_modulation: u64,
    /// Data modulation B/A too small: ambient light, shadow.
    pub low_data_modulation: u64,
    /// Next to a rejected pixel.
    pub eroded: u64,
    /// The two frequencies disagree about the fringe order.
    pub fringe_order: u64,
    /// Outside the working range.
    pub depth_range: u64,
    /// In no triangle: at a depth jump, grazing, or in a speck.
    pub unmeshed: u64,
    /// Not lit by the projector.
    pub shadow: u64,
    /// Two or more bits of the Gray code cannot be told.
    pub uncertain_bit: u64,
    /// A Gray code of no projector pixel.
    pub code_range: u64,
    /// Projector column and row off the epipolar line.
    pub epipolar: u64,
    /// Relative phase only, in a piece that the working range does not place.
    pub unanchored: u64,
}

impl std::ops::AddAssign for RejectedPixels {
    fn add_assign(&mut self, other: Self) {
        self.saturated += other.saturated;
        self.low_modulation += other.low_modulation;
        self.low_data_modulation += other.low_data_modulation;
        self.eroded += other.eroded;
        self.fringe_order += other.fringe_order;
        self.depth_range += other.depth_range;
        self.unmeshed += other.unmeshed;
        self.shadow += other.shadow;
        self.uncertain_bit += other.uncertain_bit;
        self.code_range += other.code_range;
        self.epipolar += other.epipolar;
        self.unanchored += other.unanchored;
    }
}

impl RejectedPixels {
    /// Rejected pixels of every cause.
    pub fn total(&self) -> u64 {
        self.saturated
            + self.low_modulation
            + self.low_data_modulation
            + self.eroded
            + self.fringe_order
            + self.depth_range
            + self.unmeshed
            + self.shadow
            + self.uncertain_bit
            + self.code_range
            + self.epipolar
            + self.unanchored
    }

    /// The cause that rejected most pixels, and how many; `None` when none was rejected.
    pub fn main_cause(&self) -> Option<(&'static str, u64)> {
        let causes = [
            ("saturated", self.saturated),
            ("low_modulation", self.low_modulation),
            ("low_data_modulation", self.low_data_modulation),
            ("eroded", self.eroded),
            ("fringe_order", self.fringe_order),
            ("depth_range", self.depth_range),
            ("unmeshed", self.unmeshed),
            ("shadow", self.shadow),
            ("uncertain_bit", self.uncertain_bit),
            ("code_range", self.code_range),
            ("epipolar", self.epipolar),
            ("unanchored", self.unanchored),
        ];
        causes.into_iter().max_by_key(|(_, count)| *count).filter(|(_, count)| *count > 0)
    }
}

/// Limits on the fringe signal.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MaskLimits {
    /// Least modulation B, grey levels.
    pub min_modulation: f32,
    /// Least data modulation B/A.
    pub min_data_modulation: f32,
    /// A pixel is saturated from this grey level on.
    pub saturated_level: u8,
}

impl Default for MaskLimits {
    fn default() -> Self {
        Self { min_modulation: 15.0, min_data_modulation: 0.25, saturated_level: 252 }
    }
}

impl MaskLimits {
    /// Checks that the limits leave something to measure.
    ///
    /// # Errors
    /// [`LightError::Field`] naming the limit.
    pub fn validate(&self) -> Result<(), LightError> {
        if !(self.min_modulation > 0.0 && self.min_modulation < 127.5) {
            return Err(LightError::field("mask.min_modulation", "expected grey levels above 0 and below 127.5"));
        }
        if !(0.0..1.0).contains(&self.min_data_modulation) {
            return Err(LightError::field("mask.min_data_modulation", "expected a ratio from 0 to below 1"));
        }
        if self.saturated_level == 0 {
            return Err(LightError::field("mask.saturated_level", "0 calls every pixel saturated"));
        }
        Ok(())
    }
}

/// Verdict on every pixel of the camera, row-major.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct PixelMask {
    /// Columns.
    pub width_px: usize,
    /// Rows.
    pub height_px: usize,
    /// Verdicts; later stages reject only pixels that are still kept.
    pub verdicts: Vec<Rejection>,
    row_min: Vec<u8>,
}

impl PixelMask {
    /// Everything kept.
    pub fn new(width_px: usize, height_px: usize) -> Self {
        Self {
            width_px,
            height_px,
            verdicts: vec![Rejection::Kept; width_px * height_px],
            row_min: vec![0; width_px * height_px],
        }
    }

    /// Keeps every pixel again.
    pub fn clear(&mut self) {
        self.verdicts.fill(Rejection::Kept);
    }

    /// Whether pixel `i` is part of the scan.
    #[inline]
    pub fn is_kept(&self, i: usize) -> bool {
        self.verdicts[i] == Rejection::Kept
    }

    /// Rejects every kept pixel with a rejected one among its eight neighbours: an edge pixel mixes two surfaces.
    pub fn erode(&mut self) {
        let (w, h) = (self.width_px, self.height_px);
        for (row, out) in self.verdicts.chunks_exact(w).zip(self.row_min.chunks_exact_mut(w)) {
            for (o, v) in out.iter_mut().zip(row) {
                *o = u8::from(*v == Rejection::Kept);
            }
            let mut left = 1;
            for x in 0..w {
                let here = out[x];
                let right = if x + 1 < w { out[x + 1] } else { 1 };
                out[x] = left & here & right;
                left = here;
            }
        }
        for y in 0..h {
            let above = &self.row_min[y.saturating_sub(1) * w..][..w];
            let here = &self.row_min[y * w..][..w];
            let below = &self.row_min[(y + 1).min(h - 1) * w..][..w];
            let row = &mut self.verdicts[y * w..][..w];
            for ((v, a), (b, c)) in row.iter_mut().zip(above).zip(here.iter().zip(below)) {
                let rejected = (a & b & c) == 0;
                *v = if *v == Rejection::Kept && rejected { Rejection::Eroded } else { *v };
            }
        }
    }

    /// Counts the rejected pixels by cause.
    pub fn count(&self) -> RejectedPixels {
        // A pass a cause vectorizes; one histogram waits for its own last store at every pixel.
        let in_few = |few: &[Rejection], cause| few.iter().map(|v| u8::from(*v == cause)).sum::<u8>();
        let of = |cause: Rejection| self.verdicts.chunks(128).map(|few| u64::from(in_few(few, cause))).sum();
        RejectedPixels {
            saturated: of(Rejection::Saturated),
            low_modulation: of(Rejection::LowModulation),
            low_data_modulation: of(Rejection::LowDataModulation),
            eroded: of(Rejection::Eroded),
            fringe_order: of(Rejection::FringeOrder),
            depth_range: of(Rejection::DepthRange),
            unmeshed: of(Rejection::Unmeshed),
            shadow: of(Rejection::Shadow),
            uncertain_bit: of(Rejection::UncertainBit),
            code_range: of(Rejection::CodeRange),
            epipolar: of(Rejection::Epipolar),
            unanchored: of(Rejection::Unanchored),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn erosion_takes_the_eight_neighbours_and_nothing_at_the_border() {
        let mut m = PixelMask::new(7, 5);
        m.verdicts[2 * 7 + 3] = Rejection::Saturated;
        m.erode();
        let counts = m.count();
        assert_eq!((counts.saturated, counts.eroded, counts.total()), (1, 8, 9));
        assert_eq!(m.verdicts[7 + 2], Rejection::Eroded);
        assert!(m.is_kept(0) && m.is_kept(2 * 7 + 1));
    }
}
