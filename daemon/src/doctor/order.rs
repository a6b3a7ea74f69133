//! Do pictures and patterns belong together?

use super::Check;
use super::look::Look;
use super::test_patterns::{RAMP, TestPictures};

pub(super) const NAME: &str = "order";

/// Patterns that pictures might be off by.
const SHIFTS: std::ops::RangeInclusive<isize> = -2..=2;

/// Judges the sets by number and time, and the pictures of the ramp by what they show.
pub(super) fn check(look: &Look, test: &TestPictures) -> Check {
    let dropped = look.drops.sets();
    let sets = format!("{} of {} sets whole and in order", look.sets.len(), look.sets.len() as u64 + dropped);
    if look.sets.is_empty() || dropped + look.drops.stray_frames > 0 {
        let d = &look.drops;
        let causes = format!(
            "lost {}, doubled {}, late {}, disordered {}, stray pictures {}",
            d.lost, d.doubled, d.late, d.disordered, d.stray_frames
        );
        let action = "pictures are lost on their way or come at the wrong time: give the camera a USB port of its own, close \
                      other programs, check the trigger's cable";
        return Check::fail(NAME, format!("{sets}; {causes}"), action);
    }
    let shift = match &test.pictures {
        Ok(pictures) => {
            let means: Vec<f64> = pictures[..RAMP].iter().map(|p| mean(&p.pixels)).collect();
            ramp_shift(&means, |i| test.ramp_level(i))
        }
        Err(reason) => return Check::pass(NAME, format!("{sets}; no ramp was projected: {reason}")),
    };
    match shift {
        Some(0) => Check::pass(NAME, format!("{sets}; a ramp of {RAMP} levels came in its order")),
        None => Check::pass(NAME, format!("{sets}; of the ramp nothing is seen")),
        Some(shift) => {
            let detail = format!("{sets}, but pictures show the pattern {shift:+} from their own");
            let action = "the camera misses its first trigger, or answers to the wrong edge: check its trigger setting and \
                          the polarity of the projector's output";
            Check::fail(NAME, detail, action)
        }
    }
}

fn mean(pixels: &[u8]) -> f64 {
    pixels.iter().map(|v| u64::from(*v)).sum::<u64>() as f64 / pixels.len().max(1) as f64
}

/// By how many patterns the means of the ramp's pictures fit best; `None` when they do not change.
fn ramp_shift(means: &[f64], level: impl Fn(usize) -> f64) -> Option<isize> {
    let inner = *SHIFTS.end() as usize..means.len() - *SHIFTS.end() as usize;
    let count = inner.len() as f64;
    let centre = inner.clone().map(|i| means[i]).sum::<f64>() / count;
    let spread = inner.clone().map(|i| (means[i] - centre).abs()).sum::<f64>() / count;
    if spread < 0.5 {
        return None;
    }
    let correlation = |shift: isize| {
        let at = |i: usize| level(i.saturating_add_signed(shift));
        let (mut sum, mut square) = (0.0, 0.0);
        let middle = inner.clone().map(at).sum::<f64>() / count;
        for i in inner.clone() {
            sum += (means[i] - centre) * (at(i) - middle);
            square += (at(i) - middle).powi(2);
        }
        sum / square.sqrt()
    };
    SHIFTS.max_by(|a, b| correlation(*a).total_cmp(&correlation(*b)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ramp_tells_by_how_much_pictures_are_off() {
        let level = |i: usize| 127.5 + 127.5 * (std::f64::consts::TAU * i as f64 / RAMP as f64).cos();
        for off in SHIFTS {
            for gamma in [1.0, 2.2] {
                let seen = |i: usize| 3.0 + 40.0 * (level((i + RAMP).saturating_add_signed(off)) / 255.0).powf(gamma);
                let means: Vec<f64> = (0..RAMP).map(seen).collect();
                assert_eq!(ramp_shift(&means, level), Some(off), "gamma {gamma}");
            }
        }
        assert_eq!(ramp_shift(&[7.0; RAMP], level), None);
    }
}
