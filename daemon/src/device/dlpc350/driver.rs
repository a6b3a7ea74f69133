//! What is said to the projector, in which order, and what is done when it forgets.

use super::config::Dlpc350Config;
use super::conversation::{Conversation, TalkError};
use super::link::{HidOpener, LinkError};
use super::program::Program;
use crate::device::{DeviceError, ExposureFeed};
use gv3_protocol::dlpc350::{
    DisplayMode, FirmwareTag, FlashImageCount, HardwareStatus, ImageLut, Input, InputSource, LedCurrent, LedEnable,
    Mailbox, MailboxOffset, MainStatus, PatternLut, PatternSource, Playback, Power, SystemStatus, Validate, Validation,
    Version,
};
use std::time::Duration;
use tracing::{info, warn};

/// Pause between two looks at something that takes time.
const POLL: Duration = Duration::from_millis(20);
/// Looks until validation or waking is given up.
const MOST_POLLS: u32 = 150;
/// How often start and stop are sent; after video mode the projector is known to pass over the first start.
const MOST_SENDS: u32 = 5;
/// Looks between two sends of start or stop.
const POLLS_A_SEND: u32 = 10;

/// What happened since the projector was opened.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Dlpc350Counters {
    /// Times it was found out of the mode it was put in, as after a video cable was plugged in.
    pub modes_lost: u64,
    /// Times it stopped answering.
    pub disconnects: u64,
    /// Times the sequence was started again after either.
    pub resumed: u64,
}

/// The projector and what it is meant to do.
pub(super) struct Driver {
    config: Dlpc350Config,
    opener: Box<dyn HidOpener>,
    conversation: Option<Conversation>,
    playing: Option<Program>,
    /// Of runs alone: the projector reports no exposures.
    pub(super) runs: ExposureFeed,
    pub(super) counters: Dlpc350Counters,
}

impl Driver {
    /// Opens the projector, wakes it, makes it dark and sets its light.
    pub(super) fn open(config: Dlpc350Config, opener: Box<dyn HidOpener>) -> Result<Self, DeviceError> {
        let (runs, counters) = (ExposureFeed::silent(), Dlpc350Counters::default());
        let mut driver = Self { config, opener, conversation: None, playing: None, runs, counters };
        driver.connected()?;
        Ok(driver)
    }

    /// Firmware's version and tag.
    pub(super) fn firmware(&mut self) -> Result<String, DeviceError> {
        let (version, FirmwareTag(tag)) = self.talk(|c| Ok((c.read::<Version>()?, c.read::<FirmwareTag>()?)))?;
        Ok(format!("firmware {} {tag}", version.firmware()))
    }

    /// Starts a program.
    pub(super) fn play(&mut self, program: Program) -> Result<(), DeviceError> {
        self.playing = None;
        self.arm(&program)?;
        self.playing = Some(program);
        Ok(())
    }

    /// Goes dark.
    pub(super) fn stop(&mut self) -> Result<(), DeviceError> {
        self.playing = None;
        self.connected()?;
        let stopped = self.talk(|c| reach(c, Playback::Stop))?;
        if stopped { Ok(()) } else { Err(DeviceError::Failed("the projector does not stop".into())) }
    }

    /// Looks whether the program still runs and starts it again if not.
    pub(super) fn watch(&mut self) {
        let Some(program) = self.playing.clone() else { return };
        if self.conversation.is_some() {
            match self.talk(|c| Ok((c.read::<DisplayMode>()?, c.read::<MainStatus>()?))) {
                Ok((DisplayMode::PatternSequence, MainStatus { is_running: true, .. })) => return,
                Ok((mode, _)) => {
                    self.counters.modes_lost += 1;
                    warn!("the projector left the sequence ({mode:?}); starting it again");
                }
                Err(error) => {
                    self.counters.disconnects += 1;
                    self.conversation = None;
                    self.runs.end();
                    warn!("the projector does not answer ({error}); waiting for it");
                }
            }
        }
        // While it is unplugged there is nothing to say that was not said.
        if self.arm(&program).is_ok() {
            self.counters.resumed += 1;
            info!("the projector plays again");
        }
    }

