//! A command with its payload.

use super::{Dlpc350Error, Result};

/// A value the projector holds, with the command that reads or writes it. All integers are little-endian.
pub trait Register: Sized {
    /// The command: high byte is TI's CMD2, low byte CMD3.
    const COMMAND: u16;
    /// What errors call it.
    const NAME: &'static str;

    /// The payload of a write, and the data of a reply.
    fn encode(&self) -> Vec<u8>;

    /// Reads [`Register::encode`]'s bytes.
    ///
    /// # Errors
    /// [`Dlpc350Error::PayloadSize`] or [`Dlpc350Error::Value`].
    fn decode(data: &[u8]) -> Result<Self>;

    /// The first `N` bytes; a device may send more than an older description knows of.
    ///
    /// # Errors
    /// [`Dlpc350Error::PayloadSize`] when there are fewer.
    fn bytes<const N: usize>(data: &[u8]) -> Result<[u8; N]> {
        let error = Dlpc350Error::PayloadSize { name: Self::NAME, found: data.len(), expected: N };
        data.first_chunk().copied().ok_or(error)
    }

    /// An error about the byte at `offset`.
    fn value_error(offset: usize, found: impl Into<u32>, expected: &'static str) -> Dlpc350Error {
        Dlpc350Error::Value { name: Self::NAME, offset, found: found.into(), expected }
    }

    /// An error about a setting that cannot be encoded.
    fn setting_error(reason: String) -> Dlpc350Error {
        Dlpc350Error::Setting { name: Self::NAME, reason }
    }
}
