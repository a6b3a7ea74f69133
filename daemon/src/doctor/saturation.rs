//! Is there too much light?

use super::Check;
use super::exposure::peaks;
use super::look::Look;
use crate::device::RigConfig;

pub(super) const NAME: &str = "saturation";

/// Largest part of the lit pixels that may be saturated: highlights of a face are fewer.
const MOST_SATURATED: f64 = 0.01;

/// Counts saturated pixels in the worst set.
pub(super) fn check(config: &RigConfig, look: &Look) -> Check {
    let limits = config.limits.mask;
    let part = |set| {
        let (mut lit, mut saturated) = (0u64, 0u64);
        for (most, least) in peaks(set) {
            let is_saturated = most >= limits.saturated_level;
            lit += u64::from(is_saturated || f32::from(most) - f32::from(least) >= 2.0 * limits.min_modulation);
            saturated += u64::from(is_saturated);
        }
        saturated as f64 / lit.max(1) as f64
    };
    let Some(worst) = look.sets.iter().map(part).max_by(f64::total_cmp) else {
        return Check::skip(NAME, "no set is whole");
    };
    let detail = format!("{:.2} % of the lit pixels reach level {}", 100.0 * worst, limits.saturated_level);
    match worst <= MOST_SATURATED {
        true => Check::pass(NAME, detail),
        false => Check::fail(
            NAME,
            detail,
            "less light: shorten timing.exposure_nanos, close the aperture, lower LED current or gain; powder what shines",
        ),
    }
}
