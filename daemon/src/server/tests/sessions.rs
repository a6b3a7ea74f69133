//! Sessions over HTTP: what is recorded is listed, fetched, renamed, checked, exported, compared and deleted.

use super::harness::{Running, config};
use crate::live::Live;
use crate::server::Notify;
use crate::store::{Retention, SessionDirectory, SessionName, StoreError, expire, repair};
use std::os::unix::net::UnixDatagram;
use std::time::{Duration, SystemTime};

#[tokio::test(flavor = "multi_thread")]
async fn a_recording_lives_through_all_that_is_done_with_it() {
    let server = Running::start().await;
    let stopped = server.record("smile", 25).await;
    assert_eq!((stopped["session"].as_str(), stopped["verified"].as_bool()), (Some("smile"), Some(true)));
    let listed = server.get("/api/v1/sessions").await.json();
    assert_eq!(listed["sessions"][0]["state"], "complete");
    assert_eq!(listed["sessions"][0]["scans"], stopped["scans"]);
    let curve = server.get("/api/v1/sessions/smile/curve").await.json();
    let detail = server.get("/api/v1/sessions/smile").await.json();
    let total = |v: &serde_json::Value| v.as_array().unwrap().iter().map(|b| b.as_u64().unwrap()).sum::<u64>();
    let groups: u64 = detail["groups"].as_array().unwrap().iter().map(|g| g["bytes"].as_u64().unwrap()).sum();
    assert_eq!(total(&curve["bytes"]), groups);

    let whole = std::fs::read(server.folder.path().join("smile.gv3")).unwrap();
    let file = "/api/v1/sessions/smile/file";
    assert_eq!(server.get(file).await.body, whole);
    let part = server.request("GET", file, &[("Range", "bytes=10-19")], "").await;
    assert_eq!((part.status, &part.body[..]), (206, &whole[10..20]));
    assert!(part.head.contains(&format!("content-range: bytes 10-19/{}", whole.len())));
    let outside = server.request("GET", file, &[("Range", "bytes=999999999-")], "").await;
    assert_eq!(outside.status, 416);
    assert_eq!(server.get(&format!("{file}?segment=2")).await.status, 404);

    let verified = server.job(server.post("/api/v1/sessions/smile/verify", "").await).await;
    assert_eq!((&verified["state"], &verified["report"]["ok"]), (&"done".into(), &true.into()));
    let exported = server.post("/api/v1/sessions/smile/export", r#"{"as":"mesh","format":"ply"}"#).await;
    let exported = server.job(exported).await;
    assert_eq!(exported["state"], "done", "{exported}");
    let zip = server.get(&format!("/api/v1/jobs/{}/result", exported["id"].as_str().unwrap())).await;
    assert_eq!(zip.body.len() as u64, exported["result_bytes"].as_u64().unwrap());
    let meshes = zip.body.windows(4).filter(|w| w == b"PK\x01\x02").count();
    assert!(meshes as u64 >= stopped["scans"].as_u64().unwrap(), "{meshes}");
    let usual =
        server.job(server.post("/api/v1/sessions/smile/export", r#"{"format":"obj","last_tick":3}"#).await).await;
    assert_eq!((&usual["report"]["as"], &usual["report"]["scans"]), (&"scan".into(), &4.into()), "{usual}");
    let clip = server.job(server.post("/api/v1/sessions/smile/export", r#"{"as":"mesh","format":"gltf"}"#).await).await;
    assert_eq!((&clip["state"], &clip["report"]["scans"]), (&"done".into(), &stopped["scans"]), "{clip}");
    let zip = server.get(&format!("/api/v1/jobs/{}/result", clip["id"].as_str().unwrap())).await;
    let files = zip.body.windows(4).filter(|w| w == b"PK\x01\x02").count() as u64;
    assert_eq!(Some(files), clip["report"]["files"].as_u64());
    assert!(files < stopped["scans"].as_u64().unwrap(), "{files} files, one a shot");
    // The first entry of the archive, stored as it is, begins after its head and name.
    assert_eq!((&zip.body[30..36], &zip.body[40..48]), (&b"frame_"[..], &b".glbglTF"[..]));
    assert_eq!(listed["sessions"][0]["outputs"], serde_json::json!(["scan", "mesh"]));
    for wrong in [r#"{"as":"points","format":"obj"}"#, r#"{"format":"stl"}"#, "{}", r#"{"format":"obj","fps":0}"#] {
        assert_eq!(server.post("/api/v1/sessions/smile/export", wrong).await.status, 400, "{wrong}");
    }
    let compared = server.job(server.post("/api/v1/sessions/smile/compare", r#"{"with":"smile"}"#).await).await;
    // The nearest point on its own surface is a vertex itself, to the last bits of single precision.
    assert_eq!(compared["report"]["p95_mm_all"].as_f64(), Some(0.0), "{compared}");
    assert!(compared["report"]["rms_mm_all"].as_f64().is_some_and(|rms| rms < 1e-4), "{compared}");

    let picture = server.get("/api/v1/sessions/smile/thumbnail.png").await;
    let picture = image::load_from_memory(&picture.body).unwrap().into_rgb8();
    let lit = picture.pixels().filter(|p| p.0 != crate::view::render::DARK_BACKGROUND).count();
    assert!(picture.dimensions() == (320, 240) && lit > 3000, "{lit}");

    let mut jobs = Vec::new();
    for _ in 0..4 {
        jobs.push(server.post("/api/v1/sessions/smile/export", r#"{"format":"ply"}"#).await);
    }
    // The last waits for the others.
    for (method, body) in [("DELETE", ""), ("PATCH", r#"{"name":"grin"}"#)] {
        assert_eq!(server.request(method, "/api/v1/sessions/smile", &[], body).await.status, 409, "{method}");
    }
    for job in jobs {
        let path = format!("/api/v1/jobs/{}", job.json()["id"].as_str().unwrap());
        assert_eq!(server.request("DELETE", &path, &[], "").await.status, 204);
        assert_ne!(server.job(job).await["state"], "failed");
    }
    let renamed = server.request("PATCH", "/api/v1/sessions/smile", &[], r#"{"name":"grin"}"#).await;
    assert_eq!(renamed.json()["name"], "grin");
    assert_eq!(server.get("/api/v1/sessions/smile").await.status, 404);
    assert_eq!(server.request("DELETE", "/api/v1/sessions/grin", &[], "").await.status, 204);
    assert_eq!(server.get("/api/v1/sessions").await.json()["sessions"].as_array().unwrap().len(), 0);
    server.stop().await.1.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn the_running_recording_cannot_be_renamed_deleted_repaired_or_expired() {
    let server = Running::start().await;
    let started = server.post("/api/v1/recording/start", r#"{"name":"now"}"#).await;
    assert_eq!(started.status, 201);
    server.wait_for_scans(5).await;
    assert_eq!(server.request("DELETE", "/api/v1/sessions/now", &[], "").await.status, 409);
    assert_eq!(server.request("PATCH", "/api/v1/sessions/now", &[], r#"{"name":"then"}"#).await.status, 409);
    assert_eq!(server.post("/api/v1/sessions/now/recover", "").await.status, 409);
    assert_eq!(server.get("/api/v1/sessions").await.json()["sessions"][0]["state"], "recording");
    assert_eq!(server.post("/api/v1/recording/start", r#"{"name":"now"}"#).await.status, 409);
    let stopped = server.post("/api/v1/recording/stop", "").await.json();
    assert_eq!(stopped["verified"], true);
    server.stop().await.1.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn stopping_in_any_state_leaves_whole_sessions_and_frees_the_directory() {
    for state in ["idle", "previewing", "recording"] {
        let server = Running::start().await;
        if state == "previewing" {
            assert_eq!(server.post("/api/v1/scanner/start", "").await.status, 204);
        } else if state == "recording" {
            assert_eq!(server.post("/api/v1/recording/start", r#"{"name":"last"}"#).await.status, 201);
            server.wait_for_scans(12).await;
        }
        let (folder, ended) = server.stop().await;
        ended.unwrap();
        let directory = SessionDirectory::open(folder.path()).expect("the lock is free");
        let sessions = directory.list(None).unwrap();
        assert_eq!(sessions.len(), usize::from(state == "recording"));
        for session in sessions {
            assert_eq!(session.state, crate::store::State::Complete, "{session:?}");
            assert!(session.scans >= 12);
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_torn_session_is_repaired_after_the_start() {
    let server = Running::start().await;
    server.record("torn", 25).await;
    let (folder, _) = server.stop().await;
    let path = folder.path().join("torn.gv3");
    let whole = std::fs::read(&path).unwrap();
    std::fs::write(&path, &whole[..whole.len() * 2 / 3]).unwrap();
    std::fs::write(folder.path().join("broken.gv3"), b"no session").unwrap();
    let server = Running::start_with(folder, None, Notify::default()).await;
    let is_repaired = async {
        loop {
            let all = server.get("/api/v1/sessions").await.json();
            let states: Vec<_> = all["sessions"].as_array().unwrap().iter().map(|s| s["state"].clone()).collect();
            if states == ["damaged", "complete"] {
                break;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    tokio::time::timeout(super::harness::PATIENCE, is_repaired).await.expect("the session is repaired");
    server.stop().await.1.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_configuration_is_reloaded_and_the_manager_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let socket = folder.path().join("notify");
    let manager = UnixDatagram::bind(&socket).unwrap();
    manager.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
    let notify = Notify::new(socket.as_os_str(), Some(Duration::from_millis(100)));
    let server = Running::start_with(folder, None, notify).await;
    let heard = tokio::task::spawn_blocking(move || {
        let mut all = Vec::new();
        let mut buffer = [0; 256];
        while !all.iter().any(|m: &String| m.starts_with("STOPPING=1")) {
            let n = manager.recv(&mut buffer).expect("a message");
            all.push(String::from_utf8_lossy(&buffer[..n]).into_owned());
        }
        all
    });
    assert_eq!(server.post("/api/v1/config/reload", "").await.status, 204);
    tokio::time::sleep(Duration::from_millis(1500)).await;
    let (_folder, ended) = server.stop().await;
    ended.unwrap();
    let heard = heard.await.unwrap();
    assert!(heard[0].starts_with("READY=1"), "{heard:?}");
    assert!(heard.iter().any(|m| m == "WATCHDOG=1"), "{heard:?}");
}

#[test]
fn a_second_daemon_is_refused_until_the_first_ends() {
    let folder = tempfile::tempdir().unwrap();
    let first = SessionDirectory::open(folder.path()).unwrap();
    let second = SessionDirectory::open(folder.path()).err().unwrap();
    assert!(matches!(&second, StoreError::Locked { .. }));
    assert!(second.to_string().contains(&std::process::id().to_string()), "{second}");
    drop(first);
    SessionDirectory::open(folder.path()).unwrap();
}

#[test]
fn retention_and_repair_leave_the_recording_and_other_files_alone() {
    let folder = tempfile::tempdir().unwrap();
    let directory = SessionDirectory::open(folder.path()).unwrap();
    for name in ["old.gv3", "old.0002.gv3", "now.gv3", "notes.txt"] {
        std::fs::write(folder.path().join(name), [0; 100]).unwrap();
    }
    std::fs::create_dir(folder.path().join("old.raw")).unwrap();
    std::fs::write(folder.path().join("old.raw/pictures"), [0; 50]).unwrap();
    std::os::unix::fs::symlink("/etc/hostname", folder.path().join("link.gv3")).unwrap();
    let now = SessionName::new("now").unwrap();
    let later = SystemTime::now() + Duration::from_secs(10 * 86_400);
    let keep = Retention { keep_days: Some(5.0), keep_bytes: Some(0) };
    let gone = expire(&directory, &keep, later, Some(&now)).unwrap();
    assert_eq!(gone.iter().map(|g| (g.name.as_str(), g.bytes)).collect::<Vec<_>>(), [("old", 250)]);
    assert!(repair(&directory, |_| true).unwrap().is_empty());
    let mut left: Vec<_> = std::fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
    left.sort();
    assert_eq!(left, [".gv3.lock", "link.gv3", "notes.txt", "now.gv3"]);
}

#[test]
fn an_address_that_others_reach_needs_a_token() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().to_path_buf();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    let bound = runtime.block_on(async {
        let live = Live::open(config(&path)).unwrap();
        let directory = SessionDirectory::open(&path).unwrap();
        let server_config =
            crate::server::ServerConfig { listen: "0.0.0.0:0".parse().unwrap(), token: None, hosts: Vec::new() };
        let read_config = std::sync::Arc::new(move || Ok(config(&path)));
        crate::server::Server::bind(server_config, live, directory, read_config, Notify::default()).await
    });
    let error = bound.err().unwrap().to_string();
    assert!(error.contains("--token-file"), "{error}");
}
