//! What the projected fringes left in a texture is taken away: left in, it stays where it is while the skin moves, and
//! landmarks follow it instead.
//!
//! Local least squares: about each place `I = c + sum_k (a_k cos k phi + b_k sin k phi)`, k = 1..3, with the known phase
//! `phi` and Gaussian weights; the sum is subtracted. Products of sines are sines of sums, so the normal equations need but
//! the local means of cos and sin of 0..6 phi. Those and the coefficients vary slowly: they are kept one a cell.

use super::affine_flow::{cholesky, solve};
use super::{FloatPicture, Mask};
use std::f32::consts::TAU;

/// Gaussian weight of the local fit.
const SIGMA_PX: f32 = 8.0;
/// Side of a cell that shares its moments.
const CELL: usize = 4;
/// Reach of the Gaussian, cells.
const REACH: usize = 6;
const HARMONICS: usize = 3;
/// Unknowns: the mean, then cosines, then sines.
const UNKNOWNS: usize = 1 + 2 * HARMONICS;
/// Sums over a cell: cos 0..6 phi, sin 0..6 phi, then the picture with each unknown's function.
const MOMENTS: usize = 4 * HARMONICS + 2 + UNKNOWNS;
const SINES: usize = 2 * HARMONICS + 1;
const PICTURE: usize = 4 * HARMONICS + 2;
/// Keeps harmonics small that the pixels of a window cannot tell from shading (fringes much wider than the window), as a
/// share of the weight.
const RIDGE: f32 = 0.01;

/// The picture without harmonics 1 to 3 of the fringes whose phase is `phase_rad` (wrapped or absolute, any offset, the
/// same number of pixels). Pixels outside the mask or without a finite phase stay as they are.
///
/// # Panics
/// When picture, phase and mask differ in size.
pub fn remove_fringes(picture: &FloatPicture, phase_rad: &FloatPicture, mask: &Mask) -> FloatPicture {
    let size = (picture.width_px, picture.height_px);
    assert_eq!(size, (phase_rad.width_px, phase_rad.height_px), "picture and phase differ in size");
    assert_eq!(size, (mask.width_px, mask.height_px), "picture and mask differ in size");
    let (w, h) = (picture.width_px as usize, picture.height_px as usize);
    let columns = w.div_ceil(CELL);
    let known = |i: usize| mask.inside[i] && phase_rad.pixels[i].is_finite() && picture.pixels[i].is_finite();
    let offset = mean((0..w * h).filter(|&i| known(i)).map(|i| picture.pixels[i]));
    let mut cells = vec![[0.0_f32; MOMENTS]; columns * h.div_ceil(CELL)];
    for i in (0..w * h).filter(|&i| known(i)) {
        let cell = &mut cells[i / w / CELL * columns + i % w / CELL];
        add_pixel(cell, phase_rad.pixels[i], picture.pixels[i] - offset);
    }
    let fits: Vec<[f32; UNKNOWNS]> = blurred(&cells, columns).iter().map(fit).collect();
    let mut out = picture.clone();
    for i in (0..w * h).filter(|&i| known(i)) {
        let waves = waves::<{ HARMONICS + 1 }>(phase_rad.pixels[i]);
        let at = between(&fits, columns, i % w, i / w);
        out.pixels[i] -= (1..=HARMONICS).map(|k| at[k] * waves[k][0] + at[HARMONICS + k] * waves[k][1]).sum::<f32>();
    }
    out
}

fn mean(values: impl Iterator<Item = f32>) -> f32 {
    let (sum, count) = values.fold((0.0_f64, 0_u32), |(sum, count), v| (sum + f64::from(v), count + 1));
    (sum / f64::from(count.max(1))) as f32
}

/// {cos, sin} of `k` times the phase, k from 0.
fn waves<const N: usize>(phase_rad: f32) -> [[f32; 2]; N] {
    // Half a turn at most is left of the phase; Taylor's series of the quarter angle, doubled twice, is good to 1e-6.
    let turns = phase_rad * (1.0 / TAU);
    let quarter = (turns - turns.round()) * (TAU / 4.0);
    let x = quarter * quarter;
    let sin = quarter * (1.0 - x / 6.0 * (1.0 - x / 20.0 * (1.0 - x / 42.0)));
    let cos = 1.0 - x / 2.0 * (1.0 - x / 12.0 * (1.0 - x / 30.0 * (1.0 - x / 56.0)));
    let double = |[c, s]: [f32; 2]| [c * c - s * s, 2.0 * c * s];
    let [c, s] = double(double([cos, sin]));
    let mut waves = [[1.0, 0.0]; N];
    for k in 1..N {
        let [p, q] = waves[k - 1];
        waves[k] = [p * c - q * s, q * c + p * s];
    }
    waves
}

