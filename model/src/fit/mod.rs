//! Fits: from losses and their derivatives to parameters. Pure mathematics, without a clock and without I/O.
//!
//! A [`Solver`] asks and is told: it names points, whoever holds the model evaluates them (on lanes, on cores, on an
//! accelerator, on a machine far away) and tells the losses. So any batch evaluator works with any solver, and a fit can
//! be stopped, written down with `serde` and taken up again between any two questions.
//!
//! - [`CmaEs`]: evolution of a normal distribution with full covariance, in boxes, with restarts.
//! - [`CrossEntropy`]: the same idea with a diagonal covariance and an elite.
//! - [`LevenbergMarquardt`]: damped Gauss–Newton on exact derivatives ([`Local`]), from several starts side by side.
//! - [`Hybrid`], the default: a short evolution, then Gauss–Newton on more and more of the data, or on all of them in
//!   pieces (multiple shooting).
//!
//! What enters linearly is not searched for: [`separable`] eliminates it.
//!
//! Randomness comes from ChaCha streams that are named by seed, restart and generation: the same seed gives the same
//! bits, however many threads evaluate.
//!
//! ```
//! use parallax_model::fit::{Bounds, CmaEs, CmaOptions, minimise};
//!
//! // Rosenbrock's valley, with its minimum at (1, 1).
//! let loss = |x: &[f64]| 100.0 * (x[1] - x[0] * x[0]).powi(2) + (1.0 - x[0]).powi(2);
//! let bounds = Bounds::new(vec![-2.0; 2], vec![2.0; 2])?;
//! let mut solver = CmaEs::new(bounds, &[-1.0, 1.0], CmaOptions::default())?;
//! let best = minimise(&mut solver, |points| points.iter().map(|x| loss(x)).collect());
//! assert!(best.is_some_and(|best| best.loss < 1e-10));
//! # Ok::<(), parallax_model::fit::FitError>(())
//! ```

mod bounds;
mod cma;
mod cross_entropy;
mod hybrid;
mod local;
mod marquardt;
mod normal;
pub mod separable;
mod sweep;

use serde::{Deserialize, Serialize};

pub use bounds::Bounds;
pub use cma::{CmaEs, CmaOptions};
pub use cross_entropy::{CrossEntropy, CrossEntropyOptions};
pub use hybrid::{Hybrid, HybridOptions};
pub use local::{Local, bounded_step};
pub use marquardt::{LevenbergMarquardt, MarquardtOptions};

/// Why a solver cannot start.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum FitError {
    /// Two lists differ in length.
    #[error("{found} {what}, expected {expected}")]
    Count {
        /// Of what.
        what: &'static str,
        /// How many there are.
        found: usize,
        /// How many there should be.
        expected: usize,
    },
    /// A bound is not possible.
    #[error("parameter {index} has the bounds {low} and {high}; the lower one has to be below the other")]
    Bounds {
        /// The parameter.
        index: usize,
        /// The lower bound.
        low: f64,
        /// The upper bound.
        high: f64,
    },
    /// A start is not a number.
    #[error("parameter {index} starts at {value}, which is no finite number")]
    Start {
        /// The parameter.
        index: usize,
        /// Its value.
        value: f64,
    },
    /// An option is not possible.
    #[error("`{name}` is {value}: {problem}")]
    Option {
        /// The option.
        name: &'static str,
        /// Its value.
        value: f64,
        /// What it has to be.
        problem: &'static str,
    },
}

/// Which data count, and how they are looked at.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct View {
    /// How much of the data counts, above 0 and up to 1: the beginning of every recording. Who has no data to leave out takes
    /// all. In pieces all of them count; then it is the share that a point fits that has no states yet.
    pub share: f64,
    /// Into how many pieces all of the data are cut; 1: not at all. Every piece begins in a state of its own (multiple
    /// shooting), whose numbers follow those of a point, piece by piece.
    pub pieces: usize,
    /// How much it costs that a piece does not begin where the one before ends, for each number of the state: the
    /// inverse of a standard deviation, in the units of [`Ask::States`].
    pub tightness: f64,
}

impl View {
    /// The beginning of the data in one piece.
    #[must_use]
    pub fn whole(share: f64) -> Self {
        Self { share, pieces: 1, tightness: 0.0 }
    }
}

