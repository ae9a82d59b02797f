//! How a command ends, and what the exit code says about it.

use std::error::Error;
use std::process::ExitCode;

/// How a command ended, if nothing failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Outcome {
    /// It did what it was asked.
    Done,
    /// It did, and the answer is no.
    Negative,
    /// Somebody stopped it.
    Interrupted,
}

impl From<Outcome> for ExitCode {
    fn from(outcome: Outcome) -> Self {
        match outcome {
            Outcome::Done => ExitCode::SUCCESS,
            Outcome::Negative => ExitCode::from(1),
            Outcome::Interrupted => ExitCode::from(130),
        }
    }
}

/// Why a command could not do what it was asked.
#[derive(Debug)]
pub(crate) struct Failure {
    code: u8,
    error: anyhow::Error,
}

impl Failure {
    /// What the user gave cannot be used.
    pub(crate) fn input(error: impl Into<anyhow::Error>) -> Self {
        Self { code: 2, error: error.into() }
    }

    /// The input was right and something else went wrong.
    pub(crate) fn runtime(error: impl Into<anyhow::Error>) -> Self {
        Self { code: 3, error: error.into() }
    }

    /// Somebody stopped it before there was anything to show.
    pub(crate) fn interrupted(error: impl Into<anyhow::Error>) -> Self {
        Self { code: 130, error: error.into() }
    }

    /// Prints the error and its causes, and gives the exit code.
    pub(crate) fn report(&self) -> ExitCode {
        eprintln!("error: {}", describe(&self.error));
        ExitCode::from(self.code)
    }
}

/// An error and its causes, each on a line; one that the line above says already is left out.
fn describe(error: &anyhow::Error) -> String {
    let mut text = error.to_string();
    for cause in error.chain().skip(1) {
        let cause = cause.to_string();
        if !text.contains(&cause) {
            text.push_str("\n  caused by: ");
            text.push_str(&cause);
        }
    }
    text
}

/// Sorts errors into those of the input and those of the run.
pub(crate) trait Sort<T> {
    /// The error is the input's.
    fn input(self) -> Result<T, Failure>;
    /// The error is the run's.
    fn runtime(self) -> Result<T, Failure>;
}

impl<T, E: Error + Send + Sync + 'static> Sort<T> for Result<T, E> {
    fn input(self) -> Result<T, Failure> {
        self.map_err(Failure::input)
    }

    fn runtime(self) -> Result<T, Failure> {
        self.map_err(Failure::runtime)
    }
}
