//! Quantization steps of a run in the default mode: part of its stream header.

use super::motion_code::MotionSteps;
use crate::Result;
use crate::bits::bytes::{ByteReader, put_varint};

/// Largest step, units or 2^-14.
const MAX_STEP: u64 = 4096;

/// Steps of everything that is coded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Steps {
    /// Of motions.
    pub motion: MotionSteps,
    /// Of depth patches, units.
    pub patch: i32,
    /// Of a base's control points, units.
    pub control: i32,
    /// Of a base's displacements, units.
    pub displacement: i32,
    /// A base is decimated where midpoints lie nearer to their edges than this, units.
    pub flat: i32,
}

impl Default for Steps {
    fn default() -> Self {
        let motion = MotionSteps { turn: 2, shift: 4, lattice: [38, 77, 77] };
        Self { motion, patch: 100, control: 64, displacement: 38, flat: 10 }
    }
}

impl Steps {
    fn fields(&mut self) -> [(&'static str, &mut i32); 8] {
        let m = &mut self.motion;
        let [normal, tangent, _] = &mut m.lattice;
        [
            ("turn step", &mut m.turn),
            ("shift step", &mut m.shift),
            ("normal step", normal),
            ("tangent step", tangent),
            ("patch step", &mut self.patch),
            ("control step", &mut self.control),
            ("displacement step", &mut self.displacement),
            ("flatness", &mut self.flat),
        ]
    }

    /// The first step that is out of range: its name, its value, and the largest that is allowed.
    pub fn out_of_range(mut self) -> Option<(&'static str, i32, u64)> {
        let bad = |v: i32| !(1..=MAX_STEP as i32).contains(&v);
        self.fields().into_iter().find(|(_, v)| bad(**v)).map(|(name, v)| (name, *v, MAX_STEP))
    }

    /// Appends the steps as varints.
    pub fn encode(mut self, out: &mut Vec<u8>) {
        self.fields().into_iter().for_each(|(_, v)| put_varint(out, *v as u64));
    }

    /// Reads steps.
    ///
    /// # Errors
    /// [`crate::CodecError::Payload`] naming a step out of range.
    pub fn decode(reader: &mut ByteReader<'_>) -> Result<Self> {
        let mut steps = Self::default();
        for (name, v) in steps.fields() {
            let at = reader.clone();
            *v = reader.varint_up_to(MAX_STEP, name)? as i32;
            if *v == 0 {
                return Err(at.error(format!("{name} is 0, at least 1 is needed")));
            }
        }
        steps.motion.lattice[2] = steps.motion.lattice[1];
        Ok(steps)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_come_back_and_bad_ones_are_named() {
        let mut bytes = Vec::new();
        Steps::default().encode(&mut bytes);
        assert_eq!(bytes, [2, 4, 38, 77, 100, 64, 38, 10]);
        assert_eq!(Steps::decode(&mut ByteReader::new(&bytes, "steps")).unwrap(), Steps::default());
        bytes[4] = 0;
        let text = Steps::decode(&mut ByteReader::new(&bytes, "steps")).unwrap_err().to_string();
        assert!(text.contains("patch step is 0"), "{text}");
        let wrong = Steps { flat: 5000, ..Steps::default() };
        assert_eq!(wrong.out_of_range(), Some(("flatness", 5000, 4096)));
    }
}
