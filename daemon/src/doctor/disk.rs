//! Is the disk fast enough for sessions?

use super::Check;
use crate::device::RigConfig;
use std::io::{self, Write};
use std::path::Path;
use std::time::{Duration, Instant};

const NAME: &str = "disk";

/// What is written: so many blocks, with an fsync after each.
const BLOCK_BYTES: usize = 2 << 20;
const BLOCKS: u32 = 8;
/// What a session needs at most, MB/s: a hundred times what the default mode writes.
const SESSION_MB_S: f64 = 2.0;
/// Longest fsync: a group must be on disk before the next one is.
const LONGEST_SYNC: Duration = Duration::from_millis(500);

/// What the disk did.
#[derive(Debug, Clone, Copy)]
struct Speed {
    mb_s: f64,
    slowest_sync: Duration,
}

/// Writes into the folder that sessions go to.
pub(super) fn check(config: &RigConfig, folder: &Path) -> Check {
    match measure(folder) {
        Ok(speed) => judge(config, speed),
        Err(error) => {
            let detail = format!("{}: {error}", folder.display());
            Check::fail(NAME, detail, "name a folder that exists, may be written and has 20 MB of room")
        }
    }
}

fn measure(folder: &Path) -> io::Result<Speed> {
    let mut file = tempfile::tempfile_in(folder)?;
    // No two blocks are alike, so that nothing is gained by packing them.
    let mut block: Vec<u8> = (0..BLOCK_BYTES as u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
    let (begin, mut slowest_sync) = (Instant::now(), Duration::ZERO);
    for _ in 0..BLOCKS {
        block.rotate_left(1);
        file.write_all(&block)?;
        let written = Instant::now();
        file.sync_data()?;
        slowest_sync = slowest_sync.max(written.elapsed());
    }
    let bytes = BLOCK_BYTES as f64 * f64::from(BLOCKS);
    Ok(Speed { mb_s: bytes * 1e-6 / begin.elapsed().as_secs_f64().max(1e-9), slowest_sync })
}

fn judge(config: &RigConfig, speed: Speed) -> Check {
    let pixels = f64::from(config.camera.width_px) * f64::from(config.camera.height_px);
    let raw_mb_s = pixels * 1e3 / config.timing.picture_period_nanos as f64;
    let raw = if speed.mb_s >= raw_mb_s { "enough" } else { "too little" };
    let detail = format!(
        "{:.0} MB/s written and synced, slowest sync {} ms; {raw} for raw pictures ({raw_mb_s:.1} MB/s)",
        speed.mb_s,
        speed.slowest_sync.as_millis()
    );
    match speed.mb_s >= SESSION_MB_S && speed.slowest_sync <= LONGEST_SYNC {
        true => Check::pass(NAME, detail),
        false => Check::fail(NAME, detail, "write sessions to a faster disk, one of this machine's own"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::doctor::Outcome;

    #[test]
    fn a_slow_disk_and_a_folder_that_is_not_there_fail() {
        let config = RigConfig::simulated();
        let of = |mb_s, millis| judge(&config, Speed { mb_s, slowest_sync: Duration::from_millis(millis) });
        assert_eq!(of(200.0, 20).outcome, Outcome::Pass);
        let slow = of(20.0, 20);
        assert!(slow.outcome == Outcome::Pass && slow.detail.contains("too little for raw pictures (55.3 MB/s)"));
        assert_eq!(of(0.5, 20).outcome, Outcome::Fail);
        assert_eq!(of(200.0, 900).outcome, Outcome::Fail);
        assert_eq!(check(&config, Path::new("/nowhere/at/all")).outcome, Outcome::Fail);
        let folder = tempfile::tempdir().unwrap();
        assert!(measure(folder.path()).unwrap().mb_s > 0.0);
        assert_eq!(folder.path().read_dir().unwrap().count(), 0);
    }
}
