//! Encoder of the seed mode: one scan in, a group out whenever a keyframe closes it.

use super::group;
use super::landmarks::{GivenLandmark, LandmarkTrail};
use super::surface::{self, TextureFrame};
use crate::encoder::{EncodedGroup, Pushed};
use crate::mesh::TriMesh;
use crate::mesh::repair::{RepairOptions, RepairReport, to_disk};
use crate::mesh::simplify::{SimplifyOptions, simplify};
use crate::motion::PixelMap;
use crate::texture::{encode_key_texture, fit_camera};
use crate::{CodecError, Mode, Result, Scan, Stamp, StreamHeader};

/// What the encoder may be told.
#[derive(Debug, Clone, PartialEq)]
pub struct EncoderConfig {
    /// Written before the first group.
    pub header: StreamHeader,
    /// A keyframe keeps at most one vertex in this many (at least 2).
    pub vertex_ratio: u32,
    /// JPEG quality of key textures, 1 to 100.
    pub texture_quality: u8,
    /// How scans become disks.
    pub repair: RepairOptions,
}

impl EncoderConfig {
    /// The published scheme's settings: a sixth of the vertices, every tenth scan, for scans of one period.
    pub fn new(scan_period_nanos: u64) -> Self {
        let header =
            StreamHeader { mode: Mode::Seed { position_step_mm: 0.05 }, keyframe_interval: 10, scan_period_nanos };
        Self { header, vertex_ratio: 6, texture_quality: 85, repair: RepairOptions::default() }
    }
}

/// Encoder of one run.
pub struct Encoder {
    config: EncoderConfig,
    trail: LandmarkTrail,
    stamps: Vec<Stamp>,
    last: Option<(Scan, Vec<GivenLandmark>)>,
    last_stamp: Option<Stamp>,
    key_tick: Option<u64>,
    next_key_tick: u64,
}

impl Encoder {
    /// An encoder that has seen nothing.
    ///
    /// # Errors
    /// [`CodecError::Stream`] naming a setting out of range.
    pub fn new(config: EncoderConfig) -> Result<Self> {
        config.header.validate()?;
        if config.vertex_ratio < 2 || !(1..=100).contains(&config.texture_quality) {
            return Err(CodecError::Stream("vertex ratio below 2, or texture quality outside 1 to 100".into()));
        }
        let trail = LandmarkTrail::default();
        Ok(Self { config, trail, stamps: Vec::new(), last: None, last_stamp: None, key_tick: None, next_key_tick: 0 })
    }

    /// Stream header of the run.
    pub fn header(&self) -> StreamHeader {
        self.config.header
    }

    /// Takes the next scan.
    ///
    /// # Errors
    /// [`CodecError::Stream`] when its tick does not follow, [`CodecError::Mesh`] when it is no mesh at all; the scan is
    /// then not part of the run.
    pub fn push(&mut self, scan: Scan) -> Result<Pushed> {
        self.push_with_landmarks(scan, &[])
    }

    /// As [`Self::push`], with landmarks on the scan: those on two keyframes that follow each other join the tracked ones,
    /// and stand in for tracked ones nearby.
    ///
    /// # Errors
    /// As [`Self::push`].
    pub fn push_with_landmarks(&mut self, scan: Scan, given: &[GivenLandmark]) -> Result<Pushed> {
        let stamp = Stamp { tick: scan.tick, time_nanos: scan.time_nanos };
        if self.last_stamp.is_some_and(|l| stamp.tick <= l.tick || stamp.time_nanos <= l.time_nanos) {
            return Err(CodecError::Stream(format!("scan at tick {} does not follow the one before it", scan.tick)));
        }
        scan.mesh.validate()?;
        let mut pushed = Pushed::default();
        let due = self.last_stamp.is_none() || stamp.tick >= self.next_key_tick;
        let prepared = match due.then(|| self.prepare(&scan.mesh)) {
            Some(Ok((mesh, report))) => {
                pushed.repair = report.has_damage().then_some(report);
                Some(mesh)
            }
            Some(Err(error)) if self.last_stamp.is_none() => return Err(error),
            Some(Err(error)) => {
                pushed.not_key = Some(error);
                None
            }
            None => None,
        };
        self.trail.feed(&scan, prepared.is_some())?;
        self.stamps.push(stamp);
        self.last_stamp = Some(stamp);
        match prepared {
            Some(mesh) => pushed.group = Some(self.close_group(&scan, given, &mesh)?),
            None => self.last = Some((scan, given.to_vec())),
        }
        Ok(pushed)
    }

    /// Ends the run: the scans since the last keyframe are closed by the last of them as a keyframe.
    ///
    /// # Errors
    /// [`CodecError::Mesh`] when that scan cannot be a keyframe.
    pub fn finish(mut self) -> Result<Option<EncodedGroup>> {
        let Some((scan, given)) = self.last.take() else { return Ok(None) };
        let (mesh, _) = self.prepare(&scan.mesh)?;
        self.close_group(&scan, &given, &mesh).map(Some)
    }

    /// Cleaned to a disk, then decimated where flat.
    fn prepare(&self, mesh: &TriMesh) -> Result<(TriMesh, RepairReport)> {
        let (disk, report) = to_disk(mesh, &self.config.repair)?;
        let target = (mesh.vertex_count() / self.config.vertex_ratio as usize).clamp(4, surface::MAX_VERTICES as usize);
        let (small, _) = simplify(&disk, target, &SimplifyOptions::default());
        Ok((small.into_mesh(), report))
    }

    fn close_group(&mut self, scan: &Scan, given: &[GivenLandmark], mesh: &TriMesh) -> Result<EncodedGroup> {
        let frame = texture_frame(scan);
        let coded = surface::encode(mesh, self.config.header.position_step_mm()?, frame)?;
        let (pairs, landmarks) = self.trail.close_keyframe(scan, given, &coded.decoded)?;
        let before = (self.key_tick, &pairs[..]);
        let geometry = group::encode(&self.config.header, &self.stamps, &coded.bytes, before)?;
        let texture = match (&scan.texture, &coded.decoded.uv) {
            (Some(picture), Some(_)) => {
                let map = PixelMap::new(&coded.decoded, picture.width_px, picture.height_px)?;
                Some(encode_key_texture(picture, &map.mask().inside, self.config.texture_quality)?)
            }
            _ => None,
        };
        let stamps = std::mem::take(&mut self.stamps);
        let (first, key) = (stamps[0], stamps[stamps.len() - 1]);
        let interval = u64::from(self.config.header.keyframe_interval);
        self.next_key_tick = (key.tick / interval + 1) * interval;
        self.key_tick = Some(key.tick);
        self.last = None;
        Ok(EncodedGroup { first, key, scans: stamps.len(), geometry, texture, pictures: None, landmarks, cost: None })
    }
}

fn texture_frame(scan: &Scan) -> Option<TextureFrame> {
    let (picture, uv) = (scan.texture.as_ref()?, scan.mesh.uv.as_ref()?);
    let uv_px: Vec<[f32; 2]> = uv.iter().map(|&t| picture.uv_to_px(t)).collect();
    let camera = fit_camera(&scan.mesh.positions_mm, &uv_px);
    Some(TextureFrame { size_px: [picture.width_px, picture.height_px], camera })
}
