//! Finding the camera's node: by what it can do and what it is called, since numbers change and one camera has several nodes.

use super::driver_call;
use crate::device::{DeviceError, V4lConfig};
use std::path::{Path, PathBuf};
use v4l::Device;
use v4l::capability::Flags;

/// Where the kernel lists video devices.
const CLASS: &str = "/sys/class/video4linux";

/// A node that pictures can be streamed from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct V4lNode {
    /// Path of the device node.
    pub path: PathBuf,
    /// What the driver calls the camera.
    pub name: String,
    /// Where it is plugged in, as V4L2 tells it.
    pub bus: String,
    /// The driver.
    pub driver: String,
    /// Serial number of the USB device, empty when there is none.
    pub serial: String,
}

impl V4lNode {
    /// Pixel formats that it sends, as four characters each; none when it cannot be asked.
    pub fn formats(&self) -> Vec<String> {
        let offered = driver_call(|| {
            use v4l::video::Capture;
            Device::with_path(&self.path)?.enum_formats()
        });
        offered.unwrap_or_default().iter().map(|format| format.fourcc.to_string()).collect()
    }

    fn is_wanted(&self, config: &V4lConfig) -> bool {
        let real = |path: &Path| path.canonicalize().unwrap_or_else(|_| path.to_path_buf());
        config.device.as_deref().is_none_or(|path| real(path) == real(&self.path))
            && config.name.as_deref().is_none_or(|name| self.name.contains(name))
            && config.serial.as_deref().is_none_or(|serial| self.serial == serial)
            && config.bus.as_deref().is_none_or(|bus| self.bus.starts_with(bus))
    }
}

/// Every node that streams pictures, in the order of the nodes' numbers, and what could not be opened.
pub fn capture_nodes() -> (Vec<V4lNode>, Vec<String>) {
    let entries = std::fs::read_dir(CLASS).into_iter().flatten().flatten();
    let names = entries.filter_map(|entry| entry.file_name().into_string().ok());
    let mut numbers: Vec<u32> = names.filter_map(|name| name.strip_prefix("video")?.parse().ok()).collect();
    numbers.sort_unstable();
    let (mut nodes, mut closed) = (Vec::new(), Vec::new());
    for number in numbers {
        let path = PathBuf::from(format!("/dev/video{number}"));
        match open_node(&path) {
            Ok(node) => nodes.extend(node),
            Err(error) => closed.push(format!("{}: {error}", path.display())),
        }
    }
    (nodes, closed)
}

/// `None` for a node of another kind: metadata, output, radio.
fn open_node(path: &Path) -> std::io::Result<Option<V4lNode>> {
    let found = driver_call(|| Device::with_path(path)?.query_caps())?;
    let is_capture = found.capabilities.contains(Flags::VIDEO_CAPTURE | Flags::STREAMING);
    Ok(is_capture.then(|| {
        let (name, bus, driver) = (found.card, found.bus, found.driver);
        V4lNode { path: path.to_path_buf(), name, bus, driver, serial: usb_serial(path) }
    }))
}

/// The serial number stands with the USB device, which is the parent of the interface that the node belongs to.
fn usb_serial(path: &Path) -> String {
    let name = path.file_name().unwrap_or_default();
    let interface = Path::new(CLASS).join(name).join("device").canonicalize();
    let file = interface.ok().and_then(|interface| Some(interface.parent()?.join("serial")));
    file.and_then(|file| std::fs::read_to_string(file).ok()).unwrap_or_default().trim().to_owned()
}

/// The one node that the configuration means.
pub(super) fn find(config: &V4lConfig) -> Result<V4lNode, DeviceError> {
    let (nodes, closed) = capture_nodes();
    choose(config, &nodes, &closed)
}

fn choose(config: &V4lConfig, nodes: &[V4lNode], closed: &[String]) -> Result<V4lNode, DeviceError> {
    let mut wanted = nodes.iter().filter(|node| node.is_wanted(config));
    let problem = match (wanted.next(), wanted.next()) {
        (Some(node), None) => return Ok(node.clone()),
        (None, _) => "no camera fits",
        (Some(_), Some(_)) => "more than one camera fits; give device, name, serial or bus",
    };
    let told = |n: &V4lNode| format!("{} \"{}\" serial \"{}\" bus \"{}\"", n.path.display(), n.name, n.serial, n.bus);
    let found: Vec<String> = nodes.iter().map(told).chain(closed.iter().cloned()).collect();
    let found = if found.is_empty() { "no video nodes".to_owned() } else { found.join("; ") };
    Err(DeviceError::config("camera.v4l", format!("{problem}; found: {found}")))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn node(number: u32, name: &str, serial: &str) -> V4lNode {
        V4lNode {
            path: format!("/dev/video{number}").into(),
            name: name.into(),
            bus: format!("usb-0000:00:14.0-{number}"),
            driver: "uvcvideo".into(),
            serial: serial.into(),
        }
    }

    #[test]
    fn all_that_is_given_must_fit_one_camera() {
        let nodes = [node(0, "desk camera", "A1"), node(2, "fringe camera", "B2"), node(4, "fringe camera", "B3")];
        let choice = |change: fn(&mut V4lConfig)| {
            let mut config = V4lConfig::default();
            change(&mut config);
            choose(&config, &nodes, &["/dev/video9: permission denied".into()]).map_err(|e| e.to_string())
        };
        assert_eq!(choice(|c| c.name = Some("desk".into())).unwrap(), nodes[0]);
        assert_eq!(choice(|c| c.serial = Some("B3".into())).unwrap(), nodes[2]);
        assert_eq!(choice(|c| c.bus = Some("usb-0000:00:14.0-2".into())).unwrap(), nodes[1]);
        assert_eq!(choice(|c| c.device = Some("/dev/video4".into())).unwrap(), nodes[2]);
        let many = choice(|c| c.name = Some("fringe".into())).unwrap_err();
        assert!(many.starts_with("camera.v4l: more than one") && many.contains("B3"), "{many}");
        let none = choice(|c| {
            c.serial = Some("B3".into());
            c.name = Some("desk".into());
        });
        let none = none.unwrap_err();
        assert!(none.contains("no camera fits") && none.contains("permission denied"), "{none}");
        assert_eq!(choose(&V4lConfig::default(), &nodes[..1], &[]).unwrap(), nodes[0]);
        assert!(choose(&V4lConfig::default(), &[], &[]).unwrap_err().to_string().contains("no video nodes"));
    }
}
