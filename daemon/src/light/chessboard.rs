//! Finds the inner corners of a chessboard in a picture.
//!
//! Order of the corners: row-major, never mirrored (seen from the printed side, columns run to the right of rows that run
//! down). A board has two such orders, one with equal sides four. Of these, an order whose first square (the one before
//! corner 0 along row and column) is dark goes before one where it is light; of orders alike in this, the one whose
//! diagonal from first to last corner runs furthest to the right and down in the picture is taken. So on a board with an
//! odd and an even number of corners the order is fixed to the print, on others to the print up to a half turn.

use super::LightError;
use super::board::Board;
use super::chessboard_corners::{CornerFinder, refine_sigma_px};
use super::chessboard_grid::CornerGrid;
use super::field::Field;
use glam::DVec2;
use gv3_codec::GreyPicture;

/// Pictures with less on a side hold no board.
const MIN_SIDE_PX: u32 = 24;
/// The picture is halved at most this often, until the board is found: heavy blur and noise shrink away.
const MAX_HALVINGS: usize = 2;
/// Why the board's corners were not found.
#[derive(Debug, thiserror::Error, Clone, PartialEq)]
pub enum ChessboardError {
    /// The board itself cannot be.
    #[error(transparent)]
    Board(#[from] LightError),
    /// No grid of the board's size is in the picture.
    #[error(
        "found {corners} corners in a grid of {} x {}, not the board's {} x {} inner corners; show the whole board with its \
         white margin, evenly lit and sharp, or correct the board's size", found[0], found[1], wanted[0], wanted[1]
    )]
    NotFound {
        /// Corners of the largest grid.
        corners: usize,
        /// Columns and rows of that grid, the larger first.
        found: [u32; 2],
        /// Columns and rows of the board.
        wanted: [u32; 2],
    },
    /// The board is there, but one of its corners cannot be placed.
    #[error(
        "the board's corner near pixel {:.0}, {:.0} is not clear: something covers it, or the board is bent; show the whole \
         board, flat", near_px[0], near_px[1]
    )]
    Unclear {
        /// Where, camera pixels.
        near_px: [f64; 2],
    },
    /// More than one.
    #[error("found {count} boards of {} x {} inner corners; cover all but one", wanted[0], wanted[1])]
    Several {
        /// How many.
        count: usize,
        /// Columns and rows of the board.
        wanted: [u32; 2],
    },
}

/// Places of the board's inner corners, camera pixels with whole numbers at pixel centres, row-major in the order that the
/// page on top states.
///
/// # Errors
/// [`ChessboardError`]: a board that cannot be, none of its size in the picture, more than one. Never a part of a board.
pub fn find_chessboard(picture: &GreyPicture, board: &Board) -> Result<Vec<[f64; 2]>, ChessboardError> {
    board.validate()?;
    let wanted = [board.columns, board.rows];
    let mut best = ChessboardError::NotFound { corners: 0, found: [0, 0], wanted };
    if picture.width_px.min(picture.height_px) < MIN_SIDE_PX {
        return Err(best);
    }
    let full = CornerFinder::new(Field::from_picture(picture));
    let mut smaller: Option<CornerFinder> = None;
    for halvings in 0..=MAX_HALVINGS {
        let finder = smaller.as_ref().unwrap_or(&full);
        let scale = f64::from(1u32 << halvings);
        match find_grid(finder, wanted) {
            Ok(grid) => {
                let refined = refined(&grid, scale, &full);
                let unclear = |px: DVec2| ChessboardError::Unclear { near_px: px.to_array() };
                return refined.map(|grid| ordered(&grid, board, full.levels())).map_err(unclear);
            }
            Err(several @ ChessboardError::Several { .. }) => return Err(several),
            Err(error) => best = better(best, error),
        }
        let half = finder.picture().halved();
        if half.width.min(half.height) < MIN_SIDE_PX as usize {
            break;
        }
        smaller = Some(CornerFinder::new(half));
    }
    Err(best)
}

/// Of two reports the one that found more corners.
fn better(a: ChessboardError, b: ChessboardError) -> ChessboardError {
    let count = |e: &ChessboardError| match e {
        ChessboardError::NotFound { corners, .. } => *corners,
        _ => 0,
    };
    if count(&b) > count(&a) { b } else { a }
}

