//! Encoder of the default mode: scans in, a group out whenever a keyframe closes it.

use super::anchors::{Anchors, TrackedPixel};
use super::base_fit::{BaseOptions, fit_base, refit_base};
use super::camera::ShotCamera;
use super::crop::Crop;
use super::group::{self, Chain, MAX_GROUP_PIXELS, MAX_SCANS, NewBase, Start};
use super::model::{Model, Window};
use super::motion::Motion;
use super::motion_code::Correction;
use super::order::{Decoded, coding_order};
use super::pictures::{GroupPictures, PictureEncoder, ShownBetween, ShownKey};
use super::register::{RegisterOptions, Registered, register};
use super::scan_code::{self, Context, Fidelity, ScanModels, Spent};
use super::scan_image::ScanImage;
use super::steps::Steps;
use super::textures::TextureSteps;
use crate::bits::range_coder::RangeEncoder;
use crate::encoder::{EncodedGroup, Pushed};
use crate::mesh::repair::{RepairOptions, RepairReport, to_disk};
use crate::mesh::simplify::{SimplifyOptions, simplify};
use crate::motion::{Mask, Tracker, TrackerOptions};
use crate::seed::GivenCounts;
use crate::{CodecError, GreyPicture, Mode, Result, Scan, Stamp, StreamHeader};
use std::sync::Arc;

/// Vertices of the disk that a base is mapped from.
const BASE_VERTICES: usize = 20_000;
/// Step of patches in tolerances.
const PATCH_STEP_SHARE: f64 = 4.0;
/// Step of a base's displacements in tolerances.
const DISPLACEMENT_STEP_SHARE: f64 = 1.5;
/// What a base may be flattened by, in tolerances.
const FLAT_SHARE: f64 = 0.4;
/// Squared tolerances that a bit of the lattice may cost.
const LATTICE_WORTH: f64 = 0.6;
/// Squared tolerances, summed over pixels, that a bit of a keyframe's patches may cost: they last.
const KEY_WORTH: f64 = 4.6;
/// The same for scans between keyframes.
const BETWEEN_WORTH: f64 = 25.0;
/// Farther than this from the nearest decoded scan, in ticks, a scan is first found by its tracked points.
const FAR_TICKS: u64 = 3;
/// A registration that matches less of the model than this has lost it.
const MIN_MATCHED: f64 = 0.5;

/// What the encoder may be told.
#[derive(Debug, Clone, PartialEq)]
pub struct ShotConfig {
    /// Ticks from one keyframe to the next.
    pub keyframe_interval: u8,
    /// Time from one tick to the next.
    pub scan_period_nanos: u64,
    /// Steps of everything that is quantized.
    pub steps: Steps,
    /// Error that is worth correcting, mm.
    pub tolerance_mm: f64,
    /// Farthest that any pixel of a scan may be off, mm.
    pub max_error_mm: Option<f64>,
    /// Groups from one refresh to the next.
    pub refresh_groups: u32,
    /// Steps of pictures.
    pub texture: TextureSteps,
    /// Scans between keyframes have patches and pictures of their own; without, they are what motion makes of keyframes (and
    /// as near as `max_error_mm` asks), for much less work.
    pub corrects_between: bool,
    /// How scans become disks.
    pub repair: RepairOptions,
}

impl ShotConfig {
    /// For scans of one period: a keyframe every tenth, a base every eighth group, errors of a tenth of a millimetre.
    pub fn new(scan_period_nanos: u64) -> Self {
        Self {
            keyframe_interval: 10,
            scan_period_nanos,
            steps: Steps::default(),
            tolerance_mm: 0.1,
            max_error_mm: None,
            refresh_groups: 8,
            texture: TextureSteps::default(),
            corrects_between: true,
            repair: RepairOptions::default(),
        }
    }

    /// Written before the first group.
    pub fn header(&self) -> StreamHeader {
        StreamHeader {
            mode: Mode::Shots(self.steps),
            keyframe_interval: self.keyframe_interval,
            scan_period_nanos: self.scan_period_nanos,
        }
    }

    /// Sets the tolerance and the steps that suit it.
    pub fn set_tolerance_mm(&mut self, tolerance_mm: f64) {
        self.tolerance_mm = tolerance_mm;
        let step = |share: f64, least: f64| {
            (share * tolerance_mm * f64::from(super::UNITS_PER_MM)).round().clamp(least, 4096.0) as i32
        };
        self.steps.patch = step(PATCH_STEP_SHARE, 8.0);
        self.steps.displacement = step(DISPLACEMENT_STEP_SHARE, 4.0);
        self.steps.flat = step(FLAT_SHARE, 2.0);
    }

