//! The page's files, built into the program.

use axum::body::Body;
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, header};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use flate2::Compression;
use flate2::read::GzDecoder;
use flate2::write::GzEncoder;
use include_dir::{Dir, include_dir};
use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::sync::OnceLock;

static DIST: Dir<'static> = include_dir!("$CARGO_MANIFEST_DIR/web/dist");

/// What a page may load and do: everything from here, nothing from elsewhere. Pictures and workers of the page are made
/// in the browser (blob:), and plots set widths in style attributes.
pub const CONTENT_SECURITY_POLICY: &str = "default-src 'self'; img-src 'self' blob: data:; worker-src 'self' blob:; \
    style-src 'self' 'unsafe-inline'; object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'";

const PLAIN_PAGE: &str = "<!doctype html><meta charset=utf-8><title>gv3</title><h1>gv3</h1>\
    <p>This build has no page. <a href=/api/v1/status>Status</a>, <a href=/api/v1/sessions>sessions</a>, \
    <a href=/api/v1/openapi.json>description of the interface</a>.";

struct Page {
    kind: &'static str,
    plain: Bytes,
    /// Where it is smaller.
    gzip: Option<Bytes>,
    tag: String,
    is_versioned: bool,
}

/// Answers a path that is none of the interface's.
pub fn respond(method: &Method, path: &str, headers: &HeaderMap) -> Response {
    static PAGES: OnceLock<BTreeMap<String, Page>> = OnceLock::new();
    let pages = PAGES.get_or_init(|| collect(&files(&DIST)));
    if method != Method::GET && method != Method::HEAD {
        return (StatusCode::METHOD_NOT_ALLOWED, [(header::ALLOW, "GET, HEAD")]).into_response();
    }
    let name = path.trim_start_matches('/');
    let name = if name.is_empty() { "index.html" } else { name };
    // Addresses within the page, which have no ending, are the page's own matter.
    let is_route = !name.rsplit('/').next().is_some_and(|last| last.contains('.'));
    let page = pages.get(name).or_else(|| pages.get("index.html").filter(|_| is_route));
    page.map_or_else(|| StatusCode::NOT_FOUND.into_response(), |page| page.respond(headers))
}

impl Page {
    fn new(name: &str, plain: Bytes, gzip: Option<Bytes>) -> Self {
        let tag = format!("\"{:08x}-{:x}\"", crc32fast::hash(&plain), plain.len());
        // A bundler's name with a hash in it stands for its content.
        let is_versioned = name.starts_with("assets/");
        Self { kind: kind(name), plain, gzip, tag, is_versioned }
    }

    fn respond(&self, headers: &HeaderMap) -> Response {
        let text = |name| headers.get(name).and_then(|v: &HeaderValue| v.to_str().ok()).unwrap_or("");
        let is_known = text(header::IF_NONE_MATCH).split(',').any(|t| t.trim().trim_start_matches("W/") == self.tag);
        let takes_gzip = accepts_gzip(text(header::ACCEPT_ENCODING));
        let gzip = self.gzip.as_ref().filter(|_| takes_gzip);
        let mut response = match (is_known, gzip) {
            (true, _) => StatusCode::NOT_MODIFIED.into_response(),
            (false, Some(gzip)) => ([(header::CONTENT_ENCODING, "gzip")], Body::from(gzip.clone())).into_response(),
            (false, None) => Body::from(self.plain.clone()).into_response(),
        };
        let cache = if self.is_versioned { "public, max-age=31536000, immutable" } else { "no-cache" };
        let fields = response.headers_mut();
        fields.insert(header::CONTENT_TYPE, HeaderValue::from_static(self.kind));
        fields.insert(header::CACHE_CONTROL, HeaderValue::from_static(cache));
        fields.insert(header::VARY, HeaderValue::from_static("accept-encoding"));
        fields.insert(header::CONTENT_SECURITY_POLICY, HeaderValue::from_static(CONTENT_SECURITY_POLICY));
        if let Ok(tag) = HeaderValue::from_str(&self.tag) {
            fields.insert(header::ETAG, tag);
        }
        response
    }
}

fn accepts_gzip(accepted: &str) -> bool {
    accepted.split(',').any(|coding| {
        let mut parts = coding.split(';').map(str::trim);
        let is_gzip = parts.next().is_some_and(|name| name.eq_ignore_ascii_case("gzip") || name == "*");
        is_gzip && !parts.any(|p| matches!(p, "q=0" | "q=0.0" | "q=0.00" | "q=0.000"))
    })
}

fn files(folder: &Dir<'static>) -> Vec<(String, &'static [u8])> {
    let mut all: Vec<_> = folder.files().map(|f| (f.path().to_string_lossy().into_owned(), f.contents())).collect();
    all.extend(folder.dirs().flat_map(files));
    all
}

