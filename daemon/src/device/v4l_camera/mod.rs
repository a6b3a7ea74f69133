//! Cameras behind Video4Linux.
//!
//! The crate `v4l` opens nodes, asks for capabilities and formats and sets formats, intervals and controls. Its streams are not
//! used: they give a buffer back that they do not own after a timeout, and panic when a stream cannot be stopped; and its
//! enumeration of controls panics at kinds of newer kernels. `kernel.rs` does both, with all that is unsafe. What `v4l` panics
//! about elsewhere (names that are no UTF-8) becomes an error.
//!
//! `v4l`'s own bindings need libclang to be made; the workspace puts the same ones, made beforehand, in their place
//! (`vendor/v4l2-sys-mit`), so that a Rust toolchain is all the build needs.
//!
//! A picture comes with the driver's number and time (`stamp.rs`). Pictures that the driver marks as damaged, that are too short
//! or of before the run's start are left out and counted; their numbers stay as gaps. An unplugged camera is
//! [`DeviceError::Disconnected`] until [`Camera::start`] finds it again, under whatever node it has come back; times go on then.

mod controls;
mod grey;
mod kernel;
mod node;
mod stamp;

use super::in_use;
use super::{
    Camera, CameraInfo, CameraSettings, DeviceError, Frame, PatternIndex, RigConfig, TriggerSource, V4lConfig,
};
use grey::PictureFormat;
use gv3_codec::GreyPicture;
use kernel::{BufferStamp, Queue};
use stamp::{Clocks, SequenceCounter};
use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::Instant;
use tracing::{info, warn};
use v4l::video::Capture;
use v4l::{Device, Format, FourCC, Fraction};

pub use controls::SetControl;
pub use node::{V4lNode, capture_nodes};

const FLAG_ERROR: u32 = v4l::v4l_sys::V4L2_BUF_FLAG_ERROR;
const FLAG_STAMP_SOURCE: u32 = v4l::v4l_sys::V4L2_BUF_FLAG_TSTAMP_SRC_MASK;
const FLAG_START_OF_EXPOSURE: u32 = v4l::v4l_sys::V4L2_BUF_FLAG_TSTAMP_SRC_SOE;
const ENODEV: i32 = 19;
const EBUSY: i32 = 16;

/// Streams that end by themselves are begun again so many times in a row.
const MOST_RESTARTS: u32 = 3;

/// Runs a call of the crate `v4l`, which panics at some answers of drivers.
fn driver_call<T>(call: impl FnOnce() -> io::Result<T>) -> io::Result<T> {
    catch_unwind(AssertUnwindSafe(call))
        .unwrap_or_else(|_| Err(io::Error::other("the driver's answer is not understood")))
}

/// Pictures that were not delivered, and what else went wrong, since the camera was opened.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct V4lCounts {
    /// Pictures delivered.
    pub delivered: u64,
    /// Pictures that the driver's numbers say are missing.
    pub missing: u64,
    /// Pictures that came after their successors; their numbers tell.
    pub disordered: u64,
    /// Pictures that the driver marks as damaged.
    pub damaged: u64,
    /// Pictures too short or not to be decoded.
    pub unreadable: u64,
    /// Pictures of before the run.
    pub stale: u64,
    /// Pictures with a time of no clock, stamped on arrival.
    pub unstamped: u64,
    /// Deadlines that passed without a picture.
    pub timeouts: u64,
    /// Streams that ended by themselves and were begun again.
    pub restarts: u64,
    /// Times the camera was gone.
    pub unplugged: u64,
}

/// What was agreed with the camera.
#[derive(Debug, Clone, PartialEq)]
pub struct V4lSetup {
    /// The node.
    pub node: V4lNode,
    /// Bytes from row to row.
    pub stride: u32,
    /// Time between pictures by the camera's own clock, nanoseconds, if it tells.
    pub period_nanos: Option<u64>,
    /// Controls that were set.
    pub controls: Vec<SetControl>,
}

/// A configured camera.
struct Ready {
    /// The same opened file sets the format and streams: uvcvideo refuses others.
    device: Arc<Device>,
    format: PictureFormat,
    setup: V4lSetup,
    settings: CameraSettings,
}

/// A run.
struct Run {
    queue: Queue,
    numbers: SequenceCounter,
    /// Monotonic time at which this stream began; older pictures are of another.
    began_nanos: u64,
    /// Number of the stream's first picture in the run.
    first_number: u64,
    next_number: u64,
    restarts_in_a_row: u32,
}

/// A V4L2 camera.
pub struct V4lCamera {
    config: V4lConfig,
    size_px: [u32; 2],
    pattern_count: u64,
    picture_period_nanos: u64,
    node: V4lNode,
    min_period_nanos: u64,
    ready: Option<Ready>,
    wanted: Option<CameraSettings>,
    run: Option<Run>,
    is_unplugged: bool,
    /// Monotonic time of the run's time 0, the middle of picture 0's exposure; outlives the stream when the camera is unplugged.
    origin_nanos: Option<u64>,
    counts: V4lCounts,
}

