//! Short windows with free initial states.
//!
//! The log is cut into windows of a fraction of a second. Each has an initial state of its own, fitted together with
//! the shared parameters; nothing drifts over more than a window, so closed loops and unstable plants are no trouble
//! (multiple shooting without continuity: Bock 1983; the states are eliminated window by window).

mod flow;
mod normal;
mod sums;
mod triangular;

use crate::fit::Local;
use crate::simulator::{Event, LANES, Run, Simulator};
use normal::Normal;
use sums::Sums;
use triangular::{backward, forward};

/// A window: readings whose stamps lie in `[from, to)`, and the state guessed at its first one.
#[derive(Clone, Debug)]
pub struct Window {
    /// Stamp of the first reading (s).
    pub from: f64,
    /// End of the window (s).
    pub to: f64,
    /// The initial state; refined in place by every evaluation.
    pub state: Vec<f64>,
    /// Standard deviation of a weak prior on the initial state around `guess`.
    pub std: Vec<f64>,
    /// Where the initial state was guessed to be.
    pub guess: Vec<f64>,
    /// ln of how far volumes of states grow from the first reading to where most sensors begin; below zero for one late
    /// sensor of a stable plant.
    flow: f64,
    /// How the best initial state differs from `state`, by the last evaluation.
    newton: Vec<f64>,
    /// How the best initial state moves with θ, states × parameters, by the last evaluation.
    response: Vec<f64>,
}

impl Window {
    /// A window whose state is where it was guessed to be.
    #[must_use]
    pub fn new(from: f64, to: f64, guess: Vec<f64>, std: Vec<f64>) -> Self {
        Window {
            from,
            to,
            state: guess.clone(),
            std,
            guess,
            flow: 0.0,
            newton: Vec::new(),
            response: Vec::new(),
        }
    }

    /// Moves the state to where it is best when θ moves by `step`, to first order.
    pub fn follow(&mut self, step: &[f64]) {
        for (i, (x, newton)) in self.state.iter_mut().zip(&self.newton).enumerate() {
            let row = &self.response[i * step.len()..(i + 1) * step.len()];
            *x += newton + row.iter().zip(step).map(|(r, d)| r * d).sum::<f64>();
        }
    }

    /// −2 log of the weak prior, up to a constant.
    fn prior(&self) -> f64 {
        self.state.iter().zip(&self.guess).zip(&self.std).map(|((x, g), s)| ((x - g) / s).powi(2)).sum()
    }
}

/// How far a reading is from its stamp at most (s): its delay, or how far its clock has gone astray.
#[must_use]
pub fn lateness(events: &[Event]) -> f64 {
    events.iter().filter_map(|e| Some((e.reading?.stamp - e.time).abs())).fold(0.0, f64::max)
}

/// The events of a window: from its first reading to its last. `lateness` as [`lateness`] gives it.
#[must_use]
pub fn locate(events: &[Event], lateness: f64, from: f64, to: f64) -> Option<(usize, usize)> {
    let inside = |e: &Event| e.reading.is_some_and(|r| r.stamp >= from && r.stamp < to);
    // Events are in the order of the times at which readings were taken.
    let begin = events.partition_point(|e| e.time < from - lateness - 1e-9);
    let first = begin + events[begin..].iter().position(inside)?;
    let stop = events.partition_point(|e| e.time < to + lateness);
    let last = first + events[first..stop.max(first)].iter().rposition(inside)?;
    Some((first, last + 1))
}

/// Residuals of windows at one θ.
#[derive(Clone, Debug, Default)]
pub struct Residuals {
    /// Sum of squared residuals per output.
    pub squares: Vec<f64>,
    /// Readings per output.
    pub counts: Vec<usize>,
    /// Half the gradient of the cost by θ, window by window.
    pub scores: Vec<Vec<f64>>,
    /// ln det of the curvature of the states where most sensors begin in units of their priors, summed over windows: what integrating the
    /// states out costs, more for a hypothesis with more states or fewer readings to tell them.
    pub volume: f64,
}

