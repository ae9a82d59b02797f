//! Why a diagnosis could not be made, each with what to do.

use crate::bind::BindError;
use crate::options::OptionsError;

/// Why a diagnosis could not be made.
#[derive(Debug, thiserror::Error)]
pub enum DiagnosisError {
    /// System and recording do not fit.
    #[error(transparent)]
    Bind(#[from] BindError),
    /// A choice of effects that this system cannot follow.
    #[error(transparent)]
    Options(#[from] OptionsError),
    /// The log is too short for the windows.
    #[error(
        "recording `{title}` spans {span:.3} s; windows of {horizon:.3} s need at least {needed:.3} s. Record longer, or shorten the horizon"
    )]
    Short {
        /// The recording.
        title: String,
        /// Its length (s).
        span: f64,
        /// The window (s).
        horizon: f64,
        /// What is needed (s).
        needed: f64,
    },
    /// A horizon that holds nothing to predict.
    #[error(
        "a horizon of {horizon} s is too short for recording `{title}`, whose readings come every {period:.4} s; it must hold two of them at least"
    )]
    Horizon {
        /// The recording.
        title: String,
        /// The horizon (s).
        horizon: f64,
        /// Time between readings of the fastest output (s).
        period: f64,
    },
    /// No sensor shows anything.
    #[error(
        "recording `{title}`: every output reads the same value throughout, so there is nothing to explain; record while the machine moves, or check the columns that the signals name"
    )]
    Still {
        /// The recording.
        title: String,
    },
    /// More than the fits are made for.
    #[error(
        "{file}: {states} states and {calibrated} calibrated parameters are more than the {most} that one diagnosis fits; hold some parameters, or diagnose the machine joint by joint"
    )]
    TooMany {
        /// The system's file.
        file: String,
        /// States of the system.
        states: usize,
        /// Parameters with `calibrate`.
        calibrated: usize,
        /// Most of both together.
        most: usize,
    },
    /// Stopped before anything was found.
    #[error("the diagnosis was interrupted before any effect was weighed; there is nothing to report")]
    Stopped,
    /// The nominal model cannot be run along the log.
    #[error(
        "{file}: the nominal system gives numbers that are not finite along recording `{title}`; check its equations and initial values against the log's range"
    )]
    NotFinite {
        /// The system's file.
        file: String,
        /// The recording.
        title: String,
    },
}