    fn arm(&mut self, program: &Program) -> Result<(), DeviceError> {
        self.connected()?;
        let verdict = self.talk(|c| program_sequence(c, program))?;
        check_verdict(verdict)?;
        let (hardware, system, main) = self.talk(|c| Ok((c.read()?, c.read()?, c.read()?)))?;
        check_health(hardware, system, main)?;
        self.runs.begin();
        if self.talk(|c| reach(c, Playback::Start))? {
            return Ok(());
        }
        Err(DeviceError::Failed("the projector accepted the sequence but does not start it".into()))
    }

    /// Opens the cable unless it is open.
    fn connected(&mut self) -> Result<(), DeviceError> {
        if self.conversation.is_some() {
            return Ok(());
        }
        let link = self.opener.open().map_err(|e| self.link_error("", e))?;
        self.conversation = Some(Conversation::new(link));
        let config = self.config.clone();
        let set = self.talk(|c| prepare(c, &config)).and_then(|ready| check_ready(&config, ready));
        set.inspect_err(|_| self.conversation = None)
    }

    /// Says something; a cable that failed is closed, and opened again with the next call.
    fn talk<T>(&mut self, say: impl FnOnce(&mut Conversation) -> Result<T, TalkError>) -> Result<T, DeviceError> {
        let Some(conversation) = &mut self.conversation else {
            return Err(DeviceError::Disconnected(self.opener.name()));
        };
        say(conversation).map_err(|error| match error {
            TalkError::Link { name, source } => {
                self.conversation = None;
                self.link_error(name, source)
            }
            other => DeviceError::Failed(format!("{}: {other}", self.opener.name())),
        })
    }

    fn link_error(&self, asked: &str, error: LinkError) -> DeviceError {
        let name = self.opener.name();
        match error {
            LinkError::Disconnected => DeviceError::Disconnected(name),
            other if asked.is_empty() => DeviceError::Failed(format!("{name}: {other}")),
            other => DeviceError::Failed(format!("{name}: {asked}: {other}")),
        }
    }
}

/// What [`prepare`] found.
struct Ready {
    is_awake: bool,
    current: LedCurrent,
    /// `None` from a firmware that does not tell.
    flash_images: Option<FlashImageCount>,
}

/// Wakes the projector, makes it dark and sets its light.
fn prepare(c: &mut Conversation, config: &Dlpc350Config) -> Result<Ready, TalkError> {
    let mut is_awake = true;
    if c.read::<Power>()? == Power::Standby {
        c.write(&Power::Normal)?;
        is_awake = poll(c, |c| Ok((!c.read::<MainStatus>()?.is_parked).then_some(())))?.is_some();
    }
    // Leaving the test patterns for video is known to break the USB connection: leave them for the port first.
    let input = c.read::<InputSource>()?;
    if input.input == Input::TestPattern {
        c.write(&InputSource { input: Input::Parallel, ..input })?;
    }
    c.write(&DisplayMode::PatternSequence)?;
    reach(c, Playback::Stop)?;
    c.write(&LedEnable { rgb: [false; 3], by_sequencer: true })?;
    c.write(&config.current())?;
    let flash_images = match c.read::<FlashImageCount>() {
        Ok(count) => Some(count),
        Err(TalkError::Refused(_)) => None,
        Err(error) => return Err(error),
    };
    Ok(Ready { is_awake, current: c.read()?, flash_images })
}

