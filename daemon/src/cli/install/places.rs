//! What an installation consists of and where it goes: for the machine or for one user.

use super::placed::Placed;
use crate::cli::install_udev::{RULES, RULES_NAME};
use crate::cli::manual::{COMPLETIONS, completions, man_pages};
use anyhow::{Context, Result};
use std::path::{Path, PathBuf};

const UNIT: &str = include_str!("../../../../config/systemd/gv3.service");
const USER_UNIT: &str = include_str!("../../../../config/systemd/gv3-user.service");
const SYSUSERS: &str = include_str!("../../../../config/systemd/gv3.sysusers");
const SIMULATED: &str = include_str!("../../../../config/simulated.toml");
const THREE_PATTERN: &str = include_str!("../../../../config/three-pattern.toml");
/// In the units: the path of the binary.
const BINARY: &str = "@BIN@";

/// Where an installation goes.
#[derive(Debug, Clone)]
pub struct Places {
    /// Put before every path, as for a package; empty otherwise.
    pub root: PathBuf,
    /// Of binary, pages and examples, absolute.
    pub prefix: PathBuf,
    /// Of configuration: `/etc`, or the user's.
    pub config: PathBuf,
    /// Whether it is for one user.
    pub is_user: bool,
}

impl Places {
    /// For the machine.
    pub fn system(root: PathBuf, prefix: PathBuf) -> Self {
        Self { root, prefix, config: "/etc".into(), is_user: false }
    }

    /// For the user whose home this is; `config` is `XDG_CONFIG_HOME` where it is set.
    pub fn user(root: PathBuf, prefix: Option<PathBuf>, home: &Path, config: Option<PathBuf>) -> Self {
        let prefix = prefix.unwrap_or_else(|| home.join(".local"));
        Self { root, prefix, config: config.unwrap_or_else(|| home.join(".config")), is_user: true }
    }

    /// A path as it is on the machine, below the root.
    fn at(&self, base: &Path, rest: &str) -> PathBuf {
        let path = base.join(rest);
        match path.strip_prefix("/") {
            Ok(relative) if !self.root.as_os_str().is_empty() => self.root.join(relative),
            _ => path,
        }
    }

    /// Everything, in the order in which it is put in place: what starts the rest comes last.
    ///
    /// # Errors
    /// This program's own file cannot be read; a prefix that a unit cannot name.
    pub fn files(&self, binary: Vec<u8>) -> Result<Vec<Placed>> {
        let share = |rest: &str| self.at(&self.prefix, &format!("share/{rest}"));
        let target = self.prefix.join("bin/gv3");
        let named = target.to_str().filter(|path| path.chars().all(is_plain));
        let named = named.with_context(|| format!("{}: a unit file cannot name this path", target.display()))?;
        let mut files = vec![Placed { mode: 0o755, ..Placed::new(self.at(&self.prefix, "bin/gv3"), binary) }];
        for (name, page) in man_pages()? {
            files.push(Placed::new(share(&format!("man/man1/{name}")), page));
        }
        for (shell, path) in COMPLETIONS {
            files.push(Placed::new(share(path), completions(shell)));
        }
        files.push(Placed::new(share("gv3/simulated.toml"), SIMULATED));
        files.push(Placed::new(share("gv3/three-pattern.toml"), THREE_PATTERN));
        let config = |rest: &str| self.at(&self.config, rest);
        files.push(Placed { is_config: true, ..Placed::new(config("gv3/rig.toml"), SIMULATED) });
        let (unit, folder) = if self.is_user { (USER_UNIT, "user") } else { (UNIT, "system") };
        if !self.is_user {
            files.push(Placed::new(config(&format!("udev/rules.d/{RULES_NAME}")), RULES));
            files.push(Placed::new(config("sysusers.d/gv3.conf"), SYSUSERS));
        }
        files.push(Placed::new(config(&format!("systemd/{folder}/gv3.service")), unit.replace(BINARY, named)));
        Ok(files)
    }
}

/// Whether a unit file takes a character as it is.
fn is_plain(c: char) -> bool {
    c.is_alphanumeric() || "/._-+".contains(c)
}
