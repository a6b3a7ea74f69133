//! Do the camera's clock, the schedule and the machine's clock agree?

use super::Check;
use super::look::{Look, Stamp};
use crate::device::RigConfig;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

pub(super) const NAME: &str = "clock";

/// Largest difference of two quartz clocks, parts in a million.
const MOST_PPM: f64 = 500.0;
/// Largest scatter of the pictures' times, of the period.
const MOST_JITTER: f64 = 0.125;
/// 2024: a clock that is earlier was never set.
const LEAST_AGE: Duration = Duration::from_secs(1_704_067_200);

/// Fits the pictures' times to their numbers.
pub(super) fn check(config: &RigConfig, look: &Look) -> Check {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    if now < LEAST_AGE {
        let detail = format!("this machine's clock is at {} s after 1970", now.as_secs());
        return Check::fail(NAME, detail, "set the time (timedatectl set-ntp true): sessions are stamped with it");
    }
    let period_nanos = config.timing.picture_period_nanos as f64;
    let Some(fit) = Fit::of(&look.stamps) else { return Check::skip(NAME, "too few pictures to compare clocks") };
    let drift_ppm = (fit.period_nanos / period_nanos - 1.0) * 1e6;
    let sigma_ppm = fit.sigma_nanos / period_nanos * 1e6;
    let detail = format!(
        "the camera's period is {drift_ppm:+.0} ± {sigma_ppm:.0} ppm off the schedule's, its times scatter by {:.3} ms",
        fit.jitter_nanos * 1e-6
    );
    if drift_ppm.abs() - 3.0 * sigma_ppm > MOST_PPM {
        let action = "more than two quartz clocks differ by: does the camera follow the trigger, or its own clock? is the \
                      driver's time stamp sound?";
        return Check::fail(NAME, detail, action);
    }
    if fit.jitter_nanos > MOST_JITTER * period_nanos {
        let action = "times scatter too much to tell one picture from the next: close other programs, give the camera a USB \
                      port of its own";
        return Check::fail(NAME, detail, action);
    }
    Check::pass(NAME, detail)
}

/// A line through times over numbers.
struct Fit {
    period_nanos: f64,
    /// Standard error of the period.
    sigma_nanos: f64,
    /// Root mean square of what is left.
    jitter_nanos: f64,
}

impl Fit {
    fn of(stamps: &[Stamp]) -> Option<Self> {
        let first = stamps.first().filter(|_| stamps.len() >= 12)?;
        let n = stamps.len() as f64;
        let point = |s: &Stamp| {
            let since = |a: u64, b: u64| (i128::from(a) - i128::from(b)) as f64;
            [since(s.sequence, first.sequence), since(s.device_time_nanos, first.device_time_nanos)]
        };
        let mean = |axis: usize| stamps.iter().map(|s| point(s)[axis]).sum::<f64>() / n;
        let (mean_x, mean_y) = (mean(0), mean(1));
        let sum = |f: &dyn Fn(f64, f64) -> f64| {
            stamps
                .iter()
                .map(|s| {
                    let [x, y] = point(s);
                    f(x - mean_x, y - mean_y)
                })
                .sum::<f64>()
        };
        let (xx, xy) = (sum(&|x, _| x * x), sum(&|x, y| x * y));
        if xx == 0.0 {
            return None;
        }
        let slope = xy / xx;
        let left = sum(&|x, y| (y - slope * x).powi(2));
        Some(Self { period_nanos: slope, sigma_nanos: (left / (n - 2.0) / xx).sqrt(), jitter_nanos: (left / n).sqrt() })
    }
}