/// Pages by path. A file `x.gz` is the compressed form of `x`, whether `x` itself is there or not.
fn collect(files: &[(String, &'static [u8])]) -> BTreeMap<String, Page> {
    let find = |name: &str| files.iter().find(|(n, _)| n == name).map(|(_, bytes)| *bytes);
    let mut pages = BTreeMap::new();
    for (name, bytes) in files.iter().filter(|(n, _)| !n.rsplit('/').next().is_some_and(|l| l.starts_with('.'))) {
        let page = match name.strip_suffix(".gz") {
            Some(plain_name) if find(plain_name).is_none() => {
                unpack(bytes).map(|plain| (plain_name, Page::new(plain_name, plain, Some(Bytes::from_static(bytes)))))
            }
            Some(_) => None,
            None => {
                let stored = find(&format!("{name}.gz")).map(Bytes::from_static);
                let gzip = stored.or_else(|| is_text(kind(name)).then(|| pack(bytes))?);
                Some((name.as_str(), Page::new(name, Bytes::from_static(bytes), gzip)))
            }
        };
        pages.extend(page.map(|(name, page)| (name.to_owned(), page)));
    }
    let plain = || Page::new("index.html", Bytes::from_static(PLAIN_PAGE.as_bytes()), None);
    pages.entry("index.html".into()).or_insert_with(plain);
    pages
}

fn pack(bytes: &[u8]) -> Option<Bytes> {
    let mut encoder = GzEncoder::new(Vec::new(), Compression::default());
    let packed = encoder.write_all(bytes).and_then(|()| encoder.finish()).ok()?;
    (packed.len() < bytes.len()).then(|| packed.into())
}

fn unpack(bytes: &[u8]) -> Option<Bytes> {
    let mut plain = Vec::new();
    GzDecoder::new(bytes).read_to_end(&mut plain).ok()?;
    Some(plain.into())
}

fn is_text(kind: &str) -> bool {
    kind.starts_with("text/") || kind.starts_with("application/json") || kind == "image/svg+xml"
}

fn kind(name: &str) -> &'static str {
    match name.rsplit('.').next().unwrap_or("") {
        "html" => "text/html; charset=utf-8",
        "js" | "mjs" => "text/javascript; charset=utf-8",
        "css" => "text/css; charset=utf-8",
        "txt" | "md" => "text/plain; charset=utf-8",
        "json" | "map" | "webmanifest" => "application/json",
        "svg" => "image/svg+xml",
        "png" => "image/png",
        "jpg" | "jpeg" => "image/jpeg",
        "ico" => "image/x-icon",
        "woff2" => "font/woff2",
        "wasm" => "application/wasm",
        _ => "application/octet-stream",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn compressed_forms_are_paired_with_their_plain_ones() {
        let text: &'static [u8] = "body { margin: 0 } ".repeat(50).leak().as_bytes();
        let gz: &'static [u8] = pack(text).unwrap().to_vec().leak();
        let files =
            [("a.css".into(), text), ("b.js.gz".into(), gz), ("c.png".into(), text), (".keep".into(), &b""[..])];
        let pages = collect(&files);
        assert_eq!(pages.keys().collect::<Vec<_>>(), ["a.css", "b.js", "c.png", "index.html"]);
        assert_eq!((&pages["b.js"].plain[..], pages["b.js"].kind), (text, "text/javascript; charset=utf-8"));
        assert_eq!(pages["a.css"].gzip.as_ref().map(|g| unpack(g).unwrap().to_vec()), Some(text.to_vec()));
        assert!(pages["c.png"].gzip.is_none());
    }

    #[test]
    fn gzip_tag_and_policy_are_answered() {
        let get = |fields: &[(&'static str, &str)]| {
            let map = fields.iter().map(|(n, v)| (n.parse().unwrap(), v.parse().unwrap())).collect();
            respond(&Method::GET, "/", &map)
        };
        let plain = get(&[]);
        assert_eq!(plain.status(), StatusCode::OK);
        assert!(plain.headers()[header::CONTENT_SECURITY_POLICY].to_str().unwrap().contains("default-src 'self'"));
        let tag = plain.headers()[header::ETAG].to_str().unwrap().to_owned();
        assert_eq!(get(&[("if-none-match", &tag)]).status(), StatusCode::NOT_MODIFIED);
        assert_eq!(get(&[("accept-encoding", "gzip;q=0")]).headers().get(header::CONTENT_ENCODING), None);
        assert!(accepts_gzip("br, gzip;q=0.5") && accepts_gzip("*") && !accepts_gzip("br"));
        assert_eq!(respond(&Method::GET, "/nothing.js", &HeaderMap::new()).status(), StatusCode::NOT_FOUND);
        assert_eq!(respond(&Method::GET, "/sessions", &HeaderMap::new()).status(), StatusCode::OK);
        assert_eq!(respond(&Method::POST, "/", &HeaderMap::new()).status(), StatusCode::METHOD_NOT_ALLOWED);
    }
}
