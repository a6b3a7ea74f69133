//! A calibration board and what one picture of it tells.

use super::LightError;
use serde::{Deserialize, Serialize};

/// Fewest and most inner corners along a side.
const SIDE_CORNERS: std::ops::RangeInclusive<u32> = 3..=100;

/// A flat chessboard, described by its inner corners: those where four squares meet.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Board {
    /// Inner corners along a row: one less than the squares.
    pub columns: u32,
    /// Inner corners along a column.
    pub rows: u32,
    /// Side of a square, mm.
    pub square_mm: f64,
}

impl Board {
    /// Checks 3 to 100 corners a side and a square that can be printed.
    ///
    /// # Errors
    /// [`LightError::Field`] naming the field.
    pub fn validate(&self) -> Result<(), LightError> {
        for (field, value) in [("board.columns", self.columns), ("board.rows", self.rows)] {
            if !SIDE_CORNERS.contains(&value) {
                let reason = format!("{value} inner corners, expected 3..=100; count where four squares meet");
                return Err(LightError::field(field, reason));
            }
        }
        if !(self.square_mm > 0.0 && self.square_mm <= 10_000.0) {
            return Err(LightError::field("board.square_mm", format!("{} is no side of a square", self.square_mm)));
        }
        Ok(())
    }

    /// Number of inner corners.
    pub fn corner_count(&self) -> usize {
        self.columns as usize * self.rows as usize
    }

    /// Place of corner `i`, row-major, mm: corner 0 is the origin, x runs along the rows, y along the columns.
    pub fn corner_mm(&self, i: usize) -> [f64; 2] {
        let columns = self.columns as usize;
        [(i % columns) as f64 * self.square_mm, (i / columns) as f64 * self.square_mm]
    }
}

/// Corners of the board in one pose; the lists are of the same length.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct BoardView {
    /// Name for reports: the folder or picture.
    pub name: String,
    /// Places on the board, mm.
    pub board_mm: Vec<[f64; 2]>,
    /// Camera pixels; whole numbers are pixel centres.
    pub camera_px: Vec<[f64; 2]>,
    /// Projector pixels that light the corners, whole numbers at pixel centres; `None` where the patterns cannot be read.
    pub projector_px: Vec<Option<[f64; 2]>>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corners_run_along_the_rows() {
        let board = Board { columns: 4, rows: 3, square_mm: 2.5 };
        board.validate().unwrap();
        assert_eq!(board.corner_count(), 12);
        assert_eq!([0, 3, 4, 11].map(|i| board.corner_mm(i)), [[0.0, 0.0], [7.5, 0.0], [0.0, 2.5], [7.5, 5.0]]);
    }

    #[test]
    fn a_board_that_cannot_be_is_named() {
        let error = |columns, rows, square_mm| Board { columns, rows, square_mm }.validate().unwrap_err().to_string();
        assert!(error(2, 5, 1.0).starts_with("board.columns: 2 inner corners"));
        assert!(error(5, 101, 1.0).starts_with("board.rows: 101"));
        assert!(error(5, 5, f64::NAN).starts_with("board.square_mm: NaN"));
        assert!(error(5, 5, 0.0).starts_with("board.square_mm: 0"));
    }
}
