//! Views of a calibration board as folders of pictures: a folder a view, with the pictures of one pattern sequence that codes
//! columns and rows. A view's sequence.toml stands in its folder, or beside the folders when all share it.

use crate::device::sim::{BoardScene, SceneConfig, SimWorld};
use crate::device::{DeviceError, PatternIndex, RigConfig};
use crate::files::picture::{PictureFormat, picture_bytes, read_picture};
use crate::files::raw_folder::PictureNames;
use crate::files::{FileError, RawFolder};
use crate::light::{
    AbsoluteDecoder, Board, BoardView, ChessboardError, Direction, LightError, Limits, Pattern, PatternKind,
    PatternSequence, PixelMask, UnreadCorners, find_chessboard, projector_corners,
};
use gv3_codec::GreyPicture;
use std::path::{Path, PathBuf};

/// Name of the file that says what the pictures show.
const SEQUENCE: &str = "sequence.toml";
/// Most views of a folder.
const MAX_VIEWS: usize = 1000;

/// Why a board's view cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum BoardViewError {
    /// A file that cannot be read or written.
    #[error(transparent)]
    File(#[from] FileError),
    /// Patterns or limits that cannot work.
    #[error("{view}: {source}")]
    Light {
        /// Folder.
        view: PathBuf,
        /// What cannot work.
        source: LightError,
    },
    /// The board is not in the picture.
    #[error("{picture}: {source}")]
    Board {
        /// The picture searched, or the first of those that were averaged.
        picture: PathBuf,
        /// What was found instead.
        source: ChessboardError,
    },
    /// The board is seen, but the projector's patterns cannot be read on it.
    #[error(
        "{view}: of {corners} corners, {unread}; is the board lit by the projector, and not too dark or saturated?"
    )]
    Unread {
        /// Folder.
        view: PathBuf,
        /// Corners seen.
        corners: usize,
        /// Those that cannot be read.
        unread: UnreadCorners,
    },
    /// A folder that cannot be made, or that holds no views.
    #[error("{path}: {reason}")]
    Folder {
        /// Folder.
        path: PathBuf,
        /// What is wrong and what to do.
        reason: String,
    },
    /// The simulator refused.
    #[error(transparent)]
    Simulator(#[from] DeviceError),
}

/// Name of a view's folder, and the view.
pub type NamedView = (String, Result<BoardView, BoardViewError>);

/// Reads all views of a folder, by name. A view that cannot be used is an error of its own, so that the others can be.
///
/// # Errors
/// [`BoardViewError::Folder`] when there is no view.
pub fn read_board_views(folder: &Path, board: &Board) -> Result<Vec<NamedView>, BoardViewError> {
    let wrong = |reason: String| BoardViewError::Folder { path: folder.into(), reason };
    let entries = std::fs::read_dir(folder).map_err(|e| wrong(format!("cannot open: {e}")))?;
    let mut views: Vec<PathBuf> = entries.filter_map(|e| Some(e.ok()?.path())).filter(|p| p.is_dir()).collect();
    views.sort();
    if views.is_empty() || views.len() > MAX_VIEWS {
        return Err(wrong(format!(
            "{} folders, expected 1 to {MAX_VIEWS}: one for each pose of the board, with its pattern pictures",
            views.len()
        )));
    }
    let read = |view: &PathBuf| {
        let own = view.join(SEQUENCE);
        let raw = RawFolder::read(&if own.is_file() { own } else { folder.join(SEQUENCE) })?;
        read_board_view(view, &raw, board)
    };
    let name = |view: &PathBuf| view.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned());
    Ok(views.iter().map(|view| (name(view), read(view))).collect())
}

