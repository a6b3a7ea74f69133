//! Clients that mean no good, and clients that are broken.

use super::harness::{Running, TOKEN};
use crate::server::Notify;
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

#[tokio::test(flavor = "multi_thread")]
async fn malformed_requests_are_refused_and_the_server_goes_on() {
    let server = Running::start().await;
    let long_path = format!("GET /{} HTTP/1.1\r\nHost: localhost\r\n\r\n", "a".repeat(100_000));
    let many_fields = format!("GET / HTTP/1.1\r\nHost: localhost\r\n{}\r\n", "X-Field: some text\r\n".repeat(5000));
    let broken: [&[u8]; 9] = [
        b"\x00\xff\x80\x00\r\n\r\n",
        b"GET\r\n\r\n",
        b"GET / HTTP/9.9\r\nHost: localhost\r\n\r\n",
        b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nHost: evil.example\r\nConnection: close\r\n\r\n",
        b"POST /api/v1/login HTTP/1.1\r\nHost: localhost\r\nContent-Length: 5\r\nContent-Length: 7\r\n\r\n{}",
        b"POST /api/v1/login HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n\r\n",
        long_path.as_bytes(),
        many_fields.as_bytes(),
    ];
    for bytes in broken {
        let answer = server.raw(bytes).await;
        let shown = String::from_utf8_lossy(&bytes[..bytes.len().min(60)]).into_owned();
        assert!(answer.is_none_or(|a| (400..500).contains(&a.status)), "{shown}");
    }
    assert_eq!(server.get("/healthz").await.status, 200);
    server.stop().await.1.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn bodies_are_bounded_and_checked() {
    let server = Running::start().await;
    let post = async |body: &str| server.post("/api/v1/recording/mark", body).await.status;
    assert_eq!(post("{").await, 400);
    assert_eq!(post("[]").await, 400);
    assert_eq!(post(r#"{"text":"a","more":1}"#).await, 400);
    assert_eq!(post(&format!("{{\"text\":\"{}\"}}", "a".repeat(2000))).await, 400);
    assert_eq!(post(&format!("{{\"text\":\"{}\"}}", "a".repeat(100_000))).await, 413);
    let form = b"POST /api/v1/recording/mark HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\nContent-Type: \
        text/plain\r\nContent-Length: 12\r\n\r\n{\"text\":\"a\"}";
    assert_eq!(server.raw(form).await.unwrap().status, 415);
    server.stop().await.1.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn other_names_origins_and_paths_are_refused() {
    let server = Running::start().await;
    let ask = async |path: &str, fields: &str| {
        let text = format!("GET {path} HTTP/1.1\r\nConnection: close\r\n{fields}\r\n");
        server.raw(text.as_bytes()).await.unwrap().status
    };
    assert_eq!(ask("/api/v1/status", "Host: evil.example\r\n").await, 421);
    assert_eq!(ask("/", "Host: evil.example\r\n").await, 421);
    let own = format!("Host: {}\r\n", server.address);
    assert_eq!(ask("/api/v1/status", &format!("{own}Origin: http://evil.example\r\n")).await, 403);
    assert_eq!(ask("/api/v1/status", &format!("{own}Origin: http://{}\r\n", server.address)).await, 200);
    let upgrade = "Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: \
        dGhlIHNhbXBsZSBub25jZQ==\r\n";
    let evil = format!("{own}Origin: http://evil.example\r\n{upgrade}");
    assert_eq!(ask("/api/v1/live/events", &evil).await, 403);
    for path in ["..%2f..%2fetc%2fpasswd", "%2e%2e", ".gv3.lock", "a%00b", "a%2fb", "C%3a", "%ff"] {
        for rest in ["", "/file", "/curve", "/thumbnail.png"] {
            let status = ask(&format!("/api/v1/sessions/{path}{rest}"), &own).await;
            assert_eq!(status, 400, "{path}{rest}");
        }
        assert_eq!(ask(&format!("/api/v1/reports/{path}"), &own).await, 400, "{path}");
    }
    for path in ["/../../etc/passwd", "/..%2f..%2fetc/passwd", "//etc/passwd.txt"] {
        assert_ne!(server.get(path).await.body, std::fs::read("/etc/passwd").unwrap_or_default(), "{path}");
    }
    let renamed = server.post("/api/v1/recording/start", r#"{"name":"../out"}"#).await;
    assert_eq!(renamed.status, 400);
    server.stop().await.1.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_token_opens_what_is_closed() {
    let server = Running::start_with(tempfile::tempdir().unwrap(), Some(TOKEN), Notify::default()).await;
    assert_eq!(server.get("/api/v1/status").await.status, 200);
    let bare = |path: &str| format!("GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n");
    let refused = server.raw(bare("/api/v1/status").as_bytes()).await.unwrap();
    assert_eq!((refused.status, refused.json()["status"].as_u64()), (401, Some(401)));
    assert_eq!(server.raw(bare("/metrics").as_bytes()).await.unwrap().status, 401);
    assert_eq!(server.raw(bare("/").as_bytes()).await.unwrap().status, 200);
    assert_eq!(server.post("/api/v1/login", r#"{"token":"wrong"}"#).await.status, 401);
    let login = server.post("/api/v1/login", &format!("{{\"token\":\"{TOKEN}\"}}")).await;
    assert_eq!(login.status, 204);
    let cookie = login.head.lines().find_map(|l| l.strip_prefix("set-cookie: ")).unwrap();
    assert!(cookie.contains("httponly") && cookie.contains("samesite=strict"), "{cookie}");
    let with_cookie = bare("/api/v1/status").replace("\r\n\r\n", &format!("\r\nCookie: gv3_token={TOKEN}\r\n\r\n"));
    assert_eq!(server.raw(with_cookie.as_bytes()).await.unwrap().status, 200);
    let attempts = 20;
    let mut refused = 0;
    for _ in 0..attempts {
        refused += u32::from(server.post("/api/v1/login", r#"{"token":"wrong"}"#).await.status == 429);
    }
    assert!(refused > 5, "guessing is slowed down: {refused} of {attempts}");
    server.stop().await.1.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn malformed_websocket_traffic_ends_that_socket_alone() {
    let server = Running::start().await;
    let hello = format!(
        "GET /api/v1/live/events HTTP/1.1\r\nHost: {}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
         Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n",
        server.address
    );
    // Reserved bits; an unmasked text; a length of 2^63; a continuation of nothing; a control frame in pieces.
    let frames: [&[u8]; 5] = [
        &[0xff; 20],
        &[0x81, 0x02, b'h', b'i'],
        &[0x82, 0xff, 0x80, 0, 0, 0, 0, 0, 0, 0, 1, 2, 3, 4],
        &[0x80, 0x80, 1, 2, 3, 4],
        &[0x09, 0x80, 1, 2, 3, 4],
    ];
    for frame in frames {
        let mut stream = TcpStream::connect(server.address).await.unwrap();
        stream.write_all(hello.as_bytes()).await.unwrap();
        stream.write_all(frame).await.unwrap();
        let mut heard = Vec::new();
        let ended = tokio::time::timeout(Duration::from_secs(30), stream.read_to_end(&mut heard)).await;
        assert!(ended.is_ok(), "{frame:?}");
        assert!(heard.starts_with(b"HTTP/1.1 101"), "{frame:?}");
    }
    assert_eq!(server.get("/healthz").await.status, 200);
    server.stop().await.1.unwrap();
}

/// Requests and frames that were right once, with bytes changed, left out and put in.
#[tokio::test(flavor = "multi_thread")]
async fn damaged_traffic_does_no_harm() {
    let server = Running::start().await;
    let request = format!(
        "POST /api/v1/recording/mark HTTP/1.1\r\nHost: {0}\r\nOrigin: http://{0}\r\nContent-Type: application/json\r\n\
         Content-Length: 12\r\nConnection: close\r\n\r\n{{\"text\":\"a\"}}",
        server.address
    );
    let upgrade = format!(
        "GET /api/v1/live/mesh?fps=10 HTTP/1.1\r\nHost: {}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
         Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n\u{1}\u{1}\u{1}\u{1}",
        server.address
    );
    let mut state = 1u64;
    let mut random = |below: usize| {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as usize % below
    };
    for n in 0..300 {
        let mut bytes = [&request, &upgrade][n % 2].clone().into_bytes();
        for _ in 0..=random(4) {
            let at = random(bytes.len());
            match random(3) {
                0 => bytes[at] = random(256) as u8,
                1 => drop(bytes.drain(at..(at + random(9)).min(bytes.len()))),
                _ => drop(bytes.splice(at..at, (0..random(9)).map(|_| 0xffu8))),
            }
        }
        let mut stream = TcpStream::connect(server.address).await.unwrap();
        let _ = stream.write_all(&bytes).await;
        // Gone at once, or after a look at the answer.
        if n % 3 == 0 {
            let mut answer = [0; 64];
            let _ = tokio::time::timeout(Duration::from_millis(20), stream.read(&mut answer)).await;
        }
    }
    assert_eq!(server.get("/healthz").await.status, 200);
    assert_eq!(server.live.status().state.name(), "idle");
    server.stop().await.1.unwrap();
}
