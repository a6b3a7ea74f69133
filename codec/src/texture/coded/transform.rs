//! Cosine transforms of 8x8, 16x16 and 32x32 blocks: the decoder's inverse in integers (matrix of ITU-T H.265, section
//! 8.6.4.2), the encoder's forward in floating point.

use super::levels::Levels;

/// Longest side of a block.
pub const MAX_SIDE: usize = 32;
/// Most pixels of a block.
pub const MAX_AREA: usize = MAX_SIDE * MAX_SIDE;
/// Bound of coefficients and of what is between the two passes.
const MAX_VALUE: i32 = 1 << 19;
/// Bits that the first pass takes off.
const FIRST_SHIFT: u32 = 8;

/// 64 √2 cos(k π / 64) for k = 0..32, as H.265 rounds it; row 0 is 64.
const COSINES: [i32; 33] = [
    64, 90, 90, 90, 89, 88, 87, 85, 83, 82, 80, 78, 75, 73, 70, 67, 64, 61, 57, 54, 50, 46, 43, 38, 36, 31, 25, 22, 18,
    13, 9, 4, 0,
];

/// Row k, column x: 64 √32 times the orthonormal transform. Its even rows' first halves are the 16-point matrix, and so on.
static MATRIX: [[i32; MAX_SIDE]; MAX_SIDE] = matrix();

const fn matrix() -> [[i32; MAX_SIDE]; MAX_SIDE] {
    let mut m = [[0; MAX_SIDE]; MAX_SIDE];
    let mut k = 0;
    while k < MAX_SIDE {
        let mut x = 0;
        while x < MAX_SIDE {
            // cos((2x + 1) k π / 64) by its symmetries.
            let angle = (2 * x + 1) * k % 128;
            let half = if angle > 64 { 128 - angle } else { angle };
            m[k][x] = if k == 0 {
                64
            } else if half > 32 {
                -COSINES[64 - half]
            } else {
                COSINES[half]
            };
            x += 1;
        }
        k += 1;
    }
    m
}

/// Element of the `side`-point matrix.
fn element(side: usize, k: usize, x: usize) -> i32 {
    MATRIX[k * (MAX_SIDE / side)][x]
}

/// Frequencies that encoders look for in each direction: higher ones of the largest blocks are left to smaller blocks.
const KEPT: usize = 16;

/// For each pixel of the first half of a row the even (0) or odd (1) rows of the matrix, orthonormal.
const fn half_matrix<const HALF: usize, const KEPT_HALF: usize>(odd: usize, root: f32) -> [[f32; KEPT_HALF]; HALF] {
    let mut m = [[0.0; KEPT_HALF]; HALF];
    let mut x = 0;
    while x < HALF {
        let mut j = 0;
        while j < KEPT_HALF {
            m[x][j] = MATRIX[(2 * j + odd) * (MAX_SIDE / (2 * HALF))][x] as f32 / (64.0 * root);
            j += 1;
        }
        x += 1;
    }
    m
}

const ROOT_8: f32 = 2.0 * std::f32::consts::SQRT_2;
const ROOT_32: f32 = 4.0 * std::f32::consts::SQRT_2;
static HALVES_8: [[[f32; 4]; 4]; 2] = [half_matrix(0, ROOT_8), half_matrix(1, ROOT_8)];
static HALVES_16: [[[f32; 8]; 8]; 2] = [half_matrix(0, 4.0), half_matrix(1, 4.0)];
static HALVES_32: [[[f32; 8]; 16]; 2] = [half_matrix(0, ROOT_32), half_matrix(1, ROOT_32)];

/// Orthonormal transform of a block of `side` x `side`, row-major; of the largest blocks the lower half of the frequencies
/// in each direction, 0 for the rest.
///
/// # Panics
/// When a slice is shorter than the block.
pub fn forward(block: &[f32], side: usize, out: &mut [f32]) {
    match side {
        8 => forward_sized::<8, 4, 4>(block, &HALVES_8, out),
        16 => forward_sized::<16, 8, 8>(block, &HALVES_16, out),
        _ => forward_sized::<MAX_SIDE, 16, { KEPT / 2 }>(block, &HALVES_32, out),
    }
}

/// Sums and differences of mirrored pixels give the even and the odd frequencies.
fn forward_sized<const SIDE: usize, const HALF: usize, const M: usize>(
    block: &[f32],
    halves: &[[[f32; M]; HALF]; 2],
    out: &mut [f32],
) {
    // Rows first; even frequencies, then odd ones.
    let mut rows = [[[0.0_f32; M]; 2]; SIDE];
    for (row, sums) in block.chunks_exact(SIDE).zip(&mut rows) {
        for x in 0..HALF {
            let (a, b) = (row[x], row[SIDE - 1 - x]);
            add_scaled(&mut sums[0], &halves[0][x], a + b);
            add_scaled(&mut sums[1], &halves[1][x], a - b);
        }
    }
    let out = &mut out[..SIDE * SIDE];
    out.fill(0.0);
    for v in 0..2 * M {
        let mut sums = [[0.0_f32; M]; 2];
        for (y, factors) in halves[v % 2].iter().enumerate() {
            let (above, below) = (&rows[y], &rows[SIDE - 1 - y]);
            let sign = if v % 2 == 0 { 1.0 } else { -1.0 };
            for ((sum, a), b) in sums.iter_mut().zip(above).zip(below) {
                let mirrored: [f32; M] = std::array::from_fn(|j| a[j] + sign * b[j]);
                add_scaled(sum, &mirrored, factors[v / 2]);
            }
        }
        for j in 0..M {
            out[v * SIDE + 2 * j] = sums[0][j];
            out[v * SIDE + 2 * j + 1] = sums[1][j];
        }
    }
}

