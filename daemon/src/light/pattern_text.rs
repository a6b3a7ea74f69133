//! How a pattern sequence is written in TOML.
//!
//! An entry of `patterns` is one pattern, or a run of them: `steps` for the sinusoids of one burst, `bits` for the bits of a
//! Gray code from the most significant down, with `pairs` each followed by its inverse. `kind` is `sinusoid` where it is left
//! out.

use super::LightError;
use super::pattern::{Direction, MAX_PATTERNS, Pattern, PatternKind, PatternSequence, gray_bits};
use serde::{Deserialize, Serialize};
use std::f64::consts::TAU;

/// A sequence as its text has it.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct SequenceText {
    width_px: u32,
    height_px: u32,
    patterns: Vec<PatternText>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
enum KindText {
    #[default]
    Sinusoid,
    Gray,
    White,
    Black,
    Half,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
enum BitOrder {
    #[default]
    #[serde(rename = "msb_first")]
    MsbFirst,
    #[serde(rename = "lsb_first")]
    LsbFirst,
}

#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct PatternText {
    kind: KindText,
    #[serde(skip_serializing_if = "Option::is_none")]
    period_px: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    shift_rad: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    steps: Option<u32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    bit: Option<u32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    inverse: Option<bool>,
    #[serde(skip_serializing_if = "Option::is_none")]
    bits: Option<u32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pairs: Option<bool>,
    #[serde(skip_serializing_if = "Option::is_none")]
    order: Option<BitOrder>,
    #[serde(skip_serializing_if = "Option::is_none")]
    direction: Option<Direction>,
}

impl TryFrom<SequenceText> for PatternSequence {
    type Error = LightError;

    fn try_from(text: SequenceText) -> Result<Self, LightError> {
        let mut sequence = Self { width_px: text.width_px, height_px: text.height_px, patterns: Vec::new() };
        for (i, entry) in text.patterns.iter().enumerate() {
            let length_px = sequence.side_px(entry.direction.unwrap_or_default());
            entry
                .expand(length_px, &mut sequence.patterns)
                .map_err(|(field, reason)| LightError::field(format!("sequence.patterns[{i}].{field}"), reason))?;
            if sequence.patterns.len() > MAX_PATTERNS {
                let reason = format!("more than {MAX_PATTERNS} patterns up to here");
                return Err(LightError::field(format!("sequence.patterns[{i}]"), reason));
            }
        }
        Ok(sequence)
    }
}

impl PatternText {
    /// Adds the entry's patterns; errors are a key and what is wrong with it.
    fn expand(&self, length_px: u32, out: &mut Vec<Pattern>) -> Result<(), (&'static str, String)> {
        self.refuse_strangers()?;
        let direction = self.direction.unwrap_or_default();
        match self.kind {
            KindText::Sinusoid => {
                let period_px =
                    self.period_px.ok_or(("period_px", "missing: projector pixels a fringe".to_string()))?;
                let first_rad = self.shift_rad.unwrap_or(0.0);
                let steps = match (self.steps, self.shift_rad) {
                    (None, None) => return Err(("shift_rad", "missing: give it, or steps for a whole burst".into())),
                    (None, Some(_)) => 1,
                    (Some(steps), _) if (3..=MAX_PATTERNS as u32).contains(&steps) => steps,
                    (Some(steps), _) => return Err(("steps", format!("{steps}, expected 3..={MAX_PATTERNS}"))),
                };
                let shift = |n| first_rad + TAU * f64::from(n) / f64::from(steps);
                out.extend((0..steps).map(|n| Pattern::sinusoid(period_px, shift(n), direction)));
            }
            KindText::Gray => self.expand_gray(length_px, direction, out)?,
            KindText::White => out.push(Pattern::flat(PatternKind::White)),
            KindText::Black => out.push(Pattern::flat(PatternKind::Black)),
            KindText::Half => out.push(Pattern::flat(PatternKind::Half)),
        }
        Ok(())
    }

    fn expand_gray(
        &self,
        length_px: u32,
        direction: Direction,
        out: &mut Vec<Pattern>,
    ) -> Result<(), (&'static str, String)> {
        let gray = |bit, inverse| Pattern { kind: PatternKind::Gray { bit, inverse }, direction };
        let bits = match (self.bit, self.bits) {
            (Some(bit), None) => {
                out.push(gray(bit, self.inverse.unwrap_or(false)));
                return Ok(());
            }
            (None, Some(bits)) => bits,
            _ => return Err(("bit", "give bit for one picture, or bits for a run".into())),
        };
        let most = gray_bits(length_px);
        if !(1..=most).contains(&bits) {
            return Err(("bits", format!("{bits}, but {length_px} projector pixels take 1 to {most} bits")));
        }
        // The code begins at the top whatever its length: fewer bits are a coarser code.
        let mut run: Vec<u32> = (most - bits..most).rev().collect();
        if self.order == Some(BitOrder::LsbFirst) {
            run.reverse();
        }
        for bit in run {
            out.push(gray(bit, false));
            if self.pairs == Some(true) {
                out.push(gray(bit, true));
            }
        }
        Ok(())
    }

