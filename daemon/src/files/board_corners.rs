//! Corners of calibration boards as CSV, for boards that another program, or a person, found:
//! ```csv
//! view,corner,x_px,y_px
//! left,0,102.31,88.9
//! ```
//! A view is a picture of the board; corners count row-major from 0 as [`Board::corner_mm`] does; whole-numbered pixels are
//! pixel centres. Corners may be missing and lines may come in any order.

use super::error::{FileError, Result, read_limited};
use crate::light::{Board, BoardView};
use std::path::Path;

/// Largest file read.
const MAX_BYTES: u64 = 64 << 20;
/// First line.
const HEADER: &str = "view,corner,x_px,y_px";
/// Farthest from the first pixel that a corner may be, pixels.
const MAX_PX: f64 = 1e5;

/// Reads a file of corners; see [`parse_board_corners`].
///
/// # Errors
/// [`FileError`]: not readable, or as [`parse_board_corners`].
pub fn read_board_corners(path: &Path, board: &Board) -> Result<Vec<BoardView>> {
    parse_board_corners(&read_limited(path, MAX_BYTES)?, board, path)
}

/// The views of a file of corners, in the order they first appear, corners ascending, without projector pixels. `path` only
/// names the bytes in errors.
///
/// # Errors
/// [`FileError::Line`] naming line and field: no text, another header, a field missing or too many, no number, a corner
/// that the board has not or that is there twice.
pub fn parse_board_corners(bytes: &[u8], board: &Board, path: &Path) -> Result<Vec<BoardView>> {
    board.validate().map_err(|e| FileError::content(path, e.to_string()))?;
    let text = std::str::from_utf8(bytes).map_err(|e| FileError::byte(path, e.valid_up_to(), "no UTF-8 text"))?;
    let mut lines = text.trim_start_matches('\u{feff}').lines().enumerate();
    match lines.next() {
        Some((_, first)) if first.trim() == HEADER => {}
        first => {
            let found = first.map_or("", |(_, line)| line);
            let reason =
                format!("found {:?}, expected the header {HEADER}", found.chars().take(60).collect::<String>());
            return Err(FileError::line(path, 1, reason));
        }
    }
    let mut views: Vec<(String, Vec<Option<[f64; 2]>>)> = Vec::new();
    for (index, line) in lines.filter(|(_, line)| !line.trim().is_empty()) {
        let wrong = |reason: String| FileError::line(path, index + 1, reason);
        let (name, corner, px) = parse_line(line, board).map_err(wrong)?;
        // Lines of a view follow each other, so the last view is nearly always the one.
        let at = match views.iter().rposition(|(known, _)| known == name) {
            Some(at) => at,
            None => {
                views.push((name.to_owned(), vec![None; board.corner_count()]));
                views.len() - 1
            }
        };
        if views[at].1[corner].replace(px).is_some() {
            return Err(wrong(format!("corner: {corner} of view {name:?} is there twice")));
        }
    }
    if views.is_empty() {
        return Err(FileError::content(path, "no corners below the header"));
    }
    Ok(views.into_iter().map(|(name, corners)| view(name, &corners, board)).collect())
}

fn parse_line<'a>(line: &'a str, board: &Board) -> std::result::Result<(&'a str, usize, [f64; 2]), String> {
    let fields: Vec<&str> = line.split(',').map(str::trim).collect();
    let [name, corner, x, y] = fields[..] else {
        return Err(format!("{} fields, expected 4: {HEADER}", fields.len()));
    };
    if name.is_empty() {
        return Err("view: no name".into());
    }
    let count = board.corner_count();
    let corner = corner.parse::<usize>().ok().filter(|&i| i < count).ok_or_else(|| {
        let Board { columns, rows, .. } = board;
        format!("corner: {corner:?}, expected a whole number from 0 to {} for {columns} x {rows} corners", count - 1)
    })?;
    let px = |field: &str, text: &str| {
        let value = text.parse::<f64>().ok().filter(|v| v.abs() <= MAX_PX);
        value.ok_or_else(|| format!("{field}: {text:?} is no pixel position"))
    };
    Ok((name, corner, [px("x_px", x)?, px("y_px", y)?]))
}

fn view(name: String, corners: &[Option<[f64; 2]>], board: &Board) -> BoardView {
    let known = || corners.iter().enumerate().filter_map(|(i, px)| Some((i, (*px)?)));
    let camera_px: Vec<[f64; 2]> = known().map(|(_, px)| px).collect();
    let projector_px = vec![None; camera_px.len()];
    BoardView { name, board_mm: known().map(|(i, _)| board.corner_mm(i)).collect(), camera_px, projector_px }
}

