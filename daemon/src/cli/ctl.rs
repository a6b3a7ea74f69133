//! `gv3 ctl`: commands for a running daemon.

use super::Outcome;
use super::progress::human_bytes;
use super::serve::USUAL_ADDRESS;
use anyhow::{Context, Result, anyhow, bail};
use axum::body::Bytes;
use clap::{Args, Subcommand};
use http_body_util::{BodyExt, Full, Limited};
use hyper::{Method, Request, header};
use hyper_util::rt::TokioIo;
use serde_json::{Value, json};
use std::fmt::Write;
use std::path::PathBuf;
use std::time::Duration;

/// Longest that an answer is waited for; stopping verifies what was written.
const TIMEOUT: Duration = Duration::from_secs(90);
/// Longest answer, bytes.
const MAX_ANSWER_BYTES: usize = 64 << 20;

/// Control a running `gv3 serve`: start and stop recordings, look, list sessions.
#[derive(Debug, Args)]
#[command(
    after_help = "Examples:\n  gv3 ctl start smile\n  gv3 ctl mark \"mouth open\"\n  gv3 ctl stop\n  gv3 ctl status --json\n  gv3 ctl sessions"
)]
pub struct Ctl {
    #[command(subcommand)]
    action: Action,
    /// Address and port of the daemon.
    #[arg(long, global = true, default_value_t = USUAL_ADDRESS.to_string())]
    server: String,
    /// File with the daemon's secret.
    #[arg(long, global = true, value_name = "FILE")]
    token_file: Option<PathBuf>,
    /// Report as JSON, as the daemon answered.
    #[arg(long, global = true)]
    json: bool,
}

#[derive(Debug, Subcommand)]
enum Action {
    /// Begin a recording; the scanner is switched on if it is off.
    Start {
        /// Name of the session; the time of day if none is given.
        name: Option<String>,
        /// Keep the camera's pictures too.
        #[arg(long)]
        raw: bool,
    },
    /// End the recording; when this returns, its files are on disk and verified.
    Stop,
    /// Show how scanner and recording stand.
    Status,
    /// Put a mark with a text into the recording.
    Mark {
        /// What to note.
        text: String,
    },
    /// Switch the scanner on without recording, or off.
    Preview {
        /// Off instead of on.
        #[arg(long)]
        off: bool,
    },
    /// List the sessions.
    Sessions,
    /// Read the configuration again.
    Reload,
}

impl Action {
    /// Method, path and body of the request.
    fn request(&self) -> (Method, &'static str, Option<Value>) {
        match self {
            Self::Start { name: Some(name), raw } => {
                (Method::POST, "/recording/start", Some(json!({ "name": name, "raw": raw })))
            }
            Self::Start { name: None, raw } => (Method::POST, "/recording/start", Some(json!({ "raw": raw }))),
            Self::Stop => (Method::POST, "/recording/stop", None),
            Self::Status => (Method::GET, "/status", None),
            Self::Mark { text } => (Method::POST, "/recording/mark", Some(json!({ "text": text }))),
            Self::Preview { off: false } => (Method::POST, "/scanner/start", None),
            Self::Preview { off: true } => (Method::POST, "/scanner/stop", None),
            Self::Sessions => (Method::GET, "/sessions", None),
            Self::Reload => (Method::POST, "/config/reload", None),
        }
    }

    fn describe(&self, answer: &Value) -> String {
        let text = |name: &str| answer[name].as_str().unwrap_or("unknown").to_owned();
        match self {
            Self::Start { .. } => format!("recording {}", text("session")),
            Self::Stop => {
                let bytes = human_bytes(answer["bytes"].as_u64().unwrap_or(0));
                format!("{}: {} scans, {bytes}, verified", text("session"), answer["scans"])
            }
            Self::Mark { .. } => format!("marked at tick {}", answer["tick"]),
            Self::Preview { off } => format!("the scanner is {}", if *off { "off" } else { "on" }),
            Self::Reload => "configuration reloaded".into(),
            Self::Status => status(answer),
            Self::Sessions => sessions(answer),
        }
    }
}

