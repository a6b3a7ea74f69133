//! `gv3 virtual-scanner`: the simulated scanner as USB devices.

use super::Outcome;
use crate::device::{Backend, RigConfig};
use crate::usb_device::connection::Bell;
use crate::usb_device::server::{Exported, Server};
use crate::virtual_scanner::{DeviceKind, ProjectorKind, PulseFault, VirtualConfig, VirtualScanner};
use anyhow::{Context, Result, anyhow};
use clap::{Args, ValueEnum};
use std::io::Write;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::sync::{Arc, mpsc};

/// Serve the simulated scanner as USB devices: a video camera, a projector, a serial trigger controller.
///
/// Drivers take them for real: uvcvideo, cdc-acm, and gv3's own projector driver. They are plugged in over USB/IP (usbip attach
/// on any Linux with vhci_hcd), straight into this kernel (--attach, as root), or into a virtual machine (--redir, QEMU's
/// usb-redir). Time goes with the wall's but waits for a host that does not fetch its pictures. Runs until Ctrl-C.
#[derive(Debug, Args)]
#[command(
    after_help = "Examples:\n  gv3 virtual-scanner --listen 127.0.0.1:3240 &\n  usbip attach -r 127.0.0.1 -b 1-1\n\n  sudo gv3 virtual-scanner --attach --config rig.toml\n  gv3 virtual-scanner --devices camera --play --redir /tmp/usb\n  qemu-system-x86_64 ... -device qemu-xhci -chardev socket,id=c,path=/tmp/usb/camera.sock,reconnect=1 -device usb-redir,chardev=c\n  gv3 virtual-scanner --projector dlpc350 --fault wrong-mode@100\n  gv3 virtual-scanner --fault lost@40 --fault unplug-projector@300"
)]
pub struct VirtualScannerCommand {
    /// Rig file; its patterns, calibration and [sim] are used, its backends are not. Else the built-in simulated scanner.
    #[arg(long)]
    config: Option<PathBuf>,
    /// Address to serve USB/IP at.
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1:3240", conflicts_with_all = ["attach", "redir"])]
    listen: String,
    /// Plug the devices into this machine's kernel (vhci_hcd must be loaded).
    #[arg(long, conflicts_with = "redir")]
    attach: bool,
    /// Folder for sockets that QEMU's usb-redir connects to: camera.sock, projector.sock, trigger.sock.
    #[arg(long, value_name = "DIR")]
    redir: Option<PathBuf>,
    /// Devices to serve. With the trigger controller its pulses trigger the camera, else the projector does.
    #[arg(long, value_enum, value_delimiter = ',', default_values_t = [DeviceKind::Camera, DeviceKind::Projector])]
    devices: Vec<DeviceKind>,
    /// What the projector is; else what the rig file says.
    #[arg(long, value_enum)]
    projector: Option<ProjectorKind>,
    /// The rig's sequence plays whenever the camera streams, for work on a camera alone; serves no projector.
    #[arg(long)]
    play: bool,
    /// Wall time over the scanner's; for hosts that cannot keep up.
    #[arg(long, default_value_t = 1.0, value_parser = factor)]
    slower: f64,
    /// What goes wrong, KIND@PULSE, pulses counted from 0: lost, doubled, late, saturated, stalled, short, wrong-mode,
    /// unplug-camera, unplug-projector, unplug-trigger. A pulled cable is put back after a second where the host's side allows it.
    #[arg(long = "fault", value_name = "KIND@PULSE")]
    faults: Vec<PulseFault>,
    /// The camera delivers another size than the rig's.
    #[arg(long, value_name = "WxH", value_parser = super::patterns::size)]
    camera_size: Option<[u32; 2]>,
}

fn factor(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(f) if (1.0..=1000.0).contains(&f) => Ok(f),
        _ => Err("must be a number of 1 to 1000".into()),
    }
}

