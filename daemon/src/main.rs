//! `gv3`, the command.

fn main() -> std::process::ExitCode {
    gv3::cli::main()
}
