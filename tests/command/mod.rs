//! The program as its users run it: in a folder, with arguments, to an exit code.

#![allow(dead_code, reason = "no test file needs all of it")]

use std::path::Path;
use std::process::{Command, Output};

use serde_json::Value;

/// Runs the program in `folder`.
pub(crate) fn parallax(folder: impl AsRef<Path>, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_parallax")).current_dir(folder).args(arguments).output().unwrap()
}

/// The command ends with this exit code; gives what it printed to the standard output and to that of errors.
#[track_caller]
pub(crate) fn ends(folder: impl AsRef<Path>, code: i32, arguments: &[&str]) -> (String, String) {
    let output = parallax(folder, arguments);
    let errors = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(code), "{arguments:?}: {errors}");
    assert!(!errors.contains("panicked"), "{errors}");
    (String::from_utf8(output.stdout).unwrap(), errors)
}

/// The command succeeds; gives what it printed.
#[track_caller]
pub(crate) fn succeed(folder: impl AsRef<Path>, arguments: &[&str]) -> String {
    ends(folder, 0, arguments).0
}

/// The command succeeds; gives the JSON that it printed.
#[track_caller]
pub(crate) fn json(folder: impl AsRef<Path>, arguments: &[&str]) -> Value {
    serde_json::from_str(&succeed(folder, arguments)).unwrap()
}

/// The command fails with this exit code, prints no answer, and says all of these.
#[track_caller]
pub(crate) fn fail(folder: impl AsRef<Path>, arguments: &[&str], code: i32, expected: &[&str]) {
    let (answer, errors) = ends(folder, code, arguments);
    assert!(answer.is_empty(), "{arguments:?} printed an answer: {answer}");
    for part in expected {
        assert!(errors.contains(part), "{arguments:?}: no `{part}` in: {errors}");
    }
}

/// Noise of standard deviation 1 that is the same on every run: a linear congruential generator (Knuth's MMIX), of which
/// twelve numbers make a normal one.
pub(crate) struct Noise(pub(crate) u64);

impl Noise {
    pub(crate) fn draw(&mut self) -> f64 {
        let mut uniform = || {
            self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (self.0 >> 11) as f64 / (1_u64 << 53) as f64
        };
        (0..12).map(|_| uniform()).sum::<f64>() - 6.0
    }
}
