// What the fuzz target does with its bytes; `tests/raw_recording.rs` runs the same on the corpus.

use gv3_protocol::raw::{RawItem, Segment};

/// Every byte behind the header is in exactly one item, damage included, and reading ends.
pub fn segment(bytes: &[u8]) {
    for wants_pixels in [false, true] {
        let Ok(mut segment) = Segment::new(bytes.to_vec()) else { return };
        let mut end = 0;
        let mut items = 0;
        while let Some(item) = segment.next(wants_pixels) {
            items += 1;
            assert!(items <= bytes.len(), "reading does not end");
            match item {
                RawItem::Picture(p) if wants_pixels => {
                    assert_eq!(p.pixels.len(), p.width_px as usize * p.height_px as usize);
                }
                RawItem::Damage { offset, bytes: length, .. } => {
                    assert!(offset >= end && length > 0 && offset + length <= bytes.len() as u64);
                    end = offset + length;
                }
                _ => {}
            }
        }
    }
}
