//! The next experiment: which commands separate effects that a log cannot tell apart.
//!
//! [`design`] takes the fits of the candidates, tries the [library of inputs](inputs) on each command within its range,
//! and keeps the one under which the worst pair of candidates lies farthest apart ([`trial`]): after the calibrated
//! parameters and the candidates' own have followed, in units of the noise, and with what the log already knows of
//! them. Where no input does it, it takes the one that leaves the fewest of them together ([`Design::alike`]), and looks for
//! a [sensor](sensors) that would.
//!
//! The criterion is that of T-optimal designs for discrimination between models (Atkinson & Fedorov 1975), with nuisance
//! parameters taken out to first order.

mod apart;
mod bench;
pub mod inputs;
mod next;
pub mod sensors;
pub mod trial;

use std::fmt;
use std::str::FromStr;

use parallax_model::system::Suggestion;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::experiment::Held;
use crate::fit::TEMPERATURE;
use crate::search::Fit;
use crate::setup::Setup;
pub use next::{ProposeError, propose};

use apart::is_enough;
use bench::{Bench, Tried};
use sensors::Sensor;

/// −2 log evidence from which a pair counts as separated.
pub const DECISIVE: f64 = 20.0;

/// Candidates that are compared, at most: the first of a class.
const MOST_CANDIDATES: usize = 4;

/// Inputs that are tried with added sensors: the best without.
const WITH_SENSORS: usize = 3;

/// What the user asks of an experiment.
#[derive(Clone, Debug, Default)]
pub struct Wishes {
    /// How long it lasts (s); by default as long as the log, 20 s at most, but at least twenty horizons.
    pub duration: Option<f64>,
    /// Ranges of commands and outputs that replace those of the log.
    pub limits: Vec<Limit>,
    /// Seed of phases and switching times.
    pub seed: u64,
}

/// A range that a signal must not leave.
#[derive(Clone, Debug, PartialEq)]
pub struct Limit {
    /// A signal, or the name of an input or output.
    pub signal: String,
    /// Lowest value.
    pub low: f64,
    /// Highest value.
    pub high: f64,
}

impl FromStr for Limit {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let form = || "it must look like SIGNAL=LOW:HIGH, such as motor.voltage=-4:4".to_owned();
        let (signal, range) = text.rsplit_once('=').ok_or_else(form)?;
        let (low, high) = range.split_once(':').ok_or_else(form)?;
        let number = |text: &str| text.trim().parse::<f64>().ok().filter(|v| v.is_finite()).ok_or_else(form);
        let (low, high) = (number(low)?, number(high)?);
        if signal.is_empty() {
            return Err(form());
        }
        if low >= high {
            return Err(format!("the lower limit {low} must lie below the upper one {high}"));
        }
        Ok(Limit { signal: signal.into(), low, high })
    }
}

/// Why no experiment can be designed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum DesignError {
    /// A limit on nothing.
    #[error(
        "--limit {signal}: no command or output of the system is called that{suggestion} (there are: {known})"
    )]
    Limit {
        /// What was written.
        signal: String,
        /// What may have been meant.
        suggestion: Suggestion,
        /// All commands and outputs.
        known: String,
    },
    /// Shorter than what predictions are compared over.
    #[error(
        "an experiment of {duration} s is too short to tell anything apart; it must last {needed:.3} s at least, the horizon over which predictions are compared"
    )]
    Brief {
        /// How long it was to last (s).
        duration: f64,
        /// The horizon (s).
        needed: f64,
    },
    /// Fewer than two candidates.
    #[error("there is nothing to tell apart: an experiment needs at least two candidates")]
    Alone,
    /// No command can be chosen.
    #[error(
        "the system has no command that can be chosen: every input is bound to a signal of role context, or never changed in the log; give its range with --limit SIGNAL=LOW:HIGH"
    )]
    NoCommand,
    /// Every input drives the system out of its range.
    #[error(
        "every input of the library takes the simulated system out of its range within {duration:.3} s ({reason}); widen the range with --limit SIGNAL=LOW:HIGH, shorten --duration, or state the controller in the system and choose its reference"
    )]
    Range {
        /// How long (s).
        duration: f64,
        /// What left which range.
        reason: String,
    },
}

