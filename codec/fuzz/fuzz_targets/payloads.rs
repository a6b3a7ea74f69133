// What each fuzz target does with its bytes; `tests/corpus.rs` runs the same on the corpora.

use gv3_codec::decode_stamps;
use gv3_codec::seed::{Flattened, decode_group};
use gv3_codec::texture::{MAX_SIDE_PX, decode_key_texture};
use gv3_codec::{Mode, StreamHeader};

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
