//! Whether a rig can scan: one check a file, each with what it saw and what to do.
//!
//! The rig is opened twice. First it plays its own sequence for some sets (`look`), then one set of test patterns: a ramp of
//! grey levels and fringes both ways (`test_patterns`). All checks but those of rights, USB and disk judge these pictures.

mod calibration;
mod clock;
mod devices;
mod disk;
mod exposure;
mod linearity;
mod look;
mod order;
mod rights;
mod saturation;
mod test_patterns;
#[cfg(test)]
mod tests;
mod trigger;
mod usb_speed;

use crate::device::RigConfig;
use crate::device::plugged::Plugged;
use look::Look;
use serde::Serialize;
use std::path::Path;
use test_patterns::TestPictures;

/// Checks of a report.
pub const CHECK_COUNT: usize = 11;
/// Sets of the rig's own sequence that are looked at: 0.8 s of the default rig.
const SETS: usize = 24;

/// How a check ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Outcome {
    /// All is well.
    Pass,
    /// Something is wrong.
    Fail,
    /// There was nothing to check, or no way to.
    Skip,
}

/// One check.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Check {
    /// What was checked.
    pub name: &'static str,
    /// How it ended.
    pub outcome: Outcome,
    /// What was seen, with figures.
    pub detail: String,
    /// What to do; empty when there is nothing to do.
    pub action: String,
}

impl Check {
    fn pass(name: &'static str, detail: impl Into<String>) -> Self {
        Self { name, outcome: Outcome::Pass, detail: detail.into(), action: String::new() }
    }

    fn fail(name: &'static str, detail: impl Into<String>, action: impl Into<String>) -> Self {
        Self { name, outcome: Outcome::Fail, detail: detail.into(), action: action.into() }
    }

    fn skip(name: &'static str, detail: impl Into<String>) -> Self {
        Self { name, outcome: Outcome::Skip, detail: detail.into(), action: String::new() }
    }
}

/// All checks of a rig.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize)]
pub struct Report {
    /// In the order in which they were made.
    pub checks: Vec<Check>,
}

impl Report {
    /// Whether no check failed.
    pub fn is_well(&self) -> bool {
        self.checks.iter().all(|check| check.outcome != Outcome::Fail)
    }
}

/// Checks a rig, and the disk of the working directory. `progress` gets every check as soon as it is made.
///
/// The projector shines and the camera streams for about two seconds; nobody else may use them meanwhile.
pub fn run(config: &RigConfig, progress: impl FnMut(&Check)) -> Report {
    run_in(config, Path::new("."), progress)
}

/// The same for sessions that are to be written into `folder`.
pub fn run_in(config: &RigConfig, folder: &Path, mut progress: impl FnMut(&Check)) -> Report {
    let mut report = Report::default();
    let mut add = |check: Check| {
        progress(&check);
        report.checks.push(check);
    };
    let plugged = Plugged::find();
    add(rights::check(config, &plugged));
    add(usb_speed::check(config, &plugged));
    add(disk::check(config, folder));
    let look = Look::at(config, SETS);
    add(devices::check(&look));
    let Ok(look) = look else {
        let unseen = [trigger::NAME, order::NAME, clock::NAME, exposure::NAME, saturation::NAME];
        let unseen = unseen.into_iter().chain([linearity::NAME, calibration::NAME]);
        unseen.for_each(|name| add(Check::skip(name, "the devices do not run")));
        return report;
    };
    let test = TestPictures::take(config);
    add(trigger::check(config, &look));
    add(order::check(&look, &test));
    add(clock::check(config, &look));
    add(exposure::check(config, &look));
    add(saturation::check(config, &look));
    add(linearity::check(config, &test));
    add(calibration::check(config, &test));
    report
}
