//! What holds after a group: the state that the next one is decoded from, and the scans to show.

use super::group::{Chain, Parts, Start};
use super::model::Model;
use super::seen_scan::SeenScan;
use super::steps::Steps;
use super::textures::{self, Pictures, TextureChain, Textured};
use super::tracked::{Picture, Shown};
use crate::{CodecError, Result};
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

    /// Decodes the scans between and gives those of the group in time order.
    ///
    /// # Errors
    /// As [`Self::after`].
    pub fn show(
        &self,
        parts: &Parts<'_>,
        pictures: Option<&Pictures<'_>>,
        before: Option<&Self>,
        steps: &Steps,
    ) -> Result<Vec<Shown>> {
        let between = parts.decode_between(steps, before.map(|b| &b.chain), &self.chain)?;
        let mut shown = Vec::with_capacity(parts.stamps.len());
        if let Some(before) = before {
            let mut keys: Vec<_> =
                before.key_picture(&before.chain.keys.scans[&before.chain.key_tick]).into_iter().collect();
            keys.extend(between.end.as_ref().and_then(|end| self.key_picture(end)));
            let keys = Arc::new(keys);
            for (i, (stamp, scan)) in between.scans.into_iter().enumerate() {
                let bytes = pictures.map(|p| p.between[i]).filter(|b| !b.is_empty());
                let picture = bytes.map(|b| Picture::Between(b.into(), Arc::clone(&keys)));
                let model = Arc::clone(&before.chain.model);
                shown.push(Shown { stamp, scan, model, shot: before.shot, picture });
            }
        }
        let stamp = parts.key_stamp();
        let scan = Arc::clone(&self.chain.keys.scans[&stamp.tick]);
        let picture = self.texture.as_ref().map(|t| Picture::Key(Arc::clone(t)));
        shown.push(Shown { stamp, scan, model: Arc::clone(&self.chain.model), shot: self.shot, picture });
        Ok(shown)
    }

    fn textured(&self) -> Option<Textured<'_>> {
        let tick = self.chain.key_tick;
        Some(Textured { scan: &self.chain.keys.scans[&tick], chain: self.texture.as_deref()?, tick })
    }

    fn key_picture(&self, scan: &Arc<SeenScan>) -> Option<KeyPicture> {
        Some(KeyPicture {
            scan: Arc::clone(scan),
            chain: Arc::clone(self.texture.as_ref()?),
            tick: self.chain.key_tick,
        })
    }
}

/// A keyframe that pictures between are blended from.
#[derive(Debug, Clone)]
pub struct KeyPicture {
    scan: Arc<SeenScan>,
    chain: Arc<TextureChain>,
    tick: u64,
}

impl KeyPicture {
    /// As a source.
    pub fn textured(&self) -> Textured<'_> {
        Textured { scan: &self.scan, chain: &self.chain, tick: self.tick }
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
) -> Result<crate::GreyPicture> {
    let keys: Vec<Textured<'_>> = keys.iter().map(KeyPicture::textured).collect();
    textures::decode_between(bytes, (tick, scan), model, &keys)
}
