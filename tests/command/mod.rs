//! The program as its users run it: in a folder, with arguments, to an exit code.

#![allow(dead_code, reason = "no test file needs all of it")]

use std::fs::File;
use std::io::{Read, Write};
use std::path::Path;
use std::process::{Command, Output, Stdio};

use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{Winsize, tcsetwinsize};
use serde_json::Value;

/// How many cases of each set `parallax withheld` shall make: of those that are named so many, of all others none.
pub(crate) fn counts(named: &[(&str, usize)]) -> Vec<String> {
    const SETS: [&str; 10] = [
        "singles",
        "nulls",
        "other-form",
        "pairs",
        "outside",
        "poor",
        "short",
        "leave-out",
        "rough",
        "rough-nulls",
    ];
    assert!(named.iter().all(|(set, _)| SETS.contains(set)), "a set that is none: {named:?}");
    let count = |set: &str| named.iter().find(|(name, _)| *name == set).map_or(0, |(_, count)| *count);
    SETS.iter().map(|set| format!("--{set}={}", count(set))).collect()
}

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

/// Answers questions on a terminal of its own; gives what was shown.
pub(crate) fn on_a_terminal(folder: &Path, arguments: &[&str], answers: &str) -> (bool, String) {
    let mut master = File::from(openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap());
    grantpt(&master).unwrap();
    unlockpt(&master).unwrap();
    let name = ptsname(&master, Vec::new()).unwrap();
    let flags = rustix::fs::OFlags::RDWR | rustix::fs::OFlags::NOCTTY;
    let slave = rustix::fs::open(name, flags, rustix::fs::Mode::empty()).unwrap();
    tcsetwinsize(&slave, Winsize { ws_row: 40, ws_col: 100, ws_xpixel: 0, ws_ypixel: 0 }).unwrap();
    let end = || Stdio::from(slave.try_clone().unwrap());
    let mut command = Command::new(env!("CARGO_BIN_EXE_parallax"));
    command.current_dir(folder).args(arguments).stdin(end()).stdout(end()).stderr(end()).env("TERM", "xterm");
    let mut child = command.spawn().unwrap();
    drop(command);
    drop(slave);
    master.write_all(answers.as_bytes()).unwrap();
    let mut shown = Vec::new();
    let mut bytes = [0; 4096];
    // It ends when the last end of the terminal is closed.
    while let Ok(count @ 1..) = master.read(&mut bytes) {
        shown.extend_from_slice(&bytes[..count]);
    }
    (child.wait().unwrap().success(), String::from_utf8_lossy(&shown).into_owned())
}
