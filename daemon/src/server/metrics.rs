//! `/metrics` in the text format of Prometheus, and `/healthz`.

use super::problem::Problem;
use super::shared::{Shared, State};
use axum::http::{StatusCode, header};
use axum::response::IntoResponse;
use std::fmt::Write;

/// One family of metrics.
struct Family<'a> {
    text: &'a mut String,
    name: &'a str,
}

fn family<'a>(text: &'a mut String, kind: &str, name: &'a str, help: &str) -> Family<'a> {
    // Writing to a String cannot fail.
    let _ = writeln!(text, "# HELP {name} {help}\n# TYPE {name} {kind}");
    Family { text, name }
}

impl Family<'_> {
    fn value(self, value: f64) -> Self {
        let _ = writeln!(self.text, "{} {value}", self.name);
        self
    }

    fn labelled(self, label: &str, of: &str, value: f64) -> Self {
        let escaped = of.replace('\\', "\\\\").replace('"', "\\\"").replace('\n', "\\n");
        let _ = writeln!(self.text, "{}{{{label}=\"{escaped}\"}} {value}", self.name);
        self
    }
}

/// GET /healthz: 200 while the engine answers.
pub async fn health(axum::extract::State(shared): State) -> Result<impl IntoResponse, Problem> {
    shared.blocking(|s| Ok(s.live.status())).await?;
    Ok((StatusCode::OK, [(header::CONTENT_TYPE, "text/plain; charset=utf-8")], "ok\n"))
}

/// GET /metrics.
pub async fn metrics(axum::extract::State(shared): State) -> Result<impl IntoResponse, Problem> {
    let text = shared.blocking(|s| Ok(server_metrics(s))).await?;
    Ok(([(header::CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], text))
}

fn server_metrics(shared: &Shared) -> String {
    let mut text = String::new();
    let t = &mut text;
    family(t, "gauge", "gv3_build_info", "Version of the program.")
        .labelled("version", env!("CARGO_PKG_VERSION"), 1.0);
    let mut answers = family(t, "counter", "gv3_http_responses_total", "Answers by class of status.");
    for (class, counter) in ["1xx", "2xx", "3xx", "4xx", "5xx"].iter().zip(&shared.counters.answers) {
        answers = answers.labelled("class", class, counter.get() as f64);
    }
    let counters = &shared.counters;
    family(t, "gauge", "gv3_http_connections", "Connections open.").value(counters.connections.get() as f64);
    family(t, "counter", "gv3_http_connections_refused_total", "Connections turned away because too many were open.")
        .value(counters.refused.get() as f64);
    let sockets = super::shared::MAX_SOCKETS - shared.sockets.available_permits();
    family(t, "gauge", "gv3_websockets", "WebSockets open.").value(sockets as f64);
    let replays = super::shared::MAX_REPLAYS - shared.replays.available_permits();
    family(t, "gauge", "gv3_replays", "Replays open.").value(replays as f64);
    family(t, "counter", "gv3_groups_lagged_total", "Clients of coded groups closed because they were too slow.")
        .value(counters.lagged.get() as f64);
    family(t, "gauge", "gv3_jobs_running", "Jobs that wait or are under way.").value(shared.jobs.running() as f64);
    text
}