/// What a solver wants to know next.
#[derive(Debug, Clone, PartialEq)]
pub enum Ask {
    /// The losses at these points.
    Losses {
        /// The points.
        points: Vec<Vec<f64>>,
        /// The data that count.
        view: View,
        /// Whether single precision will do: they are only ranked.
        single: bool,
    },
    /// The losses with their Gauss–Newton models.
    Locals {
        /// The points.
        points: Vec<Vec<f64>>,
        /// The data that count.
        view: View,
    },
    /// The points with the states in which pieces begin, each number in units of its spread: such that the pieces fit the data
    /// and hold together, as far as can be seen at once.
    States {
        /// The points, without states.
        points: Vec<Vec<f64>>,
        /// The data, and how they are cut.
        view: View,
    },
    /// Nothing: it has ended.
    Done(Stop),
}

/// What a solver is told.
#[derive(Debug, Clone, PartialEq)]
pub enum Tell {
    /// The losses of the points asked for. What is not finite counts as worse than everything.
    Losses(Vec<f64>),
    /// Their Gauss–Newton models.
    Locals(Vec<Local>),
    /// The points with states at the cuts.
    States(Vec<Vec<f64>>),
}

/// Why a solver ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Stop {
    /// Further steps promise nothing.
    Converged,
    /// The loss aimed at was reached.
    Target,
    /// All generations or iterations are used up.
    Budget,
    /// Nothing that was evaluated was finite.
    Failed,
}

/// A point and its loss, over all of the data.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Best {
    /// The point.
    pub point: Vec<f64>,
    /// Its loss.
    pub loss: f64,
}

impl Best {
    /// Takes the better one of what is held and a new one. What is not finite is not held.
    pub fn keep(held: &mut Option<Best>, point: &[f64], loss: f64) {
        if loss.is_finite() && held.as_ref().is_none_or(|best| loss < best.loss) {
            *held = Some(Best { point: point.to_vec(), loss });
        }
    }
}

/// A method that finds the least loss by asking.
pub trait Solver {
    /// What it wants to know. Asked again without an answer, it asks the same.
    fn ask(&mut self) -> Ask;

    /// The answer.
    ///
    /// # Panics
    ///
    /// When it does not fit what was asked: a mistake of the caller.
    fn tell(&mut self, answer: Tell);

    /// The best point so far, if any loss was finite.
    fn best(&self) -> Option<&Best>;

    /// How far it is, from 0 to 1, as far as it can say.
    fn progress(&self) -> f64;
}

/// Runs a solver that asks for losses alone.
///
/// # Panics
///
/// When the solver asks for derivatives.
pub fn minimise(solver: &mut impl Solver, mut losses: impl FnMut(&[Vec<f64>]) -> Vec<f64>) -> Option<Best> {
    minimise_with(solver, |points, _| losses(points), |_, _| panic!("this solver needs derivatives"))
}

/// Runs a solver with both kinds of answers, each told the share of the data that counts.
///
/// # Panics
///
/// When the solver asks for states: such data have none.
pub fn minimise_with(
    solver: &mut (impl Solver + ?Sized),
    mut losses: impl FnMut(&[Vec<f64>], f64) -> Vec<f64>,
    mut locals: impl FnMut(&[Vec<f64>], f64) -> Vec<Local>,
) -> Option<Best> {
    loop {
        match solver.ask() {
            Ask::Losses { points, view, .. } => solver.tell(Tell::Losses(losses(&points, view.share))),
            Ask::Locals { points, view } => solver.tell(Tell::Locals(locals(&points, view.share))),
            Ask::States { .. } => panic!("data without states are not cut"),
            Ask::Done(_) => return solver.best().cloned(),
        }
    }
}

/// Places of losses from the best to the worst; what is not finite comes last, equal ones keep their order.
fn ranked(losses: &[f64]) -> Vec<usize> {
    let worth = |loss: f64| if loss.is_finite() { loss } else { f64::INFINITY };
    let mut order: Vec<usize> = (0..losses.len()).collect();
    order.sort_by(|&a, &b| worth(losses[a]).total_cmp(&worth(losses[b])));
    order
}