impl VirtualScannerCommand {
    pub(super) fn run(self) -> Result<Outcome> {
        let config = match &self.config {
            Some(path) => RigConfig::read(path)?,
            None => RigConfig::simulated(),
        };
        let bell = Arc::new(Bell::default());
        let mut devices = self.devices.clone();
        devices.sort();
        devices.dedup();
        devices.retain(|d| !self.play || *d == DeviceKind::Camera);
        let projector = self.projector.unwrap_or(match config.projector.backend {
            Backend::Dlpc350 => ProjectorKind::Dlpc350,
            _ => ProjectorKind::Gv3,
        });
        let settings = VirtualConfig {
            devices,
            projector,
            camera_size_px: self.camera_size,
            slower: self.slower,
            plays_itself: self.play,
            faults: self.faults.clone(),
        };
        let VirtualScanner { devices, clock } = VirtualScanner::new(&config, &settings, Arc::clone(&bell))?;
        std::thread::Builder::new().name("rig-clock".into()).spawn(move || clock.run())?;
        let devices: Vec<_> =
            (1..).zip(devices).map(|(number, (kind, d))| (kind, Arc::new(Exported::new(number, d)))).collect();
        let server = Arc::new(Server::new(devices.iter().map(|d| Arc::clone(&d.1)).collect(), bell));
        let ends = self.serve(&server, &devices)?;
        // The first thread that ends takes the others with it; they end with the process.
        ends.recv().unwrap_or_else(|_| Err(anyhow!("no device is served")))?;
        Ok(Outcome::done("stopped"))
    }

    /// Begins to serve; what comes out of the receiver ends it.
    fn serve(
        &self,
        server: &Arc<Server>,
        devices: &[(DeviceKind, Arc<Exported>)],
    ) -> Result<mpsc::Receiver<Result<()>>> {
        let (ended, ends) = mpsc::channel();
        on_interrupt(ended.clone())?;
        let name = |kind: &DeviceKind| kind.to_possible_value().map_or(String::new(), |v| v.get_name().to_owned());
        if !self.attach && self.redir.is_none() {
            let listener =
                TcpListener::bind(&self.listen).with_context(|| format!("cannot listen at {}", self.listen))?;
            for (kind, exported) in devices {
                say(&format!("{} {}: usbip attach -r {} -b {0}", exported.bus_id, name(kind), host(&self.listen)))?;
            }
            let server = Arc::clone(server);
            spawn(ended, move || Ok(server.listen(&listener)?))?;
            return Ok(ends);
        }
        for (kind, exported) in devices {
            let (server, exported, name) = (Arc::clone(server), Arc::clone(exported), name(kind));
            match &self.redir {
                Some(folder) => {
                    std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
                    let socket = folder.join(format!("{name}.sock"));
                    say(&format!("{name}: {}", socket.display()))?;
                    let at = socket.clone();
                    spawn(ended.clone(), move || server.redirect(&exported, &socket).with_context(|| shown(&at)))?;
                }
                None => spawn(ended.clone(), move || {
                    server.attach(&exported).with_context(|| format!("{name}: is vhci_hcd loaded, and are you root?"))
                })?,
            }
        }
        Ok(ends)
    }
}

fn shown(path: &Path) -> String {
    path.display().to_string()
}

/// Host of an address with a port.
fn host(address: &str) -> &str {
    address.rsplit_once(':').map_or(address, |(host, _)| host)
}

/// A line for whoever waits for the devices.
fn say(line: &str) -> Result<()> {
    let mut out = std::io::stdout();
    writeln!(out, "{line}")?;
    Ok(out.flush()?)
}

fn spawn(ended: mpsc::Sender<Result<()>>, work: impl FnOnce() -> Result<()> + Send + 'static) -> Result<()> {
    std::thread::Builder::new().name("usb-server".into()).spawn(move || {
        // Nobody listens any more when another has ended before.
        let _ = ended.send(work());
    })?;
    Ok(())
}

/// Ends with Ctrl-C or SIGTERM.
fn on_interrupt(ended: mpsc::Sender<Result<()>>) -> Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    spawn(ended, move || {
        runtime.block_on(async {
            let mut terminate = tokio::signal::unix::signal(tokio::signal::unix::SignalKind::terminate())?;
            tokio::select! {
                done = tokio::signal::ctrl_c() => done?,
                _ = terminate.recv() => {}
            }
            Ok(())
        })
    })
}
