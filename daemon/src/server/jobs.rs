//! Long work on sessions: one at a time, in the background, with progress, and an end that can be asked for.

use super::byte_range;
use super::input::{Input, Name};
use super::job_work::{Export, Report, Work};
use super::problem::Problem;
use super::shared::{Shared, State};
use crate::store::SessionName;
use axum::Json;
use axum::extract::Path as UrlPath;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Jobs that wait at one time.
const MAX_WAITING: usize = 16;
/// Jobs that have ended and are remembered, with their results.
const MAX_ENDED: usize = 32;
/// Folder of the session directory that holds results; emptied at the start.
const FOLDER: &str = ".jobs";
/// How much the work yields to the capture: nice(2).
const NICENESS: i32 = 10;

/// How a job stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum JobState {
    /// Waiting or under way.
    Running,
    /// Ended as it should.
    Done,
    /// Ended with an error.
    Failed,
    /// Ended because that was asked for.
    Cancelled,
}

/// Progress of a job's work, and whether it is to end.
#[derive(Debug, Default)]
pub struct Progress {
    done: AtomicU64,
    total: AtomicU64,
    is_cancelled: AtomicBool,
}

impl Progress {
    /// Steps in all.
    pub fn set_total(&self, total: u64) {
        self.total.store(total, Ordering::Relaxed);
    }

    /// One step more; false when the work is to end.
    #[must_use]
    pub fn step(&self) -> bool {
        self.done.fetch_add(1, Ordering::Relaxed);
        !self.is_cancelled()
    }

    /// Whether the work is to end.
    pub fn is_cancelled(&self) -> bool {
        self.is_cancelled.load(Ordering::Relaxed)
    }
}

struct Job {
    id: u64,
    session: SessionName,
    /// The other session of a comparison.
    with: Option<SessionName>,
    kind: &'static str,
    progress: Arc<Progress>,
    state: JobState,
    error: Option<String>,
    report: Option<Value>,
    result: Option<(PathBuf, u64)>,
}

impl Job {
    fn to_json(&self) -> Value {
        let mut value = json!({
            "id": self.id.to_string(),
            "kind": self.kind,
            "session": self.session,
            "state": self.state,
            "done": self.progress.done.load(Ordering::Relaxed),
            "total": self.progress.total.load(Ordering::Relaxed),
        });
        let more = [
            ("error", self.error.as_ref().map(|e| json!(e))),
            ("report", self.report.clone()),
            ("result_bytes", self.result.as_ref().map(|(_, bytes)| json!(bytes))),
        ];
        for (name, field) in more {
            if let Some(field) = field {
                value[name] = field;
            }
        }
        value
    }

    fn remove_result(&mut self) {
        if let Some((path, _)) = self.result.take() {
            // It may be gone already.
            let _ = std::fs::remove_file(path);
        }
    }
}

type Table = Arc<Mutex<BTreeMap<u64, Job>>>;

/// The jobs and the thread that does them.
pub struct Jobs {
    table: Table,
    queue: SyncSender<(u64, Work)>,
    last_id: AtomicU64,
}

