//! Local normalisation inside a mask: what is left is texture, free of shading and of camera gain.
//!
//! Normalised convolution (Knutsson, Westin: Normalized and differential convolution, CVPR 1993): local mean and variance
//! are ratios of blurred moments to the blurred mask, so pixels outside the mask have no say. The Gaussian is three box
//! filters (Wells: Efficient synthesis of Gaussian filters by cascaded uniform filters, PAMI 1986).

use super::{FloatPicture, Mask};

/// Gaussian sigma that suits skin and speckle at scanner resolution.
pub const GREY_SIGMA_PX: f32 = 6.0;
/// Added to the local variance of grey levels (squared): the noise of a flat patch is not blown up to texture.
pub const GREY_VARIANCE_FLOOR: f32 = 4.0;

/// Rows or columns that one filter run carries: three moments of eight lines keep the vector units busy.
const LANES: usize = 8;
/// Moments {mask, value, value²} of [`LANES`] neighbouring lines at one place along them.
type Moments = [f32; 3 * LANES];

/// `(value - local mean) / sqrt(local variance + variance_floor)` inside the mask, 0 outside.
/// Local is a Gaussian of `sigma_px` (made of boxes, so its sigma is met within 6 % from 3 px on, and is at least 1.4 px).
///
/// # Panics
/// When picture and mask differ in size.
pub fn normalize(picture: &FloatPicture, mask: &Mask, sigma_px: f32, variance_floor: f32) -> FloatPicture {
    against_local(picture, mask, sigma_px, |deviation, variance| deviation / (variance + variance_floor).sqrt())
}

/// `value - local mean` inside the mask, 0 outside; local as in [`normalize`].
///
/// # Panics
/// When picture and mask differ in size.
pub fn high_pass(picture: &FloatPicture, mask: &Mask, sigma_px: f32) -> FloatPicture {
    against_local(picture, mask, sigma_px, |deviation, _| deviation)
}

/// `judge(value - local mean, local variance)` at every pixel of the mask, 0 outside.
fn against_local(picture: &FloatPicture, mask: &Mask, sigma_px: f32, judge: impl Fn(f32, f32) -> f32) -> FloatPicture {
    assert_eq!(
        (picture.width_px, picture.height_px),
        (mask.width_px, mask.height_px),
        "picture and mask differ in size"
    );
    let (w, h) = (picture.width_px as usize, picture.height_px as usize);
    let offset = mean_inside(picture, mask);
    let radii = box_radii(sigma_px);
    let planes = blur_rows(picture, mask, offset, radii);
    let mut out = vec![0.0_f32; w * h];
    let mut line = Line::new(h, radii);
    for x0 in (0..w).step_by(LANES) {
        let columns = LANES.min(w - x0);
        for (y, at) in line.places().iter_mut().enumerate() {
            for (moment, plane) in at.chunks_exact_mut(LANES).zip(&planes) {
                moment[..columns].copy_from_slice(&plane[y * w + x0..][..columns]);
            }
        }
        line.blur();
        for (y, at) in line.places().iter().enumerate() {
            let (mut deviation, mut variance) = ([0.0_f32; LANES], [0.0_f32; LANES]);
            deviation[..columns].copy_from_slice(&picture.pixels[y * w + x0..][..columns]);
            for c in 0..LANES {
                let per_mass = 1.0 / at[c];
                let mean = at[LANES + c] * per_mass;
                variance[c] = (at[2 * LANES + c] * per_mass - mean * mean).max(0.0);
                deviation[c] = judge(deviation[c] - offset - mean, variance[c]);
            }
            let inside = &mask.inside[y * w + x0..][..columns];
            for ((out, &value), &inside) in out[y * w + x0..][..columns].iter_mut().zip(&deviation).zip(inside) {
                *out = if inside { value } else { 0.0 };
            }
        }
    }
    FloatPicture::new(picture.width_px, picture.height_px, out)
}

/// Mean of the values inside the mask; centring on it keeps the digits of the second moment.
fn mean_inside(picture: &FloatPicture, mask: &Mask) -> f32 {
    let (mut sum, mut count) = (0.0_f64, 0_usize);
    for (&v, &inside) in picture.pixels.iter().zip(&mask.inside) {
        sum += f64::from(if inside { v } else { 0.0 });
        count += usize::from(inside);
    }
    (sum / count.max(1) as f64) as f32
}

