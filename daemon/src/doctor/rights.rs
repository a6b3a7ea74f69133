//! May this user use the devices?

use super::Check;
use crate::device::plugged::{Plugged, PluggedProjector};
use crate::device::{Backend, RigConfig};

const NAME: &str = "rights";

/// Holds what stands in the way of using the rig's devices against what is plugged in.
pub(super) fn check(config: &RigConfig, plugged: &Plugged) -> Check {
    let mut problems = Vec::new();
    let mut used = 0;
    if config.camera.backend == Backend::V4l {
        used += 1;
        let is_about_rights = |problem: &&String| problem.contains("/dev/video") && problem.contains("denied");
        problems.extend(plugged.problems.iter().filter(is_about_rights).cloned());
    }
    if let Some(backend) = projector_backend(config) {
        used += 1;
        let is_meant = |p: &&PluggedProjector| {
            p.backend == backend
                && config.projector.serial.as_ref().is_none_or(|serial| *serial == p.serial)
                && config.projector.bus_path.as_ref().is_none_or(|path| *path == p.bus_path)
        };
        let meant = plugged.projectors.iter().filter(is_meant);
        problems.extend(meant.filter_map(|p| Some(format!("projector {}: {}", p.bus_path, p.problem.as_ref()?))));
    }
    if let Some(trigger) = &config.trigger {
        used += 1;
        let meant = plugged.serial_ports.iter().filter(|p| {
            trigger.port.as_ref().is_some_and(|port| *port == p.port)
                || trigger.serial.as_ref().is_some_and(|serial| *serial == p.serial)
        });
        problems.extend(meant.filter_map(|p| Some(format!("{}: {}", p.port, p.problem.as_ref()?))));
    }
    match (used, problems.is_empty()) {
        (0, _) => Check::skip(NAME, "no device node is used: camera and projector are not plugged in anywhere"),
        (_, true) => Check::pass(NAME, format!("nothing stands in the way of {used} devices")),
        (_, false) => {
            let action = "sudo gv3 install-udev, then plug the device in again; or join the group that is named";
            Check::fail(NAME, problems.join("; "), action)
        }
    }
}

/// The projector's backend as `gv3 devices` names it; none for one that is not plugged in.
fn projector_backend(config: &RigConfig) -> Option<&'static str> {
    match config.projector.backend {
        Backend::Gv3Usb if !config.projector.is_simulated() => Some("gv3_usb"),
        Backend::Dlpc350 => {
            let is_emulated =
                config.projector.dlpc350.as_ref().is_some_and(|d| d.link == crate::device::dlpc350::LinkKind::Emulated);
            (!is_emulated).then_some("dlpc350")
        }
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::ProjectorConfig;
    use crate::doctor::Outcome;

    #[test]
    fn a_projector_without_rights_is_named_and_another_is_none_of_ours() {
        let mut config = RigConfig::simulated();
        assert_eq!(check(&config, &Plugged::default()).outcome, Outcome::Skip);
        config.projector = ProjectorConfig::of(Backend::Gv3Usb);
        config.projector.serial = Some("A7".into());
        let projector = |serial: &str, problem: Option<&str>| PluggedProjector {
            backend: "gv3_usb",
            serial: serial.into(),
            bus_path: "3-1".into(),
            node: None,
            speed: None,
            problem: problem.map(Into::into),
        };
        let mut plugged = Plugged { projectors: vec![projector("B8", Some("no rights"))], ..Plugged::default() };
        assert_eq!(check(&config, &plugged).outcome, Outcome::Pass);
        plugged.projectors.push(projector("A7", Some("no rights: the rule 70-gv3.rules is missing")));
        let found = check(&config, &plugged);
        assert_eq!(found.outcome, Outcome::Fail);
        assert!(found.detail.contains("70-gv3.rules") && found.action.contains("install-udev"), "{found:?}");
        config.projector = ProjectorConfig::of(Backend::Simulated);
        config.camera.backend = Backend::V4l;
        plugged.problems.push("/dev/video0: Permission denied; join the group video".into());
        assert_eq!(check(&config, &plugged).outcome, Outcome::Fail);
    }
}
