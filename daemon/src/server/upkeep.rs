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

/// Publishes the status, and feeds the watchdog only when the engine has answered: a server whose engine hangs, or whose
/// own threads do, falls silent and is started anew.
pub async fn pulse(shared: Arc<Shared>, status: watch::Sender<Arc<str>>, notify: Arc<Notify>) {
    let mut ticks = interval(PULSE);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut fed = Instant::now();
    let mut told = (Instant::now(), String::new());
    loop {
        ticks.tick().await;
        let Ok(newest) = shared.blocking(|s| Ok(s.live.status())).await else { continue };
        match serde_json::to_string(&newest) {
            Ok(text) => status.send_replace(Arc::from(text)),
            Err(error) => {
                tracing::error!(%error, "the status is no JSON");
                continue;
            }
        };
        if notify.watchdog().is_some_and(|period| fed.elapsed() >= period / 4) {
            notify.alive();
            fed = Instant::now();
        }
        let line = match &newest.recording {
            Some(recording) => format!("recording {}, {} scans", recording.session, recording.scans),
            None => newest.state.to_string(),
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
        repair_sessions(&shared.directory, |name| recording_of(&live).as_ref() == Some(name))
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

/// Deletes what is too old or too much, every minute.
pub async fn retain(shared: Arc<Shared>, retention: Retention) {
    if retention == Retention::default() {
        return;
    }
    let mut ticks = interval(RETAIN_PERIOD);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        ticks.tick().await;
        let work = move |s: &Shared| Ok(expire(&s.directory, &retention, SystemTime::now(), s.recording().as_ref())?);
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
