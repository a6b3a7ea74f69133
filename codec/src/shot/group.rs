//! Group payload of the default mode: a keyframe, then the scans before it.

use super::base::CodedBase;
use super::model::Model;
use super::motion::Motion;
use super::motion_code::Correction;
use super::order::{Decoded, Placed, coding_order};
use super::pictures::ShownKey;
use super::scan_code::{self, Context, ScanModels};
use super::seen_scan::SeenScan;
use super::steps::Steps;
use super::view::View;
use crate::bits::bytes::{ByteReader, put_varint, unzigzag64, zigzag64};
use crate::bits::range_coder::{RangeDecoder, RangeEncoder};
use crate::stamps::{Stamp, put_stamps, take_stamps};
use crate::{Result, StreamHeader};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Most scans of a group.
pub const MAX_SCANS: usize = 256;
/// Most pixels of all scans of a group.
pub const MAX_GROUP_PIXELS: usize = 1 << 24;
/// Most groups that follow one another without a base.
pub const MAX_CONTINUED: usize = 32;
/// Longest range-coded section: many times what any real group needs.
const MAX_SECTION: u64 = 1 << 24;
/// Ends each range-coded section, so that one cut short does not pass for whole.
const END_MARK: u32 = 0xa5;

/// What a group begins with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Start {
    /// The model of the group before goes on.
    Continues,
    /// A new base for the same points of the surface: grid nodes keep their meaning.
    Refreshes,
    /// A new base whose grid nodes mean something else.
    Begins,
}

/// A new base as it is sent.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NewBase {
    /// Camera.
    pub view: View,
    /// Neighbouring pixels whose depths differ by more than this are not joined, units.
    pub edge_step: i32,
    /// Surface.
    pub base: CodedBase,
}

/// What later groups are decoded from.
#[derive(Debug, Clone)]
pub struct Chain {
    /// Surface that the last keyframe moved.
    pub model: Arc<Model>,
    /// Tick of the last keyframe.
    pub key_tick: u64,
    /// The last keyframes that share the model.
    pub keys: Decoded,
    /// What the coder of keyframes has learned.
    pub models: ScanModels,
}

/// Keyframes that are remembered: knots of predictions.
const KEYS: usize = 2;

impl Chain {
    /// The last keyframe.
    pub fn key(&self) -> ShownKey {
        ShownKey {
            model: Arc::clone(&self.model),
            scan: Arc::clone(&self.keys.scans[&self.key_tick]),
            tick: self.key_tick,
        }
    }

    /// The chain after a keyframe.
    pub fn advance(mut self, tick: u64, scan: Arc<SeenScan>) -> Self {
        self.key_tick = tick;
        self.keys.insert(tick, scan);
        while self.keys.placed.len() > KEYS {
            self.keys.placed.pop_first();
        }
        while self.keys.scans.len() > 1 {
            self.keys.scans.pop_first();
        }
        self
    }
}

/// The scans between two keyframes, as far as they are decoded.
#[derive(Debug, Clone, Default)]
pub struct Between {
    /// Where they are and what they show, in time order; they move the model of the keyframe before.
    pub scans: Vec<(Stamp, PlacedScan)>,
    /// The keyframe after them against that model; none where another shot begins, or nothing but places was wanted.
    pub end: Option<Arc<SeenScan>>,
}

/// Where a scan is, and what it shows if that is decoded.
pub type PlacedScan = (Arc<Placed>, Option<Arc<SeenScan>>);

/// How much of the scans between is decoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Wanted {
    /// Where they are.
    Places,
    /// Also what that of a tick shows, and those coded before it.
    UpTo(u64),
    /// Everything.
    All,
}

/// A group taken apart, its range-coded sections not yet decoded.
#[derive(Debug, Clone)]
pub struct Parts<'a> {
    /// Scans of the group; the last is the keyframe.
    pub stamps: Vec<Stamp>,
    /// How it begins.
    pub start: Start,
    /// Camera, edge step and groups since the shot began, where a base is sent.
    head: Option<(View, i32, u64)>,
    base: &'a [u8],
    key: &'a [u8],
    between: &'a [u8],
}

