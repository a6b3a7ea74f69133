//! `gv3 man` and `gv3 completions`: the command line, as man pages and for shells.

use super::Outcome;
use super::install::placed::Placed;
use anyhow::{Context, Result};
use clap::{Args, Command, CommandFactory};
use clap_complete::Shell;
use std::path::PathBuf;

/// Shells with the places, below `share`, where they look for completions.
pub(super) const COMPLETIONS: [(Shell, &str); 3] = [
    (Shell::Bash, "bash-completion/completions/gv3"),
    (Shell::Zsh, "zsh/site-functions/_gv3"),
    (Shell::Fish, "fish/vendor_completions.d/gv3.fish"),
];

/// Write the man pages of all commands into a folder.
#[derive(Debug, Args)]
#[command(after_help = "Example:\n  gv3 man pages && man -l pages/gv3-serve.1")]
pub struct Man {
    /// Folder; made if it is missing.
    folder: PathBuf,
}

impl Man {
    pub(super) fn run(self) -> Result<Outcome> {
        std::fs::create_dir_all(&self.folder).with_context(|| self.folder.display().to_string())?;
        let pages = man_pages()?;
        for (name, page) in &pages {
            Placed::new(self.folder.join(name), page.as_slice()).put("gv3 man DIR")?;
        }
        Ok(Outcome::done(format!("{}: {} pages", self.folder.display(), pages.len())))
    }
}

/// Print what has a shell complete the commands and options of gv3.
#[derive(Debug, Args)]
#[command(
    after_help = "Examples:\n  source <(gv3 completions bash)\n  gv3 completions fish > ~/.config/fish/completions/gv3.fish"
)]
pub struct Completions {
    shell: Shell,
}

impl Completions {
    pub(super) fn run(self) -> Result<Outcome> {
        Ok(Outcome::done(String::from_utf8(completions(self.shell))?))
    }
}

/// What a shell reads.
pub(super) fn completions(shell: Shell) -> Vec<u8> {
    let mut text = Vec::new();
    clap_complete::generate(shell, &mut super::Arguments::command(), "gv3", &mut text);
    text
}

/// Names and texts of the man pages, one a command.
pub(super) fn man_pages() -> Result<Vec<(String, Vec<u8>)>> {
    let mut command = super::Arguments::command().disable_help_subcommand(true);
    command.build();
    let mut pages = Vec::new();
    add_pages(&command, &mut pages)?;
    Ok(pages)
}

fn add_pages(command: &Command, pages: &mut Vec<(String, Vec<u8>)>) -> Result<()> {
    let man = clap_mangen::Man::new(command.clone());
    let mut page = Vec::new();
    man.render(&mut page)?;
    pages.push((man.get_filename(), page));
    let mut subcommands = command.get_subcommands().filter(|sub| sub.get_name() != "help");
    subcommands.try_for_each(|sub| add_pages(sub, pages))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_command_has_a_page_and_every_shell_its_completions() {
        let pages = man_pages().unwrap();
        let page = |name: &str| {
            let found = pages.iter().find(|(n, _)| n == name);
            String::from_utf8(found.unwrap_or_else(|| panic!("{name} is missing")).1.clone()).unwrap()
        };
        for sub in super::super::Arguments::command().get_subcommands() {
            page(&format!("gv3-{}.1", sub.get_name()));
        }
        assert!(!pages.iter().any(|(name, _)| name.contains("help")));
        assert!(page("gv3.1").contains(".TH gv3 1"));
        assert!(page("gv3-serve.1").contains("\\-\\-token\\-file"));
        assert!(page("gv3-bench-live.1").contains("gv3 bench live"));
        for (shell, _) in COMPLETIONS {
            let text = String::from_utf8(completions(shell)).unwrap();
            assert!(text.contains("serve") && text.contains("token-file"), "{shell}");
        }
    }
}
