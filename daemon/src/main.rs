//! `gv3`, the command.
fn main() {}
