//! The virtual scanner's USB devices as a rig in this process: a host's side of every endpoint, and the clock in a thread.
//!
//! What a kernel's drivers do for real devices is done here in a few lines each, so that the devices, their descriptors apart,
//! are used byte by byte without a kernel.
#![allow(clippy::unwrap_used, reason = "helpers of tests fail as tests do")]

use gv3::device::dlpc350::{Dlpc350Projector, HidLink, HidOpener, LinkError};
use gv3::device::gv3_usb::{Gv3Projector, UsbError, UsbPlace, UsbTransport};
use gv3::device::sim::Gv3Device;
use gv3::device::{
    self, Camera, CameraInfo, CameraSettings, DeviceError, Frame, PatternIndex, Projector, ProvenCamera, Rig,
    RigConfig, TriggerSource,
};
use gv3::usb_device::connection::SharedDevice;
use gv3::usb_device::{Bus, Completion, Outcome, Request, Setup};
use gv3::virtual_scanner::{DeviceKind, ProjectorKind, RigClock, VirtualConfig, VirtualScanner};
use gv3_codec::GreyPicture;
use gv3_protocol::dlpc350::{REPORT_BYTES, Report};
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// How often is looked for what is not there yet.
const LOOK_AGAIN: Duration = Duration::from_micros(200);
/// Endpoint of the camera's pixels, bytes asked for at a time, and bytes before the pixels.
const PIXELS: u8 = 1;
const TRANSFER_BYTES: u32 = 32 * 1024;
const HEADER_BYTES: usize = 12;
/// Unit of the camera's exposure control, and of its clock.
const EXPOSURE_UNIT_NANOS: u64 = 100_000;
const NANOS_A_TICK: u64 = 100;

/// Opens the virtual scanner of a rig's configuration; its backends are not looked at.
pub fn open(config: &RigConfig, projector: ProjectorKind) -> Rig {
    let devices = vec![DeviceKind::Camera, DeviceKind::Projector];
    let settings = VirtualConfig { devices, projector, ..VirtualConfig::default() };
    let VirtualScanner { devices, clock } = VirtualScanner::new(config, &settings, Arc::default()).unwrap();
    let [camera, projector_cable] = [0, 1].map(|i| Cable::new(&devices[i].1));
    let camera = VirtualCamera::new(camera, config, Ticking::begin(clock));
    let projector: Box<dyn Projector> = match projector {
        ProjectorKind::Gv3 => {
            let opener = move || -> Result<Arc<dyn UsbTransport>, UsbError> {
                let place = UsbPlace { bus_path: "1-2".into(), serial: None };
                Ok(Arc::new(Transport { cable: projector_cable.clone(), place }))
            };
            Box::new(Gv3Projector::open(Box::new(opener)).unwrap())
        }
        ProjectorKind::Dlpc350 => {
            let settings = config.projector.dlpc350.as_ref().unwrap();
            let opener = Box::new(Hid(projector_cable));
            Box::new(Dlpc350Projector::open_with(settings, opener, Duration::from_secs(1)).unwrap())
        }
    };
    let (period_nanos, count) = (config.timing.picture_period_nanos, config.sequence.patterns.len());
    let camera = ProvenCamera::new(Box::new(camera), None, projector.exposures(), period_nanos, count);
    let mut simulated = config.clone();
    simulated.projector = device::ProjectorConfig::of(device::Backend::Simulated);
    Rig { camera: Box::new(camera), projector, ..device::open(&simulated).unwrap() }
}

/// The rig's clock, for as long as this lives.
struct Ticking(Arc<AtomicBool>);

impl Ticking {
    fn begin(mut clock: RigClock) -> Self {
        let is_over = Arc::new(AtomicBool::new(false));
        let asked = Arc::clone(&is_over);
        std::thread::spawn(move || {
            while !asked.load(Ordering::Relaxed) {
                std::thread::sleep(clock.step(Instant::now()));
            }
        });
        Self(is_over)
    }
}

impl Drop for Ticking {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// A host's end of a cable.
#[derive(Clone)]
struct Cable {
    device: SharedDevice,
    state: Arc<Mutex<Transfers>>,
}

#[derive(Default)]
struct Transfers {
    bus: Bus,
    last_id: u64,
    done: BTreeMap<u64, Outcome>,
}

impl Cable {
    fn new(device: &SharedDevice) -> Self {
        Self { device: Arc::clone(device), state: Arc::default() }
    }

    fn request(&self, request: impl FnOnce(u64) -> Request) -> u64 {
        let mut state = self.state.lock().unwrap();
        state.last_id += 1;
        let (id, mut done) = (state.last_id, Vec::new());
        state.bus.handle(request(id), &mut *self.device.lock().unwrap(), &mut done).unwrap();
        state.done.extend(done.into_iter().map(|Completion { id, outcome, .. }| (id, outcome)));
        id
    }

