//! Sums of radial kernels at many points, the inner loop of every warp.

use glam::DVec2;

/// Points that are summed at together, coordinates apart, so that vector units take several at once; their sums stay in
/// the first-level cache while the centres go by.
const BLOCK: usize = 64;

/// Adds sum_k w_k K_k(|z - p_k|^2, 1 - |z|^2) to the image of each point z, over the `terms` (p_k, w_k, K_k) in order: bit
/// for bit what a loop over the terms gives for one point.
pub(super) fn add_kernels<K: Fn(f64, f64) -> f64>(
    points: &[DVec2],
    images: &mut [DVec2],
    terms: impl Iterator<Item = (DVec2, DVec2, K)> + Clone,
) {
    for (points, images) in points.chunks(BLOCK).zip(images.chunks_mut(BLOCK)) {
        let [mut x, mut y, mut room, mut sum_x, mut sum_y] = [[0.0; BLOCK]; 5];
        for (i, (z, image)) in points.iter().zip(images.iter()).enumerate() {
            (x[i], y[i], room[i]) = (z.x, z.y, 1.0 - z.length_squared());
            (sum_x[i], sum_y[i]) = (image.x, image.y);
        }
        for (p, w, kernel) in terms.clone() {
            for i in 0..BLOCK {
                let (dx, dy) = (x[i] - p.x, y[i] - p.y);
                let k = kernel(dx * dx + dy * dy, room[i]);
                sum_x[i] += w.x * k;
                sum_y[i] += w.y * k;
            }
        }
        for (image, (&x, &y)) in images.iter_mut().zip(sum_x.iter().zip(&sum_y)) {
            *image = DVec2::new(x, y);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_of_any_length_give_what_single_points_give() {
        let spot = |k: u32| DVec2::from_angle(f64::from(k) * 2.399) * (f64::from(k) / 200.0).sqrt();
        let kernel = |scale: f64| move |distance2: f64, room: f64| scale * distance2 * room + distance2 / 3.0;
        let terms = (0..7).map(|k| (spot(3 * k), spot(k + 50), kernel(f64::from(k))));
        for count in [0, 1, 63, 64, 65, 200] {
            let points: Vec<DVec2> = (0..count).map(spot).collect();
            let mut images = points.clone();
            add_kernels(&points, &mut images, terms.clone());
            for (&z, image) in points.iter().zip(images) {
                let room = 1.0 - z.length_squared();
                let one = terms.clone().fold(z, |sum, (p, w, kernel)| sum + w * kernel(z.distance_squared(p), room));
                assert_eq!(image, one);
            }
        }
    }
}
