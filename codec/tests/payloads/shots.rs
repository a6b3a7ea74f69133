//! Groups of shots by their fields, and range-coded sections that no encoder writes.

use super::{Payload, varint};
use crate::shot_run::RUN;
use gv3_codec::Mode;
use gv3_codec::bits::bytes::{ByteReader, unzigzag64, zigzag64};
use gv3_codec::bits::range_coder::{BitModel, RangeEncoder};
use gv3_codec::shot::base::{CONTROL_SIDE, CodedBase};
use gv3_codec::shot::group::Chain;
use gv3_codec::shot::lattice::GRID_SIDE;
use gv3_codec::shot::mask::{self, MaskModels};
use gv3_codec::shot::model::Drawn;
use gv3_codec::shot::motion::Motion;
use gv3_codec::shot::seen_scan::Expected;

/// A group of shots taken apart.
#[derive(Clone)]
pub struct Shots {
    pub scan_count: u64,
    /// Tick step and time offset.
    pub scans: Vec<(u64, i64)>,
    pub start: u8,
    /// Camera rows and axis, edge step.
    pub camera: Option<([i64; 15], u64)>,
    pub since_shot: Option<u64>,
    /// Length as it is stated, if not that of the bytes.
    pub base_length: Option<u64>,
    pub base: Vec<u8>,
    pub key: Vec<u8>,
    pub between: Vec<u8>,
}

impl Shots {
    /// Group `i` of the run.
    pub fn of_run(i: usize) -> Self {
        let mut reader = ByteReader::new(&RUN.groups[i].geometry, "group");
        let mut number = || reader.varint().unwrap();
        let scan_count = number();
        let scans = (0..scan_count).map(|_| (number(), unzigzag64(number()))).collect();
        let start = number() as u8;
        let camera = (start > 0).then(|| (std::array::from_fn(|_| unzigzag64(number())), number()));
        let since_shot = (start == 1).then(&mut number);
        let mut section = || {
            let length = reader.varint().unwrap() as usize;
            reader.take(length).unwrap().to_vec()
        };
        let base = if start > 0 { section() } else { Vec::new() };
        let (key, between) = (section(), section());
        reader.finish().unwrap();
        Self { scan_count, scans, start, camera, since_shot, base_length: None, base, key, between }
    }

    /// Bytes with what they are.
    pub fn payload(&self) -> Payload {
        let mut out = vec![("scans", varint(self.scan_count))];
        for (step, offset) in &self.scans {
            out.push(("scan: tick step, time offset", [varint(*step), varint(zigzag64(*offset))].concat()));
        }
        out.push(("start: 0 continues, 1 refreshes, 2 begins", vec![self.start]));
        if let Some((numbers, edge_step)) = &self.camera {
            for (label, row) in ["camera, x", "camera, y", "camera, divisor"].iter().zip(numbers.chunks(4)) {
                out.push((label, row.iter().flat_map(|v| varint(zigzag64(*v))).collect()));
            }
            out.push(("viewing axis", numbers[12..].iter().flat_map(|v| varint(zigzag64(*v))).collect()));
            out.push(("edge step", varint(*edge_step)));
        }
        out.extend(self.since_shot.map(|since| ("groups since the shot began", varint(since))));
        if self.start > 0 {
            out.push(("base: length", varint(self.base_length.unwrap_or(self.base.len() as u64))));
            out.push(("base", self.base.clone()));
        }
        out.push(("keyframe: length", varint(self.key.len() as u64)));
        out.push(("keyframe", self.key.clone()));
        out.push(("scans between: length", varint(self.between.len() as u64)));
        out.push(("scans between", self.between.clone()));
        out
    }
}

/// Range-coded symbols in models of their own; ends with the mark.
#[derive(Default)]
pub struct Symbols(RangeEncoder);

impl Symbols {
    /// Bits in models that have learned nothing.
    pub fn bits(mut self, bits: &[bool]) -> Self {
        bits.iter().for_each(|b| self.0.bit(&mut BitModel::default(), *b));
        self
    }

    /// Numbers by their size in one table of models, as windows and outliers have them.
    pub fn wide(mut self, models: usize, values: &[u32]) -> Self {
        let mut models = vec![BitModel::default(); models];
        values.iter().for_each(|v| self.0.wide(&mut models, *v));
        self
    }

    /// Numbers of one fresh table, without signs.
    pub fn numbers(mut self, models: usize, values: &[u32]) -> Self {
        let mut models = vec![BitModel::default(); models];
        values.iter().for_each(|v| self.0.number(&mut models, *v));
        self
    }

    /// A turn of so many steps about x, then a pose, a lattice and whatever follows of zeros.
    pub fn turned(mut self, steps: i32) -> Self {
        let mut models = [[BitModel::default(); 8]; 2];
        self.0.signed(&mut models[0], &mut BitModel::default(), steps);
        (1..6).for_each(|k: usize| self.0.number(&mut models[k / 3], 0));
        self.bits(&[false; 3])
    }

