//! The command line: one binary, one file a command.
//!
//! A command returns its report as text or JSON; exit code 0 for done, 1 for failed, 2 for wrong usage.

mod accuracy;
mod bench;
mod calibrate;
mod calibrate_gamma;
mod capture;
mod ctl;
mod decode;
mod demo;
mod devices;
mod doctor;
mod encode;
mod flatten;
mod info;
mod install;
mod install_udev;
mod manual;
mod measure;
mod patterns;
mod progress;
mod raw;
mod reconstruct;
mod recover;
mod serve;
mod sweep;
mod verify;
mod virtual_scanner;

use anyhow::Result;
use clap::{Parser, Subcommand};
use std::io::Write;
use std::process::ExitCode;
use tracing_subscriber::EnvFilter;

/// Capture, code, replay and measure scans of structured-light 3D scanners.
#[derive(Debug, Parser)]
#[command(
    name = "gv3",
    version,
    arg_required_else_help = true,
    after_help = "Begin with `gv3 demo`: it needs no hardware."
)]
struct Arguments {
    /// More messages on standard error; RUST_LOG overrides it.
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    verbose: u8,
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Demo(demo::Demo),
    Devices(devices::Devices),
    Doctor(doctor::Doctor),
    Calibrate(calibrate::Calibrate),
    Capture(capture::Capture),
    Serve(serve::Serve),
    Ctl(ctl::Ctl),
    Encode(encode::Encode),
    Decode(decode::Decode),
    Info(info::Info),
    Verify(verify::Verify),
    Reconstruct(reconstruct::Reconstruct),
    Recover(recover::Recover),
    Measure(measure::Measure),
    Sweep(sweep::Sweep),
    Patterns(patterns::Patterns),
    CalibrateGamma(calibrate_gamma::CalibrateGamma),
    Flatten(flatten::Flatten),
    ExportRaw(raw::ExportRaw),
    Accuracy(accuracy::Accuracy),
    Bench(bench::Bench),
    VirtualScanner(virtual_scanner::VirtualScannerCommand),
    Install(install::Install),
    Uninstall(install::Uninstall),
    InstallUdev(install_udev::InstallUdev),
    Man(manual::Man),
    Completions(manual::Completions),
}

/// What a command prints on standard output and whether it found a fault.
#[derive(Debug)]
struct Outcome {
    report: String,
    is_fault: bool,
}

impl Outcome {
    fn done(report: impl Into<String>) -> Self {
        Self { report: report.into(), is_fault: false }
    }

    /// The text, or the value as one JSON object.
    fn of(json: bool, value: &impl serde::Serialize, text: impl FnOnce() -> String) -> Result<Self> {
        Ok(Self::done(if json { serde_json::to_string_pretty(value)? } else { text() }))
    }
}

/// Runs the command that the arguments name.
pub fn main() -> ExitCode {
    let arguments = Arguments::parse();
    start_log(&arguments);
    let outcome = match arguments.command {
        Command::Demo(c) => c.run(),
        Command::Devices(c) => c.run(),
        Command::Doctor(c) => c.run(),
        Command::Calibrate(c) => c.run(),
        Command::Capture(c) => c.run(),
        Command::Serve(c) => c.run(),
        Command::Ctl(c) => c.run(),
        Command::Encode(c) => c.run(),
        Command::Decode(c) => c.run(),
        Command::Info(c) => c.run(),
        Command::Verify(c) => c.run(),
        Command::Reconstruct(c) => c.run(),
        Command::Recover(c) => c.run(),
        Command::Measure(c) => c.run(),
        Command::Sweep(c) => c.run(),
        Command::Patterns(c) => c.run(),
        Command::CalibrateGamma(c) => c.run(),
        Command::Flatten(c) => c.run(),
        Command::ExportRaw(c) => c.run(),
        Command::Accuracy(c) => c.run(),
        Command::Bench(c) => c.run(),
        Command::VirtualScanner(c) => c.run(),
        Command::Install(c) => c.run(),
        Command::Uninstall(c) => c.run(),
        Command::InstallUdev(c) => c.run(),
        Command::Man(c) => c.run(),
        Command::Completions(c) => c.run(),
    };
    match outcome {
        Ok(outcome) => {
            // A reader that has seen enough (`| head`) is no failure.
            let _ = writeln!(std::io::stdout(), "{}", outcome.report.trim_end());
            if outcome.is_fault { ExitCode::FAILURE } else { ExitCode::SUCCESS }
        }
        Err(error) => {
            eprintln!("gv3: {}", one_line(&error));
            ExitCode::FAILURE
        }
    }
}

/// Messages on standard error; a server says more of its own accord, and in JSON if asked.
fn start_log(arguments: &Arguments) {
    let (first, is_json) = match &arguments.command {
        Command::Serve(serve) => (1, serve.logs_json()),
        _ => (0, false),
    };
    let level = ["warn", "info", "debug", "trace"][(first + usize::from(arguments.verbose)).min(3)];
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(level));
    let log = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr);
    if is_json {
        log.json().init();
    } else {
        log.with_ansi(std::io::IsTerminal::is_terminal(&std::io::stderr())).init();
    }
}

/// An error and its causes, each said once: many of our errors quote the system's answer and have it as a cause too.
fn one_line(error: &anyhow::Error) -> String {
    let mut text = String::new();
    for cause in error.chain().map(ToString::to_string) {
        if !text.ends_with(&cause) {
            text += if text.is_empty() { "" } else { ": " };
            text += &cause;
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn arguments_are_consistent_and_every_command_shows_an_example() {
        let mut command = Arguments::command();
        command.build();
        command.clone().debug_assert();
        for sub in command.get_subcommands().filter(|s| s.get_name() != "help") {
            let help = sub.clone().render_long_help().to_string();
            assert!(help.contains("Example"), "{}", sub.get_name());
        }
    }
}