fn larger_first([a, b]: [u32; 2]) -> [u32; 2] {
    [a.max(b), a.min(b)]
}

/// The one whole grid of the wanted size.
fn find_grid(finder: &CornerFinder, wanted: [u32; 2]) -> Result<CornerGrid, ChessboardError> {
    let corner_count = wanted[0] as usize * wanted[1] as usize;
    let mut grids = CornerGrid::find(&finder.candidates(), finder.levels());
    for grid in grids.iter_mut().filter(|g| !g.is_torn && 2 * g.cells.len() >= corner_count) {
        grid.trim();
        if !grid.is_whole() || larger_first(grid.size()) != larger_first(wanted) {
            grid.fill(finder, wanted);
        }
    }
    let fits = |g: &CornerGrid| larger_first(g.size()) == larger_first(wanted) && g.is_whole();
    let count = grids.iter().filter(|g| fits(g)).count();
    if count > 1 {
        return Err(ChessboardError::Several { count, wanted });
    }
    let (corners, found) = grids.first().map_or((0, [0, 0]), |g| (g.cells.len(), larger_first(g.size())));
    grids.into_iter().find(fits).ok_or(ChessboardError::NotFound { corners, found, wanted })
}

/// The grid with its corners refined in the full picture, or the place of one that cannot be.
fn refined(grid: &CornerGrid, scale: f64, full: &CornerFinder) -> Result<CornerGrid, DVec2> {
    let mut out = CornerGrid::default();
    for (cell, px) in &grid.cells {
        let start = *px * scale + 0.5 * (scale - 1.0);
        let sigma_px = refine_sigma_px(scale * grid.spacing_px(*cell));
        out.cells.insert(*cell, full.refine(start, sigma_px).ok_or(start)?);
    }
    match out.bent(full) {
        Some(px) => Err(px),
        None => Ok(out),
    }
}

/// The corners in the board's order.
fn ordered(grid: &CornerGrid, board: &Board, levels: &Field) -> Vec<[f64; 2]> {
    let [width, height] = grid.size().map(|n| n as usize);
    // Keys ascend by column, then row.
    let by_column: Vec<DVec2> = grid.cells.values().copied().collect();
    let at = |column: usize, row: usize| by_column[column * height + row];
    let (columns, rows) = (board.columns as usize, board.rows as usize);
    // Quarter turns of the grid, as places of the board's column c and row r.
    let turned = |turn: usize, c: usize, r: usize| match turn {
        0 => at(c, r),
        1 => at(width - 1 - r, c),
        2 => at(width - 1 - c, height - 1 - r),
        _ => at(r, height - 1 - c),
    };
    let order =
        |turn: usize| -> Vec<DVec2> { (0..rows * columns).map(|i| turned(turn, i % columns, i / columns)).collect() };
    let fits =
        |turn: &usize| (if turn.is_multiple_of(2) { [columns, rows] } else { [rows, columns] }) == [width, height];
    let rank = |corners: &[DVec2]| {
        let diagonal = corners[columns * rows - 1] - corners[0];
        (is_first_dark(corners, columns, levels), diagonal.x + diagonal.y)
    };
    let orders = (0..4).filter(fits).map(order);
    let best = orders.max_by(|a, b| {
        let (a, b) = (rank(a), rank(b));
        a.0.cmp(&b.0).then(a.1.total_cmp(&b.1))
    });
    // One of the four turns fits: the grid has the board's size, one way or the other.
    best.unwrap_or_default().iter().map(|p| p.to_array()).collect()
}

/// Whether the square before the first corner is darker than the one beside it.
fn is_first_dark(corners: &[DVec2], columns: usize, levels: &Field) -> bool {
    let (along, down) = (0.5 * (corners[1] - corners[0]), 0.5 * (corners[columns] - corners[0]));
    let first = levels.sample((corners[0] - along - down).to_array());
    let beside = levels.sample((corners[0] + along - down).to_array());
    first < beside
}

#[cfg(test)]
#[path = "chessboard_tests.rs"]
mod tests;
