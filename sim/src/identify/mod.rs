//! Identification: parameters, first states and hidden delays, from recordings.
//!
//! The recorded actions are replayed through the recording's computation graph, in which simulators take the place of what
//! no node records (van der Heijden et al., "REX", section 3.3). What they predict is compared with what was recorded, and
//! a solver of [`parallax_model::fit`] moves the unknown numbers until it fits: whole populations run on the lanes and the
//! cores of the processor, derivatives are differences of neighbours on lanes while it searches, and exact ones, of the same
//! models on dual numbers, where it ends and for Levenberg and Marquardt's method alone. Coefficients that enter
//! linearly (a sensor's scale and offset, the map from an angle to a pixel) are solved for at every point, not searched.
//!
//! [`Specification`] says what is looked for, [`Problem`] binds it to recordings, [`identify`] finds it, and
//! [`Identified`] tells the estimates with their uncertainties, what the data cannot tell apart, and the error on time that
//! no fit has seen.
//!
//! A hidden delay between a sensor and the world lets the sensor see what lies between two messages; one between an
//! actuator and a simulator brings each command later, and a simulator that integrates to the stamps of its commands
//! feels every microsecond of it. Where a model only takes the newest message at every tick, its delays are found to
//! within a tick.

mod apply;
mod around;
mod combination;
mod coordinate;
mod error;
mod evaluate;
mod humps;
mod identified;
mod location;
mod outcome;
mod problem;
mod simulators;
mod spec;
mod spread;

use std::ops::ControlFlow;

use parallax_model::fit::{
    Ask, Best, Bounds, CmaEs, CmaOptions, CrossEntropy, CrossEntropyOptions, Hybrid, HybridOptions,
    LevenbergMarquardt, MarquardtOptions, Solver, Stop, Tell,
};
use parallax_runtime::recording::Recording;
use parallax_runtime::registry::Registry;
use serde::{Deserialize, Serialize};

pub use apply::identified_graph;
pub use combination::Combination;
pub use coordinate::Sort;
pub use error::IdentifyError;
pub use evaluate::Evaluator;
pub use identified::{Estimate, Hump, Humps, Identified, Known, Reconstruction, Score, Series};
pub use location::{Location, Moment};
pub use problem::Problem;
pub use spec::{
    HiddenDelay, Output, Prior, Scatter, Simulated, Specification, Target, Term, Transform, Unknown,
};

/// How to search.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "method", rename_all = "kebab-case")]
pub enum Method {
    /// A short evolution, then Gauss–Newton on more and more of the data: the default.
    Hybrid(HybridOptions),
    /// CMA-ES alone.
    CmaEs(CmaOptions),
    /// The cross-entropy method alone.
    CrossEntropy(CrossEntropyOptions),
    /// Levenberg and Marquardt's method from the start values alone.
    LevenbergMarquardt(MarquardtOptions),
}

impl Default for Method {
    fn default() -> Self {
        Method::Hybrid(HybridOptions::default())
    }
}

/// A search under way.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Search {
    Hybrid(Box<Hybrid>),
    CmaEs(Box<CmaEs>),
    CrossEntropy(Box<CrossEntropy>),
    LevenbergMarquardt(Box<LevenbergMarquardt>),
}

impl Search {
    fn new(method: &Method, problem: &Problem, pieces: usize) -> Result<Self, IdentifyError> {
        let start = &problem.start();
        let bounds = Bounds::unit(start.len());
        Ok(match method {
            Method::Hybrid(options) => {
                let target = options.target.or(problem.noise_floor());
                // What delays that scatter leave is not known: two rounds say more.
                let alike = options.alike.or((!problem.scattered.is_empty()).then_some(2));
                // By a delay a message comes in time for a step, or not: there the loss jumps.
                let delays = problem.coordinates.iter().enumerate().filter(|(_, c)| c.sort == Sort::Delay);
                let swept = match options.swept.is_empty() {
                    true => delays.map(|(index, _)| index).collect(),
                    false => options.swept.clone(),
                };
                let options = HybridOptions {
                    target,
                    alike,
                    swept,
                    pieces: options.pieces.or(Some(pieces)),
                    ..options.clone()
                };
                Search::Hybrid(Box::new(Hybrid::new(bounds, start, options)?))
            }
            Method::CmaEs(options) => Search::CmaEs(Box::new(CmaEs::new(bounds, start, options.clone())?)),
            Method::CrossEntropy(options) => {
                Search::CrossEntropy(Box::new(CrossEntropy::new(bounds, start, options.clone())?))
            }
            Method::LevenbergMarquardt(options) => {
                let starts = [start.to_vec()];
                Search::LevenbergMarquardt(Box::new(LevenbergMarquardt::new(
                    bounds,
                    &starts,
                    options.clone(),
                )?))
            }
        })
    }

    fn solver(&mut self) -> &mut dyn Solver {
        match self {
            Search::Hybrid(solver) => &mut **solver,
            Search::CmaEs(solver) => &mut **solver,
            Search::CrossEntropy(solver) => &mut **solver,
            Search::LevenbergMarquardt(solver) => &mut **solver,
        }
    }
}

