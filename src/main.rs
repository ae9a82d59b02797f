//! The command line `parallax`.
fn main() {}
