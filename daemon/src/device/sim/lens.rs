//! A lens in single precision, for loops over vertices and pixels.

use crate::light::{Distortion, Intrinsics};

/// A lens; the model of [`Intrinsics`].
#[derive(Debug, Clone, Copy)]
pub struct Lens {
    f: [f32; 2],
    c: [f32; 2],
    k: [f32; 3],
    p: [f32; 2],
    /// Columns and rows.
    pub size_px: [usize; 2],
}

impl Lens {
    /// The same lens in single precision.
    pub fn new(intrinsics: &Intrinsics) -> Self {
        let Distortion { k1, k2, p1, p2, k3 } = intrinsics.distortion;
        Self {
            f: [intrinsics.fx_px as f32, intrinsics.fy_px as f32],
            c: [intrinsics.cx_px as f32, intrinsics.cy_px as f32],
            k: [k1 as f32, k2 as f32, k3 as f32],
            p: [p1 as f32, p2 as f32],
            size_px: [intrinsics.width_px as usize, intrinsics.height_px as usize],
        }
    }

    /// Pixel of normalized coordinates.
    #[inline(always)]
    pub fn px(&self, x: f32, y: f32) -> [f32; 2] {
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (self.k[0] + r2 * (self.k[1] + r2 * self.k[2]));
        let [p1, p2] = self.p;
        let dx = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x);
        let dy = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y;
        [self.f[0] * dx + self.c[0], self.f[1] * dy + self.c[1]]
    }
}