impl<'a> Parts<'a> {
    /// Takes a payload apart.
    ///
    /// # Errors
    /// [`crate::CodecError::Payload`] at the first byte that does not follow FORMAT.md, "Group of shots".
    pub fn read(header: &StreamHeader, bytes: &'a [u8]) -> Result<Self> {
        let mut reader = ByteReader::new(bytes, "group");
        let stamps = take_stamps(&mut reader, header.scan_period_nanos)?;
        if stamps.len() > MAX_SCANS {
            return Err(reader.error(format!("{} scans, at most {MAX_SCANS} are allowed", stamps.len())));
        }
        let start = match reader.u8()? {
            0 => Start::Continues,
            1 => Start::Refreshes,
            2 => Start::Begins,
            other => return Err(reader.error(format!("start {other}; 0 to 2 are defined"))),
        };
        let (mut head, mut base) = (None, &[][..]);
        if start != Start::Continues {
            let view = take_view(&mut reader)?;
            let edge_step = reader.varint_up_to(1 << 24, "edge step")? as i32;
            let since = if start == Start::Refreshes {
                reader.varint_up_to(1 << 40, "groups since the shot began")?
            } else {
                0
            };
            head = Some((view, edge_step, since));
            base = take_section(&mut reader, "base length")?;
        }
        let key = take_section(&mut reader, "keyframe length")?;
        let between = take_section(&mut reader, "length of the scans between")?;
        reader.finish()?;
        if stamps.len() == 1 && !between.is_empty() {
            return Err(ByteReader::new(between, "between").error("bytes for scans between, of which there are none"));
        }
        Ok(Self { stamps, start, head, base, key, between })
    }

    /// Stamp of the keyframe.
    pub fn key_stamp(&self) -> Stamp {
        self.stamps[self.stamps.len() - 1]
    }

    /// Groups since the one in which the shot began; `None` in groups without a base.
    pub fn groups_since_shot(&self) -> Option<u64> {
        self.head.map(|(_, _, since)| since)
    }

    /// Decodes the keyframe. `before` is needed by groups that do not begin or refresh a shot.
    ///
    /// # Errors
    /// [`crate::CodecError`] when bytes do not fit, or the chain is missing.
    pub fn decode_key(&self, steps: &Steps, before: Option<&Chain>) -> Result<Chain> {
        let tick = self.key_stamp().tick;
        let chain = match (self.head, before) {
            (None, Some(before)) if before.key_tick < self.stamps[0].tick => before.clone(),
            (None, _) => return Err(ByteReader::new(&[], "group").error("it continues a shot that is not there")),
            (Some((view, edge_step, _)), _) => {
                let mut reader = RangeDecoder::new(self.base, "base");
                let base = CodedBase::decode(&mut reader, steps.control, steps.displacement)?;
                end(reader)?;
                let model = Model::new(&NewBase { view, edge_step, base }, steps.flat);
                let models = ScanModels::default();
                Chain { model: Arc::new(model), key_tick: tick, keys: Decoded::default(), models }
            }
        };
        let mut reader = RangeDecoder::new(self.key, "keyframe");
        let mut models = chain.models.clone();
        let predicted = chain.keys.predict(tick)?.unwrap_or_default();
        let context = Context { model: &chain.model, steps };
        let nearest = chain.keys.nearest(tick).map(|(_, window)| window);
        let placed = scan_code::decode_place(context, nearest, &predicted, (&mut reader, &mut models))?;
        let references = chain.keys.references(tick);
        let scan = scan_code::decode(context, placed, &references, (&mut reader, &mut models))?;
        end(reader)?;
        Ok(Chain { models, ..chain }.advance(tick, Arc::new(scan)))
    }