/// Corners of the board in the pictures of a folder, each with its projector pixel. The corners are sought in the white
/// picture, in the mean of all where there is none.
///
/// # Errors
/// [`BoardViewError`]: pictures that cannot be read, patterns that do not code columns and rows by themselves, no board or
/// not the whole board in the picture, no corner whose patterns can be read.
pub fn read_board_view(folder: &Path, raw: &RawFolder, board: &Board) -> Result<BoardView, BoardViewError> {
    let first = raw.names()?.first().map_or_else(|| folder.into(), |name| folder.join(name));
    let size = read_picture(&first)?;
    let pictures = raw.load(folder, [size.width_px, size.height_px])?;
    let white = raw.sequence.patterns.iter().position(|p| p.kind == PatternKind::White);
    let (searched, picture) = match white {
        Some(white) => (folder.join(&raw.names()?[white]), pictures[white].clone()),
        None => (first, mean(&pictures)),
    };
    let camera_px =
        find_chessboard(&picture, board).map_err(|source| BoardViewError::Board { picture: searched, source })?;
    let name = folder.file_name().map_or_else(|| folder.into(), PathBuf::from).to_string_lossy().into_owned();
    let board_mm = (0..camera_px.len()).map(|i| board.corner_mm(i)).collect();
    let view = BoardView { name, board_mm, camera_px, projector_px: Vec::new() };
    decoded(folder, raw, &pictures, view)
}

/// The view with the projector pixels of its corners, which are known, from the pictures of a folder.
///
/// # Errors
/// [`BoardViewError`]: pictures that cannot be read, patterns that do not code columns and rows by themselves, no corner whose
/// patterns can be read.
pub fn decode_board_view(folder: &Path, raw: &RawFolder, view: BoardView) -> Result<BoardView, BoardViewError> {
    let first = raw.names()?.first().map_or_else(|| folder.into(), |name| folder.join(name));
    let size = read_picture(&first)?;
    let pictures = raw.load(folder, [size.width_px, size.height_px])?;
    decoded(folder, raw, &pictures, view)
}

fn decoded(
    folder: &Path,
    raw: &RawFolder,
    pictures: &[GreyPicture],
    view: BoardView,
) -> Result<BoardView, BoardViewError> {
    let light = |source: LightError| BoardViewError::Light { view: folder.into(), source };
    let (columns, rows, mask) =
        projector_coordinates(pictures, &raw.sequence, &raw.limits.unwrap_or_default()).map_err(light)?;
    let (projector_px, unread) = projector_corners(&view.camera_px, &columns, &rows, &mask);
    if unread.total() == view.camera_px.len() {
        return Err(BoardViewError::Unread { view: folder.into(), corners: view.camera_px.len(), unread });
    }
    if unread.total() > 0 {
        tracing::info!("{}: {} corners without projector pixel: {unread}", folder.display(), unread.total());
    }
    Ok(BoardView { projector_px, ..view })
}

/// Projector columns and rows of the pixels that both codes can be read at.
fn projector_coordinates(
    pictures: &[GreyPicture],
    sequence: &PatternSequence,
    limits: &Limits,
) -> Result<(Vec<f32>, Vec<f32>, PixelMask), LightError> {
    let decoder = |direction: Direction| {
        AbsoluteDecoder::uncalibrated(sequence, direction, limits.mask)?.ok_or_else(|| {
            let reason = format!("no pattern codes {direction:?}; calibration needs columns and rows");
            LightError::Field { field: "sequence.patterns".into(), reason }
        })
    };
    let (columns, rows) = (decoder(Direction::Columns)?, decoder(Direction::Rows)?);
    let refs: Vec<&GreyPicture> = pictures.iter().collect();
    let (width, height) = pictures.first().map_or((0, 0), |p| (p.width_px as usize, p.height_px as usize));
    let mut mask = PixelMask::new(width, height);
    let column_phases = columns.measure(&refs, &mut mask);
    let row_phases = rows.measure(&refs, &mut mask);
    mask.erode();
    let columns_px = columns.resolve(&refs, &column_phases, &mut mask);
    let rows_px = rows.resolve(&refs, &row_phases, &mut mask);
    Ok((columns_px, rows_px, mask))
}

