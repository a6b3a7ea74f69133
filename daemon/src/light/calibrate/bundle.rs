//! Reprojection errors of a rig over all views, and their derivatives.
//!
//! A corner X of the board is at X_c = R_v X + t_v before the camera and at X_p = R X_c + t before the projector. Its
//! errors are the two of the camera's pixel and, where it was decoded, the two of the projector's. Rotations move by a
//! small rotation vector w from the left, exp(w) R, so that no parameterisation has a singular point.

use super::super::{Calibration, Rigid};
use super::lens::{LENS_PARAMETERS, parameters, project, with_parameters};
use super::zhang::Pose;
use glam::{DMat3, DQuat, DVec2, DVec3};

/// Parameters that all views share: both lenses, then rotation vector and translation of projector_from_camera.
pub(super) const SHARED: usize = 2 * LENS_PARAMETERS + 6;
/// Parameters of a board's pose: rotation vector and translation.
pub(super) const POSE: usize = 6;

/// A corner of the board in one view.
#[derive(Debug, Clone, Copy)]
pub(super) struct Corner {
    pub board_mm: DVec2,
    pub camera_px: DVec2,
    pub projector_px: Option<DVec2>,
    /// Taken as an outlier of the camera, and with it the projector's coordinate that was read there.
    pub camera_rejected: bool,
    pub projector_rejected: bool,
}

impl Corner {
    /// Measurements in use: none, the camera's two, or all four.
    fn used_rows(&self) -> usize {
        match self.projector_px {
            _ if self.camera_rejected => 0,
            Some(_) if !self.projector_rejected => 4,
            _ => 2,
        }
    }
}

/// One view of the board.
#[derive(Debug, Clone)]
pub(super) struct View {
    pub pose: Pose,
    pub corners: Vec<Corner>,
}

/// Inverse of the lower Cholesky factor of the covariance of a corner's four measurements, 1/px, by rows.
///
/// Its first two rows whiten the camera's errors alone; the last two the projector's given the camera's: a corner found
/// beside its place in the picture is decoded beside it too, so the errors of both devices go together.
pub(super) type Whitening = [[f64; 4]; 4];

/// A rig, its views, and what is known of the noise.
#[derive(Debug, Clone)]
pub(super) struct Bundle {
    pub rig: Calibration,
    pub views: Vec<View>,
    /// Shared parameters to estimate, as indices below [`SHARED`].
    pub free: Vec<usize>,
    pub whitening: Whitening,
    /// From this many standard deviations on errors count linearly (P. Huber, 1964); infinite for least squares.
    pub huber: f64,
}

/// Errors of a corner and their derivatives by the shared parameters and the pose.
pub(super) struct Block {
    pub rows: usize,
    pub error: [f64; 4],
    pub shared: [[f64; SHARED]; 4],
    pub pose: [[f64; POSE]; 4],
}

impl Bundle {
    /// Measured minus projected pixels: the camera's, then the projector's; `None` for a corner not in front of a lens.
    pub fn errors(&self, view: &View, corner: &Corner) -> (Option<DVec2>, Option<DVec2>) {
        let point = view.pose.apply(corner.board_mm.extend(0.0));
        let in_projector = self.rig.projector_from_camera.apply(point);
        let camera = (point.z > 0.0).then(|| corner.camera_px - self.rig.camera.project(point));
        let projector = corner.projector_px.filter(|_| in_projector.z > 0.0);
        (camera, projector.map(|px| px - self.rig.projector.project(in_projector)))
    }

    /// Half the (robust) sum of the squared whitened errors; infinite when a corner is behind a lens.
    pub fn cost(&self) -> f64 {
        let corner_cost = |view: &View, corner: &Corner| {
            let rows = corner.used_rows();
            if rows == 0 {
                return 0.0;
            }
            let (camera, projector) = self.errors(view, corner);
            let Some(camera) = camera else { return f64::INFINITY };
            let pairs = self.whitened(camera, projector.unwrap_or_default()).into_iter();
            if rows == 4 && projector.is_none() {
                return f64::INFINITY;
            }
            let loss = |r: f64| if r <= self.huber { 0.5 * r * r } else { self.huber * (r - 0.5 * self.huber) };
            pairs.take(rows / 2).map(loss).sum()
        };
        self.views.iter().map(|view| view.corners.iter().map(|c| corner_cost(view, c)).sum::<f64>()).sum()
    }