    fn tradeoff(&self) -> Tradeoff {
        let units = f64::from(super::UNITS_PER_MM);
        let tolerance2 = self.tolerance_mm * self.tolerance_mm;
        let bound = self.max_error_mm.map(|mm| (mm * units) as i32);
        let fidelity = |factor: f64| Fidelity { patch_lambda: (factor * tolerance2 * units * units) as f32, bound };
        let register = RegisterOptions { lambda: LATTICE_WORTH * tolerance2, ..RegisterOptions::default() };
        let between = if self.corrects_between { BETWEEN_WORTH } else { f64::INFINITY };
        Tradeoff { key: fidelity(KEY_WORTH), between: fidelity(between), register }
    }
}

/// Trade-offs that follow from a tolerance.
#[derive(Debug, Clone, Copy)]
struct Tradeoff {
    key: Fidelity,
    between: Fidelity,
    register: RegisterOptions,
}

/// What a group cost, by part.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct GroupCost {
    /// Bytes of the base, if one was sent.
    pub base: usize,
    /// Of the keyframe.
    pub key: Spent,
    /// Of the scans between.
    pub between: Spent,
}

/// A scan that waits for the keyframe that closes its group.
struct Pending {
    stamp: Stamp,
    image: ScanImage,
    tracked: Vec<TrackedPixel>,
    picture: Option<GreyPicture>,
}

/// Encoder of one run.
pub struct Encoder {
    config: ShotConfig,
    crop: Crop,
    camera: Option<ShotCamera>,
    chain: Option<Chain>,
    /// None when the pictures of groups are left to the caller.
    pictures: Option<PictureEncoder>,
    groups_since_base: u32,
    groups_since_shot: u64,
    pending: Vec<Pending>,
    tracker: Tracker,
    anchors: Anchors,
    last: Option<Scan>,
    last_stamp: Option<Stamp>,
    next_key_tick: u64,
}

/// A coded keyframe and the chain after it.
struct CodedKey {
    start: Start,
    new_base: Option<NewBase>,
    /// Where the model before is at this keyframe, when a refresh replaces it.
    bridge: Option<Correction>,
    bytes: Vec<u8>,
    spent: Spent,
    chain: Chain,
    repair: Option<RepairReport>,
}

impl Encoder {
    /// An encoder that has seen nothing.
    ///
    /// # Errors
    /// [`CodecError::Stream`] naming a setting out of range.
    pub fn new(config: ShotConfig) -> Result<Self> {
        config.header().validate()?;
        Ok(Self {
            config,
            crop: Crop::default(),
            camera: None,
            chain: None,
            pictures: Some(PictureEncoder::default()),
            groups_since_base: 0,
            groups_since_shot: 0,
            pending: Vec::new(),
            tracker: Tracker::new(TrackerOptions::default()),
            anchors: Anchors::default(),
            last: None,
            last_stamp: None,
            next_key_tick: 0,
        })
    }

    /// Stream header of the run.
    pub fn header(&self) -> StreamHeader {
        self.config.header()
    }

    /// Sets [`ShotConfig::corrects_between`] for the groups to come.
    pub fn set_corrects_between(&mut self, corrects_between: bool) {
        self.config.corrects_between = corrects_between;
    }

    /// Leaves the pictures of the groups to come to a [`PictureEncoder`] of the caller's.
    pub fn defer_pictures(&mut self) {
        self.pictures = None;
    }

