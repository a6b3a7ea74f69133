//! `/live/groups`: the running recording, coded, for recording elsewhere.

use super::problem::Problem;
use super::shared::{Shared, State};
use super::socket::{self, End, Receiver, Sender, close};
use crate::live::LiveGroup;
use axum::extract::ws::WebSocketUpgrade;
use axum::extract::ws::rejection::WebSocketUpgradeRejection;
use axum::response::Response;
use std::sync::Arc;
use tokio::sync::broadcast::error::RecvError;

/// First bytes of a group message.
pub const GROUP_MAGIC: u32 = u32::from_le_bytes(*b"GV3G");

/// GET /live/groups.
pub async fn upgrade(
    axum::extract::State(shared): State,
    upgrade: Result<WebSocketUpgrade, WebSocketUpgradeRejection>,
) -> Result<Response, Problem> {
    let stream_shared = Arc::clone(&shared);
    socket::open(&shared, upgrade?, |sender, receiver| stream(stream_shared, sender, receiver))
}

async fn stream(shared: Arc<Shared>, sender: Sender, mut receiver: Receiver) -> End {
    // Subscribed before it is asked for: no header is missed, and one that comes both ways is sent once.
    let mut groups = shared.live.groups();
    let header = shared.live.stream_header();
    if let Some(header) = &header {
        if let Err(end) = sender.bytes(message(header)).await {
            return end;
        }
    }
    loop {
        let group = tokio::select! {
            end = receiver.end() => return end,
            group = groups.recv() => group,
        };
        match group {
            Ok(group) if header.as_ref().is_some_and(|h| Arc::ptr_eq(h, &group)) => {}
            Ok(group) => {
                if let Err(end) = sender.bytes(message(&group)).await {
                    return end;
                }
            }
            Err(RecvError::Lagged(missed)) => {
                shared.counters.lagged.add();
                // A copy with a hole in it is of no use.
                return End::new(close::TRY_AGAIN, format!("too slow: {missed} messages were lost"));
            }
            Err(RecvError::Closed) => return End::new(close::GOING_AWAY, "the scanner's engine stops"),
        }
    }
}

fn message(group: &LiveGroup) -> Vec<u8> {
    let mut out = Vec::with_capacity(32 + group.payload.len());
    out.extend(GROUP_MAGIC.to_le_bytes());
    out.extend([1, group.kind as u8, 0, 0]);
    out.extend([group.first_tick, group.key_tick, group.time_nanos].map(u64::to_le_bytes).concat());
    out.extend_from_slice(&group.payload);
    out
}
