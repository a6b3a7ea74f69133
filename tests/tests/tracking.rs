//! How far landmarks drift over ten scans, where a sequence with known truth is at hand. `GV3_TRACKING_DATA` names a folder
//! with `grid/` and `fixed/`, made by shared data's generator from one seed:
//!
//! ```text
//! make_sequence.py F/grid --mode grid --bmp --frames 61 --noise 0.05
//! make_sequence.py F/fixed --mode fixed --frames 61
//! GV3_TRACKING_DATA=F cargo test -p gv3-tests --release --test tracking -- --nocapture
//! ```
#![allow(clippy::unwrap_used, reason = "helpers of tests fail as tests do")]

use glam::Vec3;
use gv3::files::{obj::read_obj, picture::read_picture};
use gv3_codec::mesh::{Bvh, TriMesh};
use gv3_codec::motion::{PixelMap, Track, Tracker, TrackerOptions};
use std::path::{Path, PathBuf};
use std::time::Duration;

const INTERVAL: usize = 10;

fn data() -> Option<PathBuf> {
    let Some(folder) = std::env::var_os("GV3_TRACKING_DATA") else {
        println!("skipped: GV3_TRACKING_DATA names no folder with grid/ and fixed/");
        return None;
    };
    Some(folder.into())
}

fn mesh(folder: &Path, kind: &str, scan: usize) -> TriMesh {
    read_obj(&folder.join(kind).join(format!("frame_{scan:04}.obj"))).unwrap().mesh
}

/// Time that this thread has run on a processor, where the system tells it.
fn cpu_time() -> Duration {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap_or_default();
    Duration::from_nanos(text.split(' ').next().and_then(|n| n.parse().ok()).unwrap_or(0))
}

/// Landmarks on the surface of a keyframe.
type Lifted = Vec<(u32, Vec3)>;

fn lift(tracks: &[Track], map: &PixelMap<'_>) -> Lifted {
    tracks.iter().filter_map(|t| Some((t.id, map.lift_mm(t.px)?))).collect()
}

/// Distances (mm) of landmarks from where the truth moves them, over one interval.
fn errors_mm(before: &Lifted, here: &Lifted, truth: [&TriMesh; 2]) -> Vec<f32> {
    let bvh = Bvh::new(truth[0]);
    let error = |&(id, p): &(u32, Vec3)| {
        let q = here.iter().find(|(other, _)| *other == id)?.1;
        let place = bvh.nearest(p, 2.0)?;
        let [a, b, c] = truth[1].corners(place.triangle as usize);
        let [u, v, w] = place.barycentric;
        Some(q.distance(a * u + b * v + c * w))
    };
    before.iter().filter_map(error).collect()
}

fn quantile(sorted: &[f32], share: f32) -> f32 {
    sorted[((sorted.len() - 1) as f32 * share) as usize]
}

#[test]
fn landmarks_drift_little_over_ten_scans() {
    let Some(folder) = data() else { return };
    let scans = (0..).take_while(|i| folder.join("grid").join(format!("frame_{i:04}.obj")).is_file()).count().min(61);
    let mut tracker = Tracker::new(TrackerOptions::default());
    let (mut all, mut begun, mut feed_ms, mut map_ms) = (Vec::new(), 0, 0.0, 0.0);
    let mut key: Option<(Lifted, TriMesh)> = None;
    println!("scans      begun  alive  median   p95 mm");
    for i in 0..scans {
        let scan = mesh(&folder, "grid", i);
        let picture = read_picture(&folder.join("grid").join(format!("frame_{i:04}.bmp"))).unwrap();
        let start = cpu_time();
        let map = PixelMap::new(&scan, picture.width_px, picture.height_px).unwrap();
        let drawn = cpu_time();
        tracker.feed(&picture, &map.mask(), i % INTERVAL == 0);
        map_ms += (drawn - start).as_secs_f64() * 1e3;
        feed_ms += (cpu_time() - drawn).as_secs_f64() * 1e3;
        if i % INTERVAL != 0 {
            continue;
        }
        let (here, truth) = (lift(tracker.tracks(), &map), mesh(&folder, "fixed", i));
        if let Some((before, old)) = &key {
            let mut errors = errors_mm(before, &here, [old, &truth]);
            errors.sort_by(f32::total_cmp);
            let (median, p95) = (quantile(&errors, 0.5), quantile(&errors, 0.95));
            println!("{:3} -> {i:3} {:6} {:6}  {median:.3}   {p95:.3}", i - INTERVAL, before.len(), errors.len());
            begun += before.len();
            all.append(&mut errors);
        }
        key = Some((here, truth));
    }
    all.sort_by(f32::total_cmp);
    let (median, p95) = (quantile(&all, 0.5), quantile(&all, 0.95));
    let alive = all.len() as f32 / begun as f32;
    println!("all: median {median:.3} mm, p95 {p95:.3} mm, {:.1} % alive", 100.0 * alive);
    println!("feed {:.1} ms, map {:.1} ms a picture on one core", feed_ms / scans as f64, map_ms / scans as f64);
    assert!(median <= 0.08 && p95 <= 0.45 && alive >= 0.94, "{median} {p95} {alive}");
}
