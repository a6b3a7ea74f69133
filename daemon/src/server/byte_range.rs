//! Files, whole or one range of bytes (RFC 9110, section 14).

use super::problem::Problem;
use axum::body::Body;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use futures_util::stream;
use std::io::SeekFrom;
use std::path::Path;
use std::time::UNIX_EPOCH;
use tokio::fs::File;
use tokio::io::{AsyncReadExt, AsyncSeekExt};

/// Bytes read at a time.
const BLOCK_BYTES: u64 = 64 << 10;

/// Answers with a file, or the range of it that is asked for.
///
/// # Errors
/// [`Problem`] 404 when it cannot be opened.
pub async fn respond(path: &Path, kind: &'static str, headers: &HeaderMap) -> Result<Response, Problem> {
    let gone = |e: std::io::Error| Problem::not_found(format!("the file cannot be read: {e}"));
    let mut file = File::open(path).await.map_err(gone)?;
    let metadata = file.metadata().await.map_err(gone)?;
    let (length, modified) = (metadata.len(), metadata.modified().ok());
    let nanos = modified.and_then(|m| m.duration_since(UNIX_EPOCH).ok()).map_or(0, |d| d.as_nanos());
    let tag = format!("\"{nanos:x}-{length:x}\"");
    // A range of a file that has changed since is of no use: the whole one is answered.
    let is_same = headers.get(header::IF_RANGE).is_none_or(|t| t.as_bytes() == tag.as_bytes());
    let asked = headers.get(header::RANGE).and_then(|r| r.to_str().ok()).filter(|_| is_same);
    let range = asked.map_or(Asked::Whole, |text| parse(text, length));
    let (status, start, end) = match range {
        Asked::Whole => (StatusCode::OK, 0, length),
        Asked::Range(start, end) => (StatusCode::PARTIAL_CONTENT, start, end),
        Asked::Outside => {
            let problem = Problem::new(StatusCode::RANGE_NOT_SATISFIABLE, format!("the file has {length} bytes"));
            return Ok(([(header::CONTENT_RANGE, format!("bytes */{length}"))], problem).into_response());
        }
    };
    file.seek(SeekFrom::Start(start)).await.map_err(gone)?;
    let mut response = (status, content(file, end - start)).into_response();
    let fields = response.headers_mut();
    fields.insert(header::CONTENT_TYPE, HeaderValue::from_static(kind));
    fields.insert(header::ACCEPT_RANGES, HeaderValue::from_static("bytes"));
    fields.insert(header::CONTENT_LENGTH, HeaderValue::from(end - start));
    let name = path.file_name().map(|n| n.to_string_lossy().replace(|c: char| !c.is_ascii() || c == '"', "_"));
    let texts = [
        (header::ETAG, Some(tag)),
        (header::CONTENT_DISPOSITION, name.map(|n| format!("attachment; filename=\"{n}\""))),
        (header::CONTENT_RANGE, (status != StatusCode::OK).then(|| format!("bytes {start}-{}/{length}", end - 1))),
    ];
    for (field, text) in texts {
        if let Some(value) = text.and_then(|t| HeaderValue::from_str(&t).ok()) {
            fields.insert(field, value);
        }
    }
    Ok(response)
}

fn content(file: File, bytes: u64) -> Body {
    Body::from_stream(stream::try_unfold((file, bytes), |(mut file, left)| async move {
        let mut block = vec![0; left.min(BLOCK_BYTES) as usize];
        match file.read(&mut block).await? {
            _ if left == 0 => Ok(None),
            // Cut off while being read: the client sees a short answer.
            0 => Err(std::io::Error::from(std::io::ErrorKind::UnexpectedEof)),
            n => {
                block.truncate(n);
                Ok(Some((Bytes::from(block), (file, left - n as u64))))
            }
        }
    }))
}

#[derive(Debug, PartialEq, Eq)]
enum Asked {
    Whole,
    /// First byte and the one after the last.
    Range(u64, u64),
    Outside,
}

/// One range of bytes; several, or none that can be understood, are the whole file, as the RFC allows.
fn parse(text: &str, length: u64) -> Asked {
    let parts = text.strip_prefix("bytes=").filter(|t| !t.contains(',')).and_then(|t| t.trim().split_once('-'));
    let number = |t: &str| t.bytes().all(|b| b.is_ascii_digit()).then(|| t.parse::<u64>().unwrap_or(u64::MAX));
    match parts.and_then(|(a, b)| Some((number(a)?, number(b)?, a.is_empty(), b.is_empty()))) {
        None | Some((_, _, true, true)) => Asked::Whole,
        Some((_, last, true, false)) => match last {
            0 => Asked::Outside,
            _ if length == 0 => Asked::Outside,
            last => Asked::Range(length - last.min(length), length),
        },
        Some((first, _, false, true)) if first < length => Asked::Range(first, length),
        Some((first, last, false, false)) if first > last => Asked::Whole,
        Some((first, last, false, false)) if first < length => Asked::Range(first, last.min(length - 1) + 1),
        Some(_) => Asked::Outside,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_as_the_rfc_has_them() {
        for (text, expected) in [
            ("bytes=0-0", Asked::Range(0, 1)),
            ("bytes=2-4", Asked::Range(2, 5)),
            ("bytes=2-", Asked::Range(2, 10)),
            ("bytes=-3", Asked::Range(7, 10)),
            ("bytes=-30", Asked::Range(0, 10)),
            ("bytes=5-99999999999999999999999", Asked::Range(5, 10)),
            ("bytes=10-", Asked::Outside),
            ("bytes=10-20", Asked::Outside),
            ("bytes=-0", Asked::Outside),
            ("bytes=4-2", Asked::Whole),
            ("bytes=0-1,3-4", Asked::Whole),
            ("bytes=-", Asked::Whole),
            ("bytes=a-b", Asked::Whole),
            ("lines=1-2", Asked::Whole),
        ] {
            assert_eq!(parse(text, 10), expected, "{text}");
        }
        assert_eq!(parse("bytes=0-", 0), Asked::Outside);
    }
}