fn locked(table: &Table) -> MutexGuard<'_, BTreeMap<u64, Job>> {
    table.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Jobs {
    /// No jobs yet; results of an earlier run are removed.
    ///
    /// # Errors
    /// When the folder for results cannot be made or the thread not be started.
    pub fn start(sessions: &Path) -> std::io::Result<Self> {
        let folder = sessions.join(FOLDER);
        if let Err(error) = std::fs::remove_dir_all(&folder)
            && error.kind() != std::io::ErrorKind::NotFound
        {
            return Err(error);
        }
        std::fs::create_dir(&folder)?;
        let (queue, work) = sync_channel(MAX_WAITING);
        let table = Table::default();
        let jobs = Self { table: Arc::clone(&table), queue, last_id: AtomicU64::new(0) };
        // The thread ends with the last sender.
        std::thread::Builder::new().name("gv3-jobs".into()).spawn(move || {
            yield_to_capture();
            run_all(&work, &table, &folder);
        })?;
        Ok(jobs)
    }

    fn add(&self, session: SessionName, with: Option<SessionName>, work: Work) -> Result<Value, Problem> {
        let id = self.last_id.fetch_add(1, Ordering::Relaxed) + 1;
        let mut table = locked(&self.table);
        let job = Job {
            id,
            session,
            with,
            kind: work.kind(),
            progress: Arc::default(),
            state: JobState::Running,
            error: None,
            report: None,
            result: None,
        };
        let value = job.to_json();
        if self.queue.try_send((id, work)).is_err() {
            let detail = format!("{MAX_WAITING} jobs wait already; try again when some have ended");
            return Err(Problem::new(StatusCode::SERVICE_UNAVAILABLE, detail));
        }
        table.insert(id, job);
        let ended = table.iter().filter(|(_, j)| j.state != JobState::Running).map(|(id, _)| *id);
        let ended: Vec<u64> = ended.collect();
        for id in &ended[..ended.len().saturating_sub(MAX_ENDED)] {
            if let Some(mut job) = table.remove(id) {
                job.remove_result();
            }
        }
        Ok(value)
    }

    /// Asks all work to end, for the end of the server.
    pub fn cancel_all(&self) {
        for job in locked(&self.table).values() {
            job.progress.is_cancelled.store(true, Ordering::Relaxed);
        }
    }

    /// Refuses what would take a session's files away from a job.
    ///
    /// # Errors
    /// [`Problem`] 409 naming the job.
    pub fn leave_alone(&self, session: &SessionName) -> Result<(), Problem> {
        let table = locked(&self.table);
        let needs = |job: &&Job| {
            job.state == JobState::Running && (job.session == *session || job.with.as_ref() == Some(session))
        };
        match table.values().find(needs) {
            None => Ok(()),
            Some(Job { id, kind, .. }) => {
                Err(Problem::conflict(format!("job {id} ({kind}) needs the session; wait for its end, or cancel it")))
            }
        }
    }

    /// Removes all results, for the end of the server.
    pub fn forget_results(&self) {
        locked(&self.table).values_mut().for_each(Job::remove_result);
    }

    /// Jobs that wait or are under way.
    pub fn running(&self) -> usize {
        locked(&self.table).values().filter(|j| j.state == JobState::Running).count()
    }

    fn with<T>(&self, id: &str, take: impl FnOnce(&mut BTreeMap<u64, Job>, u64) -> T) -> Result<T, Problem> {
        let mut table = locked(&self.table);
        let known = id.parse().ok().filter(|id| table.contains_key(id));
        known.map(|id| take(&mut table, id)).ok_or_else(|| Problem::not_found(format!("there is no job {id:?}")))
    }
}

/// Lowers this thread's priority: the scanner comes first.
pub fn yield_to_capture() {
    // Without the right to, the thread stays as it is.
    let _ = rustix::process::setpriority_process(Some(rustix::thread::gettid()), NICENESS);
}

fn run_all(queue: &Receiver<(u64, Work)>, table: &Table, folder: &Path) {
    while let Ok((id, work)) = queue.recv() {
        let Some(progress) = locked(table).get(&id).map(|j| Arc::clone(&j.progress)) else { continue };
        let result = folder.join(format!("{id}.{}", work.ending()));
        let span = tracing::info_span!("job", id, kind = work.kind());
        let ended = span.in_scope(|| match progress.is_cancelled() {
            true => Ok(None),
            false => work.run(&progress, &result),
        });
        let mut table = locked(table);
        let Some(job) = table.get_mut(&id) else {
            // Nobody wants it any more, nor what it wrote.
            let _ = std::fs::remove_file(&result);
            continue;
        };
        job.result = std::fs::metadata(&result).ok().map(|m| (result, m.len()));
        match ended {
            Ok(Some(Report(report))) => (job.state, job.report) = (JobState::Done, Some(report)),
            Ok(None) => job.state = JobState::Cancelled,
            Err(error) => (job.state, job.error) = (JobState::Failed, Some(error)),
        }
        if job.state != JobState::Done {
            job.remove_result();
        }
    }
}

