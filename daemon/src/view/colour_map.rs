//! Colours for errors: viridis, which grows evenly in lightness and is read alike by colour-blind eyes.

use super::text::{TextSize, draw_text};
use image::{Rgb, RgbImage};

/// Viridis at ten even steps (S. van der Walt and N. Smith, 2015, released under CC0).
const VIRIDIS: [[u8; 3]; 10] = [
    [0x44, 0x01, 0x54],
    [0x48, 0x28, 0x78],
    [0x3e, 0x4a, 0x89],
    [0x31, 0x68, 0x8e],
    [0x26, 0x82, 0x8e],
    [0x1f, 0x9e, 0x89],
    [0x35, 0xb7, 0x79],
    [0x6d, 0xcd, 0x59],
    [0xb4, 0xde, 0x2c],
    [0xfd, 0xe7, 0x25],
];

/// Colour of values that are not numbers.
pub const NO_VALUE: [u8; 3] = [170, 170, 170];

/// Viridis at `t` from 0 (dark) to 1 (bright), clamped; [`NO_VALUE`] for NaN.
pub fn viridis(t: f32) -> [u8; 3] {
    if t.is_nan() {
        return NO_VALUE;
    }
    let place = t.clamp(0.0, 1.0) * (VIRIDIS.len() - 1) as f32;
    let step = (place as usize).min(VIRIDIS.len() - 2);
    let rest = place - step as f32;
    std::array::from_fn(|k| {
        let (a, b) = (f32::from(VIRIDIS[step][k]), f32::from(VIRIDIS[step + 1][k]));
        (a + (b - a) * rest + 0.5) as u8
    })
}

/// Colours of errors from 0 to `full_scale_mm`.
pub fn error_colours(errors_mm: &[f32], full_scale_mm: f32) -> Vec<[u8; 3]> {
    errors_mm.iter().map(|&e| viridis(e / full_scale_mm)).collect()
}

/// The scale for a set of errors: 1, 2 or 5 times a power of ten that reaches the 99th percentile, so that single
/// outliers do not darken the rest. One micrometre when there are none.
pub fn full_scale_mm(errors_mm: &[f32]) -> f32 {
    let mut finite: Vec<f32> = errors_mm.iter().copied().filter(|e| e.is_finite()).collect();
    let Some(last) = finite.len().checked_sub(1) else { return 0.001 };
    let (_, &mut percentile, _) = finite.select_nth_unstable_by(last * 99 / 100, f32::total_cmp);
    let decades = (-3..6).flat_map(|power| [1.0, 2.0, 5.0].map(|digit| digit * 10_f64.powi(power)));
    decades.map(|scale| scale as f32).find(|&scale| scale >= percentile).unwrap_or(percentile)
}

/// Labelled steps of the legend bar: five divide 1, 2 and 5 evenly.
const STEPS: u32 = 5;

/// Draws an upright legend bar with six labels to its right: 0 at the bottom, `full_scale_mm` on top.
pub fn draw_bar(
    image: &mut RgbImage,
    [left, top]: [u32; 2],
    [width, height]: [u32; 2],
    full_scale_mm: f32,
    ink: [u8; 3],
) {
    for y in 0..height {
        let colour = viridis(1.0 - y as f32 / (height - 1) as f32);
        for x in 0..width {
            image.put_pixel(left + x, top + y, Rgb(colour));
        }
    }
    let step_mm = f64::from(full_scale_mm) / f64::from(STEPS);
    // The scale was rounded to f32; a little more keeps 0.01 from counting as 0.00999.
    let decimals = (-(step_mm * 1.001).log10().floor()).max(0.0) as usize;
    for tick in 0..=STEPS {
        let y = top + (height - 1) * (STEPS - tick) / STEPS;
        for x in 0..5 {
            image.put_pixel(left + width + x, y, Rgb(ink));
        }
        let label = format!("{:.decimals$}", step_mm * f64::from(tick));
        let label_top = y.saturating_sub(TextSize::Small.height_px() / 2);
        draw_text(image, &label, [left + width + 10, label_top], TextSize::Small, ink);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn viridis_meets_its_steps_and_brightens_all_the_way() {
        assert_eq!(viridis(0.0), VIRIDIS[0]);
        assert_eq!(viridis(1.0 / 3.0), VIRIDIS[3]);
        assert_eq!((viridis(1.0), viridis(7.0), viridis(-1.0)), (VIRIDIS[9], VIRIDIS[9], VIRIDIS[0]));
        assert_eq!(viridis(f32::NAN), NO_VALUE);
        let luma = |t: f32| {
            let [r, g, b] = viridis(t).map(f32::from);
            0.2126 * r + 0.7152 * g + 0.0722 * b
        };
        assert!((0..100).all(|i| luma(i as f32 / 100.0) < luma((i + 1) as f32 / 100.0) + 0.8));
    }

    #[test]
    fn scales_are_round_and_ignore_single_outliers() {
        let mut errors: Vec<f32> = (0..1000).map(|i| i as f32 * 3e-5).collect();
        assert_eq!(full_scale_mm(&errors), 0.05);
        errors[7] = 80.0;
        errors[8] = f32::NAN;
        assert_eq!(full_scale_mm(&errors), 0.05);
        assert_eq!(full_scale_mm(&[]), 0.001);
        assert_eq!(full_scale_mm(&[1.0]), 1.0);
        assert_eq!(error_colours(&[0.0, 0.05], 0.05), [VIRIDIS[0], VIRIDIS[9]]);
    }
}