    /// The part of the section between that says where scans are.
    fn places(&self, steps: &Steps, before: Option<&Chain>, after: &Chain) -> Result<Places<'a>> {
        let stamps = &self.stamps[..self.stamps.len() - 1];
        let missing = || ByteReader::new(&[], "group").error("its scans follow a keyframe that is not there");
        let before = before.filter(|b| b.key_tick < stamps[0].tick).ok_or_else(missing)?;
        let context = Context { model: &before.model, steps };
        let mut reader = RangeDecoder::new(self.between, "between");
        let mut models = after.models.clone();
        let mut decoded = Decoded { placed: before.keys.placed.clone(), ..Decoded::default() };
        let key_tick = self.key_stamp().tick;
        let key = &after.keys.placed[&key_tick];
        let end = match self.start {
            Start::Continues => Some(key.motion.clone()),
            Start::Begins => None,
            Start::Refreshes => {
                let predicted = decoded.predict(key_tick)?.unwrap_or_default();
                Some(decode_motion(&mut reader, &mut models, &predicted, before, steps)?)
            }
        };
        if let Some(motion) = &end {
            decoded.placed.insert(key_tick, Placed { window: key.window, motion: motion.clone() });
        }
        let ticks: Vec<u64> = stamps.iter().map(|s| s.tick).collect();
        let order = coding_order(&ticks, before.key_tick, end.as_ref().map(|_| key_tick));
        let mut pixels = 0;
        for &i in &order {
            let predicted = decoded.predict(ticks[i])?.unwrap_or_default();
            let nearest = decoded.nearest(ticks[i]).map(|(_, window)| window);
            let placed = scan_code::decode_place(context, nearest, &predicted, (&mut reader, &mut models))?;
            pixels += placed.window.width * placed.window.height;
            if pixels > MAX_GROUP_PIXELS {
                return Err(reader.error(format!("more than {MAX_GROUP_PIXELS} pixels in a group")));
            }
            decoded.placed.insert(ticks[i], placed);
        }
        Ok(Places { reader, models, order, end, placed: decoded.placed })
    }

    /// Decodes the scans between; `before` and `after` are the chains at the keyframes around them.
    ///
    /// # Errors
    /// [`crate::CodecError`] when bytes do not fit, or the chain is missing.
    pub fn decode_between(
        &self,
        steps: &Steps,
        before: Option<&Chain>,
        after: &Chain,
        wanted: Wanted,
    ) -> Result<Between> {
        let stamps = &self.stamps[..self.stamps.len() - 1];
        let Some(before) = before.filter(|_| !stamps.is_empty()) else { return self.without_between() };
        let Places { mut reader, mut models, order, end: motion, placed } = self.places(steps, Some(before), after)?;
        let places = |scans: Vec<Option<Arc<SeenScan>>>| {
            let placed = stamps.iter().map(|s| Arc::new(placed[&s.tick].clone()));
            stamps.iter().copied().zip(placed.zip(scans)).collect()
        };
        let mut scans: Vec<Option<Arc<SeenScan>>> = vec![None; stamps.len()];
        if wanted == Wanted::Places {
            return Ok(Between { scans: places(scans), end: None });
        }
        let context = Context { model: &before.model, steps };
        let key_tick = self.key_stamp().tick;
        let key = &after.keys.scans[&key_tick];
        let bridge = motion.map(|motion| match self.start {
            Start::Refreshes => Arc::new(key.against(&before.model, &motion)),
            _ => Arc::clone(key),
        });
        let mut decoded = before.keys.clone();
        if let Some(bridge) = &bridge {
            decoded.insert(key_tick, Arc::clone(bridge));
        }
        for i in order {
            let tick = stamps[i].tick;
            let references = decoded.references(tick);
            let place = placed[&tick].clone();
            let scan = Arc::new(scan_code::decode(context, place, &references, (&mut reader, &mut models))?);
            decoded.scans.insert(tick, Arc::clone(&scan));
            scans[i] = Some(scan);
            if wanted == Wanted::UpTo(tick) {
                return Ok(Between { scans: places(scans), end: bridge });
            }
        }
        end(reader)?;
        Ok(Between { scans: places(scans), end: bridge })
    }

    /// What a group without scans between decodes to, or without the keyframe that they follow.
    fn without_between(&self) -> Result<Between> {
        if self.stamps.len() > 1 {
            return Err(ByteReader::new(&[], "group").error("its scans follow a keyframe that is not there"));
        }
        Ok(Between::default())
    }
}

