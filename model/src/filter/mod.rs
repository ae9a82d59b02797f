//! State estimation where readings are late and commands take time: an unscented Kalman filter in square-root form, with
//! delays compensated.
//!
//! - [`Process`] is what a filter needs of a system: how its state moves under a command, and what its sensors read.
//! - [`Unscented`] is the filter: [`Unscented::predict`] and [`Unscented::update`] on a mean and a root of its covariance.
//! - [`Compensator`] brings it in step with a graph: it updates to the time at which a reading was taken, and predicts to the
//!   time at which what is decided now will act, with the commands in flight at their recorded times.
//!
//! All of it is generic over the [`Scalar`]: one source is the real-time estimator, its derivatives, and its program. Sizes
//! are known at run time; memory is lent by the caller, so that steps on numbers allocate nothing. Loops are the structured
//! ones of [`Scalar::scan_values`] and [`Scalar::map_values`]: a trace stays as small as one step of the filter.
//!
//! ```
//! use parallax_model::filter::{Constants, Process, Scaling, Unscented, Work};
//! use parallax_model::program::Workspace;
//! use parallax_model::Scalar;
//!
//! /// A body that slides; its position is read.
//! struct Body;
//! impl Process for Body {
//!     fn states(&self) -> usize { 2 }
//!     fn outputs(&self) -> usize { 1 }
//!     fn advance<T: Scalar>(
//!         &self, _: &[T], x: &[T], force: &[T], [_, dt]: [T; 2], _: &mut Work<'_, T>, next: &mut [T],
//!     ) {
//!         next[0] = x[0] + x[1] * dt + force[0] * dt * dt * 0.5;
//!         next[1] = x[1] + force[0] * dt;
//!     }
//!     fn observe<T: Scalar>(&self, _: &[T], x: &[T], _: &[T], _: T, _: &mut Work<'_, T>, y: &mut [T]) {
//!         y[0] = x[0];
//!     }
//! }
//!
//! let filter = Unscented::new(Body, Scaling::default(), vec![1], vec![None])?; // the speed is disturbed
//! let (mut values, mut workspace) = (vec![0.0; filter.room()], Workspace::new());
//! let mut room = filter.lend(&mut values, &mut workspace);
//! let constants = Constants { params: &[], noise: &[0.01], disturbance: &[0.05] };
//! // Mean, and the lower triangle of the covariance's root, row by row.
//! let mut belief = [0.0, 0.0, 1.0, 0.0, 1.0];
//! for step in 1..=50 {
//!     let time = 0.1 * f64::from(step);
//!     filter.predict(&constants, &mut belief, &[0.5], [time - 0.1, 0.1], &mut room);
//!     filter.update(&constants, &mut belief, &[0.25 * time * time], (&[0.5], time), &mut room);
//! }
//! assert!((belief[1] - 2.5).abs() < 0.01);
//! # Ok::<(), parallax_model::filter::FilterError>(())
//! ```

mod commands;
mod compensate;
mod plant;
mod triangle;
mod unscented;

pub use commands::{Commands, Source};
pub use compensate::{Compensation, Compensator, CompensatorRoom, Given, UNKNOWN};
pub use plant::PlantProcess;
pub use unscented::{Constants, Innovation, Room, Scaling, Unscented};

use crate::program::Workspace;
use crate::scalar::Scalar;

/// Memory that a process is lent for a step, so that steps on numbers allocate nothing.
#[derive(Debug)]
pub struct Work<'a, T: Scalar> {
    /// For evaluating programs.
    pub workspace: &'a mut Workspace<T>,
    /// As many numbers as [`Process::room`] says; what they hold between calls has no meaning.
    pub values: &'a mut [T],
}

/// A system as a filter sees it: discrete steps of any length, and readings. Parameters, states, inputs and outputs are flat
/// lists, in the system's own units; times are seconds.
pub trait Process: Send + Sync + 'static {
    /// How many parameters there are.
    fn params(&self) -> usize {
        0
    }
    /// How many states there are.
    fn states(&self) -> usize;
    /// How many readings there are.
    fn outputs(&self) -> usize;
    /// How many numbers of what follows from the parameters [`prepare`](Self::prepare) writes.
    fn prepared(&self) -> usize {
        self.params()
    }
    /// What follows from the parameters alone, such as reciprocals: both functions below are given this in their place.
    fn prepare<T: Scalar>(&self, params: &[T], prepared: &mut [T]) {
        prepared.copy_from_slice(params);
    }
    /// How many numbers of memory [`advance`](Self::advance) and [`observe`](Self::observe) need.
    fn room(&self) -> usize {
        0
    }
    /// The state after `dt` seconds under constant inputs, from the state at `time`.
    fn advance<T: Scalar>(
        &self,
        params: &[T],
        state: &[T],
        inputs: &[T],
        time_and_dt: [T; 2],
        work: &mut Work<'_, T>,
        next: &mut [T],
    );
    /// What the sensors read without noise.
    fn observe<T: Scalar>(
        &self,
        params: &[T],
        state: &[T],
        inputs: &[T],
        time: T,
        work: &mut Work<'_, T>,
        readings: &mut [T],
    );
}

/// Why there is no filter.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum FilterError {
    /// A filter of nothing.
    #[error("the system has {states} states and {outputs} readings; a filter needs one of each at least")]
    Empty {
        /// How many states.
        states: usize,
        /// How many readings.
        outputs: usize,
    },
    /// The points of the unscented transform coincide or cannot be placed.
    #[error(
        "the scaling alpha = {alpha}, beta = {beta}, kappa = {kappa} places no points for {states} states: alpha must be above \
         0 and kappa above −{states}"
    )]
    Scaling {
        /// α.
        alpha: f64,
        /// β.
        beta: f64,
        /// κ.
        kappa: f64,
        /// How many states.
        states: usize,
    },
    /// Something counts beyond what there is.
    #[error("{what} {index} does not exist; there are {count}")]
    Index {
        /// A state or a reading.
        what: &'static str,
        /// Its number, from 0.
        index: usize,
        /// How many there are.
        count: usize,
    },
    /// A number that must be above zero is not.
    #[error("{what} is {value}; it must be above 0")]
    Positive {
        /// What.
        what: &'static str,
        /// Its value.
        value: f64,
    },
}
