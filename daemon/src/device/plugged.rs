//! What is plugged in that a rig could be made of, and what stands in the way of using it.

use serde::Serialize;
#[cfg(target_os = "linux")]
use std::path::Path;

/// Everything found.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Plugged {
    /// Video nodes that stream pictures.
    pub cameras: Vec<PluggedCamera>,
    /// Projectors that can be played.
    pub projectors: Vec<PluggedProjector>,
    /// USB serial ports: a trigger controller is one of these, if there is one.
    pub serial_ports: Vec<PluggedPort>,
    /// What could not be looked for, and nodes that could not even be asked what they are.
    pub problems: Vec<String>,
}

/// A camera.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct PluggedCamera {
    /// Its node, as `/dev/video0`.
    pub node: String,
    /// What the driver calls it; what `camera.v4l.name` is held against.
    pub name: String,
    /// The driver.
    pub driver: String,
    /// Where it is plugged in, as V4L2 tells it.
    pub bus: String,
    /// Serial number; empty when there is none.
    pub serial: String,
    /// Pixel formats that it sends, as four characters each.
    pub formats: Vec<String>,
}

/// A projector.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct PluggedProjector {
    /// Its backend, as in a rig's file: `gv3_usb` or `dlpc350`.
    pub backend: &'static str,
    /// Serial number; empty when there is none.
    pub serial: String,
    /// Bus and ports, as `3-1.2`.
    pub bus_path: String,
    /// Its hidraw node, if it has one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub node: Option<String>,
    /// Speed of its USB connection, where it is known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub speed: Option<String>,
    /// Why it cannot be used, and what to do.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub problem: Option<String>,
}

/// A serial port.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct PluggedPort {
    /// The port, as `/dev/ttyACM0`.
    pub port: String,
    /// Maker and model, as its USB device calls itself.
    pub product: String,
    /// Serial number; empty when there is none.
    pub serial: String,
    /// USB vendor and product, as `1209:0003`.
    pub usb_id: String,
    /// Why it cannot be used, and what to do.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub problem: Option<String>,
}

impl Plugged {
    /// Looks for everything; opens nothing for longer than it takes to ask what it is.
    pub fn find() -> Self {
        let mut found = Self::default();
        found.find_cameras();
        found.find_gv3_projectors();
        found.find_dlpc350s();
        found.find_serial_ports();
        found
    }

    /// Whether nothing stands in the way of using all that was found.
    pub fn is_usable(&self) -> bool {
        self.problems.is_empty()
            && self.projectors.iter().all(|p| p.problem.is_none())
            && self.serial_ports.iter().all(|p| p.problem.is_none())
    }

    #[cfg(all(feature = "v4l", target_os = "linux"))]
    fn find_cameras(&mut self) {
        let (nodes, closed) = super::v4l_camera::capture_nodes();
        self.cameras = nodes
            .into_iter()
            .map(|node| PluggedCamera {
                formats: node.formats(),
                node: node.path.display().to_string(),
                name: node.name,
                driver: node.driver,
                bus: node.bus,
                serial: node.serial,
            })
            .collect();
        let hint = |reason: String| match reason.contains("ermission denied") {
            true => {
                format!("{reason}; add yourself to the group video (sudo usermod -aG video $USER), then log in again")
            }
            false => reason,
        };
        self.problems.extend(closed.into_iter().map(hint));
    }

    #[cfg(not(all(feature = "v4l", target_os = "linux")))]
    fn find_cameras(&mut self) {
        self.problems.push("cameras are not looked for: this build is not for Linux or lacks the feature v4l".into());
    }

    #[cfg(feature = "nusb")]
    fn find_gv3_projectors(&mut self) {
        match super::gv3_usb::plugged() {
            Ok(found) => self.projectors.extend(found),
            Err(error) => self.problems.push(error.to_string()),
        }
    }

    #[cfg(not(feature = "nusb"))]
    fn find_gv3_projectors(&mut self) {
        self.problems.push("gv3 projectors are not looked for: this build lacks the feature nusb".into());
    }