/// A section between whose first part is decoded.
struct Places<'a> {
    reader: RangeDecoder<'a>,
    models: ScanModels,
    /// Coding order, indices in time order.
    order: Vec<usize>,
    /// The model of the keyframe before at the keyframe after, unless another shot begins there.
    end: Option<Motion>,
    placed: BTreeMap<u64, Placed>,
}

fn decode_motion(
    reader: &mut RangeDecoder<'_>,
    models: &mut ScanModels,
    predicted: &Motion,
    before: &Chain,
    steps: &Steps,
) -> Result<Motion> {
    let correction = Correction::decode(reader, models.motion())?;
    let motion = correction.apply(predicted, &before.model.frames, &steps.motion);
    if motion.in_range() { Ok(motion) } else { Err(reader.error("a motion out of range")) }
}

/// The payload of a group from its range-coded sections.
///
/// # Errors
/// [`crate::CodecError::Stream`] for stamps that cannot be coded.
pub fn write(
    header: &StreamHeader,
    stamps: &[Stamp],
    (start, new_base, since_shot): (Start, Option<&NewBase>, u64),
    key: &[u8],
    between: &[u8],
) -> Result<Vec<u8>> {
    crate::stamps::check_stamps(stamps)?;
    let mut out = Vec::new();
    put_stamps(&mut out, stamps, header.scan_period_nanos)?;
    out.push(match start {
        Start::Continues => 0,
        Start::Refreshes => 1,
        Start::Begins => 2,
    });
    if let Some(new) = new_base {
        put_view(&mut out, &new.view);
        put_varint(&mut out, new.edge_step as u64);
        if start == Start::Refreshes {
            put_varint(&mut out, since_shot);
        }
        let mut base = RangeEncoder::default();
        new.base.encode(&mut base);
        put_section(&mut out, &finish(base));
    }
    put_section(&mut out, key);
    put_section(&mut out, between);
    Ok(out)
}

/// Ends a range-coded section.
pub fn finish(mut out: RangeEncoder) -> Vec<u8> {
    out.raw(END_MARK, 8);
    out.finish()
}

fn end(mut reader: RangeDecoder<'_>) -> Result<()> {
    if reader.raw(8) != END_MARK {
        return Err(reader.error("its end is not where it should be"));
    }
    reader.finish()
}

fn put_section(out: &mut Vec<u8>, bytes: &[u8]) {
    put_varint(out, bytes.len() as u64);
    out.extend_from_slice(bytes);
}

fn take_section<'a>(reader: &mut ByteReader<'a>, name: &str) -> Result<&'a [u8]> {
    let length = reader.varint_up_to(MAX_SECTION, name)? as usize;
    reader.take(length)
}

fn put_view(out: &mut Vec<u8>, view: &View) {
    view.rows.iter().flatten().chain(&view.axis).for_each(|v| put_varint(out, zigzag64(*v)));
}

fn take_view(reader: &mut ByteReader<'_>) -> Result<View> {
    let mut numbers = [0; 15];
    for v in &mut numbers {
        *v = unzigzag64(reader.varint()?);
    }
    let rows = [0, 1, 2].map(|r| std::array::from_fn(|c| numbers[4 * r + c]));
    let view = View { rows, axis: [numbers[12], numbers[13], numbers[14]] };
    if view.in_range() { Ok(view) } else { Err(reader.error("a camera out of range")) }
}
