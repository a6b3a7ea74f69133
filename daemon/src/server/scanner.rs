//! The scanner, its recordings and its configuration.

use super::input::Input;
use super::problem::Problem;
use super::shared::{Shared, State};
use crate::device::plugged::Plugged;
use crate::doctor::{self, Report};
use crate::live::{LiveError, LiveState, LiveStatus, RecordingRequest};
use axum::Json;
use axum::http::{StatusCode, header};
use axum::response::IntoResponse;
use serde::Deserialize;
use serde_json::{Value, json};
use std::sync::Arc;

/// Longest text of a mark, bytes.
const MAX_MARK_BYTES: usize = 1000;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Login {
    token: String,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Mark {
    text: String,
}

impl From<LiveError> for Problem {
    fn from(error: LiveError) -> Self {
        let status = match error {
            LiveError::Store(error) => return error.into(),
            LiveError::Text(_) => StatusCode::BAD_REQUEST,
            LiveError::Config(_) => StatusCode::UNPROCESSABLE_ENTITY,
            LiveError::State(_) | LiveError::Timeout(_) => StatusCode::CONFLICT,
            LiveError::Space { .. } => StatusCode::INSUFFICIENT_STORAGE,
            LiveError::Device(_) | LiveError::Record(_) | LiveError::Disk { .. } => StatusCode::SERVICE_UNAVAILABLE,
        };
        Self::new(status, error.to_string())
    }
}

/// POST /login: the token as a cookie.
pub async fn login(
    axum::extract::State(shared): State,
    Input(login): Input<Login>,
) -> Result<impl IntoResponse, Problem> {
    match shared.guard.token() {
        Some(token) if token.is(&login.token) => {
            Ok((StatusCode::NO_CONTENT, [(header::SET_COOKIE, token.cookie())]).into_response())
        }
        Some(_) => Err(Problem::new(StatusCode::UNAUTHORIZED, "that is not the token")),
        None => Ok(StatusCode::NO_CONTENT.into_response()),
    }
}

/// GET /status.
pub async fn status(axum::extract::State(shared): State) -> Result<Json<LiveStatus>, Problem> {
    Ok(Json(shared.blocking(|s| Ok(s.live.status())).await?))
}

/// POST /scanner/start.
pub async fn start(axum::extract::State(shared): State) -> Result<StatusCode, Problem> {
    shared.blocking(|s| Ok(s.live.start_scanner()?)).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// POST /scanner/stop.
pub async fn stop(axum::extract::State(shared): State) -> Result<StatusCode, Problem> {
    shared.blocking(|s| Ok(s.live.stop_scanner()?)).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// POST /recording/start.
pub async fn start_recording(
    axum::extract::State(shared): State,
    Input(request): Input<RecordingRequest>,
) -> Result<impl IntoResponse, Problem> {
    let started = shared.blocking(|s| Ok(s.live.start_recording(request)?)).await?;
    Ok((StatusCode::CREATED, Json(started)))
}

/// POST /recording/stop: when it answers, the files are closed, durable and verified.
pub async fn stop_recording(axum::extract::State(shared): State) -> Result<impl IntoResponse, Problem> {
    Ok(Json(shared.blocking(|s| Ok(s.live.stop_recording()?)).await?))
}

/// POST /recording/mark.
pub async fn mark(axum::extract::State(shared): State, Input(mark): Input<Mark>) -> Result<Json<Value>, Problem> {
    if mark.text.len() > MAX_MARK_BYTES {
        return Err(Problem::bad_request(format!("text: longer than {MAX_MARK_BYTES} bytes")));
    }
    let tick = shared.blocking(move |s| Ok(s.live.mark(&mark.text)?)).await?;
    Ok(Json(json!({ "tick": tick })))
}

/// POST /config/reload.
pub async fn reload(axum::extract::State(shared): State) -> Result<StatusCode, Problem> {
    reload_now(&shared).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// Reads the configuration and hands it to the engine, all of it or nothing.
///
/// # Errors
/// [`Problem`]: the file is wrong (422), or the engine refuses it now (409).
pub async fn reload_now(shared: &Arc<Shared>) -> Result<(), Problem> {
    shared
        .blocking(|s| {
            let wrong =
                |reason: String| Problem::new(StatusCode::UNPROCESSABLE_ENTITY, format!("not reloaded: {reason}"));
            let config = (s.read_config)().map_err(|e| wrong(format!("{e:#}")))?;
            let directory = std::fs::canonicalize(&config.sessions.directory);
            if !directory.is_ok_and(|d| d == s.directory.path()) {
                return Err(wrong("sessions.directory is another one; restart the daemon for that".into()));
            }
            s.live.reload(config).map_err(|error| match error {
                LiveError::Config(reason) => wrong(reason.to_string()),
                error => error.into(),
            })
        })
        .await
}

/// GET /devices.
pub async fn devices(axum::extract::State(shared): State) -> Result<Json<Plugged>, Problem> {
    Ok(Json(shared.blocking(|_| Ok(Plugged::find())).await?))
}

/// POST /doctor: needs the devices for itself.
pub async fn doctor(axum::extract::State(shared): State) -> Result<Json<Report>, Problem> {
    let report = shared.blocking(|s| {
        let state = s.live.status().state;
        if !matches!(state, LiveState::Idle | LiveState::Failed) {
            return Err(Problem::new(StatusCode::CONFLICT, "stop the scanner first: the checks need its devices"));
        }
        Ok(doctor::run_in(&s.live.config().rig, s.directory.path(), |_| ()))
    });
    Ok(Json(report.await?))
}
