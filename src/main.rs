//! The command line `parallax`.

mod cli;

fn main() -> std::process::ExitCode {
    cli::main()
}