    #[cfg(target_os = "linux")]
    fn find_dlpc350s(&mut self) {
        match super::dlpc350::find_hidraw() {
            Ok(nodes) => self.projectors.extend(nodes.into_iter().map(|node| PluggedProjector {
                backend: "dlpc350",
                problem: access_problem(&node.path),
                node: Some(node.path.display().to_string()),
                serial: node.serial,
                bus_path: node.bus_path,
                speed: None,
            })),
            Err(error) => self.problems.push(error.to_string()),
        }
    }

    #[cfg(not(target_os = "linux"))]
    fn find_dlpc350s(&mut self) {}

    fn find_serial_ports(&mut self) {
        let ports = match serialport::available_ports() {
            Ok(ports) => ports,
            Err(error) => return self.problems.push(format!("serial ports: {error}")),
        };
        for port in ports {
            let serialport::SerialPortType::UsbPort(usb) = port.port_type else { continue };
            let product = [usb.manufacturer, usb.product].into_iter().flatten().collect::<Vec<_>>().join(" ");
            self.serial_ports.push(PluggedPort {
                product,
                serial: usb.serial_number.unwrap_or_default(),
                usb_id: format!("{:04x}:{:04x}", usb.vid, usb.pid),
                problem: port_problem(&port.port_name),
                port: port.port_name,
            });
        }
        self.serial_ports.sort_by(|a, b| a.port.cmp(&b.port));
    }
}

/// Why a node cannot be read and written, and what to do.
#[cfg(target_os = "linux")]
fn access_problem(node: &Path) -> Option<String> {
    use rustix::fs::{Access, access};
    use rustix::io::Errno;
    match access(node, Access::READ_OK | Access::WRITE_OK) {
        Ok(()) => None,
        Err(Errno::ACCESS | Errno::PERM) => Some(missing_rights()),
        Err(error) => Some(error.to_string()),
    }
}

#[cfg(target_os = "linux")]
fn port_problem(port: &str) -> Option<String> {
    let instead = "; or add yourself to the group dialout (sudo usermod -aG dialout $USER), then log in again";
    access_problem(Path::new(port)).map(|problem| match problem == missing_rights() {
        true => problem + instead,
        false => problem,
    })
}

#[cfg(not(target_os = "linux"))]
fn port_problem(_port: &str) -> Option<String> {
    None
}

/// What to do when the user may not use a USB device.
pub(super) fn missing_rights() -> String {
    let is_installed = ["/etc/udev/rules.d", "/usr/lib/udev/rules.d", "/lib/udev/rules.d"]
        .iter()
        .any(|folder| std::fs::exists(format!("{folder}/70-gv3.rules")).unwrap_or(false));
    match is_installed {
        true => "no rights, although 70-gv3.rules is installed; plug it in again, or join the group plugdev".into(),
        false => "no rights: the rule 70-gv3.rules is missing; `sudo gv3 install-udev`, then plug it in again".into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(target_os = "linux")]
    #[test]
    fn a_node_that_is_not_there_or_not_ours_is_a_problem() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        let node = folder.path().join("hidraw0");
        assert!(access_problem(&node).unwrap().contains("No such file"));
        std::fs::write(&node, "").unwrap();
        assert_eq!(access_problem(&node), None);
        std::fs::set_permissions(&node, std::fs::Permissions::from_mode(0o000)).unwrap();
        // Root may everything.
        if let Some(problem) = access_problem(&node) {
            assert!(problem.contains("70-gv3.rules"), "{problem}");
            assert!(port_problem(&node.display().to_string()).unwrap().contains("dialout"));
        }
    }

    #[test]
    fn a_problem_of_any_device_makes_it_unusable() {
        let projector = |problem: Option<&str>| PluggedProjector {
            backend: "dlpc350",
            serial: String::new(),
            bus_path: "1-4".into(),
            node: None,
            speed: None,
            problem: problem.map(str::to_owned),
        };
        let mut plugged = Plugged { projectors: vec![projector(None)], ..Plugged::default() };
        assert!(plugged.is_usable());
        plugged.projectors.push(projector(Some("no rights")));
        assert!(!plugged.is_usable());
    }
}