    /// Lengths of the whitened errors of a corner in the camera and in the projector.
    pub fn whitened(&self, camera: DVec2, projector: DVec2) -> [f64; 2] {
        let r = whiten(&self.whitening, [camera.x, camera.y, projector.x, projector.y]);
        [r[0].hypot(r[1]), r[2].hypot(r[3])]
    }

    /// Errors and derivatives of a corner, in pixels; the rows that are not in use are zero.
    pub fn block(&self, view: &View, corner: &Corner) -> Block {
        let rows = corner.used_rows();
        let mut block = Block { rows, error: [0.0; 4], shared: [[0.0; SHARED]; 4], pose: [[0.0; POSE]; 4] };
        if rows == 0 {
            return block;
        }
        let turned = view.pose.rotation * corner.board_mm.extend(0.0);
        let point = turned + view.pose.translation_mm;
        let camera = project(&self.rig.camera, point);
        let error = corner.camera_px - camera.px;
        for row in 0..2 {
            block.error[row] = error[row];
            block.shared[row][..LENS_PARAMETERS].copy_from_slice(&camera.by_lens[row]);
            block.pose[row] = rigid_derivative(turned, camera.by_point[row]);
        }
        if let (4, Some(projector_px)) = (rows, corner.projector_px) {
            let rotation = self.rig.projector_from_camera.matrix();
            let rotated = rotation * point;
            let projector = project(&self.rig.projector, rotated + self.rig.projector_from_camera.translation());
            let error = projector_px - projector.px;
            for row in 0..2 {
                block.error[2 + row] = error[row];
                let shared = &mut block.shared[2 + row];
                shared[LENS_PARAMETERS..2 * LENS_PARAMETERS].copy_from_slice(&projector.by_lens[row]);
                shared[2 * LENS_PARAMETERS..].copy_from_slice(&rigid_derivative(rotated, projector.by_point[row]));
                block.pose[2 + row] = rigid_derivative(turned, rotation.transpose() * projector.by_point[row]);
            }
        }
        block
    }

    /// [`Self::block`] in standard deviations, weighted for the robust loss.
    pub fn whitened_block(&self, view: &View, corner: &Corner) -> Block {
        let raw = self.block(view, corner);
        let mut block = Block { rows: raw.rows, error: [0.0; 4], shared: [[0.0; SHARED]; 4], pose: [[0.0; POSE]; 4] };
        block.error = whiten(&self.whitening, raw.error);
        for (row, weights) in self.whitening.iter().enumerate().take(raw.rows) {
            for (from, weight) in weights.iter().enumerate().take(row + 1) {
                for (to, from) in block.shared[row].iter_mut().zip(&raw.shared[from]) {
                    *to += weight * from;
                }
                for (to, from) in block.pose[row].iter_mut().zip(&raw.pose[from]) {
                    *to += weight * from;
                }
            }
        }
        for pair in (0..raw.rows).step_by(2) {
            let length = block.error[pair].hypot(block.error[pair + 1]);
            if length > self.huber {
                let weight = (self.huber / length).sqrt();
                for row in pair..pair + 2 {
                    block.error[row] *= weight;
                    block.shared[row].iter_mut().for_each(|v| *v *= weight);
                    block.pose[row].iter_mut().for_each(|v| *v *= weight);
                }
            }
        }
        block
    }

    /// The bundle moved by a step of the free shared parameters and of every pose.
    pub fn moved(&self, shared: &[f64], poses: &[[f64; POSE]]) -> Self {
        let mut moved = self.clone();
        let mut full = [0.0; SHARED];
        self.free.iter().zip(shared).for_each(|(&at, &by)| full[at] = by);
        moved.rig = moved_rig(&self.rig, &full);
        for (view, step) in moved.views.iter_mut().zip(poses) {
            view.pose = moved_pose(&view.pose, step);
        }
        moved
    }

    /// Measurements in use.
    pub fn measurements(&self) -> usize {
        self.views.iter().flat_map(|v| &v.corners).map(Corner::used_rows).sum()
    }

    /// Parameters to estimate.
    pub fn unknowns(&self) -> usize {
        self.free.len() + POSE * self.views.len()
    }
}