/// What is done to the windows' initial states before the cost is taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum States {
    /// They stay as they are.
    Kept,
    /// Damped Gauss–Newton steps bring each to where it is best.
    Settled,
}

/// What a walk of windows found, to be weighed by another noise without walking again.
#[derive(Clone, Debug, Default)]
pub struct Walked {
    /// Per group of lanes and output.
    groups: Vec<Vec<Sums>>,
    /// The windows that have readings.
    windows: Vec<usize>,
}

/// Columns up to which a walk is kept: beyond that it takes more memory than it saves time.
const KEPT_COLUMNS: usize = 64;

/// The cost of the windows at the parameters θ, initial states eliminated; `variance` per output weighs the residuals.
///
/// The curvature and the gradient are those of the states and θ together, the states projected out: a step in θ taken
/// with them is right if the states [`Window::follow`] it.
pub fn shoot(
    simulator: &dyn Simulator,
    theta: &[f64],
    windows: &mut [Window],
    variance: &[f64],
    states: States,
) -> (Local, Residuals, Walked) {
    let (n, p) = (simulator.states(), simulator.parameters());
    let mut run = simulator.run(theta);
    let mut total = Local { cost: 0.0, information: vec![0.0; p * p], gradient: vec![0.0; p] };
    let outputs = variance.len();
    let mut residuals =
        Residuals { squares: vec![0.0; outputs], counts: vec![0; outputs], ..Residuals::default() };
    let mut walked = Walked::default();
    let late = lateness(run.events());
    let mut found: Vec<Placed<'_>> = Vec::with_capacity(windows.len());
    for (k, window) in windows.iter_mut().enumerate() {
        if let Some((first, end)) = locate(run.events(), late, window.from, window.to) {
            found.push((window, first, end));
            walked.windows.push(k);
        }
    }
    if n > 0 && states == States::Settled {
        // Initial states are settled without the derivatives by θ, which would be most of the work.
        let mut plain = simulator.run_at(theta);
        let mut normal = Normal::new(n, 0, outputs);
        let mut other = Normal::new(n, 0, outputs);
        for group in found.chunks_mut(LANES) {
            settle(&mut *plain, group, variance, &mut normal, &mut other);
        }
    }
    if n > 0 && late > 0.0 {
        let mut plain = simulator.run_at(theta);
        for group in found.chunks_mut(LANES) {
            flow::set(&mut *plain, group, n, outputs);
        }
    }
    let mut normal = Normal::new(n, p, outputs).with_scales(simulator, theta);
    for group in found.chunks_mut(LANES) {
        let initial: Vec<Vec<f64>> = group.iter().map(|g| g.0.state.clone()).collect();
        normal.march(&mut *run, group, &initial, variance, Some(&mut residuals));
        for (lane, (window, ..)) in group.iter_mut().enumerate() {
            normal.add(lane, window, &mut total, &mut residuals);
        }
        if n + p <= KEPT_COLUMNS {
            walked.groups.push(normal.sums.clone());
        }
    }
    total.cost += noise_cost(&residuals, variance);
    (total, residuals, walked)
}

/// The same windows at the same parameters and states under another noise, if the walk was kept.
pub fn reweigh(
    walked: &Walked,
    simulator: &dyn Simulator,
    theta: &[f64],
    windows: &mut [Window],
    variance: &[f64],
    residuals: &mut Residuals,
) -> Option<Local> {
    let (n, p) = (simulator.states(), simulator.parameters());
    if n + p > KEPT_COLUMNS {
        return None;
    }
    let mut total = Local { cost: 0.0, information: vec![0.0; p * p], gradient: vec![0.0; p] };
    residuals.scores.clear();
    residuals.volume = 0.0;
    let mut normal = Normal::new(n, p, variance.len()).with_scales(simulator, theta);
    for (sums, group) in walked.groups.iter().zip(walked.windows.chunks(LANES)) {
        normal.weigh(sums, variance);
        for (lane, window) in group.iter().enumerate() {
            normal.add(lane, &mut windows[*window], &mut total, residuals);
        }
    }
    total.cost += noise_cost(residuals, variance);
    Some(total)
}