    /// A number whose prefix does not end.
    pub fn endless(mut self, models: usize) -> Self {
        let mut table = vec![BitModel::default(); models];
        (0..14).for_each(|k: usize| self.0.bit(&mut table[k.min(models - 1)], true));
        self.0.raw(u32::MAX >> 1, 31);
        self.0.raw(1, 1);
        self
    }

    /// A mask of the window of the chain's keyframe, expected from the model that has not moved.
    pub fn mask(mut self, chain: &Chain, mask: &[bool]) -> Self {
        let key = &chain.keys.scans[&chain.key_tick];
        let drawn = Drawn::new(&chain.model, &Motion::default(), &key.placed.window);
        let expected = Expected::new(&chain.model, &drawn, &[]);
        mask::encode(mask, &expected.mask, &mut self.0, &mut MaskModels::default());
        self
    }

    /// The section's bytes.
    pub fn section(mut self) -> Vec<u8> {
        self.0.raw(0xa5, 8);
        self.0.finish()
    }
}

/// A flat base with one control point and one displacement, in steps.
pub fn base(control: i32, displacement: i32, mark: u32) -> Vec<u8> {
    let Mode::Shots(steps) = RUN.header.mode else { unreachable!("the run is of shots") };
    let mut all = vec![[0; 3]; CONTROL_SIDE * CONTROL_SIDE];
    let mut residuals = vec![0; GRID_SIDE * GRID_SIDE];
    all[CONTROL_SIDE * CONTROL_SIDE - 1][1] = control;
    residuals[128 * GRID_SIDE + 128] = displacement;
    let base =
        CodedBase { control_step: steps.control, control: all, displacement_step: steps.displacement, residuals };
    let mut out = RangeEncoder::default();
    base.encode(&mut out);
    out.raw(mark, 8);
    out.finish()
}

fn changed(i: usize, change: impl FnOnce(&mut Shots)) -> Payload {
    let mut group = Shots::of_run(i);
    change(&mut group);
    group.payload()
}

/// Name (kind, number of the group in whose place it stands), payload, what the error must say.
pub fn invalid_shots(first: &Chain) -> Vec<(&'static str, Payload, &'static str)> {
    [invalid_heads(), invalid_bases(), invalid_keys(first)].concat()
}

fn invalid_heads() -> Vec<(&'static str, Payload, &'static str)> {
    let camera = |k: usize, v: i64| {
        changed(0, |g| {
            if let Some((numbers, _)) = &mut g.camera {
                numbers[k] = v;
            }
        })
    };
    let many = changed(0, |g| (g.scan_count, g.scans) = (257, (0..257).map(|i| (u64::from(i > 0), 0)).collect()));
    let mut long = Shots::of_run(0).payload();
    long.push(("one byte more", vec![0]));
    vec![
        ("shots-0-scans-257", many, "257 scans, at most 256"),
        ("shots-0-start-3", changed(0, |g| g.start = 3), "start 3; 0 to 2 are defined"),
        ("shots-0-slope-above", camera(1, 1 << 33), "a camera out of range"),
        ("shots-0-constant-above", camera(3, -(1 << 60)), "a camera out of range"),
        ("shots-0-divisor-slope-above", camera(8, 1 << 22), "a camera out of range"),
        ("shots-0-divisor-above", camera(11, 1 << 44), "a camera out of range"),
        ("shots-0-axis-above", camera(12, (1 << 15) + 1), "a camera out of range"),
        (
            "shots-0-edge-step-above",
            changed(0, |g| g.camera = g.camera.map(|(numbers, _)| (numbers, (1 << 24) + 1))),
            "edge step is 16777217",
        ),
        ("shots-2-since-above", changed(2, |g| g.since_shot = Some((1 << 40) + 1)), "groups since the shot began is"),
        ("shots-0-base-long", changed(0, |g| g.base_length = Some((1 << 24) + 1)), "base length is 16777217"),
        ("shots-0-continues-nothing", Shots::of_run(1).payload(), "continues a shot that is not there"),
        ("shots-0-follows-nothing", Shots::of_run(3).payload(), "its scans follow a keyframe that is not there"),
        ("shots-1-not-after", changed(1, |g| g.scans[0].0 = 0), "continues a shot that is not there"),
        ("shots-3-not-after", changed(3, |g| g.scans[0] = (8, 0)), "its scans follow a keyframe that is not there"),
        ("shots-0-none-between", changed(0, |g| g.between = vec![1]), "of which there are none"),
        ("shots-0-long", long, "1 bytes too many"),
    ]
}

fn invalid_bases() -> Vec<(&'static str, Payload, &'static str)> {
    let of = |bytes: Vec<u8>| changed(0, |g| g.base = bytes);
    let mut more = Shots::of_run(0).base;
    more.extend([0x55; 5]);
    vec![
        ("shots-0-control-far", of(base(65_537, 0, 0xa5)), "a control point beyond 16 m"),
        ("shots-0-displacement-far", of(base(0, -1725, 0xa5)), "a displacement beyond 256 mm"),
        ("shots-0-base-end", of(base(3, 0, 0xa4)), "its end is not where it should be"),
        ("shots-0-base-more", of(more), "bytes are left"),
        ("shots-0-base-none", of(Vec::new()), "base, byte 0"),
        ("shots-0-number-long", of(Symbols::default().endless(15).section()), "a number of more than 32 bits"),
    ]
}

