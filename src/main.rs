//! The command line `parallax`.

mod cli;
mod plot;

fn main() -> std::process::ExitCode {
    cli::main()
}
