//! Live streams and replay, and what idle and slow clients do to a recording: nothing.

use super::harness::{self, PATIENCE, Running};
use crate::live::gate::Gate;
use crate::server::Notify;
use crate::server::mesh_message::{HEADER_BYTES, MESH_MAGIC};
use futures_util::{SinkExt, StreamExt};
use gv3_codec::StreamHeader;
use serde_json::Value;
use std::collections::BTreeMap;
use std::time::Duration;
use tokio::net::TcpStream;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::Message;

type Socket = WebSocketStream<TcpStream>;

async fn next(socket: &mut Socket) -> Message {
    loop {
        let message = tokio::time::timeout(PATIENCE, socket.next()).await.expect("a message");
        match message.expect("an open socket").expect("a whole message") {
            Message::Ping(_) | Message::Pong(_) => {}
            message => return message,
        }
    }
}

async fn bytes(socket: &mut Socket) -> Vec<u8> {
    match next(socket).await {
        Message::Binary(bytes) => bytes.to_vec(),
        other => panic!("{other:?}"),
    }
}

async fn say(socket: &mut Socket, text: &str) {
    socket.send(Message::text(text)).await.unwrap();
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap())
}

/// Kind, sequence, topology, time and vertices of a mesh message, its length checked.
fn mesh(bytes: &[u8]) -> (u8, u32, u32, f64, u32) {
    assert_eq!(u32_at(bytes, 0), MESH_MAGIC);
    let (kind, flags, n, triangles) = (bytes[5], bytes[6], u32_at(bytes, 24) as usize, u32_at(bytes, 28) as usize);
    let uv = if flags & 2 == 0 { 0 } else { 4 * n };
    let scalars = if flags & 4 == 0 { 0 } else { n.next_multiple_of(4) };
    let length =
        HEADER_BYTES + (6 * n).next_multiple_of(4) + uv + scalars + 12 * triangles + u32_at(bytes, 56) as usize;
    assert_eq!(bytes.len(), length);
    (kind, u32_at(bytes, 8), u32_at(bytes, 12), f64::from_le_bytes(bytes[16..24].try_into().unwrap()), n as u32)
}

