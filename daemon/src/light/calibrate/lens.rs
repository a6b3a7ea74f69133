//! Projection through a lens with its derivatives.

use super::super::Intrinsics;
use glam::{DVec2, DVec3};

/// Parameters of a lens: fx fy cx cy k1 k2 p1 p2 k3.
pub(super) const LENS_PARAMETERS: usize = 9;

/// A projected point and how it moves.
pub(super) struct Projected {
    /// Pixel.
    pub px: DVec2,
    /// Derivatives of column and row by the point, px/mm.
    pub by_point: [DVec3; 2],
    /// Derivatives of column and row by the parameters of the lens.
    pub by_lens: [[f64; LENS_PARAMETERS]; 2],
}

/// Pixel of a point in front of the lens, with derivatives of [`Intrinsics::project`].
pub(super) fn project(lens: &Intrinsics, point_mm: DVec3) -> Projected {
    let inverse_z = 1.0 / point_mm.z;
    let DVec2 { x, y } = point_mm.truncate() * inverse_z;
    let d = lens.distortion;
    let (x2, y2, xy) = (x * x, y * y, x * y);
    let r2 = x2 + y2;
    let radial = 1.0 + r2 * (d.k1 + r2 * (d.k2 + r2 * d.k3));
    // Derivative of `radial` by r2.
    let slope = d.k1 + r2 * (2.0 * d.k2 + 3.0 * d.k3 * r2);
    let u = x * radial + 2.0 * d.p1 * xy + d.p2 * (r2 + 2.0 * x2);
    let v = y * radial + d.p1 * (r2 + 2.0 * y2) + 2.0 * d.p2 * xy;
    let u_x = radial + 2.0 * slope * x2 + 2.0 * d.p1 * y + 6.0 * d.p2 * x;
    let cross = 2.0 * slope * xy + 2.0 * d.p1 * x + 2.0 * d.p2 * y;
    let v_y = radial + 2.0 * slope * y2 + 6.0 * d.p1 * y + 2.0 * d.p2 * x;
    let (fx, fy) = (lens.fx_px, lens.fy_px);
    let (r4, r6) = (r2 * r2, r2 * r2 * r2);
    Projected {
        px: DVec2::new(fx * u + lens.cx_px, fy * v + lens.cy_px),
        by_point: [
            DVec3::new(u_x, cross, -(u_x * x + cross * y)) * (fx * inverse_z),
            DVec3::new(cross, v_y, -(cross * x + v_y * y)) * (fy * inverse_z),
        ],
        by_lens: [
            [u, 0.0, 1.0, 0.0, fx * x * r2, fx * x * r4, fx * 2.0 * xy, fx * (r2 + 2.0 * x2), fx * x * r6],
            [0.0, v, 0.0, 1.0, fy * y * r2, fy * y * r4, fy * (r2 + 2.0 * y2), fy * 2.0 * xy, fy * y * r6],
        ],
    }
}

/// The parameters in the order of [`LENS_PARAMETERS`].
pub(super) fn parameters(lens: &Intrinsics) -> [f64; LENS_PARAMETERS] {
    let d = lens.distortion;
    [lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px, d.k1, d.k2, d.p1, d.p2, d.k3]
}

/// The lens with other parameters.
pub(super) fn with_parameters(lens: &Intrinsics, p: [f64; LENS_PARAMETERS]) -> Intrinsics {
    let [fx_px, fy_px, cx_px, cy_px, k1, k2, p1, p2, k3] = p;
    let distortion = super::super::Distortion { k1, k2, p1, p2, k3 };
    Intrinsics { fx_px, fy_px, cx_px, cy_px, distortion, ..*lens }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::light::calibration::tests::rig;

    #[test]
    fn derivatives_are_those_of_the_projection() {
        let mut lens = rig().camera;
        lens.distortion.k3 = 0.3;
        for p in [DVec3::new(90.0, -70.0, 600.0), DVec3::new(-150.0, 110.0, 480.0), DVec3::new(0.0, 5.0, 700.0)] {
            let found = project(&lens, p);
            assert!((found.px - lens.project(p)).length() < 1e-10);
            let check = |plus: DVec2, minus: DVec2, step: f64, analytic: [f64; 2]| {
                let difference = (plus - minus) / (2.0 * step);
                let size = 1.0 + difference.abs().max_element();
                assert!((difference - DVec2::from_array(analytic)).abs().max_element() < 1e-6 * size);
            };
            for axis in 0..3 {
                let step = DVec3::AXES[axis] * 1e-3;
                let analytic = [found.by_point[0][axis], found.by_point[1][axis]];
                check(lens.project(p + step), lens.project(p - step), 1e-3, analytic);
            }
            for i in 0..LENS_PARAMETERS {
                let step = if i < 4 { 1e-2 } else { 1e-5 };
                let moved = |by: f64| {
                    let mut parameters = parameters(&lens);
                    parameters[i] += by;
                    with_parameters(&lens, parameters).project(p)
                };
                check(moved(step), moved(-step), step, [found.by_lens[0][i], found.by_lens[1][i]]);
            }
        }
    }
}
