//! Pictures that are coded apart from the geometry of their groups.
#![allow(clippy::unwrap_used, reason = "helpers of tests")]

#[allow(dead_code, reason = "other tests use the rest")]
mod bumpy_disk;
#[allow(dead_code, reason = "other tests use the rest")]
mod shot_run;

use gv3_codec::shot::pictures::PictureEncoder;
use gv3_codec::{EncodedGroup, Encoder};
use shot_run::{RUN, config, scans};
use std::sync::mpsc;

#[test]
fn pictures_coded_in_another_thread_are_the_same_also_after_another_run() {
    let (groups, coded) = mpsc::channel::<EncodedGroup>();
    let pictures = std::thread::spawn(move || {
        let mut encoder = PictureEncoder::default();
        let code = |mut group: EncodedGroup| {
            assert!(group.texture.is_none() && group.pictures.is_some());
            encoder.encode(&mut group);
            group
        };
        coded.into_iter().map(code).collect::<Vec<_>>()
    });
    for _ in 0..2 {
        let mut encoder = Encoder::new(config()).unwrap();
        encoder.defer_pictures();
        let pushed = scans().map(|scan| encoder.push(scan).unwrap().group).collect::<Vec<_>>();
        let last = encoder.finish().unwrap();
        pushed.into_iter().chain([last]).flatten().for_each(|group| groups.send(group).unwrap());
    }
    drop(groups);
    let found = pictures.join().unwrap();
    assert_eq!(found.len(), 2 * RUN.groups.len());
    for (found, expected) in found.iter().zip(RUN.groups.iter().cycle()) {
        assert_eq!((&found.geometry, &found.texture), (&expected.geometry, &expected.texture));
        assert!(found.texture.is_some() && expected.pictures.is_none());
    }
}
