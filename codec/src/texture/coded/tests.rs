use super::*;
use proptest::prelude::*;
use std::sync::LazyLock;

/// A speckled, shaded ellipse as it lies `shift` px to the right and `light` brighter, and its mask.
fn scene(width: usize, height: usize, shift: f64, light: f64) -> (Planes, Vec<bool>) {
    let (cx, cy) = (width as f64 / 2.0 + shift, height as f64 / 2.0);
    let at = |i: usize| ((i % width) as f64, (i / width) as f64);
    let mask =
        (0..width * height).map(|i| ((at(i).0 - cx) / cx * 1.2).powi(2) + ((at(i).1 - cy) / cy * 1.1).powi(2) < 1.0);
    let level = |i: usize| {
        let (x, y) = (at(i).0 - shift, at(i).1);
        let speckle = (1.1 * x + 0.3 * y).sin() + (0.4 * x - 0.9 * y).cos() + (0.7 * x + 0.8 * y).sin();
        let noise = ((i as u32 ^ (light as u32) << 20).wrapping_mul(2_654_435_761) >> 24) as f64 / 64.0 - 2.0;
        ((110.0 + light + 0.3 * y + 0.1 * x + 8.0 * speckle + noise) * 16.0) as i16
    };
    (Planes { width, height, levels: vec![(0..width * height).map(level).collect()] }, mask.collect())
}

/// Places of every pixel, (dx, dy) / 256 px away.
fn moved(width: usize, height: usize, dx: i32, dy: i32) -> Offsets {
    Offsets::even(width, height, [dx, dy])
}

/// Mean squared error in grey levels inside the mask.
fn mean_square(a: &Planes, b: &Planes, mask: &[bool]) -> f64 {
    let squares: Vec<f64> = (0..mask.len())
        .filter(|i| mask[*i])
        .map(|i| (f64::from(a.levels[0][i] - b.levels[0][i]) / 16.0).powi(2))
        .collect();
    squares.iter().sum::<f64>() / squares.len() as f64
}

