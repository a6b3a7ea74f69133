//! A small picture of a session: its middle scan, shaded.

use super::problem::Problem;
use crate::store::SessionPlayer;
use crate::view::compare::png_bytes;
use crate::view::render::{DARK_BACKGROUND, RenderStyle, Surface, ViewFrame, ViewSide, render};
use gv3_codec::Output;
use std::path::PathBuf;

const WIDTH_PX: u32 = 320;
const HEIGHT_PX: u32 = 240;

/// Draws the session's middle keyframe as a PNG.
///
/// # Errors
/// [`Problem`] 422 when nothing can be decoded.
pub fn draw(files: &[PathBuf]) -> Result<Vec<u8>, Problem> {
    let mut player = SessionPlayer::open(files, Output::default())?;
    let keys: Vec<u64> = player.stamps().iter().filter(|s| s.is_key).map(|s| s.time_nanos).collect();
    let time = keys.get(keys.len() / 2).copied().unwrap_or_else(|| player.first_nanos());
    let scan = player.scan_at(time)?;
    let surface = scan.texture.as_ref().map_or(Surface::Clay, Surface::Texture);
    let frame = ViewFrame::fit(&[&scan.mesh], ViewSide::default());
    let style = RenderStyle { width_px: WIDTH_PX, height_px: HEIGHT_PX, background: DARK_BACKGROUND };
    Ok(png_bytes(&render(&scan.mesh, surface, &frame, &style)))
}
