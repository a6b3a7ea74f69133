//! Stand-in with the engine's types.

use gv3_codec::{GreyPicture, Scan};
use serde::Serialize;
use std::sync::Arc;
use tokio::sync::{broadcast, watch};

#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct LiveError(pub String);
#[derive(Debug, Clone)]
pub struct LiveConfig {
    pub rig: crate::device::RigConfig,
}
#[derive(Debug, Clone, Default)]
pub struct RecordingRequest {
    pub name: Option<String>,
    pub raw: bool,
}
#[derive(Debug, Clone, Serialize)]
pub struct RecordingStarted {
    pub session: String,
}
#[derive(Debug, Clone, Serialize)]
pub struct RecordingStopped {
    pub session: String,
}
#[derive(Debug, Clone, Serialize)]
pub struct RecordingStatus {
    pub session: String,
    pub scans: u64,
}
#[derive(Debug, Clone, Serialize)]
pub struct LiveStatus {
    pub state: &'static str,
    pub recording: Option<RecordingStatus>,
    pub version: &'static str,
}
#[derive(Debug, Default)]
pub struct LivePicture {
    pub tick: u64,
    pub time_nanos: u64,
    pub frames: Vec<GreyPicture>,
}
#[derive(Debug, Default)]
pub struct LiveScan {
    pub tick: u64,
    pub time_nanos: u64,
    pub scan: Scan,
}
#[derive(Debug, Clone, Default)]
pub struct LiveGroup {
    pub kind: u8,
    pub first_tick: u64,
    pub key_tick: u64,
    pub time_nanos: u64,
    pub payload: Vec<u8>,
}
#[derive(Debug, Clone, Serialize)]
pub struct LiveEvent {
    pub tick: u64,
}
#[derive(Clone)]
pub struct Live {
    pictures: watch::Sender<Option<Arc<LivePicture>>>,
    scans: watch::Sender<Option<Arc<LiveScan>>>,
    groups: broadcast::Sender<Arc<LiveGroup>>,
    events: broadcast::Sender<LiveEvent>,
}
impl Live {
    pub fn open(_: LiveConfig) -> Result<Self, LiveError> {
        let (groups, events) = (broadcast::channel(64).0, broadcast::channel(64).0);
        Ok(Self { pictures: watch::channel(None).0, scans: watch::channel(None).0, groups, events })
    }
    pub fn status(&self) -> LiveStatus {
        LiveStatus { state: "idle", recording: None, version: env!("CARGO_PKG_VERSION") }
    }
    pub fn start_scanner(&self) -> Result<(), LiveError> {
        Err(LiveError("no engine".into()))
    }
    pub fn stop_scanner(&self) -> Result<(), LiveError> {
        Err(LiveError("no engine".into()))
    }
    pub fn start_recording(&self, _: RecordingRequest) -> Result<RecordingStarted, LiveError> {
        Err(LiveError("no engine".into()))
    }
    pub fn stop_recording(&self) -> Result<RecordingStopped, LiveError> {
        Err(LiveError("no engine".into()))
    }
    pub fn mark(&self, _: &str) -> Result<u64, LiveError> {
        Err(LiveError("no engine".into()))
    }
    pub fn reload(&self, _: LiveConfig) -> Result<(), LiveError> {
        Ok(())
    }
    pub fn pictures(&self) -> watch::Receiver<Option<Arc<LivePicture>>> {
        self.pictures.subscribe()
    }
    pub fn scans(&self) -> watch::Receiver<Option<Arc<LiveScan>>> {
        self.scans.subscribe()
    }
    pub fn groups(&self) -> broadcast::Receiver<Arc<LiveGroup>> {
        self.groups.subscribe()
    }
    pub fn events(&self) -> broadcast::Receiver<LiveEvent> {
        self.events.subscribe()
    }
    pub fn shut_down(self) -> Result<(), LiveError> {
        Ok(())
    }
}