fn both_ways(
    wanted: &Planes,
    mask: &[bool],
    sources: &[Source<'_>],
    models: &mut (Models, Models),
    options: &Options,
) -> (usize, Decoded) {
    let (bytes, coded) = encode(wanted, mask, sources, &mut models.0, options);
    let decoded = decode(&bytes, wanted.shape(), mask, sources, &mut models.1).unwrap();
    assert_eq!(decoded, coded);
    (bytes.len(), decoded)
}

#[test]
fn a_moved_picture_costs_little_and_one_between_two_next_to_nothing() {
    let (w, h) = (150, 133);
    let ((first, m1), (middle, m2), (last, m3)) = (scene(w, h, 0.0, 0.0), scene(w, h, 2.0, 3.0), scene(w, h, 4.0, 6.0));
    let options = Options::with_step(96);
    let mut keys = (Models::default(), Models::default());
    let (first_size, a) = both_ways(&first, &m1, &[], &mut keys, &options);
    assert!(mean_square(&a.planes, &first, &m1) < 6.0);
    // The map is off by (0.5, -0.25) px, which the shifts find.
    let offsets = moved(w, h, -1024 + 128, -64);
    let source = Source { planes: &a.planes, offsets: &offsets, weight: 256 };
    let (last_size, b) = both_ways(&last, &m3, &[source], &mut keys, &options);
    assert!(mean_square(&b.planes, &last, &m3) < 6.0);
    assert!(2 * last_size < first_size, "{first_size} and {last_size} bytes");
    let shift = b.shifts.at(w / 2, h / 2);
    assert!((shift[0] + 128).abs() < 48 && (shift[1] - 64).abs() < 48, "{shift:?}");

    let (mut before, uncorrected) = (moved(w, h, -512 + 64, -32), moved(w, h, 512 - 64, 32));
    let mut after = uncorrected.clone();
    b.shifts.correct(&uncorrected, 128, &mut before);
    b.shifts.correct(&uncorrected, -128, &mut after);
    let sources = [
        Source { planes: &a.planes, offsets: &before, weight: 128 },
        Source { planes: &b.planes, offsets: &after, weight: 128 },
    ];
    let mut between = (Models::default(), Models::default());
    let (size, c) = both_ways(&middle, &m2, &sources, &mut between, &Options::with_step(400));
    assert!(mean_square(&c.planes, &middle, &m2) < 6.0);
    assert!(8 * size < first_size, "{first_size} and {size} bytes");
}

#[test]
fn what_the_source_does_not_show_is_coded_anew() {
    let (w, h) = (96, 64);
    let (picture, _) = scene(w, h, 0.0, 0.0);
    let mask = vec![true; w * h];
    let dark = Planes { width: w, height: h, levels: vec![vec![0; w * h]] };
    let mut offsets = moved(w, h, 0, 0);
    let half = offsets.blocks.len() / 2;
    offsets.blocks[..half].fill(NOWHERE);
    let source = Source { planes: &dark, offsets: &offsets, weight: 256 };
    let (_, decoded) = both_ways(&picture, &mask, &[source], &mut Default::default(), &Options::with_step(64));
    assert!(mean_square(&decoded.planes, &picture, &mask) < 4.0);
}

#[test]
fn fine_steps_keep_every_pixel_and_an_empty_mask_costs_nothing() {
    let (picture, mask) = scene(77, 51, 0.0, 0.0);
    let fine = Options { lambda: 0.0, ..Options::with_step(8) };
    let (_, decoded) = both_ways(&picture, &mask, &[], &mut Default::default(), &fine);
    for i in (0..mask.len()).filter(|i| mask[*i]) {
        let (a, b) = (decoded.planes.levels[0][i], picture.levels[0][i]);
        assert!((a - b).abs() <= 24, "{a} for {b}");
    }
    let (size, _) = both_ways(&picture, &vec![false; mask.len()], &[], &mut Default::default(), &fine);
    assert!(size <= 4, "{size} bytes");
}

#[test]
fn colours_are_coded_with_the_brightness() {
    let (w, h) = (64, 48);
    let rgb: Vec<[u8; 3]> = (0..w * h).map(|i| [(i % w * 3) as u8, (i / w * 4) as u8, (90 + i % 7) as u8]).collect();
    let picture = Planes::from_rgb(w, h, &rgb);
    let mask = vec![true; w * h];
    let (_, decoded) = both_ways(&picture, &mask, &[], &mut Default::default(), &Options::with_step(24));
    let back = decoded.planes.to_rgb();
    for (a, b) in rgb.iter().flatten().zip(back.iter().flatten()) {
        assert!(a.abs_diff(*b) <= 8, "{a} became {b}");
    }
}

/// A predicted picture and what it is decoded with.
struct Predicted {
    bytes: Vec<u8>,
    reference: Planes,
    mask: Vec<bool>,
    offsets: Offsets,
    size: [usize; 2],
}

static KNOWN: LazyLock<Predicted> = LazyLock::new(Predicted::new);

impl Predicted {
    fn new() -> Self {
        let (w, h) = (70, 45);
        let ((first, m1), (second, mask)) = (scene(w, h, 0.0, 0.0), scene(w, h, 1.0, 9.0));
        let options = Options::with_step(60);
        let reference = encode(&first, &m1, &[], &mut Models::default(), &options).1.planes;
        let offsets = moved(w, h, 100, 20);
        let source = Source { planes: &reference, offsets: &offsets, weight: 256 };
        let (bytes, _) = encode(&second, &mask, &[source], &mut Models::default(), &options);
        Self { bytes, reference, mask, offsets, size: [w, h] }
    }

    fn read(&self, bytes: &[u8], predicted: bool) -> Result<Decoded> {
        let source = Source { planes: &self.reference, offsets: &self.offsets, weight: 256 };
        let sources: &[Source<'_>] = if predicted { &[source] } else { &[] };
        decode(bytes, (1, self.size), &self.mask, sources, &mut Models::default())
    }
}

#[test]
fn missing_added_and_wrong_bytes_are_noticed_or_harmless() {
    let bytes = &KNOWN.bytes;
    let read = |bytes: &[u8]| KNOWN.read(bytes, true);
    assert!(read(bytes).is_ok());
    // The mark has eight bits: one wrong ending in 256 may show it by chance.
    let unnoticed = (0..bytes.len()).filter(|n| read(&bytes[..*n]).is_ok()).count();
    assert!(unnoticed <= 1 + bytes.len() / 64, "{unnoticed} of {} prefixes", bytes.len());
    // Up to four bytes after the last one that is needed lie in the coder's window.
    assert!(read(&[&bytes[..], &[0; 5]].concat()).unwrap_err().to_string().contains("left"));
    for bit in 0..bytes.len() * 8 {
        let mut bad = bytes.clone();
        bad[bit / 8] ^= 1 << (bit % 8);
        if let Ok(decoded) = read(&bad) {
            assert!(decoded.planes.levels[0].iter().all(|v| (0..=255 * 16).contains(v)), "bit {bit}");
        }
    }
    for step in [[0, 0], [1, 16]] {
        let error = read(&[&step[..], &bytes[2..]].concat()).unwrap_err().to_string();
        assert!(error.contains("step"), "{error}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn any_bytes_end_in_an_error_or_a_picture(bytes in prop::collection::vec(any::<u8>(), 0..400), predicted: bool) {
        let bytes = [&[100, 0], &bytes[..]].concat();
        if let Ok(decoded) = KNOWN.read(&bytes, predicted) {
            prop_assert!(decoded.planes.levels[0].iter().all(|v| (0..=255 * 16).contains(v)));
        }
    }

    #[test]
    fn the_decoder_has_what_the_encoder_has(
        (width, height) in (1_usize..80, 1_usize..80),
        seed in 0_u32..10_000,
        step in 1_u16..600,
        (colour, sources, hole) in (any::<bool>(), 0_usize..3, 1_u32..6),
        reach in 0_i32..200_000,
    ) {
        let hash = |i: usize, k: u32| (i as u32 ^ (seed * 31 + k).wrapping_mul(747_796_405)).wrapping_mul(2_654_435_761) >> 12;
        let planes = if colour { 3 } else { 1 };
        let picture = |k: u32| Planes {
            width,
            height,
            levels: (0..planes)
                .map(|p| (0..width * height).map(|i| ((hash(i / 7, k + p) % 3000) + hash(i, k) % 1000) as i16).collect())
                .collect(),
        };
        let mask: Vec<bool> = (0..width * height).map(|i| hash(i / 13, 9) % hole != 0).collect();
        let offset = |i: usize, k: u32| match hash(i / 5, k) % 4 {
            0 => NOWHERE,
            _ => [0, 1].map(|c| (i64::from(hash(i / 9, k + c) % 1000) * i64::from(reach) / 500 - i64::from(reach)) as i32),
        };
        let maps = [0, 1].map(|k| {
            let mut offsets = moved(width, height, 0, 0);
            offsets.blocks.iter_mut().enumerate().for_each(|(i, o)| *o = offset(i, 20 + k));
            offsets
        });
        let references = [picture(40), picture(50)];
        let all = [0, 1].map(|k| Source { planes: &references[k], offsets: &maps[k], weight: 77 + 102 * k as u16 });
        let mut models = (Models::default(), Models::default());
        for k in 0..2 {
            both_ways(&picture(60 + k), &mask, &all[..sources], &mut models, &Options::with_step(step));
        }
    }
}