    fn control(&self, setup: [u8; 8], data: &[u8]) -> Outcome {
        let id = self.request(|id| Request::Control { id, setup: Setup::new(setup), data: data.to_vec() });
        self.state.lock().unwrap().done.remove(&id).unwrap()
    }

    fn out(&self, endpoint: u8, data: &[u8]) -> bool {
        let id = self.request(|id| Request::Out { id, endpoint, data: data.to_vec() });
        matches!(self.state.lock().unwrap().done.remove(&id), Some(Outcome::Taken(_)))
    }

    /// One transfer's data; `None` when nothing came in time.
    fn take(&self, endpoint: u8, max_bytes: u32, timeout: Duration) -> Option<Outcome> {
        let deadline = Instant::now() + timeout;
        let wanted = self.request(|id| Request::In { id, endpoint, max_bytes });
        loop {
            {
                let mut state = self.state.lock().unwrap();
                let mut done = Vec::new();
                state.bus.pump(&mut *self.device.lock().unwrap(), 1 << 24, &mut done);
                state.done.extend(done.into_iter().map(|c| (c.id, c.outcome)));
                if let Some(outcome) = state.done.remove(&wanted) {
                    return Some(outcome);
                }
            }
            if Instant::now() >= deadline {
                self.request(|id| Request::Cancel { id, victim: wanted });
                // Another thread may have completed it meanwhile.
                return self.state.lock().unwrap().done.remove(&wanted).filter(|o| matches!(o, Outcome::Data(_)));
            }
            std::thread::sleep(LOOK_AGAIN);
        }
    }
}

/// The vendor protocol's pipes.
struct Transport {
    cable: Cable,
    place: UsbPlace,
}

impl Transport {
    fn read_from(&self, address: u8, timeout: Duration) -> Result<Vec<u8>, UsbError> {
        match self.cable.take(address & 0x0f, 512, timeout) {
            None => Err(UsbError::Timeout),
            Some(Outcome::Data(bytes)) => Ok(bytes),
            Some(_) => {
                self.cable.control([0x02, 1, 0, 0, address, 0, 0, 0], &[]);
                Err(UsbError::Stall)
            }
        }
    }
}

impl UsbTransport for Transport {
    fn place(&self) -> &UsbPlace {
        &self.place
    }

    fn control_in(&self, request: u8, length: u16, _: Duration) -> Result<Vec<u8>, UsbError> {
        let [low, high] = length.to_le_bytes();
        match self.cable.control([0xc1, request, 0, 0, 0, 0, low, high], &[]) {
            Outcome::Data(bytes) => Ok(bytes),
            _ => Err(UsbError::Stall),
        }
    }

    fn control_out(&self, request: u8, _: Duration) -> Result<(), UsbError> {
        match self.cable.control([0x41, request, 0, 0, 0, 0, 0, 0], &[]) {
            Outcome::Taken(_) => Ok(()),
            _ => Err(UsbError::Stall),
        }
    }

    fn write(&self, message: &[u8], _: Duration) -> Result<(), UsbError> {
        if self.cable.out(Gv3Device::OUT, message) { Ok(()) } else { Err(UsbError::Stall) }
    }

    fn read(&self, timeout: Duration) -> Result<Vec<u8>, UsbError> {
        self.read_from(Gv3Device::IN, timeout)
    }

    fn read_event(&self, timeout: Duration) -> Result<Vec<u8>, UsbError> {
        self.read_from(Gv3Device::EVENTS, timeout)
    }
}

/// The LightCrafter's reports.
#[derive(Clone)]
struct Hid(Cable);

impl HidLink for Hid {
    fn write_report(&mut self, report: &Report) -> Result<(), LinkError> {
        if self.0.out(1, report) { Ok(()) } else { Err(LinkError::Failed("refused".into())) }
    }

    fn read_report(&mut self, timeout: Duration) -> Result<Report, LinkError> {
        match self.0.take(1, REPORT_BYTES as u32, timeout) {
            Some(Outcome::Data(bytes)) => Ok(bytes.try_into().unwrap()),
            Some(other) => Err(LinkError::Failed(format!("{other:?}"))),
            None => Err(LinkError::Timeout(timeout)),
        }
    }
}

impl HidOpener for Hid {
    fn name(&self) -> String {
        "virtual LightCrafter".into()
    }