/// Planes of the moments {mask, value, value²}, blurred along the rows.
fn blur_rows(picture: &FloatPicture, mask: &Mask, offset: f32, radii: [usize; 3]) -> [Vec<f32>; 3] {
    let (w, h) = (picture.width_px as usize, picture.height_px as usize);
    let mut planes = [0, 1, 2].map(|_| vec![0.0_f32; w * h]);
    let mut line = Line::new(w, radii);
    for y0 in (0..h).step_by(LANES) {
        let rows = LANES.min(h - y0);
        for r in 0..rows {
            let (values, inside) = (&picture.pixels[(y0 + r) * w..][..w], &mask.inside[(y0 + r) * w..][..w]);
            for ((at, &value), &inside) in line.places().iter_mut().zip(values).zip(inside) {
                let d = if inside { value - offset } else { 0.0 };
                at[r] = f32::from(u8::from(inside));
                at[LANES + r] = d;
                at[2 * LANES + r] = d * d;
            }
        }
        line.blur();
        for (k, plane) in planes.iter_mut().enumerate() {
            for r in 0..rows {
                let row = &mut plane[(y0 + r) * w..][..w];
                row.iter_mut().zip(line.places()).for_each(|(out, at)| *out = at[k * LANES + r]);
            }
        }
    }
    planes
}

/// Radii of three boxes whose variances sum to `sigma_px²` as nearly as odd widths allow.
fn box_radii(sigma_px: f32) -> [usize; 3] {
    let ideal = (4.0 * sigma_px * sigma_px + 1.0).sqrt();
    let small = (((ideal - 1.0) * 0.5) as usize).max(1);
    let variance = |r: usize| (r * (r + 1)) as f32 / 3.0;
    let of = |large: usize| [0, 1, 2].map(|i| if i < large { small + 1 } else { small });
    let error = |large: usize| (of(large).map(variance).iter().sum::<f32>() - sigma_px * sigma_px).abs();
    let large = (1..=3).fold(0, |best, k| if error(k) < error(best) { k } else { best });
    of(large)
}

/// A bundle of rows or columns, between zeros wide enough that the running sums need no special ends.
struct Line {
    values: Vec<Moments>,
    spare: Vec<Moments>,
    radii: [usize; 3],
    pad: usize,
}

impl Line {
    fn new(len: usize, radii: [usize; 3]) -> Self {
        let pad = radii.iter().max().map_or(1, |r| r + 1);
        let zeros = vec![[0.0; 3 * LANES]; len + 2 * pad];
        Self { values: zeros.clone(), spare: zeros, radii, pad }
    }

    /// The moments along the line, without the zeros.
    fn places(&mut self) -> &mut [Moments] {
        let len = self.values.len() - 2 * self.pad;
        &mut self.values[self.pad..][..len]
    }

