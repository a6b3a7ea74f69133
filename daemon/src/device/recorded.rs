//! A raw recording played back as camera and projector, at the sensor's pace or as fast as it is read.
//!
//! What went wrong when it was made comes out as it was: missing, doubled and late pictures, silence, a camera that was gone.

use super::{
    Camera, CameraInfo, CameraSettings, DeviceError, Frame, PatternIndex, Projector, ProjectorInfo, RigConfig,
    SequenceTiming, TriggerSource,
};
use crate::light::PatternSequence;
use gv3_codec::GreyPicture;
use gv3_protocol::raw::{FaultCode, RawError, RawItem, RawPicture, RawReader};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use tracing::warn;

/// Longest wait for a picture at the sensor's pace, so that one wild stamp does not stop the playback.
const MAX_WAIT_NANOS: u64 = 10_000_000_000;

/// When a recording's pictures come.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Pace {
    /// As they came when they were recorded.
    Sensor,
    /// As soon as they are asked for.
    #[default]
    Fast,
}

/// Which recording is played, and how.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RecordedConfig {
    /// Folder of the recording; a relative path starts at the rig's file.
    pub path: PathBuf,
    /// When pictures come.
    #[serde(default)]
    pub pace: Pace,
    /// Begin again at the end, with stamps that go on.
    #[serde(default, rename = "loop")]
    pub is_loop: bool,
}

impl From<RawError> for DeviceError {
    fn from(error: RawError) -> Self {
        match error {
            RawError::Io { path, action, source } => Self::File { path, reason: format!("cannot {action}: {source}") },
            RawError::NotARecording { path, reason } => {
                Self::File { path, reason: format!("not a raw recording: {reason}") }
            }
            RawError::NewerVersion { ref path, .. } | RawError::Exists { ref path } => {
                Self::File { path: path.clone(), reason: error.to_string() }
            }
            RawError::Usage(reason) => Self::config("recorded.path", reason),
        }
    }
}

/// The configuration stored in a recording, with its devices replaced by the recording itself.
///
/// # Errors
/// [`DeviceError::File`] when there is no recording or its configuration cannot be read.
pub(super) fn stored_config(recorded: RecordedConfig) -> Result<RigConfig, DeviceError> {
    let reader = RawReader::open(&recorded.path)?;
    let unreadable = |e: toml::de::Error| DeviceError::File {
        path: recorded.path.clone(),
        reason: format!("its configuration: {}", e.to_string().trim_end()),
    };
    let mut config: RigConfig = toml::from_str(reader.configuration()).map_err(unreadable)?;
    config.camera.backend = super::Backend::Recorded;
    config.projector = super::ProjectorConfig::of(super::Backend::Recorded);
    config.trigger = None;
    config.recorded = Some(recorded);
    config.validate()?;
    Ok(config)
}

/// The recording behind camera and projector.
pub struct Deck {
    reader: RawReader,
    pace: Pace,
    is_loop: bool,
    rig_name: String,
    size_px: [u32; 2],
    sequence: PatternSequence,
    timing: SequenceTiming,
    is_loaded: bool,
    is_playing: bool,
    /// What was given last is that a device was gone; whoever plays again wants what came after.
    is_interrupted: bool,
    /// Read, but not due yet.
    pending: Option<RawItem>,
    /// Host time and instant of what was given last.
    last: Option<(u64, Instant)>,
    /// When a pass after the first begins.
    pass_begin: Option<Instant>,
    /// First and last sequence numbers of this pass over the recording.
    pass: Option<[u64; 2]>,
    /// Triggers of the passes before; a multiple of the sequence's length.
    shift: u64,
}

impl Deck {
    /// Opens the recording of a configuration.
    ///
    /// # Errors
    /// [`DeviceError::File`] when there is none; [`DeviceError::Config`] when the configuration names none.
    pub fn open(config: &RigConfig) -> Result<Self, DeviceError> {
        let Some(recorded) = &config.recorded else {
            return Err(DeviceError::config("recorded", "missing; a recorded rig needs [recorded] with path"));
        };
        Ok(Self {
            reader: RawReader::open(&recorded.path)?,
            pace: recorded.pace,
            is_loop: recorded.is_loop,
            rig_name: config.name.clone(),
            size_px: [config.camera.width_px, config.camera.height_px],
            sequence: config.sequence.clone(),
            timing: config.timing,
            is_loaded: false,
            is_playing: false,
            is_interrupted: false,
            pending: None,
            last: None,
            pass_begin: None,
            pass: None,
            shift: 0,
        })
    }

