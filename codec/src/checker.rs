//! Decodes the groups of a run one after another, for the errors alone.

use crate::shot::group::{Parts, Wanted};
use crate::shot::link::Link;
use crate::shot::textures::Pictures;
use crate::texture::decode_key_texture;
use crate::{Mode, Result, StreamHeader, seed};

/// Checks a run's groups in their order.
pub struct Checker {
    header: StreamHeader,
    link: Option<Link>,
    groups: usize,
}

impl Checker {
    /// A checker of a run.
    pub fn new(header: StreamHeader) -> Self {
        Self { header, link: None, groups: 0 }
    }

    /// Decodes the next group fully.
    ///
    /// # Errors
    /// [`crate::CodecError`] naming the byte that does not fit.
    pub fn check(&mut self, geometry: &[u8], texture: Option<&[u8]>) -> Result<()> {
        match self.header.mode {
            Mode::Seed { .. } => {
                seed::decode_group(&self.header, geometry)?;
                texture.map(decode_key_texture).transpose()?;
            }
            Mode::Shots(steps) => {
                let before = self.link.take();
                let parts = Parts::read(&self.header, geometry)?;
                let pictures = texture.map(|t| Pictures::read(t, parts.stamps.len() - 1)).transpose()?;
                let after = Link::after(&parts, pictures.as_ref(), before.as_ref(), self.groups, &steps)?;
                for shown in after.show(&parts, pictures.as_ref(), before.as_ref(), &steps, Wanted::All)? {
                    shown.texture()?;
                }
                self.link = Some(after);
                self.groups += 1;
            }
        }
        Ok(())
    }
}