/// A search that can be written down and taken up again.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Checkpoint {
    /// What it is a search of.
    problem: String,
    search: Search,
    rollouts: u64,
}

/// How far a search is.
#[derive(Debug)]
pub struct Progress<'a> {
    /// From 0 to 1, as far as it can say.
    pub share: f64,
    /// The least loss so far.
    pub best: Option<f64>,
    /// Rollouts so far.
    pub rollouts: u64,
    /// To be taken up again from here.
    pub checkpoint: &'a Checkpoint,
}

/// Searches for what a problem asks for. `each` is told after every step how far it is, and may stop the search, which then
/// ends with the best so far. `resume` takes up a search of the same problem where it was.
///
/// # Errors
///
/// [`IdentifyError`] when the problem cannot run, the checkpoint is of another one, or nothing finite was found.
pub fn search(
    problem: &Problem,
    method: &Method,
    resume: Option<Checkpoint>,
    each: &mut dyn FnMut(&Progress<'_>) -> ControlFlow<()>,
) -> Result<Identified, IdentifyError> {
    let evaluator = Evaluator::new(problem)?;
    let name = problem.fingerprint();
    let mut state = match resume {
        Some(checkpoint) if checkpoint.problem == name => checkpoint,
        Some(_) => {
            let problem = "parameters, bounds or data differ".to_owned();
            return Err(IdentifyError::Checkpoint { problem });
        }
        None => {
            let search = Search::new(method, problem, evaluator.pieces())?;
            Checkpoint { problem: name, search, rollouts: 0 }
        }
    };
    let directions = (problem.coordinates.len() + 1) * problem.episodes;
    let mut best: Option<Best> = None;
    let stop: Option<Stop> = loop {
        let answer = match state.search.solver().ask() {
            Ask::Losses { points, view, single } => {
                state.rollouts += (points.len() * problem.episodes) as u64;
                Tell::Losses(match single {
                    true => evaluator.rough_losses(&points, view)?,
                    false => evaluator.losses(&points, view)?,
                })
            }
            Ask::Locals { points, view } => {
                state.rollouts += (points.len() * directions) as u64;
                match state.search {
                    Search::LevenbergMarquardt(_) => {
                        Tell::Locals(evaluator.exact_locals(&points, view.share)?)
                    }
                    _ => Tell::Locals(evaluator.locals(&points, view)?),
                }
            }
            Ask::States { points, view } => {
                state.rollouts += (points.len() * problem.episodes) as u64;
                Tell::States(evaluator.states(&points, view)?)
            }
            Ask::Done(stop) => break Some(stop),
        };
        state.search.solver().tell(answer);
        let solver = state.search.solver();
        best = solver.best().cloned();
        let share = solver.progress();
        let progress = Progress {
            share,
            best: best.as_ref().map(|best| best.loss),
            rollouts: state.rollouts,
            checkpoint: &state,
        };
        if each(&progress).is_break() {
            break None;
        }
    };
    if stop.is_some() {
        best = state.search.solver().best().cloned();
    }
    match (&best, stop) {
        (Some(best), stop) => outcome::outcome(problem, &evaluator, best, stop, state.rollouts),
        (None, None) => Err(IdentifyError::Stopped),
        (None, Some(_)) => Err(IdentifyError::NotFinite),
    }
}

/// Longest a delay without an upper bound may become, s.
const LONGEST: f64 = 2.0;

/// Binds a specification to recordings and searches, without a word in between. A delay without an upper bound whose
/// estimate comes near the longest that was looked for is looked for again, twice as long.
///
/// # Errors
///
/// As [`Problem::new`] and [`search`].
pub fn identify(
    recordings: &[Recording],
    registry: &Registry,
    specification: &Specification,
    method: &Method,
    each: &mut dyn FnMut(&Progress<'_>) -> ControlFlow<()>,
) -> Result<(Problem, Identified), IdentifyError> {
    let mut specification = specification.clone();
    let open: Vec<bool> = specification.delays.iter().map(|delay| delay.max.is_none()).collect();
    loop {
        let problem = Problem::new(recordings, registry, &specification)?;
        let found = search(&problem, method, None, each)?;
        let mut widened = false;
        for (delay, open) in specification.delays.iter_mut().zip(&open) {
            let max = simulators::longest(delay);
            let near = found.estimate(&delay.name).is_some_and(|found| found.value > 0.8 * max);
            // What is not determined goes anywhere: no reason to look further.
            let in_a_sum =
                |c: &Combination| !c.product && c.factors.iter().any(|(name, _)| *name == delay.name);
            let told = found.estimate(&delay.name).is_some_and(|found| found.std.is_some())
                || found.combinations.iter().any(in_a_sum);
            if *open && near && told && max < LONGEST && found.stop.is_some() {
                delay.max = Some(2.0 * max);
                widened = true;
            }
        }
        if !widened {
            return Ok((problem, found));
        }
    }
}
