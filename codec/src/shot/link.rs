//! What holds after a group: the state that the next one is decoded from, and the scans to show.

use super::bisection::Connectivity;
use super::group::{Chain, Parts, Start, Wanted};
use super::model::Model;
use super::order::Placed;
use super::seen_scan::SeenScan;
use super::steps::Steps;
use super::textures::{self, Pictures, TextureChain, Textured};
use super::tracked::{Picture, Shown};
use super::view::{PX_BITS, Seen};
use crate::{CodecError, GreyPicture, Result, Stamp};
use std::sync::Arc;

/// The state after a group.
#[derive(Debug, Clone)]
pub struct Link {
    /// Surface and motion.
    pub chain: Chain,
    /// Key texture, if there is one.
    pub texture: Option<Arc<TextureChain>>,
    /// Group in which the shot began.
    pub shot: usize,
}

impl Link {
    /// Decodes the keyframe of group `index` and its texture.
    ///
    /// # Errors
    /// [`CodecError`] when bytes do not fit, or what they rest on is missing.
    pub fn after(
        parts: &Parts<'_>,
        pictures: Option<&Pictures<'_>>,
        before: Option<&Self>,
        index: usize,
        steps: &Steps,
    ) -> Result<Self> {
        let shot = match parts.groups_since_shot() {
            Some(since) => usize::try_from(since).ok().and_then(|since| index.checked_sub(since)),
            None => before.map(|b| b.shot),
        };
        let shot = shot.ok_or_else(|| CodecError::Stream(format!("group {index}: its shot began before the run")))?;
        let chain = parts.decode_key(steps, before.map(|b| &b.chain))?;
        let scan = &chain.keys.scans[&parts.key_stamp().tick];
        let goes_on = parts.start == Start::Continues;
        let source = before.filter(|_| goes_on).and_then(Link::textured);
        let texture = pictures.map(|p| textures::decode_key(p.key, scan, &chain.model, source)).transpose()?;
        Ok(Self { texture: texture.map(Arc::new), chain, shot })
    }

    /// Decodes the scans between as far as they are wanted, and gives those of the group in time order.
    ///
    /// # Errors
    /// As [`Self::after`].
    pub fn show(
        &self,
        parts: &Parts<'_>,
        pictures: Option<&Pictures<'_>>,
        before: Option<&Self>,
        steps: &Steps,
        wanted: Wanted,
    ) -> Result<Vec<Shown>> {
        let between = parts.decode_between(steps, before.map(|b| &b.chain), &self.chain, wanted)?;
        let mut shown = Vec::with_capacity(parts.stamps.len());
        if let Some(before) = before {
            let key = before.key_picture(&before.chain.keys.scans[&before.chain.key_tick]);
            let after = between.end.as_ref().and_then(|end| self.key_picture(end));
            let keys: Arc<Vec<_>> = Arc::new(key.iter().cloned().chain(after).collect());
            for (i, (stamp, (placed, scan))) in between.scans.into_iter().enumerate() {
                let bytes = pictures.map(|p| p.between[i]).filter(|b| !(b.is_empty() && keys.is_empty()));
                let picture = bytes.map(|b| Picture::Between(b.into(), Arc::clone(&keys)));
                shown.push(before.shown(stamp, placed, scan, picture));
            }
        }
        shown.push(self.shown_key(parts.key_stamp()));
        Ok(shown)
    }

    /// A scan that moves this model.
    fn shown(&self, stamp: Stamp, placed: Arc<Placed>, scan: Option<Arc<SeenScan>>, picture: Option<Picture>) -> Shown {
        let key = self.key_picture(&self.chain.keys.scans[&self.chain.key_tick]).map(Arc::new);
        Shown { stamp, placed, scan, model: Arc::clone(&self.chain.model), shot: self.shot, picture, key }
    }

    fn shown_key(&self, stamp: Stamp) -> Shown {
        let scan = Arc::clone(&self.chain.keys.scans[&stamp.tick]);
        let picture = self.texture.as_ref().map(|t| Picture::Key(Arc::clone(t)));
        self.shown(stamp, Arc::new(scan.placed.clone()), Some(scan), picture)
    }

    fn textured(&self) -> Option<Textured<'_>> {
        let tick = self.chain.key_tick;
        Some(Textured { scan: &self.chain.keys.scans[&tick], chain: self.texture.as_deref()?, tick })
    }

    fn key_picture(&self, scan: &Arc<SeenScan>) -> Option<KeyPicture> {
        Some(KeyPicture {
            scan: Arc::clone(scan),
            chain: Arc::clone(self.texture.as_ref()?),
            model: Arc::clone(&self.chain.model),
            tick: self.chain.key_tick,
        })
    }
}

/// A keyframe that pictures between are blended from.
#[derive(Debug, Clone)]
pub struct KeyPicture {
    scan: Arc<SeenScan>,
    chain: Arc<TextureChain>,
    /// Of the keyframe as it was coded.
    model: Arc<Model>,
    tick: u64,
}

impl KeyPicture {
    /// As a source.
    pub fn textured(&self) -> Textured<'_> {
        Textured { scan: &self.scan, chain: &self.chain, tick: self.tick }
    }

    /// Tick of the keyframe.
    pub fn tick(&self) -> u64 {
        self.tick
    }

    /// The picture.
    pub fn grey(&self) -> GreyPicture {
        self.chain.planes.to_grey()
    }

    /// Where the picture shows grid nodes of its model's shot.
    pub fn uv(&self, nodes: &Connectivity) -> Vec<[f32; 2]> {
        let Placed { window, motion } = &self.scan.placed;
        let view = self.model.view.moved(window.offset);
        let (width, height) = (window.width as f32, window.height as f32);
        let uv = |p: &[i32; 3]| {
            let seen = view.project(*p).unwrap_or(Seen::NOWHERE);
            let [x, y] = [seen.x, seen.y].map(|v| v as f32 / f32::from(1_u16 << PX_BITS) + 0.5);
            [x / width, 1.0 - y / height]
        };
        motion.positions(&self.model.base, nodes).iter().map(uv).collect()
    }
}

/// The picture of a scan between keyframes.
///
/// # Errors
/// As [`textures::decode_between`].
pub fn blended(
    bytes: &[u8],
    keys: &[KeyPicture],
    (tick, scan): (u64, &SeenScan),
    model: &Model,
) -> Result<GreyPicture> {
    let keys: Vec<Textured<'_>> = keys.iter().map(KeyPicture::textured).collect();
    textures::decode_between(bytes, (tick, scan), model, &keys)
}
