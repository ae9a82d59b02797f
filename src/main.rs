//! The command line `parallax`.

fn main() -> std::process::ExitCode {
    parallax::command_line(|kinds| kinds)
}