fn accepted(job: Value) -> Response {
    let at = job["id"].as_str().map(|id| format!("/api/v1/jobs/{id}")).unwrap_or_default();
    (StatusCode::ACCEPTED, [(header::LOCATION, at)], Json(job)).into_response()
}

async fn add(
    shared: std::sync::Arc<Shared>,
    name: SessionName,
    with: Option<SessionName>,
    work: impl FnOnce(&Shared, Vec<PathBuf>) -> Result<Work, Problem> + Send + 'static,
) -> Result<Response, Problem> {
    let job = shared.blocking(move |s| {
        let work = work(s, s.directory.files(&name)?)?;
        s.jobs.add(name, with, work)
    });
    Ok(accepted(job.await?))
}

/// POST /sessions/{name}/verify.
pub async fn verify(axum::extract::State(shared): State, Name(name): Name) -> Result<Response, Problem> {
    add(shared, name, None, |_, files| Ok(Work::Verify { files })).await
}

/// POST /sessions/{name}/recover.
pub async fn recover(axum::extract::State(shared): State, Name(name): Name) -> Result<Response, Problem> {
    let asked = name.clone();
    add(shared, name, None, move |s, files| match s.recording() {
        Some(recording) if recording == asked => {
            Err(Problem::conflict("the session is being recorded; stop the recording first"))
        }
        _ => Ok(Work::Recover { files }),
    })
    .await
}

/// POST /sessions/{name}/export.
pub async fn export(
    axum::extract::State(shared): State,
    Name(name): Name,
    Input(export): Input<Export>,
) -> Result<Response, Problem> {
    export.check()?;
    add(shared, name, None, |s, files| Ok(Work::Export { files, export, live: s.live.clone() })).await
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Compare {
    with: String,
}

/// POST /sessions/{name}/compare.
pub async fn compare(
    axum::extract::State(shared): State,
    Name(name): Name,
    Input(compare): Input<Compare>,
) -> Result<Response, Problem> {
    let with = SessionName::new(&compare.with)?;
    let other = with.clone();
    add(shared, name, Some(other), move |s, files| Ok(Work::Compare { files, with: s.directory.files(&with)? })).await
}

/// GET /jobs.
pub async fn list(axum::extract::State(shared): State) -> Json<Value> {
    let jobs: Vec<Value> = locked(&shared.jobs.table).values().map(Job::to_json).collect();
    Json(json!({ "jobs": jobs }))
}

/// GET /jobs/{id}.
pub async fn one(axum::extract::State(shared): State, UrlPath(id): UrlPath<String>) -> Result<Json<Value>, Problem> {
    Ok(Json(shared.jobs.with(&id, |table, id| table[&id].to_json())?))
}

/// DELETE /jobs/{id}: asks a running job to end, forgets one that has ended.
pub async fn cancel(axum::extract::State(shared): State, UrlPath(id): UrlPath<String>) -> Result<StatusCode, Problem> {
    shared.jobs.with(&id, |table, id| {
        if table[&id].state == JobState::Running {
            table[&id].progress.is_cancelled.store(true, Ordering::Relaxed);
        } else if let Some(mut job) = table.remove(&id) {
            job.remove_result();
        }
    })?;
    Ok(StatusCode::NO_CONTENT)
}

/// GET /jobs/{id}/result.
pub async fn result(
    axum::extract::State(shared): State,
    UrlPath(id): UrlPath<String>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let (path, session) = shared.jobs.with(&id, |table, id| {
        let job = &table[&id];
        (job.result.as_ref().map(|(path, _)| path.clone()), job.session.clone())
    })?;
    let path = path.ok_or_else(|| Problem::not_found("the job has no result, or none yet"))?;
    let is_zip = path.extension().is_some_and(|e| e == "zip");
    let kind = if is_zip { "application/zip" } else { "application/json" };
    let mut response = byte_range::respond(&path, kind, &headers).await?;
    let name = format!("attachment; filename=\"{}.{}\"", session.as_str(), if is_zip { "zip" } else { "json" });
    if let Ok(value) = HeaderValue::from_str(&name) {
        response.headers_mut().insert(header::CONTENT_DISPOSITION, value);
    }
    Ok(response)
}