    /// Takes the next scan.
    ///
    /// # Errors
    /// [`CodecError::Stream`] when its tick does not follow, [`CodecError::Mesh`] when it cannot be seen.
    pub fn push(&mut self, scan: Scan) -> Result<Pushed> {
        let stamp = Stamp { tick: scan.tick, time_nanos: scan.time_nanos };
        if self.last_stamp.is_some_and(|l| stamp.tick <= l.tick || stamp.time_nanos <= l.time_nanos) {
            return Err(CodecError::Stream(format!("scan at tick {} does not follow the one before it", scan.tick)));
        }
        scan.mesh.validate()?;
        let scan = self.crop.apply(scan);
        let image = self.camera.and_then(|c| Some(ScanImage::new(&scan, &c.view, c.window(&scan)?)));
        let due = image.is_none() || stamp.tick >= self.next_key_tick || self.is_full();
        let tracked = self.track(&scan, image.as_ref(), due);
        let mut pushed = Pushed::default();
        if due {
            match self.code_key(&scan, stamp, image.as_ref(), &tracked) {
                Ok(key) => {
                    pushed.repair = key.repair.clone().filter(RepairReport::has_damage);
                    pushed.group = Some(self.close_group(&scan, stamp, key)?);
                    self.last = None;
                    self.last_stamp = Some(stamp);
                    return Ok(pushed);
                }
                Err(error) if image.is_none() => return Err(error),
                Err(error) => pushed.not_key = Some(error),
            }
        }
        if let Some(image) = image {
            let picture = picture_of(&scan, &image.window);
            self.pending.push(Pending { stamp, image, tracked, picture });
            self.last = Some(scan);
            self.last_stamp = Some(stamp);
        }
        Ok(pushed)
    }

    /// Ends the run: the last scan becomes a keyframe if it is none yet.
    ///
    /// # Errors
    /// [`CodecError::Mesh`] when that scan cannot be a keyframe.
    pub fn finish(mut self) -> Result<Option<EncodedGroup>> {
        let (Some(scan), Some(last)) = (self.last.take(), self.pending.pop()) else { return Ok(None) };
        let key = self.code_key(&scan, last.stamp, Some(&last.image), &last.tracked)?;
        self.close_group(&scan, last.stamp, key).map(Some)
    }

    /// Follows the texture to this scan.
    fn track(&mut self, scan: &Scan, image: Option<&ScanImage>, is_key: bool) -> Vec<TrackedPixel> {
        let (Some(picture), Some(image)) = (&scan.texture, image) else { return Vec::new() };
        if (picture.width_px as usize, picture.height_px as usize) != (image.window.width, image.window.height) {
            return Vec::new();
        }
        let mask = Mask::new(picture.width_px, picture.height_px, image.mask());
        self.tracker.feed(picture, &mask, is_key);
        self.tracker.tracks().iter().map(|t| (t.id, t.px)).collect()
    }

    fn is_full(&self) -> bool {
        let pixels: usize = self.pending.iter().map(|p| p.image.depth.len()).sum();
        let most = self.pending.iter().map(|p| p.image.depth.len()).max().unwrap_or(0);
        self.pending.len() + 2 >= MAX_SCANS || pixels + 2 * most > MAX_GROUP_PIXELS
    }

    /// The keyframe as the shot goes on, or with a new base where it must.
    fn code_key(
        &mut self,
        scan: &Scan,
        stamp: Stamp,
        image: Option<&ScanImage>,
        tracked: &[TrackedPixel],
    ) -> Result<CodedKey> {
        if let (Some(image), Some(chain)) = (image, self.chain.clone()) {
            let predicted = chain.keys.predict(stamp.tick)?.unwrap_or_default();
            let found = self.register(&chain.model, &predicted, (image, true), tracked);
            if found.matched >= MIN_MATCHED {
                let key = if self.groups_since_base < self.config.refresh_groups {
                    self.continued(stamp, image, chain, &predicted, &found.correction)
                } else {
                    self.refreshed(stamp, image, &chain, &predicted, (found.correction, tracked))?
                };
                self.anchors.renew(tracked, &key.chain.model, &key.chain.keys.scans[&stamp.tick], image);
                return Ok(key);
            }
        }
        self.begun(scan, stamp, image.is_some().then_some(tracked))
    }

    fn register(
        &self,
        model: &Model,
        predicted: &Motion,
        (image, is_far): (&ScanImage, bool),
        tracked: &[TrackedPixel],
    ) -> Registered {
        let options = RegisterOptions { is_far, ..self.config.tradeoff().register };
        register(model, predicted, image, (&self.anchors, tracked), &self.config.steps.motion, &options)
    }

    fn continued(
        &self,
        stamp: Stamp,
        image: &ScanImage,
        chain: Chain,
        predicted: &Motion,
        correction: &Correction,
    ) -> CodedKey {
        let references = chain.keys.references(stamp.tick);
        let nearest = chain.keys.nearest(stamp.tick).map(|(_, window)| window);
        let context = Context { model: &chain.model, steps: &self.config.steps };
        let mut models = chain.models.clone();
        let mut out = RangeEncoder::default();
        let fidelity = self.config.tradeoff().key;
        let window = (image.window, nearest);
        let (placed, motion) =
            scan_code::encode_place(context, window, (correction, predicted), (&mut out, &mut models));
        let (scan, spent) = scan_code::encode(context, placed, &references, (image, fidelity), (&mut out, &mut models));
        let spent = Spent { motion, ..spent };
        let chain = Chain { models, ..chain }.advance(stamp.tick, Arc::new(scan));
        let bytes = group::finish(out);
        CodedKey { start: Start::Continues, new_base: None, bridge: None, bytes, spent, chain, repair: None }
    }

