//! `/live/mesh`: the newest scan, thinned, with its depths.

use super::input::Query;
use super::latest::Latest;
use super::mesh_message::{MeshMessages, VERTEX_LIMITS};
use super::pace::{Pace, fps_limited};
use super::problem::Problem;
use super::scalars::Scalars;
use super::shared::{Shared, State};
use super::socket::{self, End, Receiver, Sender, close};
use crate::live::LiveScan;
use axum::extract::ws::WebSocketUpgrade;
use axum::extract::ws::rejection::WebSocketUpgradeRejection;
use axum::response::Response;
use serde::Deserialize;
use std::sync::Arc;

/// Meshes of the newest scan by their largest number of vertices.
pub type LiveMeshes = Latest<LiveScan, usize>;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Options {
    fps: Option<f64>,
    max_vertices: Option<usize>,
}

/// Vertices without `max_vertices`.
pub const USUAL_VERTICES: usize = 20_000;

/// GET /live/mesh.
pub async fn upgrade(
    axum::extract::State(shared): State,
    Query(options): Query<Options>,
    upgrade: Result<WebSocketUpgrade, WebSocketUpgradeRejection>,
) -> Result<Response, Problem> {
    let pace = Pace::new(fps_limited(options.fps)?);
    let most = shared_size(options.max_vertices.unwrap_or(USUAL_VERTICES));
    let stream_shared = Arc::clone(&shared);
    socket::open(&shared, upgrade?, move |sender, receiver| stream(stream_shared, sender, receiver, pace, most))
}

/// The size not above what is asked for that viewers share: few sizes cost little, whatever is asked.
fn shared_size(most: usize) -> usize {
    let sizes = [500, 1000, 2000, 5000, 10_000, 20_000, 50_000, 100_000, VERTEX_LIMITS.1];
    sizes.into_iter().rfind(|&s| s <= most).unwrap_or(VERTEX_LIMITS.0)
}

async fn stream(shared: Arc<Shared>, sender: Sender, mut receiver: Receiver, mut pace: Pace, most: usize) -> End {
    let mut scans = shared.live.scans();
    loop {
        let next = async {
            pace.wait().await;
            shared.live.want_scan();
            scans.changed().await
        };
        tokio::select! {
            end = receiver.end() => return end,
            changed = next => if changed.is_err() {
                return End::new(close::GOING_AWAY, "the scanner's engine stops");
            },
        }
        let Some(newest) = scans.borrow_and_update().clone() else { continue };
        pace.taken();
        let code = move |newest: &LiveScan| {
            let depths = |kept: &[u32]| Some(Scalars::depths(&newest.scan, kept));
            MeshMessages::new(most, false).encode(&newest.scan, newest.time_nanos as f64 * 1e-9, depths)
        };
        let Some(mut message) = shared.meshes.get(&newest, most, code).await.map(Vec::from) else {
            return End::new(close::ERROR, "the surface cannot be shown");
        };
        // Of this viewer: the shared form is numbered 1.
        message[8..12].copy_from_slice(&pace.count().to_le_bytes());
        message[12..16].copy_from_slice(&pace.count().to_le_bytes());
        if let Err(end) = sender.bytes(message).await {
            return end;
        }
    }
}
