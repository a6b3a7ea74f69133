//! Sessions: list, detail, file, picture, new names, deletion.

use super::byte_range;
use super::input::{Input, Name, Query};
use super::problem::Problem;
use super::shared::{Shared, State};
use crate::store::{Curve, SessionDetail, SessionName, SessionSummary, StoreError};
use axum::Json;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};

#[derive(Serialize)]
pub struct Sessions {
    sessions: Vec<SessionSummary>,
}

#[derive(Serialize)]
pub struct Session {
    #[serde(flatten)]
    summary: SessionSummary,
    #[serde(flatten)]
    detail: SessionDetail,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NewName {
    name: String,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Segment {
    #[serde(default = "first")]
    segment: usize,
}

fn first() -> usize {
    1
}

/// Of the running recording the engine knows more than the list, which reads finished files alone.
fn with_live_figures(shared: &Shared, summary: &mut SessionSummary) {
    if let Some(now) = shared.live.status().recording.filter(|r| r.session == summary.name.as_str()) {
        (summary.scans, summary.keyframes, summary.seconds) = (now.scans, now.keyframes, now.seconds);
    }
}

/// GET /sessions.
pub async fn list(axum::extract::State(shared): State) -> Result<Json<Sessions>, Problem> {
    let list = |s: &Shared| {
        let mut sessions = s.directory.list(s.recording().as_ref())?;
        sessions.iter_mut().for_each(|summary| with_live_figures(s, summary));
        Ok(Sessions { sessions })
    };
    Ok(Json(shared.blocking(list).await?))
}

/// GET /sessions/{name}.
pub async fn one(axum::extract::State(shared): State, Name(name): Name) -> Result<Json<Session>, Problem> {
    let read = move |s: &Shared| {
        let mut summary = s.directory.summary(&name, s.recording().as_ref())?;
        with_live_figures(s, &mut summary);
        let detail = match s.directory.detail(&name) {
            Ok(detail) => detail,
            Err(StoreError::RawOnly(_)) => SessionDetail::default(),
            // What cannot be read is still listed, with the reason.
            Err(_) if summary.fault.is_some() => SessionDetail::default(),
            Err(error) => return Err(error.into()),
        };
        Ok(Session { summary, detail })
    };
    Ok(Json(shared.blocking(read).await?))
}

/// GET /sessions/{name}/curve.
pub async fn curve(axum::extract::State(shared): State, Name(name): Name) -> Result<Json<Curve>, Problem> {
    Ok(Json(shared.blocking(move |s| Ok(s.directory.curve(&name)?)).await?))
}

/// PATCH /sessions/{name}.
pub async fn rename(
    axum::extract::State(shared): State,
    Name(from): Name,
    Input(new): Input<NewName>,
) -> Result<Json<SessionSummary>, Problem> {
    let to = SessionName::new(&new.name)?;
    let renamed = move |s: &Shared| {
        let recording = s.recording();
        s.jobs.leave_alone(&from)?;
        s.directory.rename(&from, &to, recording.as_ref())?;
        Ok(s.directory.summary(&to, recording.as_ref())?)
    };
    Ok(Json(shared.blocking(renamed).await?))
}

/// DELETE /sessions/{name}.
pub async fn remove(axum::extract::State(shared): State, Name(name): Name) -> Result<StatusCode, Problem> {
    let delete = move |s: &Shared| {
        s.jobs.leave_alone(&name)?;
        Ok(s.directory.delete(&name, s.recording().as_ref())?)
    };
    shared.blocking(delete).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// GET /sessions/{name}/file.
pub async fn file(
    axum::extract::State(shared): State,
    Name(name): Name,
    Query(segment): Query<Segment>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let path = shared
        .blocking(move |s| {
            let files = s.directory.files(&name)?;
            let count = files.len();
            let file = segment.segment.checked_sub(1).and_then(|at| files.into_iter().nth(at));
            file.ok_or_else(|| Problem::not_found(format!("no segment {}; there are {count}", segment.segment)))
        })
        .await?;
    byte_range::respond(&path, "application/octet-stream", &headers).await
}

/// GET /sessions/{name}/thumbnail.png.
pub async fn thumbnail(axum::extract::State(shared): State, Name(name): Name) -> Result<Response, Problem> {
    let files = shared.blocking(move |s| Ok(s.directory.files(&name)?)).await?;
    let png = shared.thumbnails.get(files).await?;
    Ok(([(header::CONTENT_TYPE, "image/png")], png).into_response())
}
