//! Decodes the groups of a run one after another, for the errors alone.

use crate::shot::group::{Chain, Parts};
use crate::texture::decode_key_texture;
use crate::{Mode, Result, StreamHeader, seed};

/// Checks a run's groups in their order.
pub struct Checker {
    header: StreamHeader,
    chain: Option<Chain>,
}

impl Checker {
    /// A checker of a run.
    pub fn new(header: StreamHeader) -> Self {
        Self { header, chain: None }
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
                let before = self.chain.take();
                let parts = Parts::read(&self.header, geometry)?;
                let after = parts.decode_key(&steps, before.as_ref())?;
                parts.decode_between(&steps, before.as_ref(), &after)?;
                self.chain = Some(after);
            }
        }
        Ok(())
    }
}
