// What each fuzz target does with its bytes; `tests/corpus.rs` runs the same on the corpora.

use gv3_codec::decode_stamps;
use gv3_codec::seed::{Flattened, decode_group};
use gv3_codec::shot::group::{Parts, Wanted};
use gv3_codec::shot::link::Link;
use gv3_codec::shot::steps::Steps;
use gv3_codec::shot::textures::Pictures;
use gv3_codec::texture::coded::{self, Models, Offsets, Planes, Source};
use gv3_codec::texture::{MAX_SIDE_PX, decode_key_texture};
use gv3_codec::{Mode, Result, StreamHeader};
use std::sync::LazyLock;

/// Larger surfaces are decoded but not laid on a disk, which takes seconds.
const MOST_FLATTENED: usize = 2000;

/// A stream header that decodes is coded to the same bytes.
pub fn stream_header(bytes: &[u8]) {
    if let Ok(header) = StreamHeader::decode(bytes) {
        assert_eq!(header.encode(), bytes, "a second form of a stream header");
    }
}

/// A group that decodes has sound stamps and surface, and lies on a finite disk or is refused.
pub fn group(bytes: &[u8]) {
    let header = StreamHeader {
        mode: Mode::Seed { position_step_mm: 0.0625 },
        keyframe_interval: 10,
        scan_period_nanos: 33_333_333,
    };
    let stamps = decode_stamps(&header, bytes);
    let Ok(group) = decode_group(&header, bytes) else { return };
    assert_eq!(stamps.as_deref(), Ok(&group.stamps[..]));
    assert!(group.stamps.windows(2).all(|w| w[0].tick < w[1].tick && w[0].time_nanos < w[1].time_nanos));
    assert!(group.mesh.validate().is_ok());
    let places = group.landmarks.iter().map(|p| p.here.triangle as usize);
    assert!(places.max().is_none_or(|t| t < group.mesh.triangles.len()));
    if group.mesh.vertex_count() <= MOST_FLATTENED
        && let Ok(flat) = Flattened::new(group, None)
    {
        assert!(flat.disk.points.iter().all(|z| z.is_finite()));
    }
}

/// A texture that decodes has as many pixels as it says.
pub fn texture(bytes: &[u8]) {
    if let Ok(picture) = decode_key_texture(bytes) {
        assert!(picture.width_px <= MAX_SIDE_PX && picture.height_px <= MAX_SIDE_PX);
        assert_eq!(picture.pixels.len(), picture.width_px as usize * picture.height_px as usize);
    }
}

/// A run of shots, group and textures one after another.
const RUN: [[&str; 2]; 4] = [
    [include_str!("../../vectors/valid/shots-0-begins.hex"), include_str!("../../vectors/valid/textures-0-alone.hex")],
    [
        include_str!("../../vectors/valid/shots-1-continues.hex"),
        include_str!("../../vectors/valid/textures-1-predicted.hex"),
    ],
    [
        include_str!("../../vectors/valid/shots-2-refreshes.hex"),
        include_str!("../../vectors/valid/textures-2-alone.hex"),
    ],
    [include_str!("../../vectors/valid/shots-3-begins.hex"), include_str!("../../vectors/valid/textures-3-alone.hex")],
];

/// Groups and textures of the run, and the states after each group.
static KNOWN: LazyLock<Vec<([Vec<u8>; 2], Link)>> = LazyLock::new(|| {
    let mut known: Vec<([Vec<u8>; 2], Link)> = Vec::new();
    for (i, texts) in RUN.into_iter().enumerate() {
        let [group, textures] = texts.map(from_hex);
        let after = decode(i, &group, Some(&textures), known.last().map(|k| &k.1)).expect("a vector");
        known.push(([group, textures], after));
    }
    known
});

fn from_hex(text: &str) -> Vec<u8> {
    let digits: Vec<u32> =
        text.lines().flat_map(|l| l.split('#').next().unwrap_or("").chars()).filter_map(|c| c.to_digit(16)).collect();
    digits.chunks_exact(2).map(|d| (d[0] << 4 | d[1]) as u8).collect()
}

fn decode(index: usize, group: &[u8], textures: Option<&[u8]>, before: Option<&Link>) -> Result<Link> {
    let steps = Steps::default();
    let header = StreamHeader { mode: Mode::Shots(steps), keyframe_interval: 4, scan_period_nanos: 33_333_333 };
    let parts = Parts::read(&header, group)?;
    let pictures = textures.map(|t| Pictures::read(t, parts.stamps.len() - 1)).transpose()?;
    let after = Link::after(&parts, pictures.as_ref(), before, index, &steps)?;
    for shown in after.show(&parts, pictures.as_ref(), before, &steps, Wanted::All)? {
        let Some(scan) = &shown.scan else { unreachable!("scans are decoded") };
        let pixels = scan.placed.window.width * scan.placed.window.height;
        assert!(scan.mask.len() == pixels && scan.residual.len() == pixels);
        assert!(scan.placed.motion.in_range() && (0..pixels).all(|i| scan.depth(i).abs() <= 1 << 25));
        if let Some(picture) = shown.texture()? {
            assert_eq!(picture.pixels.len(), pixels);
        }
    }
    Ok(after)
}

/// The first byte says in place of which group of a run the others stand; a group that decodes has sound scans.
pub fn shots(bytes: &[u8]) {
    let Some((n, group)) = bytes.split_first() else { return };
    let at = usize::from(*n) % RUN.len();
    let _ = decode(at, group, None, at.checked_sub(1).map(|b| &KNOWN[b].1));
}

/// As [`shots`], the textures of a group.
pub fn textures(bytes: &[u8]) {
    let Some((n, textures)) = bytes.split_first() else { return };
    let at = usize::from(*n) % RUN.len();
    let _ = decode(at, &KNOWN[at].0[0], Some(textures), at.checked_sub(1).map(|b| &KNOWN[b].1));
}

/// A single coded texture of 45x38 px: the first byte says grey or colour and how many sources; its pixels stay in range.
pub fn coded_texture(bytes: &[u8]) {
    const SIZE: [usize; 2] = [45, 38];
    let Some((kind, bytes)) = bytes.split_first() else { return };
    let (planes, sources) = (if kind & 1 == 0 { 1 } else { 3 }, usize::from(kind >> 1) % 3);
    let pixel = |i: usize| [i % SIZE[0], i / SIZE[0]];
    let mask: Vec<bool> = (0..SIZE[0] * SIZE[1]).map(|i| (pixel(i)[0] + 2 * pixel(i)[1]) % 17 != 0).collect();
    let levels = vec![(0..mask.len()).map(|i| (i * 37 % 4081) as i16).collect(); planes];
    let picture = Planes { width: SIZE[0], height: SIZE[1], levels };
    let maps = [300, -90].map(|d| {
        let mut offsets = Offsets::even(SIZE[0], SIZE[1], [d; 2]);
        offsets.blocks.iter_mut().zip(0..).for_each(|(o, i)| *o = o.map(|v| v - 25 * i));
        offsets
    });
    let all = [0, 1].map(|k| Source { planes: &picture, offsets: &maps[k], weight: 100 + 56 * k as u16 });
    if let Ok(decoded) = coded::decode(bytes, (planes, SIZE), &mask, &all[..sources], &mut Models::default()) {
        assert!(decoded.planes.levels.iter().flatten().all(|v| (0..=255 * 16).contains(v)));
    }
}