fn status(answer: &Value) -> String {
    let mut text = answer["state"].as_str().unwrap_or("unknown").to_owned();
    // Writing to a String cannot fail.
    if let Some(error) = answer["error"].as_str() {
        let _ = write!(text, ": {error}");
    }
    if let Some(recording) = answer.get("recording").filter(|r| r.is_object()) {
        let (seconds, scans) = (recording["seconds"].as_f64().unwrap_or(0.0), &recording["scans"]);
        let bytes = human_bytes(recording["bytes"].as_u64().unwrap_or(0));
        let _ = write!(text, "\n  session {}, {seconds:.1} s, {scans} scans, {bytes}", recording["session"]);
    }
    if let Some(rate) = answer["scans_per_second"].as_f64() {
        let _ = write!(text, "\n  {rate:.1} scans a second");
    }
    text
}

fn sessions(answer: &Value) -> String {
    let all = answer["sessions"].as_array().map_or(&[][..], |s| s);
    let line = |s: &Value| {
        let (bytes, seconds) = (human_bytes(s["bytes"].as_u64().unwrap_or(0)), s["seconds"].as_f64().unwrap_or(0.0));
        let [name, state] = ["name", "state"].map(|f| s[f].as_str().unwrap_or("unknown"));
        let smaller = s["ratio"].as_f64().map_or_else(String::new, |ratio| format!(" ({ratio:.0} : 1)"));
        let tolerance = s["tolerance_mm"].as_f64().map_or_else(String::new, |mm| format!(", tolerance {mm} mm"));
        format!("{name}  {seconds:.1} s, {} scans, {bytes}{smaller}{tolerance}, {state}", s["scans"])
    };
    if all.is_empty() { "no sessions".into() } else { all.iter().map(line).collect::<Vec<_>>().join("\n") }
}

impl Ctl {
    pub(super) fn run(self) -> Result<Outcome> {
        let token = match &self.token_file {
            Some(path) => {
                let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
                Some(text.trim().to_owned())
            }
            None => None,
        };
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        let (method, path, body) = self.action.request();
        let asked = ask(&self.server, token.as_deref(), method, path, body);
        let answer = runtime.block_on(async {
            tokio::time::timeout(TIMEOUT, asked).await.map_err(|_| anyhow!("{}: no answer", self.server))?
        })?;
        Outcome::of(self.json, &answer, || self.action.describe(&answer))
    }
}

/// One request; the answer's JSON, null for none.
async fn ask(server: &str, token: Option<&str>, method: Method, path: &str, body: Option<Value>) -> Result<Value> {
    let stream = tokio::net::TcpStream::connect(server).await.with_context(|| {
        format!("{server}: no daemon answers; start one with `gv3 serve`, or name it with --server")
    })?;
    let (mut sender, connection) = hyper::client::conn::http1::handshake(TokioIo::new(stream)).await?;
    // Ends with the sender.
    tokio::spawn(connection);
    let mut request = Request::builder().method(method).uri(format!("/api/v1{path}")).header(header::HOST, server);
    if let Some(token) = token {
        request = request.header(header::AUTHORIZATION, format!("Bearer {token}"));
    }
    if body.is_some() {
        request = request.header(header::CONTENT_TYPE, "application/json");
    }
    let bytes = body.map_or_else(Bytes::new, |b| b.to_string().into());
    let answer = sender.send_request(request.body(Full::new(bytes))?).await?;
    let status = answer.status();
    let content = Limited::new(answer.into_body(), MAX_ANSWER_BYTES).collect().await;
    let bytes = content.map_err(|e| anyhow!("{server}: the answer is cut short: {e}"))?.to_bytes();
    let value = if bytes.is_empty() { Value::Null } else { serde_json::from_slice(&bytes)? };
    if !status.is_success() {
        bail!("{}", value["detail"].as_str().unwrap_or(status.canonical_reason().unwrap_or("refused")));
    }
    Ok(value)
}
