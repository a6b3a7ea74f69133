//! Is there enough light?

use super::Check;
use super::look::Look;
use crate::device::RigConfig;
use crate::pipeline::FrameSet;

pub(super) const NAME: &str = "exposure";

/// Least part of the picture that fringes must be seen on.
const LEAST_LIT: f64 = 0.01;
/// Level that the brighter pixels should reach, and the least they must.
const WANTED_LEVEL: f64 = 200.0;
const LEAST_LEVEL: u8 = 100;
/// Part of the pixels that are called the brighter ones.
const BRIGHTER: f64 = 0.1;

/// Brightest and darkest level of every pixel in a set.
pub(super) fn peaks(set: &FrameSet) -> Vec<(u8, u8)> {
    let pixels = set.frames.first().map_or(0, |frame| frame.picture.pixels.len());
    let mut peaks = vec![(0, u8::MAX); pixels];
    for frame in &set.frames {
        for ((most, least), level) in peaks.iter_mut().zip(&frame.picture.pixels) {
            (*most, *least) = ((*most).max(*level), (*least).min(*level));
        }
    }
    peaks
}

/// Looks how bright the pixels with fringes are.
pub(super) fn check(config: &RigConfig, look: &Look) -> Check {
    let Some(set) = look.sets.last() else { return Check::skip(NAME, "no set is whole") };
    let set_ms = look.settings.exposure_nanos as f64 * 1e-6;
    let wanted_ms = config.timing.exposure_nanos as f64 * 1e-6;
    if (set_ms / wanted_ms - 1.0).abs() > 0.05 {
        let detail = format!("the camera exposes for {set_ms:.3} ms instead of {wanted_ms:.3} ms");
        return Check::fail(
            NAME,
            detail,
            "set timing.exposure_nanos to what the camera can do, or name its control in [camera.v4l]",
        );
    }
    let peaks = peaks(set);
    let least_swing = 2.0 * config.limits.mask.min_modulation;
    let is_lit = |p: &&(u8, u8)| f32::from(p.0) - f32::from(p.1) >= least_swing;
    let mut levels: Vec<u8> = peaks.iter().filter(is_lit).map(|p| p.0).collect();
    let lit = levels.len() as f64 / peaks.len().max(1) as f64;
    if lit < LEAST_LIT {
        let detail = format!("fringes are seen on {:.1} % of the picture at {set_ms:.3} ms", 100.0 * lit);
        let action = "put something bright into the working range, open the aperture, take the projector's cap off";
        return Check::fail(NAME, detail, action);
    }
    levels.sort_unstable();
    let level = levels[((levels.len() - 1) as f64 * (1.0 - BRIGHTER)) as usize];
    let detail = format!(
        "{:.0} % of the picture has fringes; the brighter pixels reach {level} of 255 at {set_ms:.3} ms",
        100.0 * lit
    );
    if level < LEAST_LEVEL {
        let longer_ms = wanted_ms * WANTED_LEVEL / f64::from(level.max(1));
        let period_ms = config.timing.picture_period_nanos as f64 * 1e-6;
        let action = match longer_ms <= period_ms {
            true => format!("set timing.exposure_nanos to about {:.0}", longer_ms * 1e6),
            false => {
                format!("more light: open the aperture, raise LED current or gain; {longer_ms:.1} ms would be needed")
            }
        };
        return Check::fail(NAME, detail, action);
    }
    Check::pass(NAME, detail)
}
