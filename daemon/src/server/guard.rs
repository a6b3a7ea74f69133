//! Who may ask: checks of Host, Origin, rate and token that every request passes, WebSocket upgrades among them.
//!
//! A page on another site can make a browser send requests here, and by giving its own name our address (DNS rebinding)
//! even read the answers. The Host of such a request is that page's name, so only names and addresses that are ours are
//! answered; and its Origin is not ours. There is no CORS.

use super::problem::Problem;
use super::rate::Rates;
use super::token::Token;
use axum::http::{HeaderMap, Method, StatusCode, header};
use std::net::{IpAddr, SocketAddr};

/// Paths that are answered without a token: the page asks for it, and a monitor asks whether the server lives.
const OPEN_PATHS: [&str; 2] = ["/api/v1/login", "/healthz"];
/// Paths below which a token is needed; the rest are the page's files.
const GUARDED: [&str; 2] = ["/api/", "/metrics"];

/// The client's address.
#[derive(Debug, Clone, Copy)]
pub struct Peer(pub SocketAddr);

/// What is checked.
#[derive(Debug)]
pub struct Guard {
    is_loopback: bool,
    names: Vec<String>,
    token: Option<Token>,
    rates: Rates,
}

impl Guard {
    /// Checks for a server at an address. `names` are host names besides this machine's own.
    pub fn new(listen: SocketAddr, token: Option<Token>, names: &[String]) -> Self {
        let is_loopback = listen.ip().is_loopback();
        let mut names: Vec<String> = names.iter().map(|n| n.to_ascii_lowercase()).collect();
        names.push("localhost".into());
        if !is_loopback {
            let own = rustix::system::uname().nodename().to_string_lossy().to_ascii_lowercase();
            names.push(format!("{own}.local"));
            names.push(own);
        }
        Self { is_loopback, names, token, rates: Rates::new() }
    }

    /// The token that clients must show.
    pub fn token(&self) -> Option<&Token> {
        self.token.as_ref()
    }

    /// Passes a request or says why not.
    ///
    /// # Errors
    /// [`Problem`] with 421 (Host), 403 (Origin), 429 (rate) or 401 (token).
    pub fn check(&self, method: &Method, path: &str, headers: &HeaderMap, peer: IpAddr) -> Result<(), Problem> {
        let host = self.check_host(headers)?;
        check_origin(headers, host)?;
        let is_login = path == OPEN_PATHS[0];
        if !self.rates.take(peer, is_login) {
            return Err(Problem::new(StatusCode::TOO_MANY_REQUESTS, "too many requests; wait a second"));
        }
        let needs_token = GUARDED.iter().any(|g| path.starts_with(g)) && !OPEN_PATHS.contains(&path);
        match &self.token {
            Some(token) if needs_token && !shown(headers).any(|text| token.is(text)) => {
                let detail = "a token is needed: Authorization: Bearer TOKEN, or the cookie of POST /api/v1/login";
                tracing::warn!(%peer, %method, path, "request without the token");
                Err(Problem::new(StatusCode::UNAUTHORIZED, detail))
            }
            _ => Ok(()),
        }
    }

    /// The Host header, if it names this server.
    fn check_host<'a>(&self, headers: &'a HeaderMap) -> Result<&'a str, Problem> {
        let mut all = headers.get_all(header::HOST).iter();
        let host = all.next().and_then(|h| h.to_str().ok()).filter(|_| all.next().is_none());
        match host {
            Some(host) if self.is_ours(host) => Ok(host),
            _ => Err(Problem::new(
                StatusCode::MISDIRECTED_REQUEST,
                "the Host header does not name this server; use its address, or start it with --host NAME",
            )),
        }
    }

    fn is_ours(&self, host: &str) -> bool {
        let Some(name) = without_port(host) else { return false };
        let address = name.strip_prefix('[').and_then(|n| n.strip_suffix(']')).unwrap_or(name);
        match address.parse::<IpAddr>() {
            // An address cannot be rebound; but on loopback nothing else than loopback is expected.
            Ok(ip) => !self.is_loopback || ip.is_loopback(),
            Err(_) => self.names.iter().any(|n| n.eq_ignore_ascii_case(name)),
        }
    }
}

/// Browsers name the page that asks; it must be ours, as far as a page asks at all.
fn check_origin(headers: &HeaderMap, host: &str) -> Result<(), Problem> {
    for origin in headers.get_all(header::ORIGIN) {
        let authority = origin.to_str().ok().and_then(|o| o.strip_prefix("http://").or(o.strip_prefix("https://")));
        if !authority.is_some_and(|a| a.eq_ignore_ascii_case(host)) {
            return Err(Problem::new(StatusCode::FORBIDDEN, "pages of other origins may not use this server"));
        }
    }
    Ok(())
}

