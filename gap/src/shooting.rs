//! Short windows with free initial states.
//!
//! The log is cut into windows of a fraction of a second. Each has an initial state of its own, fitted together with
//! the shared parameters; nothing drifts over more than a window, so closed loops and unstable plants are no trouble
//! (multiple shooting without continuity: Bock 1983; the states are eliminated window by window).

mod flow;
mod sums;
mod triangular;

use parallax_model::lanes::{F64x16, Level};

use crate::fit::Local;
use crate::lockstep::{Lockstep, Stretch, Tick};
use crate::simulator::{Event, Gradient, LANES, Motion, Run, Simulator, wrapped};
use sums::{Accumulate, AddScaled, Sums};
use triangular::{backward, factor, forward};

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

/// Scale of a reading from which it tells the states no less.
const LEAST_SCALE: f64 = 1e-6;

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

/// The normal equations of as many windows as there are lanes.
struct Normal {
    n: usize,
    columns: usize,
    squares: F64x16,
    /// JᵀJ over `[state | θ]`, the lower triangle row by row.
    information: Vec<F64x16>,
    /// Jᵀe over the same.
    gradient: Vec<F64x16>,
    /// The same without weights, output by output.
    sums: Vec<Sums>,
    /// By how much each output's reading is what its sensor would read, where one is not 1, and the states' JᵀJ as these sensors would
    /// tell them.
    scales: Vec<f64>,
    unscaled: Vec<F64x16>,
    motion: Motion,
    row: Gradient,
}

impl Normal {
    fn new(n: usize, p: usize, outputs: usize) -> Self {
        let (columns, zero) = (n + p, F64x16::splat(0.0));
        Normal {
            n,
            columns,
            squares: zero,
            information: vec![zero; columns * (columns + 1) / 2],
            gradient: vec![zero; columns],
            sums: vec![Sums::new(columns); outputs],
            scales: Vec::new(),
            unscaled: Vec::new(),
            motion: Motion::new(n, n, p),
            row: Gradient::default(),
        }
    }

    /// States are told in the units of sensors: one that reads a tenth tells no less, and what integrating states out costs must not make
    /// it likelier.
    fn with_scales(mut self, simulator: &dyn Simulator, theta: &[f64]) -> Self {
        let scales: Vec<f64> = (0..self.sums.len())
            .map(|output| simulator.scale(theta, output).abs().max(LEAST_SCALE))
            .collect();
        if scales.iter().any(|scale| *scale != 1.0) {
            self.unscaled = vec![F64x16::splat(0.0); self.n * (self.n + 1) / 2];
            self.scales = scales;
        }
        self
    }

