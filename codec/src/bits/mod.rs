//! Bytes and bits: integers on the wire, connectivity, quantized attributes.

pub mod attributes;
pub mod bytes;
pub mod connectivity;
pub mod range_coder;
