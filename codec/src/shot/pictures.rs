//! Pictures of a group, coded after its geometry: they need what that decodes to, and nothing of it needs them. So another
//! thread may code them while the next scans come.

use super::model::Model;
use super::seen_scan::SeenScan;
use super::textures::{self, TextureChain, TextureSteps, Textured};
use crate::{EncodedGroup, GreyPicture};
use std::sync::Arc;

/// A decoded keyframe on its model.
#[derive(Debug, Clone)]
pub struct ShownKey {
    /// Surface that it moves.
    pub model: Arc<Model>,
    /// What it shows.
    pub scan: Arc<SeenScan>,
    /// Its tick.
    pub tick: u64,
}

/// A decoded scan between keyframes, and its picture if that is to be coded.
#[derive(Debug, Clone)]
pub struct ShownBetween {
    /// What it shows.
    pub scan: Arc<SeenScan>,
    /// Its tick.
    pub tick: u64,
    /// Grey levels of its pixels.
    pub picture: Option<GreyPicture>,
}

/// Pictures of a group and what they are predicted along.
#[derive(Debug, Clone)]
pub struct GroupPictures {
    /// The keyframe.
    pub key: ShownKey,
    /// Its picture; without one the group has no texture.
    pub picture: Option<GreyPicture>,
    /// The keyframe before, if the group has scans between or goes on from it.
    pub before: Option<ShownKey>,
    /// Whether the keyframe's picture is predicted from the one before.
    pub continues: bool,
    /// The keyframe on the model of the one before, where they show the same points.
    pub end: Option<Arc<SeenScan>>,
    /// In time order.
    pub between: Vec<ShownBetween>,
    /// Steps of coded pictures.
    pub steps: TextureSteps,
}

/// Encoder of the pictures of groups, in their order; a group without a keyframe before it begins anew.
#[derive(Debug, Default)]
pub struct PictureEncoder {
    chain: Option<TextureChain>,
}

impl PictureEncoder {
    /// Codes the pictures that wait in a group into its texture.
    pub fn encode(&mut self, group: &mut EncodedGroup) {
        if let Some(pictures) = group.pictures.take() {
            group.texture = self.payload(&pictures);
        }
    }

    /// The picture of the keyframe from the one before, then what the scans between lack.
    fn payload(&mut self, group: &GroupPictures) -> Option<Vec<u8>> {
        let chain = self.chain.take();
        let picture = group.picture.as_ref()?;
        let before = chain.as_ref().zip(group.before.as_ref());
        let before = before.map(|(chain, key)| Textured { scan: &key.scan, chain, tick: key.tick });
        let continued = before.filter(|_| group.continues);
        let (bytes, texture) = textures::encode_key(picture, &group.key.scan, &group.key.model, continued, group.steps);
        let after = group.end.as_ref().map(|scan| Textured { scan, chain: &texture, tick: group.key.tick });
        let keys: Vec<Textured<'_>> = before.into_iter().chain(after).collect();
        let between = |scan: &ShownBetween| {
            let (model, picture) = (&group.before.as_ref()?.model, scan.picture.as_ref()?);
            Some(textures::encode_between(picture, (scan.tick, &scan.scan), model, &keys, group.steps))
        };
        let between: Vec<Vec<u8>> = group.between.iter().map(|scan| between(scan).unwrap_or_default()).collect();
        self.chain = Some(texture);
        Some(textures::write(&bytes, &between))
    }
}
