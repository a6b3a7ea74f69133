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

/// Orthonormal transform of a block of `side` x `side`, row-major, in place.
pub fn forward(block: &mut [f32], side: usize) {
    let scale = 1.0 / (64.0 * (side as f32).sqrt());
    let mut matrix = [0.0_f32; MAX_AREA];
    for x in 0..side {
        for k in 0..side {
            matrix[x * side + k] = element(side, k, x) as f32 * scale;
        }
    }
    let mut half = [0.0_f32; MAX_AREA];
    for (row, out) in block.chunks_exact(side).zip(half.chunks_exact_mut(side)).take(side) {
        for (v, m) in row.iter().zip(matrix.chunks_exact(side)) {
            add_scaled(out, m, *v);
        }
    }
    for (k, out) in block.chunks_exact_mut(side).enumerate().take(side) {
        out.fill(0.0);
        for (y, row) in half.chunks_exact(side).enumerate().take(side) {
            add_scaled(out, row, matrix[y * side + k]);
        }
    }
}

/// `out += factor * row`, in a form that keeps the order of additions and still fills vector registers.
fn add_scaled(out: &mut [f32], row: &[f32], factor: f32) {
    for (o, r) in out.iter_mut().zip(row) {
        *o += r * factor;
    }
}

/// Pixels of a block of `side` x `side` from its levels, `step` apart.
pub fn inverse(levels: &Levels, side: usize, step: i32, pixels: &mut [i32]) {
    let used = levels.extent.min(side);
    let mut rows = [0_i32; MAX_AREA];
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
            let mut block: Vec<f32> = values[..side * side].iter().map(|v| *v as f32).collect();
            forward(&mut block, side);
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