impl V4lCamera {
    /// Finds the camera of a rig.
    ///
    /// # Errors
    /// [`DeviceError::Config`] when none or more than one fits, with what there is.
    pub fn open(rig: &RigConfig) -> Result<Self, DeviceError> {
        let config = rig.camera.v4l.clone().unwrap_or_default();
        config.validate()?;
        let node = node::find(&config)?;
        let size_px = [rig.camera.width_px, rig.camera.height_px];
        let min_period_nanos = shortest_period_nanos(&node, &config, size_px);
        info!(node = %node.path.display(), name = node.name, serial = node.serial, "camera found");
        Ok(Self {
            config,
            size_px,
            pattern_count: rig.sequence.patterns.len().max(1) as u64,
            picture_period_nanos: rig.timing.picture_period_nanos,
            node,
            min_period_nanos,
            ready: None,
            wanted: None,
            run: None,
            is_unplugged: false,
            origin_nanos: None,
            counts: V4lCounts::default(),
        })
    }

    /// What went wrong so far.
    pub fn counts(&self) -> V4lCounts {
        self.counts
    }

    /// What was agreed with the camera, once it is configured.
    pub fn setup(&self) -> Option<&V4lSetup> {
        self.ready.as_ref().map(|ready| &ready.setup)
    }

    fn gone(&mut self) -> DeviceError {
        self.counts.unplugged += u64::from(!self.is_unplugged);
        self.is_unplugged = true;
        (self.run, self.ready) = (None, None);
        DeviceError::Disconnected(format!("the camera \"{}\"", self.node.name))
    }

    /// An error of the driver's; the device is gone if the error says so, or if it cannot be opened any more.
    fn failed(&mut self, action: &str, error: &io::Error) -> DeviceError {
        if error.raw_os_error() == Some(EBUSY) {
            return in_use(&self.node);
        }
        if error.raw_os_error() == Some(ENODEV) || Device::with_path(&self.node.path).is_err() {
            return self.gone();
        }
        DeviceError::Failed(format!("the camera \"{}\": {action}: {}", self.node.name, in_use::told(error)))
    }

    fn prepare(&mut self, want: &CameraSettings) -> Result<CameraSettings, DeviceError> {
        self.ready = None;
        let device = driver_call(|| Device::with_path(&self.node.path)).map_err(|e| self.failed("opening", &e))?;
        // Before anything is set that another program relies on.
        kernel::lock(&device).map_err(|e| self.failed("opening", &e))?;
        let format = agree_format(&device, &self.node, &self.config, want)?;
        let wanted_nanos = match want.trigger {
            TriggerSource::Projector => self.picture_period_nanos,
            TriggerSource::Internal { period_nanos } => period_nanos,
        };
        let period_nanos = agree_period(&device, wanted_nanos);
        let (controls, exposure_nanos) = controls::apply(&device, &self.config, want)?;
        let trigger = match (want.trigger, period_nanos) {
            (TriggerSource::Internal { .. }, Some(period_nanos)) => TriggerSource::Internal { period_nanos },
            (trigger, _) => trigger,
        };
        if want.trigger == TriggerSource::Projector && self.config.trigger.is_none() {
            info!("camera.v4l.trigger is not given: the camera's own trigger setting is kept");
        }
        let settings =
            CameraSettings { exposure_nanos: exposure_nanos.unwrap_or(want.exposure_nanos), trigger, ..*want };
        let setup = V4lSetup { node: self.node.clone(), stride: format.stride, period_nanos, controls };
        info!(?setup, exposure_nanos = settings.exposure_nanos, "camera configured");
        self.ready = Some(Ready { device: Arc::new(device), format, setup, settings });
        Ok(settings)
    }

    fn stream(&mut self, first_number: u64) -> Result<(), DeviceError> {
        self.run = None;
        let Some(ready) = &self.ready else {
            return Err(DeviceError::State("the camera is started before it is configured"));
        };
        let began_nanos = Clocks::now().monotonic;
        let queue = Queue::start(Arc::clone(&ready.device), self.config.buffers);
        let queue = queue.map_err(|e| self.failed("starting the stream", &e))?;
        let numbers = SequenceCounter::default();
        let next_number = first_number;
        self.run = Some(Run { queue, numbers, began_nanos, first_number, next_number, restarts_in_a_row: 0 });
        Ok(())
    }
}