/// The corners of views as [`parse_board_corners`] reads them; numbers come back to the bit.
///
/// # Errors
/// [`FileError::Content`] for a view whose name the format cannot hold, or whose corners are not the board's.
pub fn board_corners_csv(views: &[BoardView], board: &Board, path: &Path) -> Result<String> {
    use std::fmt::Write;
    let mut text = format!("{HEADER}\n");
    for BoardView { name, board_mm, camera_px, .. } in views {
        if name.trim() != name || name.is_empty() || name.contains([',', '\n', '\r']) {
            return Err(FileError::content(
                path,
                format!("view {name:?}: give it a name without comma and outer blanks"),
            ));
        }
        for (mm, [x, y]) in board_mm.iter().zip(camera_px) {
            let [column, row] = mm.map(|v| (v / board.square_mm).round());
            let corner = row * f64::from(board.columns) + column;
            let is_on_board = column >= 0.0 && column < f64::from(board.columns) && corner >= 0.0;
            if !is_on_board || corner as usize >= board.corner_count() {
                let reason = format!("view {name:?}: {mm:?} mm is no corner of the board");
                return Err(FileError::content(path, reason));
            }
            // Writing to a string cannot fail.
            let _ = writeln!(text, "{name},{corner},{x},{y}");
        }
    }
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const BOARD: Board = Board { columns: 4, rows: 3, square_mm: 7.5 };

    fn parse(text: &str) -> std::result::Result<Vec<BoardView>, String> {
        parse_board_corners(text.as_bytes(), &BOARD, Path::new("c.csv")).map_err(|e| e.to_string())
    }

    #[test]
    fn views_come_in_order_and_corners_ascending() {
        let views = parse("view,corner,x_px,y_px\r\nb,5,1.5,2\r\na, 11 ,3,4e1\n\nb,0,-0.25,7\n").unwrap();
        assert_eq!(views.iter().map(|v| v.name.as_str()).collect::<Vec<_>>(), ["b", "a"]);
        assert_eq!(views[0].board_mm, [[0.0, 0.0], [7.5, 7.5]]);
        assert_eq!(views[0].camera_px, [[-0.25, 7.0], [1.5, 2.0]]);
        assert_eq!((views[1].camera_px.clone(), views[1].projector_px.clone()), (vec![[3.0, 40.0]], vec![None]));
    }

    #[test]
    fn errors_name_file_line_and_field() {
        let error = |line: &str| parse(&format!("{HEADER}\na,0,1,1\n{line}\n")).unwrap_err();
        assert_eq!(
            error("a,12,1,1"),
            "c.csv, line 3: corner: \"12\", expected a whole number from 0 to 11 for 4 x 3 corners"
        );
        assert!(error("a,-1,1,1").contains("corner: \"-1\""));
        assert_eq!(error("a,0,1,1"), "c.csv, line 3: corner: 0 of view \"a\" is there twice");
        assert_eq!(error("a,1,x,1"), "c.csv, line 3: x_px: \"x\" is no pixel position");
        assert!(error("a,1,1,inf").contains("y_px: \"inf\"") && error("a,1,NaN,1").contains("x_px: \"NaN\""));
        assert_eq!(error("a,1,1"), "c.csv, line 3: 3 fields, expected 4: view,corner,x_px,y_px");
        assert!(error(",1,1,1").contains("view: no name"));
        assert!(parse("a,0,1,1\n").unwrap_err().starts_with("c.csv, line 1: found \"a,0,1,1\", expected the header"));
        assert!(parse("").unwrap_err().contains("expected the header"));
        assert!(parse("view,corner,x_px,y_px\n").unwrap_err().contains("no corners"));
        let bytes = b"view,corner,x_px,y_px\n\xff";
        let text = parse_board_corners(bytes, &BOARD, Path::new("c.csv")).unwrap_err().to_string();
        assert_eq!(text, "c.csv, byte 22: no UTF-8 text");
        let mut views = parse("view,corner,x_px,y_px\na,0,1,1\n").unwrap();
        views[0].name = "a,b".into();
        assert!(board_corners_csv(&views, &BOARD, Path::new("c.csv")).is_err());
        views[0].name = "a".into();
        views[0].board_mm[0] = [7.5 * 4.0, 0.0];
        assert!(board_corners_csv(&views, &BOARD, Path::new("c.csv")).unwrap_err().to_string().contains("no corner"));
    }

    proptest! {
        #[test]
        fn what_is_written_reads_back(corners in prop::collection::vec(
            prop::option::of(prop::array::uniform2(-1000.0f64..5000.0)), 12..=12
        )) {
            prop_assume!(corners.iter().any(Option::is_some));
            let views = vec![view("one".into(), &corners, &BOARD), view("two".into(), &vec![Some([0.1, 0.2]); 12], &BOARD)];
            let text = board_corners_csv(&views, &BOARD, Path::new("c.csv")).unwrap();
            prop_assert_eq!(parse(&text).unwrap(), views);
        }
    }
}
