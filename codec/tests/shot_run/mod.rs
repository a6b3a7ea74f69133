//! A run of four groups of shots, and the integers that are decoded from it as text.

use crate::bumpy_disk::{PERIOD_NANOS, Surface, scan};
use gv3_codec::shot::encoder::ShotConfig;
use gv3_codec::shot::group::{Chain, Parts, Wanted};
use gv3_codec::shot::link::Link;
use gv3_codec::shot::model::Model;
use gv3_codec::shot::seen_scan::SeenScan;
use gv3_codec::shot::textures::Pictures;
use gv3_codec::{CodecError, EncodedGroup, Encoder, EncoderConfig, Scan, Stamp, StreamHeader};
use std::fmt::Write;
use std::sync::LazyLock;

/// Ticks from keyframe to keyframe.
const INTERVAL: u8 = 4;
/// Tick of the last scan, a keyframe of another surface.
const LAST: u64 = 12;

/// A coded run.
pub struct Run {
    /// Stream header.
    pub header: StreamHeader,
    /// A new shot; scans that go on in it; a refresh; a shot of another surface.
    pub groups: Vec<EncodedGroup>,
}

/// The run that the vectors hold.
pub static RUN: LazyLock<Run> = LazyLock::new(|| {
    let mut encoder = Encoder::new(config()).unwrap();
    let header = encoder.header();
    let mut groups = Vec::new();
    for scan in scans() {
        groups.extend(encoder.push(scan).unwrap().group);
    }
    groups.extend(encoder.finish().unwrap());
    Run { header, groups }
});

/// How the run is coded.
pub fn config() -> EncoderConfig {
    let mut config = ShotConfig::new(PERIOD_NANOS);
    config.keyframe_interval = INTERVAL;
    config.refresh_groups = 2;
    config.max_error_mm = Some(1.0);
    EncoderConfig::Shots(config)
}

/// The scans of the run.
pub fn scans() -> impl Iterator<Item = Scan> {
    (0..=LAST).map(|tick| scan(tick, if tick == LAST { Surface::Bowl } else { Surface::Dome }))
}

/// Decodes a group after the chain before it; returns what it holds as text, and the chain after it.
pub fn describe(header: &StreamHeader, bytes: &[u8], before: Option<&Chain>) -> Result<(String, Chain), CodecError> {
    let steps = header.steps()?;
    let parts = Parts::read(header, bytes)?;
    let after = parts.decode_key(&steps, before)?;
    let mut out = String::new();
    writeln!(out, "start {:?}", parts.start).unwrap();
    if parts.groups_since_shot().is_some() {
        describe_model(&mut out, &after.model);
    }
    for (stamp, (_, scan)) in parts.decode_between(&steps, before, &after, Wanted::All)?.scans {
        let scan = scan.expect("all are wanted");
        describe_scan(&mut out, stamp, &scan);
    }
    let key = parts.key_stamp();
    describe_scan(&mut out, key, &after.keys.scans[&key.tick]);
    Ok((out, after))
}

/// Decodes the textures of a group after the group before it; returns what they hold as text, and the state after it.
pub fn describe_textures(
    header: &StreamHeader,
    (index, group): (usize, &[u8]),
    bytes: &[u8],
    before: Option<&Link>,
) -> Result<(String, Link), CodecError> {
    let steps = header.steps()?;
    let parts = Parts::read(header, group)?;
    let pictures = Pictures::read(bytes, parts.stamps.len() - 1)?;
    let after = Link::after(&parts, Some(&pictures), before, index, &steps)?;
    let mut out = String::new();
    for shown in after.show(&parts, Some(&pictures), before, &steps, Wanted::All)? {
        let picture = shown.texture()?.ok_or_else(|| CodecError::Stream("no picture".into()))?;
        let levels = crc(picture.pixels.iter().map(|v| i32::from(*v)));
        writeln!(out, "tick {} size_px {} {} grey {levels:08x}", shown.stamp.tick, picture.width_px, picture.height_px)
            .unwrap();
    }
    Ok((out, after))
}

fn describe_model(out: &mut String, model: &Model) {
    let (nodes, triangles) = (&model.connectivity.nodes, &model.connectivity.triangles);
    let line = |v: &[i64]| v.iter().map(i64::to_string).collect::<Vec<_>>().join(" ");
    for row in model.view.rows {
        writeln!(out, "camera {}", line(&row)).unwrap();
    }
    writeln!(out, "axis {}\nedge_step {}", line(&model.view.axis), model.edge_step).unwrap();
    let flat = model.base.positions.iter().flatten().copied();
    writeln!(out, "base positions {:08x} normals {:08x}", crc(flat), crc(model.base.normals.iter().flatten().copied()))
        .unwrap();
    let frames = model.frames.iter().flatten().flatten().flatten().copied();
    writeln!(out, "frames {:08x}", crc(frames)).unwrap();
    let corners = triangles.iter().flatten().map(|v| *v as i32);
    writeln!(out, "nodes {} {:08x}", nodes.len(), crc(nodes.iter().map(|n| *n as i32))).unwrap();
    writeln!(out, "triangles {} {:08x}", triangles.len(), crc(corners)).unwrap();
}

fn describe_scan(out: &mut String, stamp: Stamp, scan: &SeenScan) {
    let (w, pose) = (scan.placed.window, scan.placed.motion.pose);
    writeln!(out, "scan tick {} time_nanos {}", stamp.tick, stamp.time_nanos).unwrap();
    writeln!(out, "  window {} {} offset {} {}", w.width, w.height, w.offset[0], w.offset[1]).unwrap();
    let [[a, b, c], [x, y, z]] = [pose.turn, pose.shift];
    writeln!(out, "  turn {a} {b} {c} shift {x} {y} {z}").unwrap();
    writeln!(out, "  lattice {:08x}", crc(scan.placed.motion.nodes.iter().flatten().copied())).unwrap();
    let seen = scan.drawn.seen.iter().flat_map(|s| [s.x, s.y, s.depth]);
    writeln!(out, "  seen {:08x} drawn {:08x}", crc(seen), crc(scan.drawn.picture.depth.iter().copied())).unwrap();
    let count = scan.mask.iter().filter(|m| **m).count();
    writeln!(out, "  mask {count} {:08x}", crc(scan.mask.iter().map(|m| i32::from(*m)))).unwrap();
    let depth = (0..scan.mask.len()).map(|i| if scan.mask[i] { scan.depth(i) } else { 0 });
    writeln!(out, "  residual {:08x} depth {:08x}", crc(scan.residual.iter().copied()), crc(depth)).unwrap();
}

/// CRC-32 (ISO-HDLC) of little-endian 32-bit integers.
pub fn crc(values: impl Iterator<Item = i32>) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    values.for_each(|v| hasher.update(&v.to_le_bytes()));
    hasher.finalize()
}
