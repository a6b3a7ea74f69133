//! Reports of sweeps and measurements beside the sessions, for the page's plots.

use super::input::Name;
use super::problem::Problem;
use super::shared::State;
use crate::store::SessionName;
use axum::Json;
use axum::http::header;
use axum::response::IntoResponse;
use serde_json::{Value, json};
use std::fs::File;
use std::io::Read;
use std::path::Path;

/// Folder of the session directory that holds them.
const FOLDER: &str = "reports";
/// Largest report answered, bytes.
const MAX_REPORT_BYTES: u64 = 32 << 20;

/// GET /reports.
pub async fn list(axum::extract::State(shared): State) -> Result<Json<Value>, Problem> {
    let reports = shared.blocking(|s| Ok(found(&s.directory.path().join(FOLDER)))).await?;
    Ok(Json(json!({ "reports": reports })))
}

/// GET /reports/{name}.
pub async fn one(axum::extract::State(shared): State, Name(name): Name) -> Result<impl IntoResponse, Problem> {
    let text = shared.blocking(move |s| read(&s.directory.path().join(FOLDER), &name)).await?;
    Ok(([(header::CONTENT_TYPE, "application/json")], text))
}

fn found(folder: &Path) -> Vec<Value> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().filter_map(Result::ok);
    let files = entries.filter(|e| e.metadata().is_ok_and(|m| m.is_file()));
    let mut names: Vec<SessionName> =
        files.filter_map(|e| SessionName::new(e.file_name().to_str()?.strip_suffix(".json")?).ok()).collect();
    names.sort();
    let kinds = names.iter().filter_map(|name| Some((name, kind(&read(folder, name).ok()?)?)));
    kinds.map(|(name, kind)| json!({ "name": name, "kind": kind })).collect()
}

fn read(folder: &Path, name: &SessionName) -> Result<Vec<u8>, Problem> {
    let path = folder.join(format!("{name}.json"));
    let missing = || Problem::not_found(format!("there is no report {:?}", name.as_str()));
    let is_file = std::fs::symlink_metadata(&path).is_ok_and(|m| m.is_file() && m.len() <= MAX_REPORT_BYTES);
    let mut bytes = Vec::new();
    let file = File::open(&path).ok().filter(|_| is_file).ok_or_else(missing)?;
    file.take(MAX_REPORT_BYTES).read_to_end(&mut bytes).map_err(|e| Problem::internal(e.to_string()))?;
    Ok(bytes)
}

/// What wrote it, by what only it has; `None` for other JSON.
fn kind(text: &[u8]) -> Option<&'static str> {
    let value: Value = serde_json::from_slice(text).ok()?;
    if value.get("curve").is_some() {
        Some("measure")
    } else if value.get("curves").is_some() {
        Some("sweep")
    } else {
        None
    }
}