    fn open(&mut self) -> Result<Box<dyn HidLink>, LinkError> {
        Ok(Box::new(self.clone()))
    }
}

/// The camera, as a driver of its class uses it.
struct VirtualCamera {
    cable: Cable,
    size_px: [u32; 2],
    period_nanos: u64,
    pattern_count: u64,
    settings: Option<CameraSettings>,
    run: Option<Run>,
    _clock: Ticking,
}

/// A stream.
#[derive(Default)]
struct Run {
    payload: Vec<u8>,
    pictures: u64,
    /// Its first picture's time, ticks, and when it came.
    first: Option<(u32, Instant)>,
    last_host_nanos: u64,
}

impl VirtualCamera {
    fn new(cable: Cable, config: &RigConfig, clock: Ticking) -> Self {
        Self {
            cable,
            size_px: [config.camera.width_px, config.camera.height_px],
            period_nanos: config.timing.picture_period_nanos,
            pattern_count: config.sequence.patterns.len() as u64,
            settings: None,
            run: None,
            _clock: clock,
        }
    }

    fn end(&mut self) {
        if self.run.take().is_some() {
            self.cable.control([0x02, 1, 0, 0, 0x80 | PIXELS, 0, 0, 0], &[]);
        }
    }
}

impl Run {
    /// The frame of a payload that is whole.
    fn frame(
        &mut self,
        payload: &[u8],
        [width_px, height_px]: [u32; 2],
        exposure_nanos: u64,
        count: u64,
    ) -> Option<Frame> {
        let sequence = self.pictures;
        self.pictures += 1;
        let pixels = payload.get(HEADER_BYTES..).filter(|p| p.len() == (width_px * height_px) as usize)?;
        let ticks = u32::from_le_bytes([payload[2], payload[3], payload[4], payload[5]]);
        let (first, arrival) = *self.first.get_or_insert((ticks, Instant::now()));
        let device_time_nanos = u64::from(ticks.wrapping_sub(first)) * NANOS_A_TICK;
        let since_nanos = arrival.elapsed().as_nanos() as u64;
        self.last_host_nanos = since_nanos.max(device_time_nanos).max(self.last_host_nanos + 1);
        Some(Frame {
            sequence,
            pattern: PatternIndex((sequence % count) as u16),
            device_time_nanos,
            host_time_nanos: self.last_host_nanos,
            exposure_nanos,
            picture: GreyPicture::new(width_px, height_px, pixels.to_vec()),
        })
    }
}

impl Camera for VirtualCamera {
    fn info(&self) -> CameraInfo {
        CameraInfo {
            model: "virtual camera".into(),
            serial: String::new(),
            width_px: self.size_px[0],
            height_px: self.size_px[1],
            min_period_nanos: self.period_nanos,
            waits_for_reader: false,
        }
    }

    fn configure(&mut self, want: &CameraSettings) -> Result<CameraSettings, DeviceError> {
        let refuse = |field: &str| Err(DeviceError::Config { field: field.into(), reason: "not possible".into() });
        if [want.width_px, want.height_px] != self.size_px {
            return refuse("camera.width_px");
        }
        if want.trigger != TriggerSource::Projector {
            return refuse("camera.trigger");
        }
        self.end();
        let units = u32::try_from(want.exposure_nanos / EXPOSURE_UNIT_NANOS).unwrap();
        assert_eq!(self.cable.control([0x21, 1, 0, 4, 0, 1, 4, 0], &units.to_le_bytes()), Outcome::Taken(4));
        let set = CameraSettings { exposure_nanos: u64::from(units) * EXPOSURE_UNIT_NANOS, ..*want };
        self.settings = Some(set);
        Ok(set)
    }

    fn start(&mut self) -> Result<(), DeviceError> {
        if self.settings.is_none() {
            return Err(DeviceError::State("the camera is started before it is configured"));
        }
        self.end();
        // Probe and commit, as uvcvideo does.
        let mut probe = vec![1, 0, 1, 1];
        probe.extend(((self.period_nanos / NANOS_A_TICK) as u32).to_le_bytes());
        probe.resize(26, 0);
        for selector in [1, 2] {
            assert_eq!(self.cable.control([0x21, 1, 0, selector, 1, 0, 26, 0], &probe), Outcome::Taken(26));
        }
        self.run = Some(Run::default());
        Ok(())
    }

    fn next_frame(&mut self, deadline: Instant) -> Result<Frame, DeviceError> {
        let (Some(run), Some(settings)) = (&mut self.run, self.settings) else {
            return Err(DeviceError::State("a frame is asked of a camera that is not started"));
        };
        loop {
            let wait = deadline.saturating_duration_since(Instant::now());
            let Some(Outcome::Data(part)) = self.cable.take(PIXELS, TRANSFER_BYTES, wait) else {
                return Err(DeviceError::Timeout("the virtual camera".into()));
            };
            run.payload.extend_from_slice(&part);
            if part.len() == TRANSFER_BYTES as usize {
                continue;
            }
            let payload = std::mem::take(&mut run.payload);
            if let Some(frame) = run.frame(&payload, self.size_px, settings.exposure_nanos, self.pattern_count) {
                return Ok(frame);
            }
        }
    }

    fn stop(&mut self) -> Result<(), DeviceError> {
        self.end();
        Ok(())
    }
}
