//! What FORMAT.md allows of ITU-T T.81: one baseline frame of one 8-bit component, one scan, nothing after it.
//!
//! Checked before the decoder sees the bytes: its time and memory then follow from the size stated here.

use crate::Result;
use crate::bits::bytes::ByteReader;

const SOI: u8 = 0xd8;
const EOI: u8 = 0xd9;
const SOF0: u8 = 0xc0;
const DHT: u8 = 0xc4;
const DQT: u8 = 0xdb;
const SOS: u8 = 0xda;
const APP0: u8 = 0xe0;

/// Bytes of a quantization table: its number, 64 values of 8 bits.
const TABLE: usize = 65;

/// Width and height, px, of a JPEG.
///
/// # Errors
/// [`crate::CodecError::Payload`] for marker segments other than SOI APP0* (DQT | DHT | SOF0)* SOS EOI, for a frame that
/// is not 8-bit grey, and for bytes after EOI.
pub fn size_px(reader: &mut ByteReader<'_>) -> Result<[u16; 2]> {
    if marker(reader)? != SOI {
        return Err(reader.error("JPEG: no start of image"));
    }
    let mut size = None;
    loop {
        let code = marker(reader)?;
        let body = match code {
            APP0 | DQT | DHT | SOF0 | SOS => segment(reader)?,
            other => return Err(reader.error(format!("JPEG: marker {other:#04x} in a baseline grey picture"))),
        };
        match (code, size) {
            (DQT, _) if body.len() % TABLE != 0 || body.chunks(TABLE).any(|t| t[0] > 3) => {
                return Err(reader.error("JPEG: a quantization table not of 8 bits"));
            }
            (SOF0, None) => match *body {
                // Precision, height, width, components, component, sampling, table.
                [8, h1, h0, w1, w0, 1, _, 0x11, _] => {
                    size = Some([u16::from_be_bytes([w1, w0]), u16::from_be_bytes([h1, h0])]);
                }
                _ => return Err(reader.error("JPEG: not one grey component of 8 bits")),
            },
            (SOF0, Some(_)) => return Err(reader.error("JPEG: two frames")),
            (SOS, None) => return Err(reader.error("JPEG: a scan without a frame")),
            (SOS, Some(size)) => {
                skip_scan(reader)?;
                return Ok(size);
            }
            _ => {}
        }
    }
}

fn marker(reader: &mut ByteReader<'_>) -> Result<u8> {
    match reader.u8()? {
        0xff => reader.u8(),
        other => Err(reader.error(format!("JPEG: byte {other:#04x} where a marker belongs"))),
    }
}

/// Body of a marker segment, without its length (big-endian, itself included).
fn segment<'a>(reader: &mut ByteReader<'a>) -> Result<&'a [u8]> {
    let length = u16::from_be_bytes([reader.u8()?, reader.u8()?]);
    let body = length.checked_sub(2).ok_or_else(|| reader.error("JPEG: a segment shorter than its length"))?;
    reader.take(body.into())
}

/// The entropy-coded bytes, in which 0xff is always followed by 0, up to EOI, which ends the payload.
fn skip_scan(reader: &mut ByteReader<'_>) -> Result<()> {
    loop {
        if reader.u8()? != 0xff {
            continue;
        }
        match reader.u8()? {
            0 => {}
            EOI => break,
            other => return Err(reader.error(format!("JPEG: marker {other:#04x} in the scan"))),
        }
    }
    reader.clone().finish()
}
