//! What the diagnosis asks of a simulator: to go from one event of a log to the next, and say what is read there.
//!
//! A [`Simulator`] is a system under one hypothesis, bound to one recording. Its [`Run`] at given parameters walks
//! along the events with exact derivatives. Equations ([`crate::equations`]) are one implementation; a simulator
//! of another kind implements the same two calls, with finite differences where it has no derivatives.

use parallax_model::lanes::F64x16;

use crate::machine::columns::Columns;

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
    /// A start of this simulator's states from the nominal system's, with standard deviations, at `time` seconds: a
    /// hypothesis may have states that the nominal system lacks. A start that has all states already stays as it is.
    fn start(&self, state: &[f64], std: &[f64], time: f64) -> (Vec<f64>, Vec<f64>) {
        let _ = time;
        (state.to_vec(), std.to_vec())
    }
    /// The scale of an output's readings that the hypothesis fits, at the parameters θ; 1 where it fits none.
    fn scale(&self, theta: &[f64], output: usize) -> f64 {
        let _ = (theta, output);
        1.0
    }
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

/// States on lanes, each lane a stretch of its own, with sensitivities.
#[derive(Clone, Debug, Default)]
pub struct Motion {
    /// The states.
    pub x: Vec<F64x16>,
    /// Derivatives of the states by the seeds and θ, states × columns.
    pub by: Vec<F64x16>,
    /// How many columns come before those of θ: where a walk began, usually one per state.
    pub seeds: usize,
    /// How many columns there are.
    pub columns: usize,
    /// The columns of each state that can differ from zero; the others are zero.
    pub live: Vec<Columns>,
}

/// The derivatives of a reading on lanes by the seeds and θ.
#[derive(Clone, Debug, Default)]
pub struct Gradient {
    /// One per column.
    pub by: Vec<F64x16>,
    /// The columns that can differ from zero.
    pub live: Columns,
}

impl Gradient {
    /// All zero.
    pub fn reset(&mut self, columns: usize) {
        self.by.clear();
        self.by.resize(columns, F64x16::splat(0.0));
        self.live = Columns::default();
    }
}

impl Motion {
    /// States at rest at zero, with room for `seeds` and `parameters` columns.
    #[must_use]
    pub fn new(states: usize, seeds: usize, parameters: usize) -> Self {
        let zero = F64x16::splat(0.0);
        let columns = seeds + parameters;
        let live = vec![Columns::default(); states];
        Motion { x: vec![zero; states], by: vec![zero; states * columns], seeds, columns, live }
    }

    /// Makes the present states the seeds; derivatives by θ start from zero.
    pub fn seed(&mut self) {
        self.by.fill(F64x16::splat(0.0));
        self.live.fill(Columns::default());
        self.reseed();
    }

    /// Makes the present states the seeds; derivatives by θ stay.
    pub fn reseed(&mut self) {
        for (i, row) in self.by.chunks_mut(self.columns.max(1)).enumerate() {
            for (j, entry) in row.iter_mut().take(self.seeds).enumerate() {
                *entry = F64x16::splat(f64::from(u8::from(i == j)));
            }
        }
        for (i, live) in self.live.iter_mut().enumerate() {
            live.clear_below(self.seeds);
            if i < self.seeds {
                live.insert(i);
            }
        }
    }
}

/// What there is of each lane; usually which event it is at. A lane without one rests.
pub type At<T = usize> = [Option<T>; LANES];

/// A limit of a sensor at which a reading rests, while the state is predicted within: what it shows is that the state lies beyond.
#[derive(Clone, Copy, Debug)]
pub struct AtLimit {
    /// The limit, in the output's unit.
    pub level: f64,
    /// 1 of an upper limit, −1 of a lower one.
    pub side: f64,
    /// The entry of θ that it is, if it is fitted.
    pub column: Option<usize>,
}

/// How many stretches are walked at once.
pub const LANES: usize = F64x16::LANES;