    /// Walks the windows from the given initial states.
    fn march(
        &mut self,
        run: &mut dyn Run,
        group: &[Placed<'_>],
        initial: &[Vec<f64>],
        variance: &[f64],
        mut residuals: Option<&mut Residuals>,
    ) {
        let zero = F64x16::splat(0.0);
        self.sums.iter_mut().for_each(Sums::clear);
        self.motion.x.fill(zero);
        for (lane, state) in initial.iter().enumerate() {
            for (lanes, value) in self.motion.x.iter_mut().zip(state) {
                lanes[lane] = *value;
            }
        }
        self.motion.seed();
        let mut lanes = Lockstep::new(group.iter().map(|(window, first, end)| Stretch {
            first: *first,
            end: *end,
            from: window.from,
            to: window.to,
        }));
        while let Some(tick) = lanes.next(run) {
            let reads = match tick {
                Tick::Advance(steps) => {
                    run.advance_lanes(&steps, &mut self.motion);
                    continue;
                }
                Tick::Read(reads) => reads,
            };
            let (mut error, mut active) = (zero, zero);
            let value = run.compare_lanes(&reads, &self.motion, &mut self.row);
            let mut output = 0;
            for lane in 0..LANES {
                let Some(reading) = reads[lane].and_then(|index| run.events()[index].reading) else {
                    continue;
                };
                let e = wrapped(reading.value - value[lane], run.wrap(reading.output));
                (error[lane], active[lane], output) = (e, 1.0, reading.output);
                if let Some(residuals) = residuals.as_deref_mut() {
                    residuals.squares[reading.output] += e * e;
                    residuals.counts[reading.output] += 1;
                }
            }
            // All lanes read the same output.
            let sums = &mut self.sums[output];
            Level::widest().run(Accumulate { row: &self.row, error: &error, active: &active, sums });
        }
        let sums = std::mem::take(&mut self.sums);
        self.weigh(&sums, variance);
        self.sums = sums;
    }

    /// Sums up the outputs, each weighed by its variance.
    fn weigh(&mut self, sums: &[Sums], variance: &[f64]) {
        let zero = F64x16::splat(0.0);
        self.squares = zero;
        self.information.fill(zero);
        self.gradient.fill(zero);
        for (sums, variance) in sums.iter().zip(variance) {
            let weight = 1.0 / variance;
            let add =
                |to: &mut [F64x16], from: &[F64x16]| Level::widest().run(AddScaled { to, from, weight });
            add(std::slice::from_mut(&mut self.squares), std::slice::from_ref(&sums.squares));
            add(&mut self.information, &sums.information);
            add(&mut self.gradient, &sums.gradient);
        }
        self.unscaled.fill(zero);
        for ((sums, variance), scale) in sums.iter().zip(variance).zip(&self.scales) {
            let (to, from) = (&mut self.unscaled[..], &sums.information[..self.n * (self.n + 1) / 2]);
            Level::widest().run(AddScaled { to, from, weight: 1.0 / (variance * scale * scale) });
        }
    }

    /// Adds a window to the total, its state eliminated.
    fn add(&self, lane: usize, window: &mut Window, total: &mut Local, residuals: &mut Residuals) {
        let (score, volume) = self.eliminate(lane, window, total);
        residuals.scores.push(score);
        residuals.volume += volume - 2.0 * window.flow;
    }

    /// Squared residuals and the weak prior of the initial state, which is `window.state`.
    fn cost(&self, lane: usize, window: &Window) -> f64 {
        self.squares[lane] + window.prior()
    }

    fn information(&self, lane: usize, i: usize, j: usize) -> f64 {
        let (i, j) = (i.max(j), i.min(j));
        self.information[i * (i + 1) / 2 + j][lane]
    }

    /// The Cholesky factor of the initial state's curvature, and its gradient, the prior included.
    fn state_system(&self, lane: usize, window: &Window) -> (Option<Vec<f64>>, Vec<f64>) {
        let n = self.n;
        let mut a = vec![0.0; n * n];
        let mut g = vec![0.0; n];
        for i in 0..n {
            for j in 0..=i {
                a[i * n + j] = self.information(lane, i, j);
            }
            let precision = window.std[i].powi(-2);
            a[i * n + i] += precision;
            g[i] = self.gradient[i][lane] + precision * (window.state[i] - window.guess[i]);
        }
        (factor(a, n), g)
    }

    /// ln det of the initial state's curvature, the prior included, in units of that.
    fn volume(&self, lane: usize, window: &Window, factored: &[f64]) -> f64 {
        let n = self.n;
        let of = |l: &[f64]| (0..n).map(|i| 2.0 * (l[i * n + i] * window.std[i]).ln()).sum();
        if self.unscaled.is_empty() {
            return of(factored);
        }
        let mut a = vec![0.0; n * n];
        for i in 0..n {
            for j in 0..=i {
                a[i * n + j] = self.unscaled[i * (i + 1) / 2 + j][lane];
            }
            a[i * n + i] += window.std[i].powi(-2);
        }
        factor(a, n).map_or_else(|| of(factored), |l| of(&l))
    }

    /// Takes over one lane of another walk.
    fn take(&mut self, other: &Normal, lane: usize) {
        self.squares[lane] = other.squares[lane];
        for (to, from) in self.information.iter_mut().zip(&other.information) {
            to[lane] = from[lane];
        }
        for (to, from) in self.gradient.iter_mut().zip(&other.gradient) {
            to[lane] = from[lane];
        }
    }

    /// Adds a window to the total, its state projected out (Schur complement). Gives its share of the gradient, and
    /// ln det of its state's curvature in units of the prior.
    fn eliminate(&self, lane: usize, window: &mut Window, total: &mut Local) -> (Vec<f64>, f64) {
        let n = self.n;
        let p = self.columns - n;
        total.cost += self.cost(lane, window);
        let (factor, g) = self.state_system(lane, window);
        window.newton.clear();
        window.response.clear();
        window.newton.resize(n, 0.0);
        window.response.resize(n * p, 0.0);
        let mut score: Vec<f64> = (0..p).map(|j| self.gradient[n + j][lane]).collect();
        // With A = L Lᵀ: Y = L⁻¹ B and z = L⁻¹ g, so that Bᵀ A⁻¹ B = Yᵀ Y.
        let mut y = vec![0.0; n * p];
        let mut volume = 0.0;
        if let Some(l) = &factor {
            volume = self.volume(lane, window, l);
            let mut z = g;
            forward(l, n, &mut z);
            for j in 0..p {
                let mut column: Vec<f64> = (0..n).map(|i| self.information(lane, n + j, i)).collect();
                forward(l, n, &mut column);
                score[j] -= column.iter().zip(&z).map(|(a, b)| a * b).sum::<f64>();
                for (i, entry) in column.iter().enumerate() {
                    y[i * p + j] = *entry;
                }
                backward(l, n, &mut column);
                for (i, moved) in column.iter().enumerate() {
                    window.response[i * p + j] = -moved;
                }
            }
            backward(l, n, &mut z);
            for (newton, z) in window.newton.iter_mut().zip(&z) {
                *newton = -z;
            }
        }
        for i in 0..p {
            total.gradient[i] += score[i];
            for j in 0..=i {
                let through: f64 = (0..n).map(|k| y[k * p + i] * y[k * p + j]).sum();
                let value = self.information(lane, n + i, n + j) - through;
                total.information[i * p + j] += value;
                if i != j {
                    total.information[j * p + i] += value;
                }
            }
        }
        (score, volume)
    }
}

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
