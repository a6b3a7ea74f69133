//! Is the camera's USB connection fast enough?

use super::Check;
use crate::device::plugged::{Plugged, PluggedCamera};
use crate::device::{Backend, PixelFormat, RigConfig};
use std::path::Path;

const NAME: &str = "usb_speed";

/// Where the kernel lists video devices.
const CLASS: &str = "/sys/class/video4linux";
/// Part of a bus's bits that arrive as pixels: 39 MB/s at high speed, 400 MB/s at SuperSpeed.
const USABLE: f64 = 0.65;

/// Holds the pictures' bytes against the speed that the kernel tells.
pub(super) fn check(config: &RigConfig, plugged: &Plugged) -> Check {
    if config.camera.backend != Backend::V4l {
        return Check::skip(NAME, "the camera is not plugged in anywhere");
    }
    let Some(camera) = plugged.cameras.iter().find(|camera| is_meant(config, camera)) else {
        return Check::skip(NAME, "the rig's camera is not found");
    };
    match speed_mbit_s(Path::new(CLASS), &camera.node) {
        Some(speed_mbit_s) => judge(config, speed_mbit_s),
        None => Check::skip(NAME, format!("{} is no USB camera", camera.node)),
    }
}

fn is_meant(config: &RigConfig, camera: &PluggedCamera) -> bool {
    config.camera.v4l.as_ref().is_none_or(|v4l| {
        v4l.device.as_ref().is_none_or(|device| device.as_os_str() == camera.node.as_str())
            && v4l.name.as_ref().is_none_or(|name| camera.name.contains(name.as_str()))
            && v4l.serial.as_ref().is_none_or(|serial| *serial == camera.serial)
            && v4l.bus.as_ref().is_none_or(|bus| camera.bus.starts_with(bus.as_str()))
    })
}

/// Speed of the USB device behind a video node, Mbit/s; `None` when it is none.
fn speed_mbit_s(class: &Path, node: &str) -> Option<f64> {
    let name = Path::new(node).file_name()?;
    let device = class.join(name).join("device").canonicalize().ok()?;
    let speed = device.ancestors().find_map(|folder| std::fs::read_to_string(folder.join("speed")).ok())?;
    speed.trim().parse().ok()
}

fn judge(config: &RigConfig, speed_mbit_s: f64) -> Check {
    let pixel_bytes = match config.camera.v4l.as_ref().map(|v4l| v4l.pixel_format).unwrap_or_default() {
        PixelFormat::Grey => 1.0,
        PixelFormat::Y10 | PixelFormat::Y12 | PixelFormat::Y16 | PixelFormat::Yuyv => 2.0,
        PixelFormat::Mjpeg => 0.25,
    };
    let pixels = f64::from(config.camera.width_px) * f64::from(config.camera.height_px);
    let pictures_a_second = 1e9 / config.timing.picture_period_nanos as f64;
    let needed_mb_s = pixels * pixel_bytes * pictures_a_second * 1e-6;
    let usable_mb_s = speed_mbit_s / 8.0 * USABLE;
    let detail =
        format!("{speed_mbit_s:.0} Mbit/s carry about {usable_mb_s:.0} MB/s; the camera sends {needed_mb_s:.1} MB/s");
    match needed_mb_s <= usable_mb_s {
        true => Check::pass(NAME, detail),
        false => Check::fail(
            NAME,
            detail,
            "plug the camera into a faster port, without a hub; or take fewer or smaller pictures",
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::doctor::Outcome;

    #[test]
    fn the_speed_of_the_bus_is_held_against_the_pictures() {
        let mut config = RigConfig::simulated();
        assert_eq!(check(&config, &Plugged::default()).outcome, Outcome::Skip);
        config.camera.backend = Backend::V4l;
        assert_eq!(judge(&config, 5000.0).outcome, Outcome::Pass);
        let slow = judge(&config, 480.0);
        assert!(slow.outcome == Outcome::Fail && slow.detail.contains("55.3 MB/s"), "{slow:?}");
        config.timing.picture_period_nanos = 11_111_111;
        assert_eq!(judge(&config, 480.0).outcome, Outcome::Pass);
    }

    #[cfg(unix)]
    #[test]
    fn the_speed_is_that_of_the_usb_device_above_the_node() {
        let root = tempfile::tempdir().unwrap();
        let interface = root.path().join("devices/usb2/2-1/2-1:1.0");
        std::fs::create_dir_all(&interface).unwrap();
        std::fs::write(root.path().join("devices/usb2/2-1/speed"), "5000\n").unwrap();
        let class = root.path().join("class");
        std::fs::create_dir_all(class.join("video3")).unwrap();
        std::os::unix::fs::symlink(&interface, class.join("video3/device")).unwrap();
        assert_eq!(speed_mbit_s(&class, "/dev/video3"), Some(5000.0));
        assert_eq!(speed_mbit_s(&class, "/dev/video4"), None);
    }
}