/// A command over time.
#[derive(Clone, Debug, PartialEq)]
pub struct Command {
    /// Index of the input.
    pub input: usize,
    /// The recorded signal to which the input is bound.
    pub signal: String,
    /// Its unit, a label.
    pub unit: String,
    /// Its values.
    pub held: Held,
}

/// A proposed experiment.
#[derive(Clone, Debug, PartialEq)]
pub struct Design {
    /// The candidates it is made for.
    pub effects: Vec<String>,
    /// How long it lasts (s).
    pub duration: f64,
    /// What to command.
    pub commands: Vec<Command>,
    /// The commands in words.
    pub description: String,
    /// A sensor without which the candidates, or those of them that it leaves [alike](Design::alike), stay so.
    pub sensor: Option<String>,
    /// The pair that lies nearest.
    pub pair: (String, String),
    /// Separation of that pair, in noise units.
    pub separation: f64,
    /// Candidates that stay alike all the same, where it separates others; the nearest pair is one of those that it separates.
    pub alike: Vec<Vec<String>>,
    /// Smallest and largest value that a candidate predicts for each output: name, low, high.
    pub reach: Vec<(String, f64, f64)>,
}

/// What a design promises, as the report states it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Promise {
    /// The commands in words.
    pub input: String,
    /// How long they last (s).
    pub duration_s: f64,
    /// A sensor without which the candidates, or those of them that it leaves alike, stay so.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sensor: Option<String>,
    /// Log evidence to be expected for the truth against the nearest other candidate.
    pub log_evidence: f64,
    /// Probability of a correct decision between these two.
    pub probability: f64,
    /// Whether that is enough to tell all of them apart.
    pub separates: bool,
    /// Candidates that stay alike all the same, where it separates others.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub alike: Vec<Vec<String>>,
}

impl Design {
    /// Log evidence to be expected for the truth against the nearest other candidate.
    #[must_use]
    pub fn log_evidence(&self) -> f64 {
        0.5 * self.separation * self.separation
    }

    /// Probability of a correct decision between the nearest pair: Φ(δ/2), with δ² tempered as the posterior is.
    #[must_use]
    pub fn probability(&self) -> f64 {
        parallax_runtime::delay::special::normal_cdf(0.5 * self.separation / TEMPERATURE.sqrt())
    }

    /// Whether the evidence to be expected tells every pair apart.
    #[must_use]
    pub fn separates(&self) -> bool {
        self.narrows() && self.alike.is_empty()
    }

    /// Whether the evidence to be expected tells some of them apart.
    #[must_use]
    pub fn narrows(&self) -> bool {
        is_enough(self.separation)
    }

    /// For the report.
    #[must_use]
    pub fn promise(&self) -> Promise {
        Promise {
            input: self.description.clone(),
            duration_s: self.duration,
            sensor: self.sensor.clone(),
            log_evidence: self.log_evidence(),
            probability: self.probability(),
            separates: self.separates(),
            alike: self.alike.clone(),
        }
    }
}

impl fmt::Display for Design {
    /// One line: what to do, and what to expect.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let percent = (100.0 * self.probability()).min(99.9);
        let expected =
            format!("right in {percent:.1} % of cases, log evidence {:.1} expected", self.log_evidence());
        if !self.alike.is_empty() {
            let alike: Vec<String> = self.alike.iter().map(|group| group.join(" and ")).collect();
            write!(f, "{} ({expected}), which leaves {} alike", self.description, alike.join(", and "))?;
            return match &self.sensor {
                Some(sensor) => write!(f, "; with {sensor} one would tell all of them apart"),
                None => Ok(()),
            };
        }
        match &self.sensor {
            None if self.separates() => write!(f, "{} ({expected})", self.description),
            None => write!(
                f,
                "impossible with these sensors and ranges, and with any one more of a state or input; the best is {} ({expected})",
                self.description
            ),
            Some(sensor) => write!(
                f,
                "impossible with these sensors; add {sensor}, then {} ({expected})",
                self.description
            ),
        }
    }
}