/// Mean of pictures of one size.
fn mean(pictures: &[GreyPicture]) -> GreyPicture {
    let mut sums = vec![0u32; pictures[0].pixels.len()];
    for picture in pictures {
        for (sum, &level) in sums.iter_mut().zip(&picture.pixels) {
            *sum += u32::from(level);
        }
    }
    let count = pictures.len() as u32;
    let pixels = sums.iter().map(|sum| ((sum + count / 2) / count) as u8).collect();
    GreyPicture::new(pictures[0].width_px, pictures[0].height_px, pixels)
}

/// Patterns for calibration: columns, then rows, each in three frequencies, and white.
pub fn calibration_sequence(size_px: [u32; 2]) -> PatternSequence {
    /// Finest period, projector pixels, ratio of neighbours, and pictures each.
    const PERIOD_PX: f64 = 20.0;
    const RATIO: f64 = 8.0;
    const STEPS: u32 = 4;
    let of = |direction| PatternSequence::hierarchical(size_px, direction, PERIOD_PX, RATIO, STEPS).patterns;
    let patterns = [of(Direction::Columns), of(Direction::Rows), vec![Pattern::flat(PatternKind::White)]].concat();
    PatternSequence { width_px: size_px[0], height_px: size_px[1], patterns }
}

/// Captures `count` poses of a board with a simulated rig, drawn from a seed (see [`BoardScene::draw`]): a folder a view, as
/// [`read_board_views`] reads them, in `folder`, which must be empty or missing.
///
/// # Errors
/// [`BoardViewError`]: a board that does not fit the pictures, a folder that cannot be written or is not empty.
pub fn simulate_board_views(
    rig: &RigConfig,
    board: &Board,
    seed: u64,
    count: usize,
    folder: &Path,
) -> Result<(), BoardViewError> {
    let wrong = |path: &Path, reason: String| BoardViewError::Folder { path: path.into(), reason };
    let make = |path: &Path| std::fs::create_dir_all(path).map_err(|e| wrong(path, format!("cannot create: {e}")));
    let write =
        |path: &Path, bytes: &[u8]| std::fs::write(path, bytes).map_err(|e| wrong(path, format!("cannot write: {e}")));
    if !(1..=MAX_VIEWS).contains(&count) {
        return Err(wrong(folder, format!("{count} views, expected 1 to {MAX_VIEWS}")));
    }
    let calibration = rig.calibration()?;
    let poses = BoardScene::draw(*board, &calibration, seed, count)?;
    make(folder)?;
    let mut entries = std::fs::read_dir(folder).map_err(|e| wrong(folder, format!("cannot open: {e}")))?;
    if entries.next().is_some() {
        return Err(wrong(folder, "the folder is not empty; give another one".into()));
    }
    let sequence = calibration_sequence([calibration.projector.width_px, calibration.projector.height_px]);
    let pictures = PictureNames::Numbered(format!("pattern_##.{}", PictureFormat::Png.extension()));
    let raw = RawFolder { pictures, first: 0, sequence, limits: None, processing: Default::default() };
    write(&folder.join(SEQUENCE), raw.to_toml()?.as_bytes())?;
    let names = raw.names()?;
    for (k, pose) in poses.iter().enumerate() {
        let view = folder.join(format!("view_{k:02}"));
        make(&view)?;
        let mut config = RigConfig { sequence: raw.sequence.clone(), ..rig.clone() };
        config.sim.scene = SceneConfig::Board(*pose);
        config.sim.faults.clear();
        let mut world = SimWorld::new(&config)?;
        world.load(&raw.sequence);
        for (i, name) in names.iter().enumerate() {
            // The board stands still, so only the noise changes with the picture's number.
            let number = (k * names.len() + i) as u64;
            let picture = world.expose(0, Some(PatternIndex(i as u16)), rig.timing.exposure_nanos, number);
            let path = view.join(name);
            write(&path, &picture_bytes(&picture, PictureFormat::Png, &path)?)?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec2;

    const BOARD: Board = Board { columns: 9, rows: 6, square_mm: 12.0 };

    #[test]
    fn simulated_views_read_back_with_the_true_pixels_of_camera_and_projector() {
        let folder = tempfile::tempdir().unwrap();
        let config = RigConfig::simulated();
        let rig = config.calibration().unwrap();
        simulate_board_views(&config, &BOARD, 5, 3, folder.path()).unwrap();
        let poses = BoardScene::draw(BOARD, &rig, 5, 3).unwrap();
        let views = read_board_views(folder.path(), &BOARD).unwrap();
        assert_eq!(views.iter().map(|v| v.0.as_str()).collect::<Vec<_>>(), ["view_00", "view_01", "view_02"]);
        for ((name, view), pose) in views.into_iter().zip(poses) {
            let view = view.unwrap();
            assert_eq!(view.name, name);
            let (mut camera, mut projector, mut read) = (0.0, 0.0, 0.0f64);
            for (i, mm) in view.board_mm.iter().enumerate() {
                let point = pose.camera_from_board().apply(DVec2::from(*mm).extend(0.0));
                camera += DVec2::from(view.camera_px[i]).distance_squared(rig.camera.project(point));
                if let Some(px) = view.projector_px[i] {
                    projector += DVec2::from(px).distance_squared(rig.projector_px(point));
                    read += 1.0;
                }
            }
            let (camera_px, projector_px) = ((camera / 54.0).sqrt(), (projector / read).sqrt());
            println!("{name}: camera {camera_px:.3} px, projector {projector_px:.3} px, {read} of 54 corners");
            assert!(
                camera_px < 0.08 && projector_px < 0.12 && read >= 50.0,
                "{name}: {camera_px}, {projector_px}, {read}"
            );
        }
        let again = simulate_board_views(&config, &BOARD, 5, 1, folder.path()).unwrap_err().to_string();
        assert!(again.contains("not empty"), "{again}");
    }

    #[test]
    fn what_makes_a_view_useless_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let none = read_board_views(folder.path(), &BOARD).unwrap_err().to_string();
        assert!(none.contains("0 folders, expected 1 to 1000"), "{none}");
        let config = RigConfig::simulated();
        simulate_board_views(&config, &BOARD, 6, 1, folder.path()).unwrap();
        let view = folder.path().join("view_00");
        let raw = RawFolder::read(&folder.path().join(SEQUENCE)).unwrap();
        let error = |raw: &RawFolder, board: &Board| read_board_view(&view, raw, board).unwrap_err().to_string();
        let text = error(&raw, &Board { columns: 10, ..BOARD });
        assert!(text.contains("pattern_24.png: found 54 corners in a grid of 9 x 6, not the board's 10 x 6"), "{text}");
        let mut columns = raw.clone();
        columns.pictures = PictureNames::Listed(raw.names().unwrap()[..12].to_vec());
        columns.sequence.patterns.truncate(12);
        assert!(error(&columns, &BOARD).contains("no pattern codes Rows"));
        let mut fine = raw.clone();
        fine.pictures = PictureNames::Listed([&raw.names().unwrap()[8..12], &raw.names().unwrap()[12..]].concat());
        fine.sequence.patterns.drain(..8);
        let text = error(&fine, &BOARD);
        assert!(text.contains("20.0 px, does not cover the projector's 912 px"), "{text}");
        let mut dark = raw.clone();
        let mut limits = Limits::default();
        limits.mask.min_modulation = 120.0;
        dark.limits = Some(limits);
        let text = error(&dark, &BOARD);
        assert!(text.contains("of 54 corners, 54 with too few decoded pixels"), "{text}");
        std::fs::remove_file(view.join("pattern_03.png")).unwrap();
        assert!(error(&raw, &BOARD).contains("pattern_03.png: missing"));
    }
}