/// A walk along a recording at fixed parameters, on lanes.
pub trait Run {
    /// All events in the order of time.
    fn events(&self) -> &[Event];
    /// How many parameters the walk gives derivatives by.
    fn parameters(&self) -> usize;
    /// Whether the next event happens at the time of event `index`, whatever the parameters.
    fn stands(&self, index: usize) -> bool {
        let events = self.events();
        events.get(index + 1).is_some_and(|next| next.time == events[index].time)
    }
    /// Takes each lane from its event to the next one. What a resting lane holds afterwards is of no use.
    fn advance_lanes(&mut self, at: &At, motion: &mut Motion);
    /// Predicts the reading of each lane's event, which must be one, from its states: the value, and in `by` the
    /// derivatives by seeds and θ.
    fn observe_lanes(&mut self, at: &At, motion: &Motion, by: &mut Gradient) -> F64x16;
    /// The same to compare with the readings, which tell whether a sensor is at its limit: where it is not, a prediction
    /// beyond the limit is wrong by all of its distance.
    fn compare_lanes(&mut self, at: &At, motion: &Motion, by: &mut Gradient) -> F64x16 {
        self.observe_lanes(at, motion, by)
    }
    /// Where readings that [`compare_lanes`](Run::compare_lanes) was last asked for rest at a limit of which their predictions fall
    /// short.
    fn at_limits(&self) -> At<AtLimit> {
        [None; LANES]
    }
    /// The period of an output that is an angle (2π in rad), if it wraps.
    fn wrap(&self, output: usize) -> Option<f64>;

    /// Takes `state` from event `index` to event `index + 1`.
    fn advance(&mut self, index: usize, state: &mut [f64], transition: &mut Transition) {
        let (n, p) = (state.len(), self.parameters());
        let mut motion = single(state, p);
        self.advance_lanes(&only(index), &mut motion);
        for (value, lanes) in state.iter_mut().zip(&motion.x) {
            *value = lanes[0];
        }
        transition.by_state.clear();
        transition.by_parameter.clear();
        for row in motion.by.chunks((n + p).max(1)) {
            transition.by_state.extend(row[..n].iter().map(|d| d[0]));
            transition.by_parameter.extend(row[n..].iter().map(|d| d[0]));
        }
    }

    /// Predicts the reading of event `index`, which must be one, from the state there.
    fn observe(&mut self, index: usize, state: &[f64], prediction: &mut Prediction) {
        let n = state.len();
        let motion = single(state, self.parameters());
        let mut gradient = Gradient::default();
        prediction.value = self.observe_lanes(&only(index), &motion, &mut gradient)[0];
        let by = gradient.by;
        prediction.by_state.clear();
        prediction.by_state.extend(by[..n].iter().map(|d| d[0]));
        prediction.by_parameter.clear();
        prediction.by_parameter.extend(by[n..].iter().map(|d| d[0]));
    }
}

fn single(state: &[f64], parameters: usize) -> Motion {
    let mut motion = Motion::new(state.len(), state.len(), parameters);
    for (lanes, value) in motion.x.iter_mut().zip(state) {
        *lanes = F64x16::splat(*value);
    }
    motion.seed();
    motion
}

/// A state that goes along a walk by itself, without sensitivities.
#[derive(Clone, Debug)]
pub struct Trajectory {
    motion: Motion,
    gradient: Gradient,
}

impl From<&[f64]> for Trajectory {
    /// One that is at `state`.
    fn from(state: &[f64]) -> Self {
        let mut motion = Motion::new(state.len(), 0, 0);
        motion.x.iter_mut().zip(state).for_each(|(lanes, value)| *lanes = F64x16::splat(*value));
        Trajectory { motion, gradient: Gradient::default() }
    }
}

impl Trajectory {
    /// Where it is.
    pub fn state(&self) -> impl Iterator<Item = f64> + '_ {
        self.motion.x.iter().map(|lanes| lanes[0])
    }

    /// Goes from event `index` to event `index + 1`.
    pub fn advance(&mut self, run: &mut dyn Run, index: usize) {
        run.advance_lanes(&only(index), &mut self.motion);
    }

    /// Predicts the reading of event `index`, which must be one, from where it is.
    pub fn observe(&mut self, run: &mut dyn Run, index: usize) -> f64 {
        run.observe_lanes(&only(index), &self.motion, &mut self.gradient)[0]
    }
}

/// One event, on the first lane; the others rest.
fn only(index: usize) -> At {
    let mut at = [None; LANES];
    at[0] = Some(index);
    at
}

/// `difference` brought into [−period/2, period/2).
#[must_use]
pub fn wrapped(difference: f64, period: Option<f64>) -> f64 {
    match period {
        Some(period) => difference - period * (difference / period).round(),
        None => difference,
    }
}
