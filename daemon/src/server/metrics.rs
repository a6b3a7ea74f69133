//! `/metrics` in the text format of Prometheus, and `/healthz`.

use super::problem::Problem;
use super::shared::{Shared, State};
use crate::live::Live;
use crate::pipeline::LatencySummary;
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
    let text = shared.blocking(|s| Ok(server_metrics(s) + &engine_metrics(&s.live))).await?;
    Ok(([(header::CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], text))
}

fn server_metrics(shared: &Shared) -> String {
    let mut text = String::new();
    let t = &mut text;
    family(t, "gauge", "gv3_build_info", "Version of the program.").labelled("version", env!("CARGO_PKG_VERSION"), 1.0);
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

fn engine_metrics(live: &Live) -> String {
    let (status, counts) = (live.status(), live.metrics());
    let mut text = String::new();
    let t = &mut text;
    let mut states = family(t, "gauge", "gv3_state", "1 for the state that the scanner is in.");
    for state in ["idle", "starting", "previewing", "recording", "stopping", "failed"] {
        states = states.labelled("state", state, f64::from(status.state.name() == state));
    }
    family(t, "counter", "gv3_pictures_total", "Pictures taken.").value(counts.pictures as f64);
    family(t, "counter", "gv3_frame_sets_total", "Complete frame sets.").value(counts.sets as f64);
    family(t, "counter", "gv3_scans_total", "Scans reconstructed.").value(counts.scans as f64);
    let mut drops = family(t, "counter", "gv3_drops_total", "Pictures, frame sets and scans left out, by cause.");
    for (cause, count) in &status.drops {
        drops = drops.labelled("cause", cause, *count as f64);
    }
    summary(t, "gv3_picture_to_mesh_seconds", "From a scan's last picture to its mesh.", &counts.picture_to_mesh);
    summary(t, "gv3_group_on_disk_seconds", "From a group's last picture until it is durable.", &counts.group_on_disk);
    let mut cpu = family(t, "counter", "gv3_stage_cpu_seconds_total", "Processor time of the stages.");
    for (stage, seconds) in ["capture", "reconstruct", "encode", "pictures", "write"].iter().zip(counts.cpu_seconds) {
        cpu = cpu.labelled("stage", stage, seconds);
    }
    let queues = [("sets", status.queues.sets), ("scans", status.queues.scans), ("groups", status.queues.groups)];
    let mut depths = family(t, "gauge", "gv3_queue_length", "What waits between the stages.");
    for (queue, length) in queues {
        depths = depths.labelled("queue", queue, length as f64);
    }
    let degraded = family(t, "gauge", "gv3_degraded", "1 while something is left out so that the encoder keeps up.");
    degraded.value(f64::from(status.degradation != "none"));
    family(t, "gauge", "gv3_saturated_pixels_ratio", "Share of pixels that are clipped.")
        .value(status.exposure.saturated_share);
    family(t, "gauge", "gv3_disk_free_bytes", "Room left for sessions.").value(status.disk.free_bytes as f64);
    family(t, "gauge", "gv3_disk_floor_bytes", "Room that must stay free.").value(status.disk.floor_bytes as f64);
    family(t, "gauge", "gv3_uptime_seconds", "Since the engine was opened.").value(status.uptime_seconds);
    if let Some(recording) = &status.recording {
        family(t, "gauge", "gv3_recording_scans", "Scans of the running recording.").value(recording.scans as f64);
        family(t, "gauge", "gv3_recording_bytes", "Bytes of the running recording.").value(recording.bytes as f64);
    }
    text
}

fn summary(text: &mut String, name: &str, help: &str, of: &LatencySummary) {
    // Writing to a String cannot fail.
    let _ = writeln!(
        text,
        "# HELP {name} {help}\n# TYPE {name} summary\n{name}{{quantile=\"0.5\"}} {}\n{name}{{quantile=\"0.99\"}} {}\n\
         {name}_sum {}\n{name}_count {}",
        of.p50_ms * 1e-3,
        of.p99_ms * 1e-3,
        of.sum_ms * 1e-3,
        of.count
    );
}