    fn rewind(&mut self) {
        self.reader.rewind();
        (self.pending, self.last, self.pass_begin, self.pass, self.shift) = (None, None, None, None, 0);
    }

    /// When the next picture or fault is due, none for at once; [`DeviceError::Ended`] when nothing more comes.
    fn due(&mut self) -> Result<Option<Instant>, DeviceError> {
        while self.pending.is_none() {
            match self.reader.next(true)? {
                Some((path, RawItem::Damage { offset, bytes, reason })) => {
                    warn!(path = %path.display(), offset, bytes, reason, "damage in the recording passed over");
                }
                Some((_, RawItem::End(_))) => {}
                Some((path, RawItem::Picture(p))) if [p.width_px, p.height_px] != self.size_px => {
                    warn!(path = %path.display(), p.width_px, p.height_px, "a picture of another size passed over");
                }
                Some((_, item)) => self.pending = Some(item),
                None => self.begin_again()?,
            }
        }
        let host_nanos = match &self.pending {
            Some(RawItem::Picture(picture)) => picture.stamp.host_time_nanos,
            Some(RawItem::Fault { host_time_nanos, .. }) => *host_time_nanos,
            _ => return Ok(None),
        };
        Ok(match (self.pace, self.last) {
            (Pace::Fast, _) => None,
            (Pace::Sensor, None) => self.pass_begin,
            (Pace::Sensor, Some((last_nanos, at))) => {
                Some(at + Duration::from_nanos(host_nanos.saturating_sub(last_nanos).min(MAX_WAIT_NANOS)))
            }
        })
    }

    /// At the end of the recording: back to its beginning, with stamps that go on.
    fn begin_again(&mut self) -> Result<(), DeviceError> {
        let Some([first, last]) = self.pass.take().filter(|_| self.is_loop) else {
            return Err(DeviceError::Ended(format!("the recording {}", self.reader.folder().display())));
        };
        let count = self.sequence.patterns.len() as u64;
        let sets = (last.saturating_sub(first) / count).saturating_add(1);
        self.shift = self.shift.saturating_add(sets.saturating_mul(count));
        self.reader.rewind();
        // The gap between the passes is one picture period.
        self.pass_begin = self.last.take().map(|(_, at)| at + Duration::from_nanos(self.timing.picture_period_nanos));
        Ok(())
    }

    /// What is due: a frame, or the error that came in its place.
    fn take(&mut self, due: Option<Instant>) -> Result<Frame, DeviceError> {
        let at = due.unwrap_or_else(Instant::now);
        let gone = |item: &RawItem| matches!(item, RawItem::Fault { code: FaultCode::Disconnected, .. });
        self.is_interrupted = self.pending.as_ref().is_some_and(gone);
        match self.pending.take() {
            Some(RawItem::Picture(picture)) => {
                self.last = Some((picture.stamp.host_time_nanos, at));
                let sequence = picture.stamp.sequence;
                let [first, last] = self.pass.unwrap_or([sequence; 2]);
                self.pass = Some([first, last.max(sequence)]);
                Ok(self.frame(picture))
            }
            Some(RawItem::Fault { code, host_time_nanos, message }) => {
                self.last = Some((host_time_nanos, at));
                Err(match code {
                    FaultCode::Timeout => DeviceError::Timeout(message),
                    FaultCode::Disconnected => DeviceError::Disconnected(message),
                    FaultCode::Other => DeviceError::Failed(message),
                })
            }
            _ => Err(DeviceError::Timeout("the recording was rewound".into())),
        }
    }

    fn frame(&self, picture: RawPicture) -> Frame {
        let RawPicture { stamp, width_px, height_px, pixels } = picture;
        let later_nanos = self.shift.saturating_mul(self.timing.picture_period_nanos);
        Frame {
            sequence: stamp.sequence.wrapping_add(self.shift),
            pattern: PatternIndex(stamp.pattern),
            device_time_nanos: stamp.device_time_nanos.saturating_add(later_nanos),
            host_time_nanos: stamp.host_time_nanos.saturating_add(later_nanos),
            exposure_nanos: stamp.exposure_nanos,
            picture: GreyPicture::new(width_px, height_px, pixels),
        }
    }
}

fn lock(deck: &Mutex<Deck>) -> MutexGuard<'_, Deck> {
    deck.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Camera of a recording.
pub struct RecordedCamera {
    deck: Arc<Mutex<Deck>>,
    is_configured: bool,
    is_running: bool,
}

