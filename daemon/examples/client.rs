//! A client of gv3: reads a session file, and the streams of a running daemon.
//!
//! ```sh
//! cargo run -p gv3 --example client -- session smile.gv3
//! cargo run -p gv3 --example client -- mesh 127.0.0.1:8433 10      # ten surfaces of the live view
//! cargo run -p gv3 --example client -- groups 127.0.0.1:8433 10    # ten groups of the running recording
//! ```
//! `gv3 serve --sim` and `gv3 ctl start` make something to look at. A daemon on another machine wants its token, here in
//! GV3_TOKEN. `GET /api/v1/openapi.json` has the byte tables of all messages.

use anyhow::{Context, Result, bail, ensure};
use futures_util::StreamExt;
use glam::Vec3;
use gv3::replay::Replay;
use gv3_codec::{StreamHeader, decode_stamps};
use std::path::Path;
use tokio::net::TcpStream;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::client::IntoClientRequest;

const USUAL_ADDRESS: &str = "127.0.0.1:8433";

#[tokio::main(flavor = "current_thread")]
async fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let address = arguments.get(1).copied().unwrap_or(USUAL_ADDRESS);
    let count = arguments.get(2).map_or(Ok(10), |text| text.parse()).context("the number of messages")?;
    match arguments[..] {
        ["session", path] => session(Path::new(path)),
        ["mesh", ..] => meshes(address, count).await,
        ["groups", ..] => groups(address, count).await,
        _ => bail!("expected: session FILE, or mesh or groups with [ADDRESS [COUNT]]"),
    }
}

/// A session holds every scan at its own time, and the surface at any moment between them.
fn session(path: &Path) -> Result<()> {
    let mut replay = Replay::open(path)?;
    let stamps = replay.stamps().to_vec();
    let (Some(first), Some(last)) = (stamps.first(), stamps.last()) else { bail!("{}: no scans", path.display()) };
    let (begin, nanos) = (first.time_nanos, last.time_nanos - first.time_nanos);
    let keys = stamps.iter().filter(|stamp| stamp.is_key).count();
    println!("{} scans, {keys} of them keyframes, {:.2} s", stamps.len(), nanos as f64 * 1e-9);
    for quarter in 0..=4 {
        let scan = replay.scan_at(begin + nanos / 4 * quarter)?;
        let (low, high) = scan.mesh.bounds_mm();
        println!(
            "{:8.3} s: {} vertices, {} triangles, {:.0} mm wide, {:.0} mm to {:.0} mm away",
            scan.time_nanos as f64 * 1e-9,
            scan.mesh.vertex_count(),
            scan.mesh.triangles.len(),
            high.x - low.x,
            low.z.abs().min(high.z.abs()),
            low.z.abs().max(high.z.abs()),
        );
    }
    Ok(())
}

/// The live view: decimated surfaces with 16-bit positions. The newest is sent, and what a slow client misses is skipped.
async fn meshes(address: &str, count: usize) -> Result<()> {
    let mut socket = connect(address, "/api/v1/live/mesh?fps=10&max_vertices=5000").await?;
    for _ in 0..count {
        let mesh = LiveMesh::read(&message(&mut socket).await?)?;
        let centre = mesh.positions_mm.iter().sum::<Vec3>() / mesh.positions_mm.len().max(1) as f32;
        println!(
            "{:8.3} s: {} vertices, {} triangles, centre {centre:.1} mm, texture of {} bytes",
            mesh.time_seconds,
            mesh.positions_mm.len(),
            mesh.triangles.len(),
            mesh.jpeg.len()
        );
    }
    Ok(())
}

/// What a message of `/live/mesh` holds.
struct LiveMesh {
    time_seconds: f64,
    /// Camera convention: x right, y down, z away from the camera.
    positions_mm: Vec<Vec3>,
    triangles: Vec<[u32; 3]>,
    jpeg: Vec<u8>,
}

