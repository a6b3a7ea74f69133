//! The thread that owns the port.

use super::TriggerConfig;
use crate::device::{DeviceError, TriggerEvent};
use gv3_protocol::trigger::{Answer, Command, Event, LineReader, Message, PROTOCOL_VERSION, Request, State};
use serialport::{SerialPort, SerialPortType};
use std::io::{ErrorKind, Read, Write};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TryRecvError};
use std::time::{Duration, Instant};
use tracing::{debug, info, warn};

/// How long the port is listened to before orders are looked for.
const LISTEN: Duration = Duration::from_millis(5);
/// After this a request is sent again.
const REPEAT: Duration = Duration::from_millis(250);
/// A request is sent so many times.
const MOST_SENT: u32 = 8;
/// A controller that begins anew when its port is opened is greeted so many times.
const MOST_GREETED: u32 = 12;
/// From one attempt to open the port to the next.
const REOPEN: Duration = Duration::from_millis(500);

/// What the thread is told.
pub(super) enum Order {
    /// Ask the controller.
    Ask {
        /// What.
        command: Command,
        /// Where the answer goes.
        reply: SyncSender<Result<Answer, DeviceError>>,
    },
    /// Send what happens there from now on.
    Report(SyncSender<TriggerEvent>),
}

type Port = Box<dyn SerialPort>;

/// The port and what has been said over it.
pub(super) struct Link {
    config: TriggerConfig,
    inbox: Receiver<Order>,
    reader: LineReader,
    reports: Option<SyncSender<TriggerEvent>>,
    last_id: u16,
    is_firing: bool,
    lost_reports: u64,
    damaged_lines: u64,
}

impl Link {
    pub fn new(config: TriggerConfig, inbox: Receiver<Order>) -> Self {
        let reader = LineReader::default();
        let (lost_reports, damaged_lines) = (0, 0);
        Self { config, inbox, reader, reports: None, last_id: 0, is_firing: false, lost_reports, damaged_lines }
    }

    /// Runs until the other end of the inbox is gone.
    pub fn run(mut self) {
        let mut port: Option<Port> = None;
        loop {
            match port.take() {
                Some(open) => match self.serve(open) {
                    Ok(still_open) => port = Some(still_open),
                    Err(Ended::Orders) => return,
                    Err(Ended::Port(reason)) => {
                        warn!(reason, "the trigger controller is gone; its port is tried again")
                    }
                },
                None => match self.connect() {
                    Ok(open) => port = Some(open),
                    Err(reason) => {
                        debug!(reason, "the trigger's port");
                        if !self.wait_for_port(&reason) {
                            return;
                        }
                    }
                },
            }
        }
    }

    /// Answers orders with the reason why there is no port, until it is time to try again; `false` at the end.
    fn wait_for_port(&mut self, reason: &str) -> bool {
        let until = Instant::now() + REOPEN;
        loop {
            match self.inbox.recv_timeout(until.saturating_duration_since(Instant::now())) {
                Ok(Order::Ask { reply, .. }) => {
                    let gone = DeviceError::Disconnected(format!("the trigger controller ({reason})"));
                    // Whoever asked may have given up.
                    let _ = reply.try_send(Err(gone));
                }
                Ok(Order::Report(reports)) => self.reports = Some(reports),
                Err(RecvTimeoutError::Timeout) => return true,
                Err(RecvTimeoutError::Disconnected) => return false,
            }
        }
    }

    fn connect(&mut self) -> Result<Port, String> {
        let path = self.path()?;
        let port = serialport::new(&path, self.config.baud).timeout(LISTEN).open();
        let mut port = port.map_err(|e| match e.kind {
            // What the crate calls a port that is locked.
            serialport::ErrorKind::NoDevice => {
                format!("{path}: in use by another program; end that one (`fuser -v {path}` names it)")
            }
            _ => format!("{path}: {e}"),
        })?;
        self.reader.clear();
        // Ends a line that was cut off.
        port.write_all(b"\n").map_err(|e| format!("{path}: {e}"))?;
        match self.converse(&mut port, Command::Hello, MOST_GREETED) {
            Ok(Answer::Hello(who)) if who.version == PROTOCOL_VERSION => {}
            Ok(Answer::Hello(who)) => {
                return Err(format!(
                    "{path}: version {} of the protocol, {PROTOCOL_VERSION} is spoken here",
                    who.version
                ));
            }
            Ok(_) | Err(Failure::Silent) => return Err(format!("{path}: no trigger controller answers")),
            Err(Failure::Port(reason)) => return Err(format!("{path}: {reason}")),
        }
        if self.is_firing {
            self.see_whether_it_fires(&mut port)?;
        }
        info!(path, "trigger controller connected");
        Ok(port)
    }

    /// After a connection was lost: a controller that kept its power goes on by itself.
    fn see_whether_it_fires(&mut self, port: &mut Port) -> Result<(), String> {
        match self.converse(port, Command::Status, MOST_SENT) {
            Ok(Answer::Status(status)) if status.state == State::Firing => Ok(()),
            Ok(_) => {
                self.restarted();
                Ok(())
            }
            Err(_) => Err("the trigger controller does not tell its state".into()),
        }
    }

