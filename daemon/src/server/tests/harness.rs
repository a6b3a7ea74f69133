//! A server on a port of its own, and plain clients.

use crate::files::SessionsConfig;
use crate::live::{Ground, Live, LiveConfig};
use crate::pipeline::test_rig::small_rig;
use crate::server::{Notify, Server, ServerConfig, ServerError, Token};
use crate::store::SessionDirectory;
use serde_json::Value;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;
use tempfile::TempDir;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::sync::oneshot;
use tokio::task::JoinHandle;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::client::IntoClientRequest;

/// Far longer than anything takes on the slowest machine.
pub const PATIENCE: Duration = Duration::from_secs(120);
pub const TOKEN: &str = "0123456789abcdef0123456789abcdef";

pub fn config(folder: &Path) -> LiveConfig {
    let sessions = SessionsConfig {
        directory: folder.to_path_buf(),
        free_floor_bytes: 0,
        free_floor_percent: 0.0,
        ..SessionsConfig::default()
    };
    LiveConfig { rig: small_rig(), sessions }
}

/// A running server.
pub struct Running {
    pub address: SocketAddr,
    pub folder: TempDir,
    pub live: Live,
    token: bool,
    stop: oneshot::Sender<()>,
    task: JoinHandle<Result<(), ServerError>>,
}

/// An answer.
pub struct Answer {
    pub status: u16,
    pub head: String,
    pub body: Vec<u8>,
}

impl Answer {
    pub fn json(&self) -> Value {
        serde_json::from_slice(&self.body).unwrap_or_else(|e| panic!("{e}: {}", String::from_utf8_lossy(&self.body)))
    }
}

impl Running {
    pub async fn start() -> Self {
        Self::start_with(tempfile::tempdir().unwrap(), None, Notify::default()).await
    }

    pub async fn start_with(folder: TempDir, token: Option<&str>, notify: Notify) -> Self {
        Self::start_on(Ground::default(), folder, token, notify).await
    }

    pub async fn start_on(ground: Ground, folder: TempDir, token: Option<&str>, notify: Notify) -> Self {
        let path = folder.path().to_path_buf();
        let directory = SessionDirectory::open(&path).unwrap();
        let live = Live::open_on(config(&path), ground).unwrap();
        let listen = "127.0.0.1:0".parse().unwrap();
        let server_config = ServerConfig { listen, token: token.and_then(Token::new), hosts: Vec::new() };
        let read_config = Arc::new(move || Ok(config(&path)));
        let server = Server::bind(server_config, live.clone(), directory, read_config, notify).await.unwrap();
        let address = server.address();
        let (stop, stopped) = oneshot::channel();
        let task = tokio::spawn(server.run(async {
            let _ = stopped.await;
        }));
        Self { address, folder, live, token: token.is_some(), stop, task }
    }

    pub async fn stop(self) -> (TempDir, Result<(), ServerError>) {
        let _ = self.stop.send(());
        let ended = tokio::time::timeout(PATIENCE, self.task).await.expect("the server stops").unwrap();
        (self.folder, ended)
    }

    pub async fn request(&self, method: &str, path: &str, fields: &[(&str, &str)], body: &str) -> Answer {
        let mut text = format!("{method} {path} HTTP/1.1\r\nHost: {}\r\nConnection: close\r\n", self.address);
        for (name, value) in fields {
            text += &format!("{name}: {value}\r\n");
        }
        if self.token {
            text += &format!("Authorization: Bearer {TOKEN}\r\n");
        }
        if !body.is_empty() {
            text += &format!("Content-Type: application/json\r\nContent-Length: {}\r\n", body.len());
        }
        self.raw(format!("{text}\r\n{body}").as_bytes()).await.expect("an answer")
    }

    pub async fn get(&self, path: &str) -> Answer {
        self.request("GET", path, &[], "").await
    }

    pub async fn post(&self, path: &str, body: &str) -> Answer {
        let length = if body.is_empty() { &[("Content-Length", "0")][..] } else { &[] };
        self.request("POST", path, length, body).await
    }

    /// Sends bytes as they are; `None` when the server closes without a word.
    pub async fn raw(&self, bytes: &[u8]) -> Option<Answer> {
        let mut stream = TcpStream::connect(self.address).await.unwrap();
        // The server may close before it has taken everything.
        let _ = stream.write_all(bytes).await;
        let mut all = Vec::new();
        let _ = tokio::time::timeout(PATIENCE, stream.read_to_end(&mut all)).await.expect("the server closes");
        let end = all.windows(4).position(|w| w == b"\r\n\r\n")?;
        let head = String::from_utf8_lossy(&all[..end]).to_lowercase();
        let status = head.split(' ').nth(1)?.parse().ok()?;
        Some(Answer { status, head, body: all[end + 4..].to_vec() })
    }

    /// Opens a WebSocket below /api/v1.
    pub async fn socket(&self, path: &str) -> WebSocketStream<TcpStream> {
        let stream = TcpStream::connect(self.address).await.unwrap();
        let request = format!("ws://{}/api/v1{path}", self.address).into_client_request().unwrap();
        tokio_tungstenite::client_async(request, stream).await.expect("a WebSocket").0
    }

    /// Records until there are this many scans on disk.
    pub async fn record(&self, name: &str, scans: u64) -> Value {
        let started = self.post("/api/v1/recording/start", &format!("{{\"name\":\"{name}\"}}")).await;
        assert_eq!(started.status, 201, "{}", String::from_utf8_lossy(&started.body));
        self.wait_for_scans(scans).await;
        let stopped = self.post("/api/v1/recording/stop", "").await;
        assert_eq!(stopped.status, 200, "{}", String::from_utf8_lossy(&stopped.body));
        stopped.json()
    }

    pub async fn wait_for_scans(&self, scans: u64) {
        let enough = || self.live.status().recording.is_some_and(|r| r.scans >= scans);
        let waited = async {
            while !enough() {
                tokio::time::sleep(Duration::from_millis(10)).await;
            }
        };
        tokio::time::timeout(PATIENCE, waited).await.expect("scans");
    }

    /// Waits for the end of a job.
    pub async fn job(&self, accepted: Answer) -> Value {
        assert_eq!(accepted.status, 202, "{}", String::from_utf8_lossy(&accepted.body));
        let path = format!("/api/v1/jobs/{}", accepted.json()["id"].as_str().unwrap());
        let ended = async {
            loop {
                let job = self.get(&path).await.json();
                if job["state"] != "running" {
                    return job;
                }
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
        };
        tokio::time::timeout(PATIENCE, ended).await.expect("the job ends")
    }
}