fn add_pixel(cell: &mut [f32; MOMENTS], phase_rad: f32, value: f32) {
    let waves = waves::<SINES>(phase_rad);
    for (m, [c, s]) in waves.into_iter().enumerate() {
        cell[m] += c;
        cell[SINES + m] += s;
    }
    for (k, [c, s]) in waves.into_iter().enumerate().take(HARMONICS + 1) {
        cell[PICTURE + k] += value * c;
        if k > 0 {
            cell[PICTURE + HARMONICS + k] += value * s;
        }
    }
}

/// Gaussian sums over cells, along columns and then along rows.
fn blurred(cells: &[[f32; MOMENTS]], columns: usize) -> Vec<[f32; MOMENTS]> {
    let weight = |d: usize| libm::expf(-0.5 * (d as f32 * CELL as f32 / SIGMA_PX).powi(2));
    let weights: Vec<f32> = (0..=REACH).map(weight).collect();
    let rows = cells.len() / columns.max(1);
    let pass = |from: &[[f32; MOMENTS]], place: &dyn Fn(usize) -> (usize, usize, usize)| -> Vec<[f32; MOMENTS]> {
        (0..from.len())
            .map(|i| {
                let (at, len, stride) = place(i);
                let mut sum = [0.0; MOMENTS];
                for j in at.saturating_sub(REACH)..(at + REACH + 1).min(len) {
                    let (other, weight) = (&from[i + j * stride - at * stride], weights[at.abs_diff(j)]);
                    sum.iter_mut().zip(other).for_each(|(sum, value)| *sum += weight * value);
                }
                sum
            })
            .collect()
    };
    let upright = pass(cells, &|i| (i / columns, rows, columns));
    pass(&upright, &|i| (i % columns, columns, 1))
}

/// The least-squares coefficients of one cell; zeros where too little is known.
fn fit(moments: &[f32; MOMENTS]) -> [f32; UNKNOWNS] {
    let cos = |m: usize| moments[m];
    let sin = |j: usize, k: usize| if j >= k { moments[SINES + j - k] } else { -moments[SINES + k - j] };
    let mut normal = [[0.0; UNKNOWNS]; UNKNOWNS];
    for j in 0..=HARMONICS {
        for k in 0..=j {
            let (difference, sum) = (cos(j - k), cos(j + k));
            normal[j][k] = 0.5 * (difference + sum);
            if k > 0 {
                normal[HARMONICS + j][HARMONICS + k] = 0.5 * (difference - sum);
            }
        }
        for k in (0..=HARMONICS).filter(|_| j > 0) {
            normal[HARMONICS + j][k] = 0.5 * (moments[SINES + j + k] + sin(j, k));
        }
    }
    for (k, row) in normal.iter_mut().enumerate().skip(1) {
        row[k] += RIDGE * cos(0);
    }
    let right = std::array::from_fn(|k| moments[PICTURE + k]);
    cholesky(normal).map_or([0.0; UNKNOWNS], |factor| solve(&factor, right))
}

