//! `/live/picture`: what the camera sees, and what is made of it.

use super::input::Query;
use super::latest::Latest;
use super::mesh_message::jpeg_bytes;
use super::pace::{Pace, fps_limited};
use super::problem::Problem;
use super::shared::{Shared, State};
use super::socket::{self, End, Receiver, Sender, close};
use crate::files::picture::{PictureFormat, picture_bytes};
use crate::live::LivePicture;
use crate::pipeline::PhaseMaps;
use axum::extract::ws::WebSocketUpgrade;
use axum::extract::ws::rejection::WebSocketUpgradeRejection;
use axum::response::Response;
use gv3_codec::GreyPicture;
use serde::Deserialize;
use std::f32::consts::PI;
use std::path::Path;
use std::sync::Arc;

/// First bytes of a picture message.
pub const PICTURE_MAGIC: u32 = u32::from_le_bytes(*b"GV3P");

/// Coded pictures of the newest frame set by view.
pub type LivePictures = Latest<LivePicture, View>;

/// What is shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum View {
    /// Mean of the pictures of a sequence: the fringes cancel.
    #[default]
    Camera,
    /// The first picture of the sequence.
    Fringe,
    /// Modulation B.
    Modulation,
    /// Wrapped phase.
    Phase,
    /// Pixels that are used.
    Mask,
}

impl View {
    fn needs_maps(self) -> bool {
        matches!(self, Self::Modulation | Self::Phase | Self::Mask)
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Options {
    #[serde(default)]
    view: View,
    fps: Option<f64>,
}

/// GET /live/picture.
pub async fn upgrade(
    axum::extract::State(shared): State,
    Query(options): Query<Options>,
    upgrade: Result<WebSocketUpgrade, WebSocketUpgradeRejection>,
) -> Result<Response, Problem> {
    let pace = Pace::new(fps_limited(options.fps)?);
    let stream_shared = Arc::clone(&shared);
    socket::open(&shared, upgrade?, move |sender, receiver| stream(stream_shared, sender, receiver, pace, options.view))
}

async fn stream(shared: Arc<Shared>, sender: Sender, mut receiver: Receiver, mut pace: Pace, view: View) -> End {
    let mut pictures = shared.live.pictures();
    let _wanted = view.needs_maps().then(|| shared.live.want_maps());
    loop {
        let next = async {
            pace.wait().await;
            pictures.changed().await
        };
        tokio::select! {
            end = receiver.end() => return end,
            changed = next => if changed.is_err() {
                return End::new(close::GOING_AWAY, "the scanner's engine stops");
            },
        }
        let Some(newest) = pictures.borrow_and_update().clone() else { continue };
        let code = move |newest: &LivePicture| image(newest, view).unwrap_or_default();
        let Some(image) = shared.pictures.get(&newest, view, code).await else {
            return End::new(close::ERROR, "the picture cannot be shown");
        };
        if image.is_empty() {
            // This view is not made of every frame set.
            continue;
        }
        pace.taken();
        let mut message = Vec::with_capacity(24 + image.len());
        message.extend(PICTURE_MAGIC.to_le_bytes());
        message.extend([1, view as u8, 0, 0]);
        message.extend(pace.count().to_le_bytes());
        message.extend([0; 4]);
        message.extend((newest.time_nanos as f64 * 1e-9).to_le_bytes());
        message.extend_from_slice(&image);
        if let Err(end) = sender.bytes(message).await {
            return end;
        }
    }
}

/// The view as a JPEG or a PNG; `None` where the frame set does not have it.
fn image(picture: &LivePicture, view: View) -> Option<Vec<u8>> {
    match view {
        View::Camera => mean(&picture.frames).map(|p| jpeg_bytes(&p)),
        View::Fringe => picture.frames.first().map(jpeg_bytes),
        View::Modulation => picture.maps.as_ref().and_then(|m| map(m, &m.modulation, 0.0, brightest(&m.modulation))),
        View::Phase => picture.maps.as_ref().and_then(|m| map(m, &m.wrapped_phase_rad, -PI, PI)),
        View::Mask => picture.maps.as_ref().and_then(|m| {
            let pixels = m.is_kept.iter().map(|&kept| if kept { 255 } else { 0 }).collect();
            png(&GreyPicture::new(m.width_px as u32, m.height_px as u32, pixels))
        }),
    }
}

/// The value that 99 of 100 pixels do not exceed.
fn brightest(values: &[f32]) -> f32 {
    let mut sample: Vec<f32> = values.iter().step_by(7).copied().filter(|v| v.is_finite()).collect();
    sample.sort_unstable_by(f32::total_cmp);
    sample.get(sample.len() * 99 / 100).copied().unwrap_or(1.0).max(1.0)
}

/// Values of the camera's pixels as grey levels from `low` to `high`; black where there is none.
fn map(maps: &PhaseMaps, values: &[f32], low: f32, high: f32) -> Option<Vec<u8>> {
    let scale = 255.0 / (high - low);
    let pixels = values.iter().map(|v| ((v - low) * scale + 0.5) as u8).collect();
    png(&GreyPicture::new(maps.width_px as u32, maps.height_px as u32, pixels))
}

fn png(picture: &GreyPicture) -> Option<Vec<u8>> {
    picture_bytes(picture, PictureFormat::Png, Path::new("live picture")).ok()
}

/// Mean of pictures of one size.
fn mean(frames: &[GreyPicture]) -> Option<GreyPicture> {
    let first = frames.first()?;
    let mut sums = vec![0u16; first.pixels.len()];
    // 257 pictures are the most that 16 bits hold; no sequence is that long.
    let frames: Vec<_> = frames.iter().filter(|f| f.pixels.len() == sums.len()).take(257).collect();
    for frame in &frames {
        for (sum, &pixel) in sums.iter_mut().zip(&frame.pixels) {
            *sum += u16::from(pixel);
        }
    }
    let count = frames.len() as u16;
    let pixels = sums.iter().map(|sum| ((sum + count / 2) / count) as u8).collect();
    Some(GreyPicture::new(first.width_px, first.height_px, pixels))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_mean_of_shifted_fringes_is_the_background() {
        let fringe = |shift: f32| {
            let pixels = (0..64).map(|x| (100.0 + 50.0 * (x as f32 * 0.7 + shift).cos()).round() as u8).collect();
            GreyPicture::new(64, 1, pixels)
        };
        let third = std::f32::consts::TAU / 3.0;
        let mean = mean(&[fringe(0.0), fringe(third), fringe(2.0 * third)]).unwrap();
        assert!(mean.pixels.iter().all(|p| p.abs_diff(100) <= 1));
        assert!(super::mean(&[]).is_none());
    }
}
