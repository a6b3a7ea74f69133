//! What the head does when: smooth functions of time, closed mouth and open eyes at time 0.

use super::face::{smoothstep, squared};
use super::noise;
use glam::{Mat3, Vec3};
use std::f32::consts::TAU;

/// Amounts of every movement at one time; 0 is rest.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Posture {
    /// Jaw opening, radians.
    pub jaw_rad: f32,
    /// Mouth corners out and up, 0..=1.
    pub smile: f32,
    /// Lips forward and narrow, 0..=1.
    pub pucker: f32,
    /// Lids closed, 0..=1.
    pub blink: f32,
    /// Brows up, 0..=1.
    pub brow: f32,
    /// Rotation of the head.
    pub rotation: Mat3,
    /// Centre of the head in the scan frame, mm.
    pub centre_mm: Vec3,
}

/// Largest jaw opening, radians.
const JAW_RAD: f32 = 0.095;
/// Time between phrases and between blinks, seconds.
const PHRASE_SECONDS: f32 = 3.4;
const BLINK_SECONDS: f32 = 2.7;
/// Mean place of the head in the scan frame, and its turn towards the projector.
const CENTRE_MM: Vec3 = Vec3::new(0.0, 0.0, -602.0);
const YAW_RAD: f32 = 0.07;

fn swing(t: f32, hertz: f32) -> f32 {
    0.5 - 0.5 * libm::cosf(TAU * hertz * t)
}

/// Rotation by a yaw about y of a pitch about x of a roll about z, radians; the same on every machine.
fn turned(yaw_rad: f32, pitch_rad: f32, roll_rad: f32) -> Mat3 {
    let [(sy, cy), (sx, cx), (sz, cz)] = [yaw_rad, pitch_rad, roll_rad].map(|a| (libm::sinf(a), libm::cosf(a)));
    let yaw = Mat3::from_cols(Vec3::new(cy, 0.0, -sy), Vec3::Y, Vec3::new(sy, 0.0, cy));
    let pitch = Mat3::from_cols(Vec3::X, Vec3::new(0.0, cx, sx), Vec3::new(0.0, -sx, cx));
    let roll = Mat3::from_cols(Vec3::new(cz, sz, 0.0), Vec3::new(-sz, cz, 0.0), Vec3::Z);
    yaw * pitch * roll
}

impl Posture {
    /// The posture at a time; `amount` scales all movement, `seed` sets the head's sway.
    pub fn at(time_nanos: i64, seed: u64, amount: f32) -> Self {
        let t = (time_nanos as f64 * 1e-9) as f32;
        let speech = amount * smoothstep(0.1, 0.6, swing(t, 1.0 / PHRASE_SECONDS));
        let syllable = swing(t + 0.13 * libm::sinf(TAU * 0.61 * t), 2.1);
        let blink_phase = (t + 0.45 * BLINK_SECONDS) % BLINK_SECONDS / 0.32;
        let sway = |axis: u64, hertz: f32| {
            let start = TAU * noise::uniform(seed.wrapping_mul(16).wrapping_add(axis));
            amount * libm::sinf(TAU * hertz * t + start)
        };
        Self {
            jaw_rad: JAW_RAD * speech * (0.15 + 0.85 * syllable),
            smile: 0.8 * amount * swing(t, 0.23) * (1.0 - 0.4 * speech),
            pucker: 0.7 * speech * swing(t + 0.3, 0.95),
            blink: amount * if blink_phase < 1.0 { swing(blink_phase, 1.0) } else { 0.0 },
            brow: 0.9 * amount * squared(swing(t, 0.31)),
            rotation: turned(YAW_RAD + 0.035 * sway(1, 0.27), 0.03 * sway(2, 0.34), 0.015 * sway(3, 0.21)),
            centre_mm: CENTRE_MM + Vec3::new(2.5 * sway(4, 0.19), 2.0 * sway(5, 0.24), 3.0 * sway(6, 0.16)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn motion_has_no_jumps_in_value_or_speed_and_starts_at_rest() {
        let values = |millis: i64| {
            let p = Posture::at(millis * 1_000_000, 3, 1.0);
            [p.jaw_rad * 10.0, p.smile, p.pucker, p.blink, p.brow, p.centre_mm.x, p.rotation.x_axis.z * 10.0]
        };
        assert!(values(0)[..5].iter().all(|v| v.abs() < 1e-6));
        for millis in 1..10_000 {
            let (before, here, after) = (values(millis - 1), values(millis), values(millis + 1));
            for k in 0..7 {
                assert!((after[k] - here[k]).abs() < 0.03, "value {k} at {millis} ms");
                assert!((after[k] - 2.0 * here[k] + before[k]).abs() < 0.002, "speed {k} at {millis} ms");
            }
        }
    }

    #[test]
    fn no_amount_is_no_motion() {
        assert_eq!(Posture::at(0, 1, 0.0), Posture::at(1_234_567_890, 2, 0.0));
    }
}
