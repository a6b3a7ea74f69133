//! `/live/events`: the status twice a second, and every event.

use super::problem::Problem;
use super::shared::{Shared, State};
use super::socket::{self, End, Receiver, Sender, close};
use crate::store::event_value;
use axum::extract::ws::WebSocketUpgrade;
use axum::response::Response;
use serde_json::json;
use std::sync::Arc;
use tokio::sync::broadcast::error::RecvError;

/// GET /live/events.
pub async fn upgrade(
    axum::extract::State(shared): State,
    upgrade: Result<WebSocketUpgrade, axum::extract::ws::rejection::WebSocketUpgradeRejection>,
) -> Result<Response, Problem> {
    let stream_shared = Arc::clone(&shared);
    socket::open(&shared, upgrade?, |sender, receiver| stream(stream_shared, sender, receiver))
}

impl From<axum::extract::ws::rejection::WebSocketUpgradeRejection> for Problem {
    fn from(rejection: axum::extract::ws::rejection::WebSocketUpgradeRejection) -> Self {
        Self::new(rejection.status(), rejection.body_text())
    }
}

async fn stream(shared: Arc<Shared>, sender: Sender, mut receiver: Receiver) -> End {
    let (mut events, mut status) = (shared.live.events(), shared.status_text.clone());
    status.mark_changed();
    loop {
        let text = tokio::select! {
            end = receiver.end() => return end,
            changed = status.changed() => match changed {
                Ok(()) => format!("{{\"status\":{}}}", *status.borrow_and_update()),
                Err(_) => return End::new(close::GOING_AWAY, "the server stops"),
            },
            event = events.recv() => match event {
                Ok(event) => json!({ "event": event_value(&event) }).to_string(),
                // Counts are in the status; the newest events are what a viewer wants.
                Err(RecvError::Lagged(_)) => continue,
                Err(RecvError::Closed) => return End::new(close::GOING_AWAY, "the scanner's engine stops"),
            },
        };
        if let Err(end) = sender.text(&text).await {
            return end;
        }
    }
}
