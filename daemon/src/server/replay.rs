//! `/sessions/{name}/replay`: a session decoded here, at any time and speed, shown elsewhere.
//!
//! One thread a viewer decodes; at most four messages are on their way, so that a slow viewer makes it wait instead of
//! filling memory.

use super::input::{Name, Query};
use super::jobs::yield_to_capture;
use super::live_mesh::USUAL_VERTICES;
use super::playback::{Command, Playback, play};
use super::problem::Problem;
use super::shared::State;
use super::socket::{self, End, Receiver, Sender, close};
use crate::measure::Output;
use crate::store::SessionPlayer;
use axum::extract::ws::WebSocketUpgrade;
use axum::extract::ws::rejection::WebSocketUpgradeRejection;
use axum::http::StatusCode;
use axum::response::Response;
use serde::Deserialize;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::mpsc::sync_channel;
use tokio::sync::{OwnedSemaphorePermit, mpsc};

/// Commands that wait at one time.
const MAX_COMMANDS: usize = 64;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Options {
    #[serde(rename = "as")]
    output: Option<Output>,
    max_vertices: Option<usize>,
}

/// GET /sessions/{name}/replay.
pub async fn upgrade(
    axum::extract::State(shared): State,
    Name(name): Name,
    Query(options): Query<Options>,
    upgrade: Result<WebSocketUpgrade, WebSocketUpgradeRejection>,
) -> Result<Response, Problem> {
    let files = shared.blocking(move |s| Ok(s.directory.files(&name)?)).await?;
    let upgrade = upgrade?;
    let place = Arc::clone(&shared.replays).try_acquire_owned().map_err(|_| {
        Problem::new(StatusCode::SERVICE_UNAVAILABLE, "too many replays are open; close one, or try again later")
    })?;
    socket::open(&shared, upgrade, move |sender, receiver| stream(files, options, place, sender, receiver))
}

async fn stream(
    files: Vec<PathBuf>,
    options: Options,
    place: OwnedSemaphorePermit,
    sender: Sender,
    mut receiver: Receiver,
) -> End {
    let (commands, inbox) = sync_channel(MAX_COMMANDS);
    let (outbox, mut messages) = mpsc::channel(1);
    let started = std::thread::Builder::new().name("gv3-replay".into()).spawn(move || {
        yield_to_capture();
        let failed = open(&files, &options).and_then(|mut playback| play(&mut playback, &inbox, &outbox));
        if let Err(reason) = failed {
            // The viewer may be gone too.
            let _ = outbox.blocking_send(Err(reason));
        }
        drop(place);
    });
    if started.is_err() {
        return End::new(close::ERROR, "the system has no thread left for a replay");
    }
    // Dropping the commands ends the thread.
    loop {
        tokio::select! {
            text = receiver.text() => match text.map(|t| serde_json::from_str::<Command>(&t)) {
                Ok(Ok(command)) => if commands.try_send(command).is_err() {
                    return End::new(close::POLICY, "commands come faster than they are done");
                },
                Ok(Err(error)) => return End::new(close::POLICY, format!("command: {error}")),
                Err(end) => return end,
            },
            message = messages.recv() => match message {
                Some(Ok(bytes)) => if let Err(end) = sender.bytes(bytes).await {
                    return end;
                },
                Some(Err(reason)) => return End::new(close::ERROR, reason),
                None => return End::new(close::ERROR, "the replay ended unexpectedly"),
            },
        }
    }
}

fn open(files: &[PathBuf], options: &Options) -> Result<Playback, String> {
    let player = SessionPlayer::open(files, options.output).map_err(|e| e.to_string())?;
    Ok(Playback::new(player, files.to_vec(), options.max_vertices.unwrap_or(USUAL_VERTICES)))
}