/// N log variance, summed over outputs.
fn noise_cost(residuals: &Residuals, variance: &[f64]) -> f64 {
    residuals.counts.iter().zip(variance).map(|(count, v)| *count as f64 * v.ln()).sum()
}

/// A window with its first event and the one after its last.
type Placed<'a> = (&'a mut Window, usize, usize);

/// Damped Gauss–Newton on each window's initial state, from where it is or was guessed to be.
fn settle(
    run: &mut dyn Run,
    group: &mut [Placed<'_>],
    variance: &[f64],
    normal: &mut Normal,
    other: &mut Normal,
) {
    // At other parameters the state found before may lie beyond a stop or a turn: the guess never does.
    let mut initial: Vec<Vec<f64>> = group.iter().map(|g| g.0.guess.clone()).collect();
    normal.march(run, group, &initial, variance, None);
    let mut cost: Vec<f64> = (0..group.len()).map(|lane| normal.squares[lane]).collect();
    if group.iter().any(|g| g.0.state != g.0.guess) {
        for (state, (window, ..)) in initial.iter_mut().zip(group.iter()) {
            state.clone_from(&window.state);
        }
        other.march(run, group, &initial, variance, None);
        for (lane, (window, ..)) in group.iter_mut().enumerate() {
            let found = other.cost(lane, window);
            if found <= cost[lane] || cost[lane].is_nan() {
                normal.take(other, lane);
                cost[lane] = found;
            } else {
                window.state = window.guess.clone();
            }
        }
    }
    // Each window takes steps of its own; those that are done wait for the others.
    let mut tries: Vec<Try> = group.iter().map(|_| Try { step: Vec::new(), share: 1.0, left: 4 }).collect();
    for (lane, (attempt, (window, ..))) in tries.iter_mut().zip(group.iter()).enumerate() {
        attempt.begin(normal, lane, window);
    }
    while tries.iter().any(|t| t.left > 0) {
        for ((state, attempt), (window, ..)) in initial.iter_mut().zip(&tries).zip(group.iter()) {
            state.clone_from(&window.state);
            if attempt.left > 0 {
                for (x, d) in state.iter_mut().zip(&attempt.step) {
                    *x += attempt.share * d;
                }
            }
        }
        other.march(run, group, &initial, variance, None);
        for (lane, (attempt, (window, ..))) in tries.iter_mut().zip(group.iter_mut()).enumerate() {
            if attempt.left == 0 {
                continue;
            }
            let before = std::mem::replace(&mut window.state, initial[lane].clone());
            let trial = other.cost(lane, window);
            if trial < cost[lane] {
                let gain = cost[lane] - trial;
                cost[lane] = trial;
                normal.take(other, lane);
                attempt.left -= 1;
                if gain < 1e-3 * trial.max(1e-3) {
                    attempt.left = 0;
                }
                attempt.begin(normal, lane, window);
            } else {
                window.state = before;
                attempt.share *= 0.3;
                if attempt.share < 0.02 {
                    attempt.left = 0;
                }
            }
        }
    }
}

/// A step of a window's initial state under trial.
struct Try {
    step: Vec<f64>,
    share: f64,
    left: usize,
}

impl Try {
    fn begin(&mut self, normal: &Normal, lane: usize, window: &Window) {
        let (factor, mut g) = normal.state_system(lane, window);
        let Some(l) = factor else {
            self.left = 0;
            return;
        };
        forward(&l, normal.n, &mut g);
        backward(&l, normal.n, &mut g);
        self.step = g.into_iter().map(|d| -d).collect();
        self.share = 1.0;
    }
}
