//! The secret that clients from other machines show.

use std::fmt::Write as _;
use std::fs::{File, OpenOptions};
use std::io::{Read, Write};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use subtle::ConstantTimeEq;

/// Shortest token taken from a file, bytes.
const MIN_TOKEN_BYTES: usize = 16;
/// Longest token, bytes.
const MAX_TOKEN_BYTES: usize = 512;
/// Random bytes in a new token.
const RANDOM_BYTES: usize = 32;

/// What is wrong with a token's file.
#[derive(Debug, thiserror::Error)]
pub enum TokenError {
    /// The system refused.
    #[error("{}: cannot {action}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What was tried.
        action: &'static str,
        /// The system's answer.
        source: std::io::Error,
    },
    /// Others may read it.
    #[error("{}: mode {mode:04o} lets others read the token; chmod 600 it", path.display())]
    Readable {
        /// The file.
        path: PathBuf,
        /// Its mode.
        mode: u32,
    },
    /// No token in it.
    #[error("{}: a token is {MIN_TOKEN_BYTES} to {MAX_TOKEN_BYTES} printable characters without spaces; make one with `gv3 serve --new-token FILE`", path.display())]
    Content {
        /// The file.
        path: PathBuf,
    },
}

/// A token. It is never printed.
#[derive(Clone)]
pub struct Token(Vec<u8>);

impl std::fmt::Debug for Token {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Token(...)")
    }
}

impl Token {
    /// Reads a token from a file that only its owner may read.
    ///
    /// # Errors
    /// [`TokenError`].
    pub fn read(path: &Path) -> Result<Self, TokenError> {
        let fail = |action| move |source| TokenError::Io { path: path.into(), action, source };
        let file = File::open(path).map_err(fail("open"))?;
        // Of the open file, so that nobody swaps it between check and reading.
        let mode = file.metadata().map_err(fail("read"))?.mode() & 0o7777;
        if mode & 0o077 != 0 {
            return Err(TokenError::Readable { path: path.into(), mode });
        }
        let mut text = String::new();
        let limited = file.take(MAX_TOKEN_BYTES as u64 + 2).read_to_string(&mut text);
        limited.map_err(fail("read"))?;
        Self::new(text.trim()).ok_or_else(|| TokenError::Content { path: path.into() })
    }

    /// Writes a new random token into a new file of mode 0600.
    ///
    /// # Errors
    /// [`TokenError::Io`], also when the file exists.
    pub fn create(path: &Path) -> Result<(), TokenError> {
        let fail = |action| move |source| TokenError::Io { path: path.into(), action, source };
        let mut random = [0; RANDOM_BYTES];
        let source = Path::new("/dev/urandom");
        File::open(source).and_then(|mut f| f.read_exact(&mut random)).map_err(fail("draw random numbers for"))?;
        let mut text = String::with_capacity(2 * RANDOM_BYTES + 1);
        for byte in random {
            // Writing to a String cannot fail.
            let _ = write!(text, "{byte:02x}");
        }
        text.push('\n');
        let mut file =
            OpenOptions::new().write(true).create_new(true).mode(0o600).open(path).map_err(fail("create"))?;
        file.write_all(text.as_bytes()).and_then(|()| file.sync_all()).map_err(fail("write"))
    }

    /// A token of this text.
    pub fn new(text: &str) -> Option<Self> {
        let is_printable = text.bytes().all(|b| b.is_ascii_graphic() && !b";,\"\\".contains(&b));
        ((MIN_TOKEN_BYTES..=MAX_TOKEN_BYTES).contains(&text.len()) && is_printable).then(|| Self(text.into()))
    }

    /// Whether a client's text is the token; the time this takes says nothing about where they differ.
    pub fn is(&self, text: &str) -> bool {
        self.0.ct_eq(text.as_bytes()).into()
    }

    /// The cookie that carries the token.
    pub fn cookie(&self) -> String {
        let text = String::from_utf8_lossy(&self.0);
        format!("gv3_token={text}; Path=/; HttpOnly; SameSite=Strict; Max-Age=31536000")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    #[test]
    fn a_new_token_is_private_random_and_found_again() {
        let folder = tempfile::tempdir().unwrap();
        let (a, b) = (folder.path().join("a"), folder.path().join("b"));
        Token::create(&a).unwrap();
        Token::create(&b).unwrap();
        assert!(Token::create(&a).is_err(), "an existing token is not replaced");
        assert_eq!(std::fs::metadata(&a).unwrap().mode() & 0o777, 0o600);
        let text = std::fs::read_to_string(&a).unwrap();
        let (a, b) = (Token::read(&a).unwrap(), Token::read(&b).unwrap());
        assert!(a.is(text.trim()) && !b.is(text.trim()) && !a.is("") && !a.is(&text));
        assert!(!format!("{a:?}").contains(text.trim()));
    }

    #[test]
    fn a_file_that_others_may_read_or_that_holds_no_token_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("token");
        std::fs::write(&path, "0123456789abcdef").unwrap();
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o640)).unwrap();
        assert!(matches!(Token::read(&path), Err(TokenError::Readable { mode: 0o640, .. })));
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o600)).unwrap();
        assert!(Token::read(&path).unwrap().is("0123456789abcdef"));
        for bad in ["", "short", "with spaces in between", "semi;colon;semi;colon", &"x".repeat(600)] {
            std::fs::write(&path, bad).unwrap();
            assert!(matches!(Token::read(&path), Err(TokenError::Content { .. })), "{bad}");
        }
    }
}