    /// Three running means, in place.
    fn blur(&mut self) {
        let len = self.values.len() - 2 * self.pad;
        for r in self.radii {
            let scale = 1.0 / (2 * r + 1) as f32;
            let mut sum = [0.0_f32; 3 * LANES];
            for at in &self.values[self.pad..][..r.min(len)] {
                for k in 0..3 * LANES {
                    sum[k] += at[k];
                }
            }
            let entering = &self.values[self.pad + r..][..len];
            let leaving = &self.values[self.pad - r - 1..][..len];
            let out = &mut self.spare[self.pad..][..len];
            for ((out, entering), leaving) in out.iter_mut().zip(entering).zip(leaving) {
                for k in 0..3 * LANES {
                    sum[k] += entering[k] - leaving[k];
                    out[k] = sum[k] * scale;
                }
            }
            std::mem::swap(&mut self.values, &mut self.spare);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wavy(w: usize, h: usize, gain: f32, offset: f32) -> FloatPicture {
        let at = |i: usize| {
            let (x, y) = ((i % w) as f32, (i / w) as f32);
            offset + gain * (20.0 * (0.7 * x + 0.2 * y).sin() + 10.0 * (0.31 * x - 0.9 * y).cos() + 0.2 * x)
        };
        FloatPicture::new(w as u32, h as u32, (0..w * h).map(at).collect())
    }

    /// Disk, so that rows and columns begin and end everywhere.
    fn disk(w: usize, h: usize) -> Mask {
        let (cx, cy, r) = (w as f32 * 0.45, h as f32 * 0.5, w.min(h) as f32 * 0.45);
        let inside = (0..w * h).map(|i| ((i % w) as f32 - cx).hypot((i / w) as f32 - cy) < r).collect();
        Mask::new(w as u32, h as u32, inside)
    }

    /// The definition with a true Gaussian, at one pixel.
    fn by_definition(p: &FloatPicture, m: &Mask, x: usize, y: usize, floor: f32) -> f32 {
        let (mut s0, mut s1, mut s2) = (0.0_f64, 0.0_f64, 0.0_f64);
        for (i, &v) in p.pixels.iter().enumerate().filter(|(i, _)| m.inside[*i]) {
            let (dx, dy) = ((i % p.width_px as usize) as f64 - x as f64, (i / p.width_px as usize) as f64 - y as f64);
            let g = (-(dx * dx + dy * dy) / 72.0).exp();
            let v = f64::from(v);
            (s0, s1, s2) = (s0 + g, s1 + g * v, s2 + g * v * v);
        }
        let mean = s1 / s0;
        let v = f64::from(p.pixels[y * p.width_px as usize + x]);
        ((v - mean) / (s2 / s0 - mean * mean + f64::from(floor)).sqrt()) as f32
    }

    #[test]
    fn agrees_with_the_definition_to_the_error_of_three_boxes() {
        let (p, m) = (wavy(90, 70, 1.0, 100.0), disk(90, 70));
        let n = normalize(&p, &m, GREY_SIGMA_PX, GREY_VARIANCE_FLOOR);
        for (x, y) in [(40, 35), (20, 30), (41, 6), (12, 35), (55, 20)] {
            assert!(m.inside[y * 90 + x]);
            let want = by_definition(&p, &m, x, y, GREY_VARIANCE_FLOOR);
            assert!((n.pixels[y * 90 + x] - want).abs() < 0.06, "{x},{y}: {} {want}", n.pixels[y * 90 + x]);
        }
    }

    #[test]
    fn what_lies_outside_the_mask_has_no_say_and_becomes_zero() {
        let (p, m) = (wavy(61, 50, 1.0, 90.0), disk(61, 50));
        let mut other = p.clone();
        for (v, _) in other.pixels.iter_mut().zip(&m.inside).filter(|(_, inside)| !**inside) {
            *v = 1000.0;
        }
        let (a, b) = (normalize(&p, &m, 6.0, 4.0), normalize(&other, &m, 6.0, 4.0));
        assert_eq!(a, b);
        assert!(a.pixels.iter().zip(&m.inside).all(|(v, inside)| *inside || *v == 0.0));
        assert!(a.pixels.iter().any(|v| v.abs() > 0.5));
    }

    #[test]
    fn gain_and_offset_of_the_camera_cancel() {
        let m = disk(80, 60);
        let (a, b) =
            (normalize(&wavy(80, 60, 1.0, 50.0), &m, 6.0, 0.0), normalize(&wavy(80, 60, 3.0, 10.0), &m, 6.0, 0.0));
        let worst = a.pixels.iter().zip(&b.pixels).map(|(x, y)| (x - y).abs()).fold(0.0, f32::max);
        assert!(worst < 2e-3, "{worst}");
    }

    #[test]
    fn flat_and_empty_pictures_give_zeros() {
        let flat = FloatPicture::new(30, 20, vec![77.0; 600]);
        assert!(normalize(&flat, &Mask::full(30, 20), 6.0, 4.0).pixels.iter().all(|v| v.abs() < 1e-4));
        assert!(normalize(&flat, &Mask::new(30, 20, vec![false; 600]), 6.0, 4.0).pixels.iter().all(|v| *v == 0.0));
        assert!(normalize(&FloatPicture::default(), &Mask::default(), 6.0, 4.0).pixels.is_empty());
        assert!(
            normalize(&FloatPicture::new(3, 1, vec![5.0; 3]), &Mask::full(3, 1), 6.0, 4.0)
                .pixels
                .iter()
                .all(|v| v.abs() < 1e-4)
        );
    }

    #[test]
    fn boxes_meet_the_sigma() {
        for sigma in [3.0_f32, 4.5, 6.0, 10.0] {
            let variance: f32 = box_radii(sigma).iter().map(|r| (r * (r + 1)) as f32 / 3.0).sum();
            assert!((variance.sqrt() / sigma - 1.0).abs() < 0.06, "{sigma}: {}", variance.sqrt());
        }
    }
}
