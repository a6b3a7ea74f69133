//! What goes on beside the requests: the status twice a second, the watchdog, repair, retention, reloading.

use super::notify::Notify;
use super::scanner::reload_now;
use super::shared::{Shared, recording_of};
use crate::store::{Retention, expire, repair as repair_sessions};
use std::sync::Arc;
use std::time::{Duration, SystemTime};
use tokio::sync::{Notify as Wakeup, watch};
use tokio::time::{Instant, MissedTickBehavior, interval};

/// From status to status.
const PULSE: Duration = Duration::from_millis(500);
/// From one line for the service manager to the next.
const STATUS_PERIOD: Duration = Duration::from_secs(5);
/// From one look at ages and sizes to the next.
const RETAIN_PERIOD: Duration = Duration::from_secs(60);

/// What the engine had done when the watchdog was fed last.
#[derive(Debug, Default)]
struct Progress {
    sets: u64,
    scans: u64,
}

impl Progress {
    /// Whether the engine got on: frame sets that come must become scans. A stage that hangs holds up all before it until
    /// sets come and no scan does; a camera that is silent is no hang, the engine gives it up by itself.
    fn moves(&mut self, sets: u64, scans: u64) -> bool {
        let moves = sets == self.sets || scans != self.scans;
        if moves {
            *self = Self { sets, scans };
        }
        moves
    }
}

/// Publishes the status, and feeds the watchdog only when the engine has answered and gets on: a server whose engine hangs,
/// or whose own threads do, falls silent and is started anew.
pub async fn pulse(shared: Arc<Shared>, status: watch::Sender<Arc<str>>, notify: Arc<Notify>) {
    let mut ticks = interval(PULSE);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let (mut fed, mut progress) = (Instant::now(), Progress::default());
    let mut told = (Instant::now(), String::new());
    loop {
        ticks.tick().await;
        let Ok((newest, counts)) = shared.blocking(|s| Ok((s.live.status(), s.live.metrics()))).await else { continue };
        match serde_json::to_string(&newest) {
            Ok(text) => status.send_replace(Arc::from(text)),
            Err(error) => {
                tracing::error!(%error, "the status is no JSON");
                continue;
            }
        };
        let is_due = notify.watchdog().is_some_and(|period| fed.elapsed() >= period / 4);
        if is_due && progress.moves(counts.sets, counts.scans) {
            notify.alive();
            fed = Instant::now();
        }
        let line = match &newest.recording {
            Some(recording) => format!("recording {}, {} scans", recording.session, recording.scans),
            None => newest.state.name().to_owned(),
        };
        if line != told.1 && told.0.elapsed() >= STATUS_PERIOD {
            notify.status(&line);
            told = (Instant::now(), line);
        }
    }
}

/// Makes unfinished sessions whole, once.
pub async fn repair(shared: Arc<Shared>) {
    let work = tokio::task::spawn_blocking(move || {
        let live = shared.live.clone();
        let is_left_alone = |name: &_| *shared.stopping.borrow() || recording_of(&live).as_ref() == Some(name);
        repair_sessions(&shared.directory, is_left_alone)
    });
    match work.await {
        Ok(Ok(repaired)) => {
            for file in repaired {
                match file.outcome {
                    Ok(groups) => tracing::info!(session = %file.name, groups, "unfinished session repaired"),
                    Err(error) => tracing::warn!(session = %file.name, %error, "unfinished session left as it is"),
                }
            }
        }
        Ok(Err(error)) => tracing::warn!(%error, "unfinished sessions were not looked for"),
        Err(error) => tracing::error!(%error, "repair ended unexpectedly"),
    }
}

/// The system's time, but not further on than this process has lived: a clock that jumps ahead makes no session old.
struct SteadyClock {
    begun: SystemTime,
    since: Instant,
}

impl SteadyClock {
    fn start() -> Self {
        Self { begun: SystemTime::now(), since: Instant::now() }
    }

    fn now(&self, system: SystemTime) -> SystemTime {
        system.min(self.begun + self.since.elapsed())
    }
}

/// Deletes what is too old or too much, every minute.
pub async fn retain(shared: Arc<Shared>) {
    let clock = SteadyClock::start();
    let mut ticks = interval(RETAIN_PERIOD);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        ticks.tick().await;
        let now = clock.now(SystemTime::now());
        let work = move |s: &Shared| {
            let sessions = s.live.config().sessions;
            let retention = Retention { keep_days: sessions.keep_days, keep_bytes: sessions.keep_bytes };
            match retention == Retention::default() {
                true => Ok(Vec::new()),
                false => Ok(expire(&s.directory, &retention, now, s.recording().as_ref())?),
            }
        };
        match shared.blocking(work).await {
            Ok(gone) => gone.iter().for_each(|s| tracing::info!(session = %s.name, bytes = s.bytes, "session expired")),
            Err(problem) => tracing::warn!(detail = problem.detail, "sessions could not be expired"),
        }
    }
}

/// Reads the configuration again whenever it is asked for.
pub async fn reload(shared: Arc<Shared>, asked: Arc<Wakeup>, notify: Arc<Notify>) {
    loop {
        asked.notified().await;
        notify.reloading();
        match reload_now(&shared).await {
            Ok(()) => {
                tracing::info!("configuration reloaded");
                notify.ready("configuration reloaded");
            }
            Err(problem) => {
                tracing::error!(detail = problem.detail, "configuration not reloaded, the old one stays");
                notify.ready("configuration not reloaded, the old one stays");
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clock_that_jumps_ahead_makes_nothing_old_and_one_that_falls_back_is_followed() {
        let clock = SteadyClock::start();
        let (hour, year) = (Duration::from_secs(3600), Duration::from_secs(31_557_600));
        assert!(clock.now(clock.begun + year) < clock.begun + hour);
        assert_eq!(clock.now(clock.begun - year), clock.begun - year);
    }

    #[test]
    fn sets_without_scans_are_a_hang_and_silence_is_none() {
        let mut progress = Progress::default();
        assert!(progress.moves(0, 0), "idle");
        assert!(progress.moves(30, 29) && progress.moves(60, 59), "previewing");
        assert!(progress.moves(60, 59), "the camera is silent");
        assert!(!progress.moves(61, 59) && !progress.moves(90, 59), "hung");
        assert!(progress.moves(91, 60), "on again");
    }
}