/// Designs the experiment that separates the candidates' worst pair most.
///
/// # Errors
///
/// [`DesignError`] when there are fewer than two candidates, no command to choose, or no input within the ranges.
pub fn design(
    setup: &Setup,
    null: &Fit,
    candidates: &[&Fit],
    wishes: &Wishes,
) -> Result<Design, DesignError> {
    let candidates = &candidates[..candidates.len().min(MOST_CANDIDATES)];
    if candidates.len() < 2 {
        return Err(DesignError::Alone);
    }
    if let Some(duration) = wishes.duration.filter(|duration| *duration < setup.horizon) {
        return Err(DesignError::Brief { duration, needed: setup.horizon });
    }
    let bench = Bench::new(setup, null, candidates, wishes)?;
    let mut tried: Vec<Tried> =
        bench.proposals().into_par_iter().filter_map(|p| bench.try_alone(p)).collect();
    let best_first = |tried: &mut Vec<Tried>| {
        tried.sort_by(|a, b| score(b).total_cmp(&score(a)).then(a.order.cmp(&b.order)));
    };
    best_first(&mut tried);
    // Halves of two good inputs of different kinds: what one pair lacks, another input may show.
    let better = bench.halves(&tried).into_par_iter().filter_map(|p| bench.try_alone(p));
    tried.extend(better.collect::<Vec<_>>());
    best_first(&mut tried);
    let Some(best) = tried.first() else {
        return Err(DesignError::Range { duration: bench.frame.duration, reason: bench.reason() });
    };
    if best.apart.all() {
        return Ok(bench.conclude(best, None));
    }
    let with: Vec<(Sensor, Tried)> = sensors::missing(setup)
        .into_par_iter()
        .filter_map(|sensor| {
            let tried = tried.iter().take(WITH_SENSORS).filter_map(|t| bench.try_with(t, &sensor));
            let best = tried.max_by(|a, b| score(a).total_cmp(&score(b)))?;
            Some((sensor, best))
        })
        .collect();
    // Of sensors that do it equally well the first in the file's order.
    let enough = with.iter().filter(|(_, tried)| tried.apart.all());
    let leader = enough.reduce(|a, b| if score(&b.1) > 1.5 * score(&a.1) { b } else { a });
    Ok(match (most_groups(&tried), leader) {
        (Some(narrowing), leader) => bench.conclude(narrowing, leader.map(|(sensor, _)| sensor)),
        (None, Some((sensor, tried))) => bench.conclude(tried, Some(sensor)),
        (None, None) => bench.conclude(best, None),
    })
}

/// Separation of the nearest pair.
fn score(tried: &Tried) -> f64 {
    tried.apart.worst().1
}

/// The first of those that leave the most groups, the one that keeps them farthest apart; none where nothing is separated.
fn most_groups(tried: &[Tried]) -> Option<&Tried> {
    let parts = |t: &Tried| {
        let groups = t.apart.groups();
        (groups.len(), t.apart.between(&groups).1)
    };
    let narrowing = tried.iter().rev().filter(|t| parts(t).0 > 1);
    narrowing.max_by(|a, b| parts(a).0.cmp(&parts(b).0).then(parts(a).1.total_cmp(&parts(b).1)))
}

/// Three digits.
fn short(value: f64) -> String {
    if value == 0.0 {
        return "0".into();
    }
    let digits = (2 - value.abs().log10().floor() as i32).clamp(0, 6) as usize;
    let text = format!("{value:.digits$}");
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').into() } else { text }
}