    fn refreshed(
        &self,
        stamp: Stamp,
        image: &ScanImage,
        chain: &Chain,
        predicted: &Motion,
        (bridge, tracked): (Correction, &[TrackedPixel]),
    ) -> Result<CodedKey> {
        let motion = bridge.apply(predicted, &chain.model.frames, &self.config.steps.motion);
        let moved = motion.grid_positions(&chain.model.base);
        let base = refit_base(&moved, image, &chain.model.view, &self.base_options())?;
        let new = NewBase { view: chain.model.view, edge_step: chain.model.edge_step, base };
        let key = self.with_base(stamp, image, (Start::Refreshes, new), tracked);
        Ok(CodedKey { bridge: Some(bridge), ..key })
    }

    /// A new shot; `tracked` are the points of this scan, unless it is the first that is seen.
    fn begun(&mut self, scan: &Scan, stamp: Stamp, tracked: Option<&[TrackedPixel]>) -> Result<CodedKey> {
        let camera = ShotCamera::of(scan)?;
        let window = camera.window(scan).ok_or_else(|| CodecError::Mesh("its camera does not see it".into()))?;
        let image = ScanImage::new(scan, &camera.view, window);
        let (disk, report) = to_disk(&scan.mesh, &self.config.repair)?;
        let (small, _) = simplify(&disk, BASE_VERTICES, &SimplifyOptions::default());
        let base = fit_base(&small, &image, &camera.view, &self.base_options())?;
        let new = NewBase { view: camera.view, edge_step: image.edge_step(scan), base };
        self.anchors.clear();
        let tracked = match tracked {
            Some(tracked) => tracked.to_vec(),
            None => self.track(scan, Some(&image), true),
        };
        let key = self.with_base(stamp, &image, (Start::Begins, new), &tracked);
        self.anchors.renew(&tracked, &key.chain.model, &key.chain.keys.scans[&stamp.tick], &image);
        self.camera = Some(camera);
        Ok(CodedKey { repair: Some(report), ..key })
    }

    fn with_base(
        &self,
        stamp: Stamp,
        image: &ScanImage,
        (start, new): (Start, NewBase),
        tracked: &[TrackedPixel],
    ) -> CodedKey {
        let model = Arc::new(Model::new(&new, self.config.steps.flat));
        let chain = Chain { model, key_tick: stamp.tick, keys: Decoded::default(), models: ScanModels::default() };
        let predicted = Motion::default();
        let found = self.register(&chain.model, &predicted, (image, true), tracked);
        let key = self.continued(stamp, image, chain, &predicted, &found.correction);
        CodedKey { start, new_base: Some(new), ..key }
    }

    fn base_options(&self) -> BaseOptions {
        let steps = &self.config.steps;
        BaseOptions { control_step: steps.control, displacement_step: steps.displacement, ..BaseOptions::default() }
    }

    fn close_group(&mut self, scan: &Scan, stamp: Stamp, key: CodedKey) -> Result<EncodedGroup> {
        let pending = std::mem::take(&mut self.pending);
        let (between, spent, decoded) = self.code_between(&pending, stamp, &key)?;
        let stamps: Vec<Stamp> = pending.iter().map(|p| p.stamp).chain([stamp]).collect();
        self.groups_since_shot = if key.start == Start::Begins { 0 } else { self.groups_since_shot + 1 };
        let head = (key.start, key.new_base.as_ref(), self.groups_since_shot);
        let geometry = group::write(&self.config.header(), &stamps, head, &key.bytes, &between)?;
        let base = key.new_base.as_ref().map_or(0, |_| geometry.len() - key.bytes.len() - between.len());
        let cost = GroupCost { base, key: key.spent, between: spent };
        let pictures = self.pictures(scan, stamp, &key, pending, &decoded);
        self.groups_since_base = if key.start == Start::Continues { self.groups_since_base + 1 } else { 1 };
        self.chain = Some(key.chain);
        let interval = u64::from(self.config.keyframe_interval);
        self.next_key_tick = (stamp.tick / interval + 1) * interval;
        let mut group = EncodedGroup {
            first: stamps[0],
            key: stamp,
            scans: stamps.len(),
            geometry,
            texture: None,
            pictures: Some(Box::new(pictures)),
            landmarks: GivenCounts::default(),
            cost: Some(cost),
        };
        if let Some(encoder) = &mut self.pictures {
            encoder.encode(&mut group);
        }
        Ok(group)
    }