    /// A key that the kind has no use for is a mistake of the writer.
    fn refuse_strangers(&self) -> Result<(), (&'static str, String)> {
        let (is_sinusoid, is_gray) = (self.kind == KindText::Sinusoid, self.kind == KindText::Gray);
        let is_run = is_gray && self.bits.is_some();
        let keys = [
            ("period_px", self.period_px.is_some(), is_sinusoid),
            ("shift_rad", self.shift_rad.is_some(), is_sinusoid),
            ("steps", self.steps.is_some(), is_sinusoid),
            ("bit", self.bit.is_some(), is_gray),
            ("bits", self.bits.is_some(), is_gray),
            ("inverse", self.inverse.is_some(), is_gray && !is_run),
            ("pairs", self.pairs.is_some(), is_run),
            ("order", self.order.is_some(), is_run),
            ("direction", self.direction.is_some(), is_sinusoid || is_gray),
        ];
        match keys.into_iter().find(|(_, is_given, is_used)| *is_given && !is_used) {
            Some((key, ..)) => Err((key, "has no meaning here; leave it out".into())),
            None => Ok(()),
        }
    }
}

impl From<PatternSequence> for SequenceText {
    fn from(sequence: PatternSequence) -> Self {
        let text = |pattern: &Pattern| {
            let direction = Some(pattern.direction);
            match pattern.kind {
                PatternKind::Sinusoid { period_px, shift_rad } => PatternText {
                    period_px: Some(period_px),
                    shift_rad: Some(shift_rad),
                    direction,
                    ..PatternText::default()
                },
                PatternKind::Gray { bit, inverse } => PatternText {
                    kind: KindText::Gray,
                    bit: Some(bit),
                    inverse: Some(inverse),
                    direction,
                    ..PatternText::default()
                },
                PatternKind::White => PatternText { kind: KindText::White, ..PatternText::default() },
                PatternKind::Black => PatternText { kind: KindText::Black, ..PatternText::default() },
                PatternKind::Half => PatternText { kind: KindText::Half, ..PatternText::default() },
            }
        };
        let patterns = sequence.patterns.iter().map(text).collect();
        Self { width_px: sequence.width_px, height_px: sequence.height_px, patterns }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(entry: &str) -> Result<PatternSequence, String> {
        let text = format!("width_px = 1024\nheight_px = 768\n[[patterns]]\n{entry}");
        toml::from_str(&text).map_err(|e| e.to_string())
    }

    #[test]
    fn runs_expand_in_order() {
        let both = [Direction::Columns, Direction::Rows];
        let text = "kind = \"gray\"\nbits = 10\npairs = true\n[[patterns]]\nkind = \"gray\"\nbits = 10\npairs = true\n\
                    direction = \"rows\"\n[[patterns]]\nkind = \"white\"\n[[patterns]]\nkind = \"black\"";
        assert_eq!(parse(text).unwrap(), PatternSequence::gray_code([1024, 768], &both));
        let text = "period_px = 16.0\nsteps = 5\ndirection = \"rows\"";
        assert_eq!(parse(text).unwrap(), PatternSequence::n_step([1024, 768], Direction::Rows, 16.0, 5));
        let coarse = parse("kind = \"gray\"\nbits = 2\norder = \"lsb_first\"").unwrap();
        let bits: Vec<_> = coarse.patterns.iter().map(|p| p.kind).collect();
        assert_eq!(bits, [8, 9].map(|bit| PatternKind::Gray { bit, inverse: false }));
    }

    #[test]
    fn every_sequence_survives_its_text() {
        let size = [912, 1140];
        for sequence in [
            PatternSequence::two_plus_one(size, Direction::Rows, 36.0),
            PatternSequence::two_frequency(size, 264.0, 22.0, 3),
            PatternSequence::gray_phase(size, Direction::Columns, 24.0, 4),
            PatternSequence::heterodyne(size, Direction::Columns, 20.0, 3),
        ] {
            let back: PatternSequence = toml::from_str(&toml::to_string(&sequence).unwrap()).unwrap();
            assert_eq!(back, sequence);
        }
    }

    #[test]
    fn errors_name_entry_and_key() {
        let error = |entry| parse(entry).unwrap_err();
        assert!(error("period_px = 20.0").contains("sequence.patterns[0].shift_rad: missing"));
        assert!(error("kind = \"white\"\nbit = 3").contains("sequence.patterns[0].bit: has no meaning"));
        assert!(error("kind = \"gray\"\nbits = 11").contains("1024 projector pixels take 1 to 10 bits"));
        assert!(error("period_px = 20.0\nsteps = 4000000000").contains("steps: 4000000000, expected 3..=256"));
        assert!(error("kind = \"gray\"\nbits = 3\ninverse = true").contains("inverse: has no meaning"));
    }
}