fn invalid_keys(chain: &Chain) -> Vec<(&'static str, Payload, &'static str)> {
    let first = |s: Symbols| changed(0, |g| g.key = s.section());
    let sized = |width: u32, height: u32| Symbols::default().bits(&[true]).wide(12, &[width, height]);
    let key = &chain.keys.scans[&chain.key_tick];
    let placed = || sized(key.placed.window.width as u32, key.placed.window.height as u32);
    let still = || placed().wide(24, &[0, 0]);
    let posed = || (0..2).fold(still(), |s, _| s.numbers(8, &[0, 0, 0]));
    let unmoved = || posed().bits(&[false; 3]);
    let mut one = vec![false; key.mask.len()];
    one[20 * key.placed.window.width + 24] = true;
    let none = vec![false; key.mask.len()];
    let mut more = Shots::of_run(1).key;
    more.extend([0x55; 5]);
    vec![
        ("shots-0-window-none", first(sized(0, 40)), "a scan of 0x40 pixels"),
        ("shots-0-window-wide", first(sized(4097, 40)), "a scan of 4097x40 pixels"),
        ("shots-0-window-large", first(sized(4096, 4096)), "a scan of 4096x4096 pixels"),
        ("shots-0-window-far", first(placed().wide(24, &[(1 << 20) + 1])), "a window too far from the camera's pixels"),
        ("shots-0-pose-step", first(still().numbers(8, &[32_769])), "a pose step out of range"),
        ("shots-0-turn", first(still().turned(20_000)), "a pose out of range"),
        (
            "shots-0-coefficient",
            first(posed().bits(&[true, true]).numbers(8, &[32_768])),
            "a lattice coefficient out of range",
        ),
        (
            "shots-0-level",
            first(unmoved().mask(chain, &one).bits(&[true, true]).numbers(6, &[32_768])),
            "a transform coefficient out of range",
        ),
        (
            "shots-0-outlier-off",
            first(unmoved().mask(chain, &none).wide(24, &[1]).wide(26, &[5]).wide(24, &[0])),
            "an outlier off the mask",
        ),
        (
            "shots-0-outlier-step",
            first(unmoved().mask(chain, &none).wide(24, &[1]).wide(26, &[0])),
            "a step of outliers out of range",
        ),
        ("shots-0-key-end", first(unmoved().mask(chain, &none).wide(24, &[0]).bits(&[false; 3])), "keyframe, byte"),
        ("shots-1-key-more", changed(1, |g| g.key = more), "bytes are left"),
        ("shots-1-between-cut", changed(1, |g| g.between.truncate(20)), "between, byte"),
    ]
}

/// The textures of a group taken apart.
#[derive(Clone)]
pub struct Textures(pub Vec<Vec<u8>>);

impl Textures {
    /// Those of group `i` of the run: the keyframe's, then those between.
    pub fn of_run(i: usize) -> Self {
        let bytes = RUN.groups[i].texture.as_deref().unwrap();
        let mut reader = ByteReader::new(bytes, "textures");
        let mut pictures = Vec::new();
        while reader.remaining() > 0 {
            let length = reader.varint().unwrap() as usize;
            pictures.push(reader.take(length).unwrap().to_vec());
        }
        Self(pictures)
    }

    /// Bytes with what they are.
    pub fn payload(&self) -> Payload {
        let labels = |i: usize| if i == 0 { ("length", "keyframe") } else { ("length", "scan between") };
        let parts = self.0.iter().enumerate();
        parts.flat_map(|(i, p)| [(labels(i).0, varint(p.len() as u64)), (labels(i).1, p.clone())]).collect()
    }
}

/// As [`invalid_shots`], of textures.
pub fn invalid_group_textures() -> Vec<(&'static str, Payload, &'static str)> {
    let changed = |i: usize, change: &dyn Fn(&mut Vec<Vec<u8>>)| {
        let mut textures = Textures::of_run(i);
        change(&mut textures.0);
        textures.payload()
    };
    let mut long = Textures::of_run(0).payload();
    long[0].1 = varint((1 << 24) + 1);
    vec![
        ("textures-0-step-0", changed(0, &|t| t[0][0] = 0), "a step of 0"),
        ("textures-0-step-above", changed(0, &|t| t[0][..2].copy_from_slice(&[1, 16])), "a step of 4097"),
        ("textures-0-cut", changed(0, &|t| t[0].truncate(40)), "the picture"),
        ("textures-0-more", changed(0, &|t| t[0].extend([0x55; 6])), "bytes are left"),
        ("textures-0-two", changed(0, &|t| t.push(vec![1, 2])), "bytes too many"),
        ("textures-1-few", changed(1, &|t| t.truncate(3)), "1 bytes wanted, 0 left"),
        ("textures-0-long", long, "length of a picture is 16777217"),
        ("textures-0-none", changed(0, &|t| t[0].clear()), "coded texture"),
    ]
}