impl V4lCamera {
    /// The picture of the next buffer; `None` when it holds none.
    fn next_picture(&mut self, deadline: Instant) -> Result<Option<Frame>, DeviceError> {
        let (Some(ready), Some(run)) = (&self.ready, &mut self.run) else {
            return Err(DeviceError::State("a frame is asked of a camera that is not started"));
        };
        let format = ready.format;
        let taken = run.queue.next(deadline, |bytes, stamp| {
            let is_damaged = stamp.flags & FLAG_ERROR != 0;
            (stamp, Clocks::now(), (!is_damaged).then(|| format.grey(bytes)))
        });
        match taken {
            Ok(Some((stamp, clocks, picture))) => Ok(self.frame(stamp, &clocks, picture)),
            Ok(None) => {
                self.counts.timeouts += 1;
                Err(DeviceError::Timeout(format!("the camera \"{}\"", self.node.name)))
            }
            Err(error) => self.begin_again(&error).map(|()| None),
        }
    }

    /// A frame of a picture that is whole and of this run.
    fn frame(
        &mut self,
        stamp: BufferStamp,
        clocks: &Clocks,
        picture: Option<Result<GreyPicture, String>>,
    ) -> Option<Frame> {
        let (run, ready) = (self.run.as_mut()?, self.ready.as_ref()?);
        let time_nanos = clocks.monotonic_of(stamp.time_nanos);
        if time_nanos.is_some_and(|time| time < run.began_nanos) {
            self.counts.stale += 1;
            return None;
        }
        self.counts.unstamped += u64::from(time_nanos.is_none());
        run.restarts_in_a_row = 0;
        let (number, missing) = run.numbers.number(stamp.sequence);
        self.counts.missing = self.counts.missing.saturating_add_signed(missing);
        self.counts.disordered += u64::from(missing < 0);
        let sequence = run.first_number + number;
        run.next_number = run.next_number.max(sequence + 1);
        let picture = match picture {
            Some(Ok(picture)) => picture,
            None => {
                self.counts.damaged += 1;
                return None;
            }
            Some(Err(reason)) => {
                self.counts.unreadable += 1;
                warn!(sequence, reason, "a picture that cannot be read");
                return None;
            }
        };
        self.counts.delivered += 1;
        let exposure_nanos = ready.settings.exposure_nanos;
        let stamp_nanos = time_nanos.unwrap_or(clocks.monotonic);
        let middle_nanos = match stamp.flags & FLAG_STAMP_SOURCE {
            FLAG_START_OF_EXPOSURE => stamp_nanos.saturating_add(exposure_nanos / 2),
            _ => stamp_nanos.saturating_sub(exposure_nanos / 2),
        };
        // However long the trigger let the camera wait, the run begins with its first picture.
        let period_nanos = match ready.settings.trigger {
            TriggerSource::Projector => self.picture_period_nanos,
            TriggerSource::Internal { period_nanos } => period_nanos,
        };
        let due_nanos = sequence.saturating_mul(period_nanos);
        let origin_nanos = *self.origin_nanos.get_or_insert(middle_nanos.saturating_sub(due_nanos));
        let device_time_nanos = middle_nanos.saturating_sub(origin_nanos);
        Some(Frame {
            sequence,
            pattern: PatternIndex((sequence % self.pattern_count) as u16),
            device_time_nanos,
            host_time_nanos: clocks.monotonic.saturating_sub(origin_nanos).max(device_time_nanos),
            exposure_nanos,
            picture,
        })
    }

    /// After an error of the stream's: another stream of the same run, unless the device is gone.
    fn begin_again(&mut self, error: &io::Error) -> Result<(), DeviceError> {
        let Some(run) = &self.run else { return Err(self.failed("streaming", error)) };
        let (next_number, restarts) = (run.next_number, run.restarts_in_a_row + 1);
        if error.raw_os_error() == Some(ENODEV) || restarts > MOST_RESTARTS {
            return Err(self.failed("streaming", error));
        }
        warn!(%error, "the stream has ended; it is begun again");
        self.counts.restarts += 1;
        self.stream(next_number)?;
        if let Some(run) = &mut self.run {
            run.restarts_in_a_row = restarts;
        }
        Ok(())
    }
}

impl Camera for V4lCamera {
    fn info(&self) -> CameraInfo {
        CameraInfo {
            model: self.node.name.clone(),
            serial: self.node.serial.clone(),
            width_px: self.size_px[0],
            height_px: self.size_px[1],
            min_period_nanos: self.min_period_nanos,
            waits_for_reader: false,
        }
    }

    fn configure(&mut self, want: &CameraSettings) -> Result<CameraSettings, DeviceError> {
        (self.run, self.origin_nanos) = (None, None);
        let set = self.prepare(want)?;
        self.wanted = Some(*want);
        Ok(set)
    }

