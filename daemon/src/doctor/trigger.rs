//! Does every pulse of the trigger give a picture?

use super::Check;
use super::look::Look;
use crate::device::RigConfig;

pub(super) const NAME: &str = "trigger";

/// Share of the pulses that may be without a picture.
const MOST_MISSING: f64 = 0.01;

/// Counts pictures against pulses.
pub(super) fn check(config: &RigConfig, look: &Look) -> Check {
    let (Some(first), Some(last)) = (look.stamps.first(), look.stamps.last()) else {
        let reason = look.ended_by.as_deref().unwrap_or("no picture came");
        let action = match config.trigger {
            Some(_) => "check the cables from the controller to camera and projector, and the camera's trigger setting",
            None => {
                "check the cable from the projector's trigger output to the camera, and the camera's trigger setting \
                     ([camera.v4l.trigger])"
            }
        };
        return Check::fail(NAME, format!("no picture: {reason}"), action);
    };
    let pulses = last.sequence.saturating_sub(first.sequence) + 1;
    let mut seen: Vec<u64> = look.stamps.iter().map(|stamp| stamp.sequence).collect();
    seen.sort_unstable();
    seen.dedup();
    let missing = pulses.saturating_sub(seen.len() as u64) + first.sequence;
    let period_ms = config.timing.picture_period_nanos as f64 * 1e-6;
    let fired = look.pulses.map_or(String::new(), |fired| format!("; the controller fired {fired}"));
    let detail = format!("{} pictures of {} pulses every {period_ms:.3} ms{fired}", seen.len(), last.sequence + 1);
    let all = missing as f64 <= MOST_MISSING * (last.sequence + 1) as f64;
    match (all, &look.ended_by) {
        (true, None) => Check::pass(NAME, detail),
        (true, Some(reason)) => Check::fail(NAME, format!("{detail}; then {reason}"), "see the check of the devices"),
        (false, _) => {
            let action = "pulses without a picture: lengthen timing.picture_period_nanos or shorten the exposure, and look \
                          after the trigger's cable";
            Check::fail(NAME, format!("{detail}: {missing} are missing"), action)
        }
    }
}