/// Scalars of a message are what -z of the positions says, but for the few beyond their range.
fn depths_are_distances(bytes: &[u8]) {
    let (n, f32_at) = (mesh(bytes).4 as usize, |at| f32::from_bits(u32_at(bytes, at)));
    assert_eq!((bytes[6] & 4, bytes[7]), (4, 1), "depths");
    let (low, high) = (f32_at(60), f32_at(64));
    assert!(0.0 < low && low < high, "{low} to {high}");
    let uv = if bytes[6] & 2 == 0 { 0 } else { 4 * n };
    let scalars = &bytes[HEADER_BYTES + (6 * n).next_multiple_of(4) + uv..][..n];
    for (v, &scalar) in scalars.iter().enumerate() {
        let z = HEADER_BYTES + 6 * v + 4;
        let depth = -(f32_at(40) + f32_at(52) * f32::from(u16::from_le_bytes([bytes[z], bytes[z + 1]])));
        let shown = low + (high - low) * f32::from(scalar) / 255.0;
        assert!(
            (depth.clamp(low, high) - shown).abs() <= (high - low) / 255.0,
            "vertex {v}: {depth} mm, shown {shown}"
        );
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn the_newest_is_streamed_to_those_who_look() {
    let server = Running::start().await;
    let mut events = server.socket("/live/events").await;
    let Message::Text(text) = next(&mut events).await else { panic!("no text") };
    let status: Value = serde_json::from_str(&text).unwrap();
    assert!(status["status"].is_object() || status["status"].is_null());
    let mut meshes = server.socket("/live/mesh?fps=60&max_vertices=1000").await;
    let mut groups = server.socket("/live/groups").await;
    let mut views = Vec::new();
    for view in ["camera", "fringe", "modulation", "phase", "mask"] {
        views.push(server.socket(&format!("/live/picture?view={view}&fps=30")).await);
    }
    assert_eq!(server.post("/api/v1/recording/start", "{}").await.status, 201);
    let first = bytes(&mut meshes).await;
    depths_are_distances(&first);
    let (first, second) = (mesh(&first), mesh(&bytes(&mut meshes).await));
    assert!((1..=1000).contains(&first.4), "{first:?}");
    assert!(second.1 == first.1 + 1 && second.3 > first.3, "{first:?} {second:?}");
    for (view, socket) in views.iter_mut().enumerate() {
        let picture = bytes(socket).await;
        assert_eq!((&picture[..5], picture[5] as usize), (&b"GV3P\x01"[..], view));
        let image = if view < 2 { &b"\xff\xd8"[..] } else { &b"\x89P"[..] };
        assert_eq!(&picture[24..26], image);
    }
    let header = bytes(&mut groups).await;
    assert_eq!(&header[..6], b"GV3G\x01\x00");
    StreamHeader::decode(&header[32..]).unwrap();
    assert_eq!(&bytes(&mut groups).await[..6], b"GV3G\x01\x01");
    let mut late = server.socket("/live/groups").await;
    assert_eq!(bytes(&mut late).await, header);
    server.stop().await.1.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn replay_shows_any_moment_forwards_and_backwards_and_waits_for_acks() {
    let server = Running::start().await;
    server.record("face", 32).await;
    let mut socket = server.socket("/sessions/face/replay?as=mesh").await;
    let first = mesh(&bytes(&mut socket).await);
    assert_eq!((first.0, first.1, first.3), (0, 1, 0.0));
    say(&mut socket, r#"{"ack":1,"seek_seconds":0.55}"#).await;
    let second = mesh(&bytes(&mut socket).await);
    assert_eq!((second.1, second.3), (2, 0.55));
    say(&mut socket, r#"{"ack":2,"play":-1,"fps":100,"scalars":"motion"}"#).await;
    let mut last = second;
    for _ in 0..2 {
        let next = mesh(&bytes(&mut socket).await);
        assert!(next.3 <= last.3, "{last:?} {next:?}");
        last = next;
    }
    say(&mut socket, r#"{"play":1,"loop":true,"scalars":"depth"}"#).await;
    // At most four are on their way: 2 is the last acknowledged.
    while last.1 < 6 {
        last = mesh(&bytes(&mut socket).await);
    }
    let more = tokio::time::timeout(Duration::from_millis(300), socket.next()).await;
    assert!(more.is_err(), "a fifth message without an ack");
    say(&mut socket, r#"{"ack":6,"play":0,"seek_seconds":1e300}"#).await;
    let end = bytes(&mut socket).await;
    depths_are_distances(&end);
    let end = mesh(&end);
    assert!(end.3 < 100.0 && end.1 == 7, "{end:?}");
    let mut scans = server.socket("/sessions/face/replay?as=scan&max_vertices=600").await;
    let one = mesh(&bytes(&mut scans).await);
    assert!(one.4 <= 600 && one.0 == 0);
    say(&mut scans, "{\"fly\":1}").await;
    assert!(matches!(next(&mut scans).await, Message::Close(Some(frame)) if u16::from(frame.code) == 1008));
    server.stop().await.1.unwrap();
}

/// Clients that look on and take nothing from a recording: `idle` ones, half of which never ask for anything, and `slow` ones
/// that never read: their sockets fill, and the newest replaces what they miss.
struct Crowd {
    _slow: Vec<Socket>,
    _silent: Vec<TcpStream>,
}

impl Crowd {
    async fn come(server: &Running, idle: usize, slow: usize) -> Self {
        let paths = ["/live/mesh?fps=60&max_vertices=20000", "/live/picture?fps=60", "/live/groups", "/live/events"];
        let (mut kept, mut silent) = (Vec::new(), Vec::new());
        for i in 0..slow {
            kept.push(server.socket(paths[i % paths.len()]).await);
        }
        for _ in 0..idle / 2 {
            let mut reader = server.socket("/live/events").await;
            tokio::spawn(async move { while reader.next().await.is_some_and(|m| m.is_ok()) {} });
        }
        for _ in 0..idle - idle / 2 {
            silent.push(TcpStream::connect(server.address).await.unwrap());
        }
        Self { _slow: kept, _silent: silent }
    }
}

/// Records in real time among clients; gives the drops of queues meanwhile.
async fn record_among(idle: usize, slow: usize, scans: u64) -> u64 {
    let server = Running::start().await;
    let _crowd = Crowd::come(&server, idle, slow).await;
    let stopped = server.record("kept", scans).await;
    assert_eq!(stopped["verified"], true);
    assert!(stopped["scans"].as_u64().unwrap() >= scans);
    assert_eq!(server.get("/healthz").await.status, 200);
    let drops = server.live.status().drops;
    let queues = ["queue_reconstruct", "queue_encode", "degradation_between"];
    server.stop().await.1.unwrap();
    queues.iter().map(|cause| drops[*cause]).sum()
}

#[tokio::test(flavor = "multi_thread")]
async fn slow_and_idle_clients_do_not_stop_a_recording() {
    record_among(40, 12, 45).await;
}

/// Pictures come as fast as scans are made of them: whatever the clients cost but processor time would be missing.
#[tokio::test(flavor = "multi_thread")]
async fn two_hundred_idle_and_fifty_slow_clients_cost_no_scan() {
    const SCANS: u64 = 150;
    let folder = tempfile::tempdir().unwrap();
    let (mut gate, ground) = Gate::new(&harness::config(folder.path()).rig);
    let server = Running::start_on(ground, folder, None, Notify::default()).await;
    let _crowd = Crowd::come(&server, 200, 50).await;
    let started = server.post("/api/v1/recording/start", "{\"name\":\"kept\"}").await;
    assert_eq!(started.status, 201, "{}", String::from_utf8_lossy(&started.body));
    let live = server.live.clone();
    let passed = tokio::task::spawn_blocking(move || {
        gate.pass(&live, SCANS);
        gate
    });
    let gate = passed.await.unwrap();
    let stopped = server.post("/api/v1/recording/stop", "").await.json();
    assert_eq!((&stopped["verified"], &stopped["scans"]), (&true.into(), &SCANS.into()), "{stopped}");
    assert_eq!(server.live.metrics().drops, BTreeMap::new());
    assert_eq!(server.get("/healthz").await.status, 200);
    drop(gate);
    server.stop().await.1.unwrap();
}

/// `cargo test -p gv3 --lib -- --ignored real_time`.
#[tokio::test(flavor = "multi_thread")]
#[ignore = "needs a machine that has nothing else to do for half a minute"]
async fn two_hundred_idle_and_fifty_slow_clients_cost_no_scan_in_real_time() {
    assert_eq!(record_among(200, 50, 600).await, 0);
}
