//! The command line of Parallax, with one kind of node more.
//!
//! `cargo run --release -- sim graph.toml`, `… run graph.toml`, `… diagnose RECORDING`: all that `parallax` does, `--help` has it.

mod my_agent;

fn main() -> std::process::ExitCode {
    // The launcher starts this program again for every node of a run, so that each finds the kind.
    parallax::command_line(|kinds| kinds.with("my_agent", my_agent::kind()))
}