impl LiveMesh {
    fn read(bytes: &[u8]) -> Result<Self> {
        ensure!(bytes.len() >= 72 && bytes.starts_with(b"GV3M") && bytes[4] == 1, "no mesh message of version 1");
        let has_uv = bytes[6] & 2 != 0;
        let has_scalars = bytes[6] & 4 != 0;
        let u32_at = |at: usize| u32::from_le_bytes([0, 1, 2, 3].map(|i| bytes[at + i]));
        let f32x3_at = |at: usize| Vec3::from_array([0, 4, 8].map(|i| f32::from_bits(u32_at(at + i))));
        let [vertices, triangles, jpeg] = [24, 28, 56].map(|at| u32_at(at) as usize);
        let (origin_mm, step_mm) = (f32x3_at(32), f32x3_at(44));
        // Positions, texture coordinates, scalars, triangles, texture; each begins at a multiple of four bytes.
        let positions_bytes = (6 * vertices).next_multiple_of(4);
        let uv_bytes = if has_uv { 4 * vertices } else { 0 };
        let scalar_bytes = if has_scalars { vertices.next_multiple_of(4) } else { 0 };
        let triangles_at = 72 + positions_bytes + uv_bytes + scalar_bytes;
        let jpeg_at = triangles_at + 12 * triangles;
        ensure!(bytes.len() == jpeg_at + jpeg, "a mesh message of {} bytes that says {}", bytes.len(), jpeg_at + jpeg);
        let step_at = |at: usize| f32::from(u16::from_le_bytes([bytes[at], bytes[at + 1]]));
        let position = |v: usize| origin_mm + step_mm * Vec3::from_array([0, 2, 4].map(|i| step_at(72 + 6 * v + i)));
        Ok(Self {
            time_seconds: f64::from_le_bytes(std::array::from_fn(|i| bytes[16 + i])),
            positions_mm: (0..vertices).map(position).collect(),
            triangles: (0..triangles).map(|t| [0, 4, 8].map(|i| u32_at(triangles_at + 12 * t + i))).collect(),
            jpeg: bytes[jpeg_at..].to_vec(),
        })
    }
}

/// The running recording as it comes to be on disk: what `gv3_codec::Player` decodes, from the file's first group on.
async fn groups(address: &str, count: usize) -> Result<()> {
    let mut socket = connect(address, "/api/v1/live/groups").await?;
    let (mut header, mut seen) = (None, 0);
    while seen < count {
        let bytes = message(&mut socket).await?;
        ensure!(bytes.len() >= 32 && bytes.starts_with(b"GV3G") && bytes[4] == 1, "no group message of version 1");
        let key_tick = u64::from_le_bytes(std::array::from_fn(|i| bytes[16 + i]));
        let (kind, payload) = (bytes[5], &bytes[32..]);
        match (kind, &header) {
            (0, _) => header = Some(StreamHeader::decode(payload)?),
            (1, Some(header)) => {
                let scans = decode_stamps(header, payload)?.len();
                println!("group of {scans} scans up to tick {key_tick}: {} bytes of geometry", payload.len());
                seen += 1;
            }
            (2, Some(_)) => println!("  its textures: {} bytes", payload.len()),
            _ => bail!("a group of kind {kind} before its stream's header"),
        }
    }
    Ok(())
}

async fn connect(address: &str, path: &str) -> Result<WebSocketStream<TcpStream>> {
    let stream = TcpStream::connect(address).await;
    let stream = stream.with_context(|| format!("{address}: is the daemon running? gv3 serve --sim"))?;
    let mut request = format!("ws://{address}{path}").into_client_request()?;
    if let Ok(token) = std::env::var("GV3_TOKEN") {
        request.headers_mut().insert("Authorization", format!("Bearer {token}").parse()?);
    }
    Ok(tokio_tungstenite::client_async(request, stream).await?.0)
}

/// The next binary message.
async fn message(socket: &mut WebSocketStream<TcpStream>) -> Result<Vec<u8>> {
    while let Some(message) = socket.next().await {
        match message? {
            Message::Binary(bytes) => return Ok(bytes.to_vec()),
            Message::Close(reason) => bail!("the daemon closed the stream: {reason:?}"),
            _ => {}
        }
    }
    bail!("the daemon ended the stream")
}