    fn path(&self) -> Result<String, String> {
        if let Some(path) = &self.config.port {
            return Ok(path.clone());
        }
        let wanted = self.config.serial.as_deref().unwrap_or_default();
        let ports = serialport::available_ports().map_err(|e| e.to_string())?;
        let is_wanted = |kind: &SerialPortType| match kind {
            SerialPortType::UsbPort(usb) => usb.serial_number.as_deref() == Some(wanted),
            _ => false,
        };
        let found = ports.iter().find(|port| is_wanted(&port.port_type)).map(|port| port.port_name.clone());
        found.ok_or_else(|| {
            let names: Vec<&str> = ports.iter().map(|port| port.port_name.as_str()).collect();
            format!("no port has a USB device of serial number \"{wanted}\"; ports: {}", names.join(", "))
        })
    }

    /// One order, or what the port says meanwhile.
    fn serve(&mut self, mut port: Port) -> Result<Port, Ended> {
        match self.inbox.try_recv() {
            Ok(Order::Report(reports)) => self.reports = Some(reports),
            Ok(Order::Ask { command, reply }) => {
                let answer = self.converse(&mut port, command, MOST_SENT);
                let ended = match &answer {
                    Err(Failure::Port(reason)) => Some(Ended::Port(reason.clone())),
                    _ => None,
                };
                // Whoever asked may have given up.
                let _ = reply.try_send(answer.map_err(|failure| failure.into_error()));
                return ended.map_or(Ok(port), Err);
            }
            Err(TryRecvError::Empty) => {
                self.hear(&mut port, 0).map_err(Ended::Port)?;
            }
            Err(TryRecvError::Disconnected) => {
                if self.is_firing {
                    // Best effort: the controller may be gone as well.
                    let _ = self.converse(&mut port, Command::Disarm, MOST_SENT);
                }
                let (lost_reports, damaged_lines) = (self.lost_reports, self.damaged_lines);
                info!(lost_reports, damaged_lines, "trigger controller closed");
                return Err(Ended::Orders);
            }
        }
        Ok(port)
    }

    /// Asks, and asks again under the same number, until the answer comes.
    fn converse(&mut self, port: &mut Port, command: Command, most_sent: u32) -> Result<Answer, Failure> {
        self.last_id = self.last_id.checked_add(1).unwrap_or(1);
        let request = Request { id: self.last_id, command };
        for _ in 0..most_sent {
            port.write_all(request.encode().as_bytes()).map_err(|e| Failure::Port(e.to_string()))?;
            let until = Instant::now() + REPEAT;
            while Instant::now() < until {
                if let Some(answer) = self.hear(port, request.id).map_err(Failure::Port)? {
                    match (command, &answer) {
                        (Command::Fire { .. }, Answer::Fire(_)) => self.is_firing = true,
                        (Command::Disarm, Answer::Disarm(_)) => self.is_firing = false,
                        _ => {}
                    }
                    return Ok(answer);
                }
            }
        }
        Err(Failure::Silent)
    }

    /// Takes what the port has; gives the answer to request `id` if it is among it.
    fn hear(&mut self, port: &mut Port, id: u16) -> Result<Option<Answer>, String> {
        let mut bytes = [0; 512];
        let count = match port.read(&mut bytes) {
            Ok(0) => return Err("the port has ended".into()),
            Ok(count) => count,
            Err(e) if matches!(e.kind(), ErrorKind::TimedOut | ErrorKind::Interrupted | ErrorKind::WouldBlock) => {
                return Ok(None);
            }
            Err(e) => return Err(e.to_string()),
        };
        let (mut heard, mut damaged) = (Vec::new(), 0);
        self.reader.feed(&bytes[..count], |line| match line.and_then(Message::decode) {
            Ok(message) => heard.push(message),
            Err(error) => {
                damaged += 1;
                debug!(%error, "a line of the trigger controller");
            }
        });
        self.damaged_lines += damaged;
        let mut found = None;
        for message in heard {
            match message {
                Message::Reply { id: of, answer } if of == id => found = Some(answer),
                Message::Reply { .. } => {}
                Message::Event(event) => self.event(event),
            }
        }
        Ok(found)
    }

    fn event(&mut self, event: Event) {
        match event {
            Event::Pulse { counter, time_nanos } => {
                self.report(TriggerEvent::Pulse { counter: counter.into(), time_nanos });
            }
            Event::Overrun { counter } => self.report(TriggerEvent::Overrun { counter: counter.into() }),
            Event::Boot { .. } if self.is_firing => self.restarted(),
            // Of a run that goes on for ever only the counter's end is one.
            Event::Done { .. } => self.restarted(),
            Event::Boot { .. } | Event::Reject => {}
        }
    }

    fn restarted(&mut self) {
        warn!("the trigger controller has begun anew and fires no more");
        self.is_firing = false;
        self.report(TriggerEvent::Restarted);
    }

    fn report(&mut self, event: TriggerEvent) {
        let is_lost = self.reports.as_ref().is_some_and(|reports| reports.try_send(event).is_err());
        self.lost_reports += u64::from(is_lost);
    }
}

/// Why the port is not served any more.
enum Ended {
    Orders,
    Port(String),
}

/// Why there is no answer.
enum Failure {
    Silent,
    Port(String),
}

impl Failure {
    fn into_error(self) -> DeviceError {
        match self {
            Self::Silent => DeviceError::Timeout("the trigger controller does not answer".into()),
            Self::Port(reason) => DeviceError::Disconnected(format!("the trigger controller ({reason})")),
        }
    }
}
