//! What the diagnosis asks of a simulator: to go from one event of a log to the next, and say what is read there.
//!
//! A [`Simulator`] is a system under one hypothesis, bound to one recording. Its [`Run`] at given parameters walks
//! along the events with exact derivatives. Equations ([`crate::equations`]) are one implementation; a simulator
//! of another kind implements the same two calls, with finite differences where it has no derivatives.

/// One thing that happens in a log, in the order of time: a command changes or a reading is taken.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Event {
    /// Seconds since the start of the recording, at the run's parameters (a delay shifts it).
    pub time: f64,
    /// The reading, if this event is one.
    pub reading: Option<Reading>,
}

/// One sample of one output.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reading {
    /// Index of the output.
    pub output: usize,
    /// What was measured, in the output's unit.
    pub value: f64,
    /// The stamp of the sample, in seconds; differs from the event's time where the reading is late.
    pub stamp: f64,
}

/// A system under one hypothesis, bound to one recording.
pub trait Simulator: Sync {
    /// How many states there are.
    fn states(&self) -> usize;
    /// How many parameters the hypothesis fits: θ.
    fn parameters(&self) -> usize;
    /// Prepares a walk at the parameters θ.
    fn run<'a>(&'a self, theta: &[f64]) -> Box<dyn Run + 'a>;
    /// Prepares a walk at the parameters θ that gives derivatives by the state alone: its `by_parameter` are empty.
    fn run_at<'a>(&'a self, theta: &[f64]) -> Box<dyn Run + 'a>;
}

/// The derivatives of one step between two events, row by row.
#[derive(Clone, Debug, Default)]
pub struct Transition {
    /// ∂x′/∂x, states × states.
    pub by_state: Vec<f64>,
    /// ∂x′/∂θ at fixed x, states × parameters.
    pub by_parameter: Vec<f64>,
}

/// What is predicted for a reading, with its derivatives.
#[derive(Clone, Debug, Default)]
pub struct Prediction {
    /// The reading predicted, in the output's unit.
    pub value: f64,
    /// ∂y/∂x, one per state.
    pub by_state: Vec<f64>,
    /// ∂y/∂θ at fixed x, one per parameter.
    pub by_parameter: Vec<f64>,
}

/// A walk along a recording at fixed parameters.
pub trait Run {
    /// All events in the order of time.
    fn events(&self) -> &[Event];
    /// Takes `state` from event `index` to event `index + 1`.
    fn advance(&mut self, index: usize, state: &mut [f64], transition: &mut Transition);
    /// Predicts the reading of event `index`, which must be one, from the state there.
    fn observe(&mut self, index: usize, state: &[f64], prediction: &mut Prediction);
    /// The period of an output that is an angle (2π in rad), if it wraps.
    fn wrap(&self, output: usize) -> Option<f64>;
}

/// `difference` brought into [−period/2, period/2).
#[must_use]
pub fn wrapped(difference: f64, period: Option<f64>) -> f64 {
    match period {
        Some(period) => difference - period * (difference / period).round(),
        None => difference,
    }
}
