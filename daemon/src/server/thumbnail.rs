//! A small picture of a session: its middle keyframe, shaded.

use super::jobs::yield_to_capture;
use super::problem::Problem;
use crate::store::middle_keyframe;
use crate::view::compare::png_bytes;
use crate::view::render::{DARK_BACKGROUND, RenderStyle, Surface, ViewFrame, ViewSide, render};
use bytes::Bytes;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::SystemTime;
use tokio::sync::oneshot;

const WIDTH_PX: u32 = 320;
const HEIGHT_PX: u32 = 240;

/// Pictures kept in memory.
const MAX_KEPT: usize = 256;

/// A file, its length and its time of change.
type FileState = (PathBuf, u64, Option<SystemTime>);

/// Thumbnails drawn before, by the first file and its length and time; one is drawn at a time.
#[derive(Default)]
pub struct Thumbnails {
    kept: tokio::sync::Mutex<BTreeMap<FileState, Bytes>>,
}

impl Thumbnails {
    /// The picture of a session.
    ///
    /// # Errors
    /// As [`draw`].
    pub async fn get(&self, files: Vec<PathBuf>) -> Result<Bytes, Problem> {
        let metadata = files.first().and_then(|f| std::fs::metadata(f).ok());
        let Some((first, metadata)) = files.first().zip(metadata) else {
            return Err(Problem::not_found("the session is gone"));
        };
        let key = (first.clone(), metadata.len(), metadata.modified().ok());
        let mut kept = self.kept.lock().await;
        if let Some(png) = kept.get(&key) {
            return Ok(png.clone());
        }
        let (done, drawn) = oneshot::channel();
        let started = std::thread::Builder::new().name("gv3-thumbnail".into()).spawn(move || {
            yield_to_capture();
            // The client may be gone.
            let _ = done.send(draw(&files));
        });
        started.map_err(|e| Problem::internal(format!("no thread for the picture: {e}")))?;
        let png = Bytes::from(drawn.await.map_err(|_| Problem::internal("the picture could not be drawn"))??);
        if kept.len() >= MAX_KEPT {
            kept.clear();
        }
        kept.insert(key, png.clone());
        Ok(png)
    }
}

/// Draws the session's middle keyframe as a PNG.
///
/// # Errors
/// [`Problem`] 422 when nothing can be decoded.
fn draw(files: &[PathBuf]) -> Result<Vec<u8>, Problem> {
    let scan = middle_keyframe(files)?;
    let surface = scan.texture.as_ref().map_or(Surface::Clay, Surface::Texture);
    let frame = ViewFrame::fit(&[&scan.mesh], ViewSide::default());
    let style = RenderStyle { width_px: WIDTH_PX, height_px: HEIGHT_PX, background: DARK_BACKGROUND };
    Ok(png_bytes(&render(&scan.mesh, surface, &frame, &style)))
}