/// The rig with a step of every shared parameter.
pub(super) fn moved_rig(rig: &Calibration, step: &[f64; SHARED]) -> Calibration {
    let lens = |lens, at: usize| {
        let mut values = parameters(lens);
        values.iter_mut().zip(&step[at..]).for_each(|(v, by)| *v += by);
        with_parameters(lens, values)
    };
    let rigid = rig.projector_from_camera;
    let pose = Pose { rotation: rigid.matrix(), translation_mm: rigid.translation() };
    let mut rigid_step = [0.0; POSE];
    rigid_step.copy_from_slice(&step[2 * LENS_PARAMETERS..]);
    let pose = moved_pose(&pose, &rigid_step);
    Calibration {
        camera: lens(&rig.camera, 0),
        projector: lens(&rig.projector, LENS_PARAMETERS),
        projector_from_camera: Rigid::new(pose.rotation, pose.translation_mm),
    }
}

fn moved_pose(pose: &Pose, step: &[f64; POSE]) -> Pose {
    let [a, b, c, x, y, z] = *step;
    // Through a unit quaternion, so that a long run of steps leaves a rotation.
    let rotation = DQuat::from_scaled_axis(DVec3::new(a, b, c)) * DQuat::from_mat3(&pose.rotation).normalize();
    Pose { rotation: DMat3::from_quat(rotation.normalize()), translation_mm: pose.translation_mm + DVec3::new(x, y, z) }
}

/// Derivative along `by_point` of a point that turns and shifts: (w x p) . g = w . (p x g).
fn rigid_derivative(turned: DVec3, by_point: DVec3) -> [f64; POSE] {
    let w = turned.cross(by_point);
    [w.x, w.y, w.z, by_point.x, by_point.y, by_point.z]
}

fn whiten(whitening: &Whitening, error: [f64; 4]) -> [f64; 4] {
    whitening.map(|row| row.iter().zip(&error).map(|(a, b)| a * b).sum())
}

#[cfg(test)]
mod tests {
    use super::super::tests::{Noise, simulated_bundle};
    use super::*;

    #[test]
    fn derivatives_are_those_of_the_errors() {
        let mut bundle = simulated_bundle(5, &Noise { camera_px: 0.3, projector_px: 0.3, seed: 3 });
        bundle.whitening = [[2.0, 0.0, 0.0, 0.0], [0.5, 3.0, 0.0, 0.0], [-0.4, 0.2, 1.5, 0.0], [0.1, -0.3, 0.2, 2.5]];
        bundle.free = (0..SHARED).collect();
        let errors = |bundle: &Bundle, view: usize, corner: usize| {
            let view = &bundle.views[view];
            whiten(&bundle.whitening, bundle.block(view, &view.corners[corner]).error)
        };
        for view in 0..bundle.views.len() {
            let is_full = |c: &Corner| c.used_rows() == 4;
            let corner = bundle.views[view].corners.iter().rposition(is_full).unwrap();
            let block = bundle.whitened_block(&bundle.views[view], &bundle.views[view].corners[corner]);
            assert_eq!(block.error, errors(&bundle, view, corner));
            for i in 0..SHARED + POSE {
                let is_distortion = i < 2 * LENS_PARAMETERS && i % LENS_PARAMETERS >= 4;
                let is_turn =
                    (2 * LENS_PARAMETERS..2 * LENS_PARAMETERS + 3).contains(&i) || (SHARED..SHARED + 3).contains(&i);
                let step = if is_distortion || is_turn { 1e-5 } else { 1e-2 };
                let at = |by: f64| {
                    let (mut shared, mut poses) = (vec![0.0; SHARED], vec![[0.0; POSE]; bundle.views.len()]);
                    if i < SHARED {
                        shared[i] = by
                    } else {
                        poses[view][i - SHARED] = by
                    }
                    errors(&bundle.moved(&shared, &poses), view, corner)
                };
                let (plus, minus) = (at(step), at(-step));
                for row in 0..4 {
                    // Errors are measured minus projected: they fall where the projection rises.
                    let difference = (minus[row] - plus[row]) / (2.0 * step);
                    let found = if i < SHARED { block.shared[row][i] } else { block.pose[row][i - SHARED] };
                    assert!((difference - found).abs() < 1e-5 * (1.0 + found.abs()), "{i} {row}: {difference} {found}");
                }
            }
        }
    }
}