/// Bilinear between the middles of the cells about pixel (x, y).
fn between(fits: &[[f32; UNKNOWNS]], columns: usize, x: usize, y: usize) -> [f32; UNKNOWNS] {
    let rows = fits.len() / columns;
    let place = |p: usize, len: usize| {
        let at = ((p as f32 + 0.5) / CELL as f32 - 0.5).clamp(0.0, (len - 1) as f32);
        (at as usize, (at as usize + 1).min(len - 1), at.fract())
    };
    let ((x0, x1, fx), (y0, y1, fy)) = (place(x, columns), place(y, rows));
    let [a, b, c, d] = [(x0, y0), (x1, y0), (x0, y1), (x1, y1)].map(|(x, y)| &fits[y * columns + x]);
    std::array::from_fn(|k| (1.0 - fy) * (a[k] + fx * (b[k] - a[k])) + fy * (c[k] + fx * (d[k] - c[k])))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::test_texture::{Warp, median, render};
    use crate::motion::{GREY_SIGMA_PX, GREY_VARIANCE_FLOOR, Tracker, TrackerOptions, normalize};

    const SIZE: (u32, u32) = (200, 150);

    /// Fringes of about 11 px, bent by a surface.
    fn phase() -> FloatPicture {
        let at = |i: u32| {
            let (x, y) = ((i % SIZE.0) as f32, (i / SIZE.0) as f32);
            x * TAU / 11.0 + 0.004 * (y - 75.0) * (y - 75.0) / 4.0 + 1.5 * (0.03 * x).sin() + 40.0
        };
        FloatPicture::new(SIZE.0, SIZE.1, (0..SIZE.0 * SIZE.1).map(at).collect())
    }

    /// Weak speckle on grey 120, and 3 % of that as a residue of the fringes.
    fn pictures(warp: &Warp) -> (FloatPicture, FloatPicture) {
        let mut clean = render(warp, SIZE.0, SIZE.1);
        clean.pixels.iter_mut().for_each(|v| *v = 120.0 + 2.4 * *v);
        let mut fringed = clean.clone();
        for (v, phase) in fringed.pixels.iter_mut().zip(phase().pixels) {
            *v += 3.6 * (phase + 0.7).cos() + 1.0 * (2.0 * phase - 0.4).cos() + 0.5 * (3.0 * phase).sin();
        }
        (clean, fringed)
    }

    fn rms(a: &FloatPicture, b: &FloatPicture) -> f32 {
        (a.pixels.iter().zip(&b.pixels).map(|(a, b)| (a - b) * (a - b)).sum::<f32>() / a.pixels.len() as f32).sqrt()
    }

    #[test]
    fn a_residue_on_flat_grey_goes_entirely() {
        let flat = FloatPicture::new(SIZE.0, SIZE.1, vec![120.0; (SIZE.0 * SIZE.1) as usize]);
        let mut fringed = flat.clone();
        fringed.pixels.iter_mut().zip(phase().pixels).for_each(|(v, p)| *v += 3.6 * (p + 0.7).cos() + (3.0 * p).sin());
        let left = rms(&remove_fringes(&fringed, &phase(), &Mask::full(SIZE.0, SIZE.1)), &flat);
        assert!(left < 0.05 * rms(&fringed, &flat), "{left} of {}", rms(&fringed, &flat));
    }

    #[test]
    fn most_of_the_residue_goes_and_most_of_the_speckle_stays() {
        let (clean, fringed) = pictures(&Warp::still());
        let left = rms(&remove_fringes(&fringed, &phase(), &Mask::full(SIZE.0, SIZE.1)), &clean);
        assert!(left < 0.35 * rms(&fringed, &clean), "{left} of {}", rms(&fringed, &clean));
    }

    #[test]
    fn landmarks_follow_the_speckle_only_when_the_fringes_are_gone() {
        let mask = Mask::full(SIZE.0, SIZE.1);
        let warp = |k: u32| Warp::shift(1.1 * k as f32, 0.6 * k as f32);
        let errors_px = |remove: bool| {
            let mut tracker = Tracker::new(TrackerOptions::default());
            let mut first = Vec::new();
            for k in 0..=8 {
                let (_, mut picture) = pictures(&warp(k));
                if remove {
                    picture = remove_fringes(&picture, &phase(), &mask);
                }
                let picture = normalize(&picture, &mask, GREY_SIGMA_PX, GREY_VARIANCE_FLOOR);
                tracker.feed_normalized(&picture, &mask, false);
                if k == 0 {
                    first = tracker.tracks().to_vec();
                }
            }
            let error = |t: &crate::motion::Track| {
                let want = warp(8).apply(first.iter().find(|f| f.id == t.id)?.px);
                Some((t.px[0] - want[0]).hypot(t.px[1] - want[1]))
            };
            let errors: Vec<f32> = tracker.tracks().iter().filter_map(error).collect();
            (errors.len(), median(&errors))
        };
        let ((_, with), (kept, without)) = (errors_px(false), errors_px(true));
        assert!(with > 2.0, "fringes must mislead, or this test proves nothing: {with} px");
        assert!(kept > 60 && without < 0.3, "{kept} kept, {without} px");
    }

    #[test]
    fn unknown_phase_and_empty_pictures_change_nothing() {
        let (_, fringed) = pictures(&Warp::still());
        let mut unknown = phase();
        unknown.pixels.fill(f32::NAN);
        assert_eq!(remove_fringes(&fringed, &unknown, &Mask::full(SIZE.0, SIZE.1)), fringed);
        let none = Mask::new(SIZE.0, SIZE.1, vec![false; fringed.pixels.len()]);
        assert_eq!(remove_fringes(&fringed, &phase(), &none), fringed);
        assert!(remove_fringes(&FloatPicture::default(), &FloatPicture::default(), &Mask::default()).pixels.is_empty());
    }

    #[test]
    fn waves_are_cosines_and_sines() {
        for i in -60..60 {
            let phase_rad = 0.37 * i as f32;
            for (k, [c, s]) in waves::<7>(phase_rad).into_iter().enumerate() {
                let (sin, cos) = (k as f64 * f64::from(phase_rad)).sin_cos();
                assert!((f64::from(c) - cos).abs() < 2e-5 && (f64::from(s) - sin).abs() < 2e-5, "{phase_rad} {k}");
            }
        }
    }
}
