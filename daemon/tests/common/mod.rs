//! The `gv3` binary as a child process, and folders to run it in.
#![allow(dead_code, reason = "each test file uses its own part")]

#[path = "../../../tests/src/moving_face.rs"]
pub mod moving_face;
#[path = "../../src/pipeline/test_rig.rs"]
pub mod test_rig;

use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// What a run of `gv3` gave.
#[derive(Debug)]
pub struct Run {
    pub code: Option<i32>,
    pub stdout: String,
    pub stderr: String,
}

impl Run {
    pub fn of(output: Output) -> Self {
        let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
        let run = Self { code: output.status.code(), stdout: text(output.stdout), stderr: text(output.stderr) };
        assert!(!run.stderr.contains("panicked") && !run.stderr.contains("RUST_BACKTRACE"), "{}", run.stderr);
        run
    }

    /// Standard output of a run that did its work.
    #[track_caller]
    pub fn done(self) -> String {
        assert_eq!(self.code, Some(0), "{self:?}");
        self.stdout
    }

    /// Standard output as JSON of a run that did its work.
    #[track_caller]
    pub fn json(self) -> serde_json::Value {
        serde_json::from_str(&self.done()).unwrap()
    }

    /// Message of a run that failed: one line on standard error with all of `parts`, nothing on standard output.
    #[track_caller]
    pub fn failed(self, parts: &[&str]) {
        assert_eq!(self.code, Some(1), "{self:?}");
        assert_eq!(self.stdout, "");
        let message = self.stderr.trim_end();
        assert!(message.starts_with("gv3: ") && message.lines().count() == 1, "{message}");
        for part in parts {
            assert!(message.contains(part), "{part} is not in: {message}");
        }
        let (half, rest) = message.split_once(": ").unwrap();
        let causes: Vec<&str> = rest.split(": ").collect();
        assert!(causes.windows(2).all(|w| w[0] != w[1]), "said twice after {half}: {message}");
    }
}

pub fn command<S: AsRef<OsStr>>(arguments: &[S]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_gv3"));
    command.args(arguments).env_remove("RUST_LOG");
    command
}

/// A folder of its own for one test; commands run in it, so that messages show the names as given.
pub struct Place(tempfile::TempDir);

impl Place {
    pub fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    /// Runs `gv3` with arguments split at spaces.
    pub fn gv3(&self, arguments: &str) -> Run {
        let arguments: Vec<&str> = arguments.split_whitespace().collect();
        Run::of(command(&arguments).current_dir(self.0.path()).output().unwrap())
    }

    pub fn read(&self, name: &str) -> Vec<u8> {
        std::fs::read(self.path(name)).unwrap()
    }

    pub fn write(&self, name: &str, bytes: impl AsRef<[u8]>) {
        std::fs::write(self.path(name), bytes).unwrap();
    }

    /// Names of everything in the folder and the folders in it.
    pub fn names(&self) -> Vec<String> {
        let mut names = Vec::new();
        collect(self.0.path(), self.0.path(), &mut names);
        names.sort();
        names
    }
}

fn collect(root: &Path, folder: &Path, names: &mut Vec<String>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        names.push(path.strip_prefix(root).unwrap().to_string_lossy().into_owned());
        if path.is_dir() {
            collect(root, &path, names);
        }
    }
}