impl RecordedCamera {
    /// The camera of a deck.
    pub fn new(deck: Arc<Mutex<Deck>>) -> Self {
        Self { deck, is_configured: false, is_running: false }
    }
}

impl Camera for RecordedCamera {
    fn info(&self) -> CameraInfo {
        let deck = lock(&self.deck);
        CameraInfo {
            model: format!("recorded camera of {}", deck.rig_name),
            serial: deck.reader.folder().display().to_string(),
            width_px: deck.size_px[0],
            height_px: deck.size_px[1],
            min_period_nanos: deck.timing.picture_period_nanos,
            waits_for_reader: true,
        }
    }

    /// The exposure set is the recorded one, whatever was asked.
    fn configure(&mut self, want: &CameraSettings) -> Result<CameraSettings, DeviceError> {
        let deck = lock(&self.deck);
        let [width, height] = deck.size_px;
        if [want.width_px, want.height_px] != deck.size_px {
            let reason = format!("{} x {}, but the recording has {width} x {height}", want.width_px, want.height_px);
            return Err(DeviceError::config("camera.width_px", reason));
        }
        if want.trigger != TriggerSource::Projector {
            return Err(DeviceError::config("camera.trigger", "a recording has the projector's triggers only"));
        }
        self.is_configured = true;
        Ok(CameraSettings { exposure_nanos: deck.timing.exposure_nanos, ..*want })
    }

    fn start(&mut self) -> Result<(), DeviceError> {
        if !self.is_configured {
            return Err(DeviceError::State("the camera is started before it is configured"));
        }
        self.is_running = true;
        Ok(())
    }

    fn next_frame(&mut self, deadline: Instant) -> Result<Frame, DeviceError> {
        if !self.is_running {
            return Err(DeviceError::State("a frame is asked of a camera that is not started"));
        }
        let due = {
            let mut deck = lock(&self.deck);
            if !deck.is_playing {
                return Err(DeviceError::Timeout("the projector plays nothing, so no trigger comes".into()));
            }
            deck.due()?
        };
        // Not under the lock: the projector may be stopped meanwhile.
        if let Some(due) = due {
            std::thread::sleep(due.min(deadline).saturating_duration_since(Instant::now()));
            if due > deadline {
                return Err(DeviceError::Timeout("the recording's next picture is due later".into()));
            }
        }
        lock(&self.deck).take(due)
    }

    fn stop(&mut self) -> Result<(), DeviceError> {
        self.is_running = false;
        Ok(())
    }
}

/// Projector of a recording: plays the recorded patterns from the beginning, or from where a device was unplugged.
pub struct RecordedProjector {
    deck: Arc<Mutex<Deck>>,
}

impl RecordedProjector {
    /// The projector of a deck.
    pub fn new(deck: Arc<Mutex<Deck>>) -> Self {
        Self { deck }
    }
}

impl Projector for RecordedProjector {
    fn info(&self) -> ProjectorInfo {
        let deck = lock(&self.deck);
        ProjectorInfo {
            model: format!("recorded projector of {}", deck.rig_name),
            serial: deck.reader.folder().display().to_string(),
            width_px: deck.sequence.width_px,
            height_px: deck.sequence.height_px,
            min_period_nanos: deck.timing.picture_period_nanos,
            hardware_sequence: true,
        }
    }

    fn load(&mut self, sequence: &PatternSequence) -> Result<(), DeviceError> {
        sequence.validate()?;
        let mut deck = lock(&self.deck);
        if *sequence != deck.sequence {
            return Err(DeviceError::config("sequence", "the recording was made with other patterns"));
        }
        deck.is_loaded = true;
        Ok(())
    }

    fn play(&mut self, timing: &SequenceTiming) -> Result<(), DeviceError> {
        timing.validate()?;
        let mut deck = lock(&self.deck);
        if !deck.is_loaded {
            return Err(DeviceError::State("the projector plays before a sequence is loaded"));
        }
        if *timing != deck.timing {
            let reason = format!("{} was recorded", deck.timing.picture_period_nanos);
            return Err(DeviceError::config("timing.picture_period_nanos", reason));
        }
        if !std::mem::take(&mut deck.is_interrupted) {
            deck.rewind();
        }
        deck.is_playing = true;
        Ok(())
    }

    fn show(&mut self, _pattern: PatternIndex) -> Result<(), DeviceError> {
        Err(DeviceError::State("a recording plays its patterns in order and can show none for itself"))
    }

    fn stop(&mut self) -> Result<(), DeviceError> {
        lock(&self.deck).is_playing = false;
        Ok(())
    }
}