/// `out += factor * row`, in a form that keeps the order of additions and still fills vector registers.
fn add_scaled<const M: usize>(out: &mut [f32; M], row: &[f32; M], factor: f32) {
    for (o, r) in out.iter_mut().zip(row) {
        *o += r * factor;
    }
}

/// Pixels of a block of `side` x `side` from its levels, `step` apart.
pub fn inverse(levels: &Levels, side: usize, step: i32, pixels: &mut [i32]) {
    let used = levels.extent.min(side);
    let mut rows = vec![0_i32; used * side];
    for (v, row) in rows.chunks_exact_mut(side).enumerate().take(used) {
        for u in 0..used.min(levels.extent - v) {
            let level = levels.values[v * side + u];
            if level != 0 {
                let coefficient = (level * step).clamp(-MAX_VALUE, MAX_VALUE);
                add_scaled_integers(row, &MATRIX[u * (MAX_SIDE / side)], coefficient);
            }
        }
        for r in row {
            *r = ((*r + (1 << (FIRST_SHIFT - 1))) >> FIRST_SHIFT).clamp(-MAX_VALUE, MAX_VALUE);
        }
    }
    let shift = 4 + side.ilog2();
    for (y, out) in pixels.chunks_exact_mut(side).enumerate().take(side) {
        out.fill(1 << (shift - 1));
        for (v, row) in rows.chunks_exact(side).enumerate().take(used) {
            add_scaled_integers(out, row, element(side, v, y));
        }
        out.iter_mut().for_each(|p| *p >>= shift);
    }
}

fn add_scaled_integers(out: &mut [i32], row: &[i32], factor: i32) {
    for (o, r) in out.iter_mut().zip(row) {
        *o += r * factor;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn rows_are_nearly_orthogonal() {
        for side in [8, 16, 32] {
            for a in 0..side {
                for b in 0..side {
                    let dot: i32 = (0..side).map(|x| element(side, a, x) * element(side, b, x)).sum();
                    let wanted = if a == b { 4096 * side as i32 } else { 0 };
                    assert!((dot - wanted).abs() <= 20 * side as i32, "{side}: {a} {b} {dot}");
                }
            }
        }
    }

    proptest! {
        #[test]
        fn the_inverse_undoes_the_transform(size in 0_usize..3, values in prop::collection::vec(-4080_i32..4080, MAX_AREA)) {
            let side = 8 << size;
            // Waves of the lower half of the frequencies, which is all that is looked for in the largest blocks.
            let wave = |x: usize, f: i32| element(MAX_SIDE, f.rem_euclid(KEPT as i32) as usize, x);
            let waves = |k: usize| {
                let one = |j: usize| values[j] / 4 * wave(k % 32, values[4 + j]) * wave(k / 32, values[8 + j]);
                (0..4).map(one).sum::<i32>() / 8100
            };
            let values: Vec<i32> =
                (0..side * side).map(|k| if side < MAX_SIDE { values[k] } else { waves(k) }).collect();
            let pixels: Vec<f32> = values.iter().map(|v| *v as f32).collect();
            let mut block = vec![0.0; side * side];
            forward(&pixels, side, &mut block);
            let levels = Levels { extent: 2 * side - 1, values: block.iter().map(|c| c.round() as i32).collect() };
            let mut back = vec![0; side * side];
            inverse(&levels, side, 1, &mut back);
            let square = |f: &dyn Fn(usize) -> i32| (0..side * side).map(|k| i64::from(f(k)).pow(2)).sum::<i64>();
            let (error, all) = (square(&|k| back[k] - values[k]), square(&|k| values[k]));
            prop_assert!(error <= all / 10_000 + (side * side) as i64, "{} of {}", error, all);
        }

        #[test]
        fn no_levels_overflow(size in 0_usize..3, values in prop::collection::vec(-(1 << 15)..=(1 << 15), MAX_AREA)) {
            let side = 8 << size;
            let levels = Levels { extent: 2 * side - 1, values: values[..side * side].to_vec() };
            inverse(&levels, side, 1 << 12, &mut vec![0; side * side]);
            let largest = Levels { extent: 2 * side - 1, values: vec![1 << 15; side * side] };
            inverse(&largest, side, 1 << 12, &mut vec![0; side * side]);
        }
    }
}
