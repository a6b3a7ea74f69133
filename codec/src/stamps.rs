//! When the scans of a group were taken; how every group payload begins.

use crate::bits::bytes::{ByteReader, put_varint, unzigzag64, zigzag64};
use crate::{CodecError, Result, StreamHeader};

/// Most scans in a group.
pub const MAX_SCANS: u64 = 65_536;

/// Largest tick: a scan a microsecond for twelve days.
pub const MAX_TICK: u64 = 1 << 40;

/// Largest sensor time, 146 years.
pub const MAX_TIME_NANOS: u64 = (1 << 62) - 1;

/// When a scan was taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Stamp {
    /// Sensor time in scan periods.
    pub tick: u64,
    /// Sensor time in nanoseconds since the run began.
    pub time_nanos: u64,
}

/// Checks that stamps can be coded.
///
/// # Errors
/// [`CodecError::Stream`] when they are missing, too many, out of range, or do not increase.
pub fn check_stamps(stamps: &[Stamp]) -> Result<()> {
    let increasing = stamps.windows(2).all(|w| w[0].tick < w[1].tick && w[0].time_nanos < w[1].time_nanos);
    let in_range = stamps.iter().all(|s| s.tick <= MAX_TICK && s.time_nanos <= MAX_TIME_NANOS);
    if stamps.is_empty() || stamps.len() as u64 > MAX_SCANS || !increasing || !in_range {
        return Err(CodecError::Stream("a group needs 1 to 65536 scans with increasing ticks and times".into()));
    }
    Ok(())
}

/// Appends the stamps of a group.
///
/// # Errors
/// [`CodecError::Stream`] for a time too far from its tick.
pub fn put_stamps(out: &mut Vec<u8>, stamps: &[Stamp], scan_period_nanos: u64) -> Result<()> {
    put_varint(out, stamps.len() as u64);
    let mut before = 0;
    for s in stamps {
        put_varint(out, s.tick - before);
        before = s.tick;
        let offset = i128::from(s.time_nanos) - i128::from(s.tick) * i128::from(scan_period_nanos);
        let offset = i64::try_from(offset).map_err(|_| {
            CodecError::Stream(format!("tick {} lies centuries away from its time, {} ns", s.tick, s.time_nanos))
        })?;
        put_varint(out, zigzag64(offset));
    }
    Ok(())
}

/// Reads the stamps of a group without the rest.
///
/// # Errors
/// [`CodecError::Payload`] at the first byte that does not follow FORMAT.md, "Group".
pub fn decode_stamps(header: &StreamHeader, bytes: &[u8]) -> Result<Vec<Stamp>> {
    take_stamps(&mut ByteReader::new(bytes, "group"), header.scan_period_nanos)
}

/// Reads stamps off the start of a group.
///
/// # Errors
/// [`CodecError::Payload`] at the first byte that does not follow FORMAT.md, "Group".
pub fn take_stamps(reader: &mut ByteReader<'_>, scan_period_nanos: u64) -> Result<Vec<Stamp>> {
    let count = reader.varint_up_to(MAX_SCANS, "scan count")?;
    let mut stamps: Vec<Stamp> = Vec::new();
    for i in 0..count {
        let step = reader.varint_up_to(MAX_TICK, "tick step")?;
        let tick = stamps.last().map_or(0, |s| s.tick) + step;
        if tick > MAX_TICK || (i > 0 && step == 0) {
            return Err(reader.error(format!("tick {tick} does not follow the one before")));
        }
        let offset = unzigzag64(reader.varint()?);
        let time = i128::from(tick) * i128::from(scan_period_nanos) + i128::from(offset);
        let time_nanos = u64::try_from(time).ok().filter(|t| *t <= MAX_TIME_NANOS);
        let time_nanos = time_nanos.ok_or_else(|| reader.error("a time out of range"))?;
        if stamps.last().is_some_and(|s| s.time_nanos >= time_nanos) {
            return Err(reader.error(format!("time {time_nanos} ns does not follow the one before")));
        }
        stamps.push(Stamp { tick, time_nanos });
    }
    if stamps.is_empty() { Err(reader.error("a group without scans")) } else { Ok(stamps) }
}
