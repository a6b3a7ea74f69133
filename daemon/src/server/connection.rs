//! Takes connections and serves HTTP/1.1 on each, within limits.

use super::guard::Peer;
use super::patient::Patient;
use super::shared::Shared;
use axum::{Extension, Router};
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{Semaphore, watch};
use tokio::task::JoinSet;

/// Connections open at one time.
pub const MAX_CONNECTIONS: usize = 512;
/// Longest for the fields of a request to arrive; also the longest pause between two requests.
const HEADER_TIMEOUT: Duration = Duration::from_secs(15);
/// Longest that a client may take nothing of an answer.
const WRITE_PATIENCE: Duration = Duration::from_secs(15);
/// Largest request line and fields, bytes.
const MAX_HEADER_BYTES: usize = 16 << 10;
/// Longest that open connections are waited for at the end.
const FAREWELL: Duration = Duration::from_secs(3);

/// Serves until `stopping` becomes true, then gives connections a moment to end.
pub async fn serve(listener: TcpListener, app: Router, shared: Arc<Shared>, mut stopping: watch::Receiver<bool>) {
    let places = Arc::new(Semaphore::new(MAX_CONNECTIONS));
    let mut connections = JoinSet::new();
    loop {
        tokio::select! {
            accepted = listener.accept() => match accepted {
                Ok((stream, peer)) => match Arc::clone(&places).try_acquire_owned() {
                    Ok(place) => {
                        let (app, shared, stopping) = (app.clone(), Arc::clone(&shared), stopping.clone());
                        connections.spawn(async move {
                            shared.counters.connections.add();
                            one(stream, peer, app, stopping).await;
                            shared.counters.connections.sub();
                            drop(place);
                        });
                    }
                    Err(_) => shared.counters.refused.add(),
                },
                Err(error) => {
                    // Out of descriptors, mostly: others will be closed.
                    tracing::warn!(%error, "a connection could not be taken");
                    tokio::time::sleep(Duration::from_millis(100)).await;
                }
            },
            Some(_) = connections.join_next() => {}
            () = told_to_stop(&mut stopping) => break,
        }
    }
    drop(listener);
    let all = async { while connections.join_next().await.is_some() {} };
    // What is still open after that ends with the runtime.
    let _ = tokio::time::timeout(FAREWELL, all).await;
}

async fn one(stream: TcpStream, peer: SocketAddr, app: Router, mut stopping: watch::Receiver<bool>) {
    // Small messages of the streams are not to wait for each other.
    let _ = stream.set_nodelay(true);
    let service = TowerToHyperService::new(app.layer(Extension(Peer(peer))));
    let connection = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEADER_TIMEOUT)
        .max_buf_size(MAX_HEADER_BYTES)
        .serve_connection(TokioIo::new(Patient::new(stream, WRITE_PATIENCE)), service)
        .with_upgrades();
    tokio::pin!(connection);
    let ended = tokio::select! {
        ended = connection.as_mut() => Some(ended),
        () = told_to_stop(&mut stopping) => None,
    };
    let ended = match ended {
        Some(ended) => ended,
        None => {
            connection.as_mut().graceful_shutdown();
            connection.await
        }
    };
    if let Err(error) = ended {
        tracing::debug!(%peer, %error, "connection ended");
    }
}

/// Returns when the server stops.
pub async fn told_to_stop(stopping: &mut watch::Receiver<bool>) {
    // An error says that the server is gone already.
    let _ = stopping.wait_for(|stop| *stop).await;
}