fn check_ready(config: &Dlpc350Config, ready: Ready) -> Result<(), DeviceError> {
    if !ready.is_awake {
        return Err(DeviceError::Failed("the projector does not wake from standby".into()));
    }
    if ready.current != config.current() {
        let reason = format!("{:?} set, but the projector reports {:?}", config.led_current, ready.current.rgb);
        return Err(DeviceError::config("projector.dlpc350.led_current", reason));
    }
    let Some(FlashImageCount(count)) = ready.flash_images else { return Ok(()) };
    match config.flash_images.iter().find(|&&image| image >= count) {
        Some(image) => {
            let reason = format!("image {image}, but the projector's flash holds {count}, counted from 0");
            Err(DeviceError::config("projector.dlpc350.flash_images", reason))
        }
        None => Ok(()),
    }
}

/// Everything up to the controller's verdict; the order is that of TI's sample.
fn program_sequence(c: &mut Conversation, program: &Program) -> Result<Option<Validation>, TalkError> {
    c.write(&DisplayMode::PatternSequence)?;
    reach(c, Playback::Stop)?;
    c.write(&program.source)?;
    c.write(&program.control())?;
    c.write(&program.timing)?;
    c.write(&program.trigger)?;
    c.write(&program.trigger_1)?;
    c.write(&program.trigger_2)?;
    c.write(&Mailbox::Patterns)?;
    c.write(&MailboxOffset(0))?;
    c.write(&PatternLut(program.patterns.clone()))?;
    c.write(&Mailbox::Closed)?;
    if program.source == PatternSource::Flash {
        c.write(&Mailbox::Images)?;
        c.write(&MailboxOffset(0))?;
        c.write(&ImageLut(program.images.clone()))?;
        c.write(&Mailbox::Closed)?;
    }
    c.write(&Validate)?;
    poll(c, |c| Ok(Some(c.read::<Validation>()?).filter(|v| !v.is_busy)))
}

fn check_verdict(verdict: Option<Validation>) -> Result<(), DeviceError> {
    let Some(verdict) = verdict else {
        return Err(DeviceError::Failed("the projector does not finish checking the sequence".into()));
    };
    if verdict.exposure_invalid {
        let reason =
            "the projector refuses this exposure and period; give more time, or lower projector.dlpc350.bit_depth";
        return Err(DeviceError::config("timing.exposure_nanos", reason));
    }
    if verdict.pattern_invalid {
        let reason =
            "the projector refuses a pattern; check projector.dlpc350.bit_depth and projector.dlpc350.flash_images";
        return Err(DeviceError::config("sequence.patterns", reason));
    }
    if verdict.trigger_overlaps || verdict.lacks_black || verdict.gap_too_short {
        warn!("the projector warns of the sequence: {verdict:?}");
    }
    Ok(())
}

/// The registers have to be read between validation and start, or nothing plays.
fn check_health(hardware: HardwareStatus, system: SystemStatus, main: MainStatus) -> Result<(), DeviceError> {
    if !hardware.is_initialized || !system.memory_ok || main.is_parked || hardware.has_reset_error {
        let reason = format!("the projector is not well: {hardware:?}, {system:?}, {main:?}; switch it off and on");
        return Err(DeviceError::Failed(reason));
    }
    if hardware.has_forced_swap || hardware.has_sequencer_abort || hardware.has_sequencer_error {
        warn!("the projector reports faults of its past: {hardware:?}");
    }
    Ok(())
}

/// Sends start or stop until the projector has done it; whether it has.
fn reach(c: &mut Conversation, want: Playback) -> Result<bool, TalkError> {
    for _ in 0..MOST_SENDS {
        c.write(&want)?;
        for k in 0..POLLS_A_SEND {
            if c.read::<Playback>()? == want {
                return Ok(true);
            }
            if k + 1 < POLLS_A_SEND {
                c.pause(POLL);
            }
        }
    }
    Ok(false)
}

/// Looks until there is an answer, for three seconds.
fn poll<T>(
    c: &mut Conversation,
    mut look: impl FnMut(&mut Conversation) -> Result<Option<T>, TalkError>,
) -> Result<Option<T>, TalkError> {
    for _ in 0..MOST_POLLS {
        let found = look(c)?;
        if found.is_some() {
            return Ok(found);
        }
        c.pause(POLL);
    }
    Ok(None)
}