    /// The scans before a keyframe, as [`group::Parts::decode_between`] reads them.
    fn code_between(&self, pending: &[Pending], stamp: Stamp, key: &CodedKey) -> Result<(Vec<u8>, Spent, Decoded)> {
        let mut total = Spent::default();
        let (Some(before), false) = (&self.chain, pending.is_empty()) else {
            return Ok((Vec::new(), total, Decoded::default()));
        };
        let mut out = RangeEncoder::default();
        let mut models = key.chain.models.clone();
        let mut decoded = before.keys.clone();
        let coded_key = &key.chain.keys.scans[&stamp.tick];
        let steps = &self.config.steps;
        let mut end_tick = Some(stamp.tick);
        match (key.start, &key.bridge) {
            (Start::Continues, _) => decoded.insert(stamp.tick, Arc::clone(coded_key)),
            (Start::Refreshes, Some(bridge)) => {
                let predicted = decoded.predict(stamp.tick)?.unwrap_or_default();
                bridge.encode(&mut out, models.motion());
                let motion = bridge.apply(&predicted, &before.model.frames, &steps.motion);
                decoded.insert(stamp.tick, Arc::new(coded_key.against(&before.model, &motion)));
            }
            _ => end_tick = None,
        }
        let ticks: Vec<u64> = pending.iter().map(|p| p.stamp.tick).collect();
        let order = coding_order(&ticks, before.key_tick, end_tick);
        let context = Context { model: &before.model, steps };
        for &i in &order {
            let predicted = decoded.predict(ticks[i])?.unwrap_or_default();
            let nearest = decoded.nearest(ticks[i]);
            let image = (&pending[i].image, nearest.is_none_or(|(distance, _)| distance > FAR_TICKS));
            let found = self.register(&before.model, &predicted, image, &pending[i].tracked);
            let window = (pending[i].image.window, nearest.map(|(_, window)| window));
            let motion = (&found.correction, &predicted);
            let (placed, spent) = scan_code::encode_place(context, window, motion, (&mut out, &mut models));
            total.motion += spent;
            decoded.placed.insert(ticks[i], placed);
        }
        let fidelity = self.config.tradeoff().between;
        for i in order {
            let references = decoded.references(ticks[i]);
            let (placed, shown) = (decoded.placed[&ticks[i]].clone(), (&pending[i].image, fidelity));
            let (scan, spent) = scan_code::encode(context, placed, &references, shown, (&mut out, &mut models));
            total = total + spent;
            decoded.scans.insert(ticks[i], Arc::new(scan));
        }
        Ok((group::finish(out), total, decoded))
    }

    /// What the pictures of a group are coded from.
    fn pictures(
        &self,
        scan: &Scan,
        stamp: Stamp,
        key: &CodedKey,
        pending: Vec<Pending>,
        decoded: &Decoded,
    ) -> GroupPictures {
        let coded = Arc::clone(&key.chain.keys.scans[&stamp.tick]);
        let between = |p: Pending| {
            let scan = Arc::clone(decoded.scans.get(&p.stamp.tick)?);
            Some(ShownBetween { scan, tick: p.stamp.tick, picture: p.picture.filter(|_| self.config.corrects_between) })
        };
        GroupPictures {
            picture: picture_of(scan, &coded.placed.window),
            key: ShownKey { model: Arc::clone(&key.chain.model), scan: coded, tick: stamp.tick },
            before: self.chain.as_ref().map(Chain::key),
            continues: key.start == Start::Continues,
            end: decoded.scans.get(&stamp.tick).cloned(),
            between: pending.into_iter().filter_map(between).collect(),
            steps: self.config.texture,
        }
    }
}

/// The picture of a scan whose pixels are the window's.
fn picture_of(scan: &Scan, window: &Window) -> Option<GreyPicture> {
    let fits = |p: &&GreyPicture| (p.width_px as usize, p.height_px as usize) == (window.width, window.height);
    scan.texture.as_ref().filter(fits).cloned()
}
