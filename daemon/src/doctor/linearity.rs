//! Does twice the level give twice the light?

use super::Check;
use super::test_patterns::{RAMP, TestPictures};
use crate::device::RigConfig;
use gv3_codec::GreyPicture;

pub(super) const NAME: &str = "linearity";

/// Largest deviation from a line, of the range: it bends a plane by about as much of a fringe's three-step ripple.
const MOST_BEND: f64 = 0.02;
/// A pixel takes part when white is so much brighter than black.
const LEAST_SWING: u8 = 40;
/// Pixels that make a curve.
const LEAST_PIXELS: usize = 1000;

/// Draws the response curve of the rig, from the projector's level to the camera's.
pub(super) fn check(config: &RigConfig, test: &TestPictures) -> Check {
    let pictures = match &test.pictures {
        Ok(pictures) => &pictures[..RAMP],
        Err(reason) => return Check::skip(NAME, reason.clone()),
    };
    let Some(levels) = response(pictures, config.limits.mask.saturated_level) else {
        return Check::skip(NAME, "nothing in view is lit well enough to measure a response");
    };
    let projected: Vec<f64> = (0..RAMP).map(|i| test.ramp_level(i)).collect();
    let (bend, gamma) = (bend(&projected, &levels), gamma(&projected, &levels));
    let detail = format!("the response bends by {:.1} % of its range, gamma about {gamma:.2}", 100.0 * bend);
    match (bend <= MOST_BEND, &config.processing.gamma_file) {
        (true, _) => Check::pass(NAME, detail),
        (false, Some(file)) => Check::pass(NAME, format!("{detail}; {} corrects it", file.display())),
        (false, None) => {
            let action = "switch the projector's gamma correction off; or gv3 calibrate-gamma, and name its table in \
                          processing.gamma_file";
            Check::fail(NAME, detail, action)
        }
    }
}

/// Mean level of every picture over the pixels that are lit and not saturated.
fn response(pictures: &[GreyPicture], saturated_level: u8) -> Option<Vec<f64>> {
    let (white, black) = (&pictures[0].pixels, &pictures[RAMP / 2].pixels);
    let is_lit = |i: &usize| white[*i].saturating_sub(black[*i]) >= LEAST_SWING && white[*i] < saturated_level;
    let lit: Vec<usize> = (0..white.len()).filter(is_lit).collect();
    let mean = |p: &GreyPicture| lit.iter().map(|&i| u64::from(p.pixels[i])).sum::<u64>() as f64 / lit.len() as f64;
    (lit.len() >= LEAST_PIXELS).then(|| pictures.iter().map(mean).collect())
}

/// Largest distance from the least-squares line, of the line's range.
fn bend(projected: &[f64], seen: &[f64]) -> f64 {
    let n = projected.len() as f64;
    let (mean_x, mean_y) = (projected.iter().sum::<f64>() / n, seen.iter().sum::<f64>() / n);
    let pairs = || projected.iter().zip(seen).map(|(x, y)| (x - mean_x, y - mean_y));
    let slope = pairs().map(|(x, y)| x * y).sum::<f64>() / pairs().map(|(x, _)| x * x).sum::<f64>();
    let largest = pairs().map(|(x, y)| (y - slope * x).abs()).fold(0.0, f64::max);
    largest / (slope.abs() * 255.0)
}

/// Exponent of the response between black and white, by its logarithms.
fn gamma(projected: &[f64], seen: &[f64]) -> f64 {
    let (white, black) = (seen[0], seen[RAMP / 2]);
    let logs = projected.iter().zip(seen).filter_map(|(x, y)| {
        let (input, output) = (x / 255.0, (y - black) / (white - black));
        ((0.1..0.95).contains(&input) && output > 0.0).then(|| (input.ln(), output.ln()))
    });
    let (xy, xx) = logs.fold((0.0, 0.0), |(xy, xx), (x, y)| (xy + x * y, xx + x * x));
    xy / xx
}