/// `name:80`, `[::1]:80` and `name` without their ports; `None` when that is no port.
fn without_port(host: &str) -> Option<&str> {
    let end = host.rfind(']').map_or(0, |at| at + 1);
    match host[end..].rfind(':').map(|at| end + at) {
        None => Some(host),
        Some(at) => {
            let port = &host[at + 1..];
            (!port.is_empty() && port.bytes().all(|b| b.is_ascii_digit())).then(|| &host[..at])
        }
    }
}

/// Tokens that a request shows: bearer or cookie.
fn shown(headers: &HeaderMap) -> impl Iterator<Item = &str> {
    let bearer = headers.get_all(header::AUTHORIZATION).iter().filter_map(|h| h.to_str().ok()).filter_map(|text| {
        let (scheme, token) = text.split_once(' ')?;
        scheme.eq_ignore_ascii_case("bearer").then(|| token.trim())
    });
    let cookies = headers.get_all(header::COOKIE).iter().filter_map(|h| h.to_str().ok());
    let cookie = cookies.flat_map(|c| c.split(';')).filter_map(|c| c.trim().strip_prefix("gv3_token="));
    bearer.chain(cookie)
}

#[cfg(test)]
mod tests {
    use super::*;

    const TOKEN: &str = "0123456789abcdef0123";

    fn ask(guard: &Guard, path: &str, headers: &[(&'static str, &str)]) -> u16 {
        let mut map = HeaderMap::new();
        for (name, value) in headers {
            map.append(*name, value.parse().unwrap());
        }
        let peer = IpAddr::from([127, 0, 0, 1]);
        guard.check(&Method::GET, path, &map, peer).err().map_or(200, |p| p.status.as_u16())
    }

    fn loopback() -> Guard {
        Guard::new("127.0.0.1:8433".parse().unwrap(), None, &["scanner.lan".into()])
    }

    #[test]
    fn only_our_own_names_are_answered() {
        let guard = loopback();
        for good in ["localhost", "localhost:9", "127.0.0.1:8433", "[::1]:8433", "LOCALHOST:1", "scanner.lan"] {
            assert_eq!(ask(&guard, "/api/v1/status", &[("host", good)]), 200, "{good}");
        }
        for bad in ["evil.example", "localhost.evil.example", "192.168.1.5", "localhost:x", "", "127.0.0.1:", "[::1"] {
            assert_eq!(ask(&guard, "/", &[("host", bad)]), 421, "{bad}");
        }
        assert_eq!(ask(&guard, "/", &[]), 421);
        assert_eq!(ask(&guard, "/", &[("host", "localhost"), ("host", "evil.example")]), 421);
        let open = Guard::new("0.0.0.0:8433".parse().unwrap(), Token::new(TOKEN), &[]);
        assert_eq!(ask(&open, "/", &[("host", "192.168.1.5:8433")]), 200);
        assert_eq!(ask(&open, "/", &[("host", "evil.example")]), 421);
    }

    #[test]
    fn pages_of_other_origins_are_refused() {
        let guard = loopback();
        let from = |origin| ask(&guard, "/api/v1/status", &[("host", "localhost:8433"), ("origin", origin)]);
        assert_eq!(from("http://localhost:8433"), 200);
        for bad in
            ["http://localhost:9", "http://evil.example", "null", "http://localhost:8433.evil.example", "file://"]
        {
            assert_eq!(from(bad), 403, "{bad}");
        }
    }

    #[test]
    fn a_token_is_asked_for_where_data_is() {
        let guard = Guard::new("0.0.0.0:8433".parse().unwrap(), Token::new(TOKEN), &[]);
        let host = ("host", "10.0.0.1");
        for path in ["/api/v1/status", "/metrics", "/api/v1/live/mesh", "/api/unknown"] {
            assert_eq!(ask(&guard, path, &[host]), 401, "{path}");
            assert_eq!(ask(&guard, path, &[host, ("authorization", &format!("Bearer {TOKEN}"))]), 200);
            assert_eq!(ask(&guard, path, &[host, ("cookie", &format!("a=b; gv3_token={TOKEN}"))]), 200);
            assert_eq!(ask(&guard, path, &[host, ("authorization", "Bearer 0123456789abcdef0124")]), 401);
            assert_eq!(ask(&guard, path, &[host, ("authorization", &format!("Basic {TOKEN}"))]), 401);
        }
        for path in ["/", "/index.html", "/healthz", "/api/v1/login"] {
            assert_eq!(ask(&guard, path, &[host]), 200, "{path}");
        }
    }
}