    fn start(&mut self) -> Result<(), DeviceError> {
        let Some(wanted) = self.wanted else {
            return Err(DeviceError::State("the camera is started before it is configured"));
        };
        if self.is_unplugged {
            let name = &self.node.name;
            self.node =
                node::find(&self.config).map_err(|_| DeviceError::Disconnected(format!("the camera \"{name}\"")))?;
        }
        if self.ready.is_none() {
            self.prepare(&wanted)?;
        }
        self.stream(0)?;
        self.is_unplugged = false;
        Ok(())
    }

    fn next_frame(&mut self, deadline: Instant) -> Result<Frame, DeviceError> {
        if self.is_unplugged {
            return Err(self.gone());
        }
        loop {
            if let Some(frame) = self.next_picture(deadline)? {
                return Ok(frame);
            }
        }
    }

    fn stop(&mut self) -> Result<(), DeviceError> {
        if self.run.take().is_some() {
            info!(counts = ?self.counts, "camera stopped");
        }
        self.origin_nanos = None;
        Ok(())
    }
}

/// A camera serves one program at a time; drivers refuse the second when it sets a format, or when it begins to stream.
fn in_use(node: &V4lNode) -> DeviceError {
    let (name, path) = (&node.name, node.path.display());
    // v4l2loopback says the same when there is nothing to show.
    let or_else = if node.driver == "v4l2 loopback" { ", or nobody sends to it" } else { "" };
    let action = format!("end that one (`fuser -v {path}` names it)");
    DeviceError::Failed(format!("the camera \"{name}\" is in use by another program; {action}{or_else}"))
}

/// Sets size and pixel format; what the driver makes of them must be what was asked for.
fn agree_format(
    device: &Device,
    node: &V4lNode,
    config: &V4lConfig,
    want: &CameraSettings,
) -> Result<PictureFormat, DeviceError> {
    let fourcc = FourCC::new(&config.pixel_format.fourcc());
    // Stride and size 0 leave both to the driver; what comes back is used.
    let wanted = Format::new(want.width_px, want.height_px, fourcc);
    let set = driver_call(|| device.set_format(&wanted));
    let set = set.map_err(|e| match e.raw_os_error() {
        Some(EBUSY) => in_use(node),
        _ => DeviceError::config("camera.v4l.pixel_format", format!("the camera refuses {fourcc}: {e}")),
    })?;
    if set.fourcc != fourcc {
        let offered = driver_call(|| device.enum_formats()).unwrap_or_default();
        let offered: Vec<String> = offered.iter().map(|format| format.fourcc.to_string()).collect();
        let reason = format!("the camera does not send {fourcc}; it sends {}", offered.join(", "));
        return Err(DeviceError::config("camera.v4l.pixel_format", reason));
    }
    if [set.width, set.height] != [want.width_px, want.height_px] {
        let reason = format!(
            "{} x {}, but the camera sends {} x {} as {fourcc}",
            want.width_px, want.height_px, set.width, set.height
        );
        return Err(DeviceError::config("camera.width_px", reason));
    }
    let mut format = PictureFormat {
        pixels: config.pixel_format,
        width_px: set.width,
        height_px: set.height,
        stride: set.stride,
        is_full_range: matches!(set.quantization, v4l::format::Quantization::FullRange),
    };
    // Some drivers leave the stride of packed rows at 0.
    format.stride = format.stride.max(format.row_bytes() as u32);
    Ok(format)
}

/// Sets the interval of the camera's own clock; `None` when the driver has none.
fn agree_period(device: &Device, wanted_nanos: u64) -> Option<u64> {
    let wanted = u32::try_from(wanted_nanos / 100).unwrap_or(u32::MAX);
    let parameters = v4l::video::capture::Parameters::new(Fraction::new(wanted, 10_000_000));
    let set = driver_call(|| device.set_params(&parameters)).ok().and_then(|set| fraction_nanos(&set.interval))?;
    if set > wanted_nanos + wanted_nanos / 50 {
        warn!(wanted_nanos, set_nanos = set, "the camera's own clock is slower than the patterns");
    }
    Some(set)
}

fn fraction_nanos(fraction: &Fraction) -> Option<u64> {
    (u64::from(fraction.numerator) * 1_000_000_000).checked_div(u64::from(fraction.denominator)).filter(|n| *n > 0)
}

/// Shortest interval that the driver offers at a size, nanoseconds; 1 when it does not say.
fn shortest_period_nanos(node: &V4lNode, config: &V4lConfig, [width, height]: [u32; 2]) -> u64 {
    use v4l::frameinterval::FrameIntervalEnum as Kind;
    let fourcc = FourCC::new(&config.pixel_format.fourcc());
    let offered = driver_call(|| Device::with_path(&node.path)?.enum_frameintervals(fourcc, width, height));
    let nanos = offered.unwrap_or_default().into_iter().filter_map(|offer| match offer.interval {
        Kind::Discrete(interval) => fraction_nanos(&interval),
        Kind::Stepwise(range) => fraction_nanos(&range.min),
    });
    nanos.min().unwrap_or(1)
}
