//! How visible a cause is in a case, and what cannot be told from it, by the generator's own simulations.
//!
//! The healthy machine is fitted to what the faulty one shows without noise: its calibrated parameters within their
//! bounds, and the initial state of every short segment. What is left, in units of the sensors' noise, is the cause's
//! signature; its square is the detectability. The fit is nonlinear: what a large cause and other parameters have in
//! common beyond the first order is no part of the signature. Others are alike when the machine that has one of them in
//! the cause's place, fitted as well, follows what is shown ([`crate::alike`]).

use crate::alike::ALIKE;
use crate::case::{Case, Run, reading};
use crate::effect::{Cause, Kind, Place, label};
use crate::least_squares::inverse;
use crate::mechanics::{H, Machine};
use crate::system::{N, State};
use nalgebra::{DMatrix, DVector};

/// Steps of a segment (0.4 s).
const SEGMENT: usize = 4000;
/// Steps of the fit, at most.
const STEPS: usize = 5;
/// Share of the sum of squares that a step must take, else it was the last.
const LEAST: f64 = 0.01;
/// Sum of squares below which nothing is left to fit.
pub(crate) const NOTHING: f64 = 0.01;
/// Share of a cause's parameter by which a slope moves it: several steps of the integrator for a delay.
const STEP: f64 = 0.01;
/// How many times smaller or larger a fitted cause may become in one step.
const WIDEST: f64 = 20.0;

/// Mean of half a normal distribution in units of its standard deviation: 1/√(π/2 − 1).
const LATE: f64 = 1.323_6;

/// Sensor values in noise units, by segment.
pub(crate) type Values = Vec<DVector<f64>>;

/// A machine, fitted: the healthy one, or one with causes that are fitted as well.
pub(crate) struct View<'a> {
    pub(crate) case: &'a Case,
    pub(crate) run: &'a Run,
    /// What the fit follows: what the sensors show without scatter.
    target: Values,
    /// What acts on the healthy machine.
    plain: Vec<[f64; N]>,
    parameters: Vec<f64>,
    pub(crate) starts: Vec<State>,
    /// The causes that this machine has.
    pub(crate) causes: Vec<Cause>,
    shown: Values,
    pub(crate) rest: Values,
    pub(crate) cost: f64,
}

/// What a fit moves besides initial states.
#[derive(Clone, Copy)]
pub(crate) enum Free {
    /// A parameter of the machine.
    Machine(usize),
    /// A parameter of one of its causes.
    Cause(usize, usize),
}

/// What small changes do to the sensor values.
pub(crate) struct Slopes {
    /// By variable of the initial state, then by segment; in units of a step.
    pub(crate) local: Vec<Values>,
    local_steps: Vec<Vec<f64>>,
    /// By what else is free; the size of a step, and the values.
    pub(crate) global: Vec<(Free, f64, Values)>,
}

/// Twice the log-likelihood ratio that the causes are worth.
pub(crate) fn detectability(case: &Case, run: &Run) -> f64 {
    let view = View::fit(case, run, Vec::new());
    view.map_or(0.0, |view| view.cost) + scatter(case, run)
}

/// The same that each of two causes is worth beside the other, the lesser of the two; of two that only scatter readings, each of
/// which does so of its own sensor, what both are.
pub(crate) fn least_beside(case: &Case, run: &Run) -> f64 {
    let moving = moving(case);
    if moving.is_empty() {
        return scatter(case, run);
    }
    let worth = |cause: &Cause| {
        let is_it = |other: &Cause| of_mean(cause).is_some_and(|own| is_same(&own, other));
        let (own, others): (Vec<Cause>, Vec<Cause>) = moving.iter().partition(|other| is_it(other));
        let view = if own.is_empty() { None } else { View::fit(case, run, others) };
        view.map_or(0.0, |view| view.cost) + likelihood(case, run, cause)
    };
    case.causes.iter().map(worth).fold(f64::INFINITY, f64::min)
}

/// Twice the log-likelihood ratio that the causes are worth, and the labels of the class: the causes, then what is alike
/// one of them beside the others.
pub(crate) fn judge(case: &Case, run: &Run) -> (f64, Vec<String>) {
    let own = |c: &Cause| label(case.system, c.kind, c.place);
    let mut labels: Vec<String> = case.causes.iter().map(own).collect();
    let healthy = View::fit(case, run, Vec::new());
    let cost = healthy.as_ref().map_or(0.0, |view| view.cost);
    // Readings that scatter as well are told from whatever moves them as their mean is, unless that is nearly all they do.
    let is_all = |view: &View, lacking: &Cause| {
        let cause = case.causes.iter().find(|cause| of_mean(cause).is_some_and(|own| is_same(&own, lacking)));
        let scatters = cause.map_or(0.0, |cause| likelihood(case, run, cause));
        scatters <= (1.0 - ALIKE * ALIKE) * (view.cost + scatters)
    };
    match (moving(case).as_slice(), healthy) {
        ([cause], Some(view)) if is_all(&view, cause) => view.classify(cause, &mut labels),
        ([first, second], _) => {
            for (lacking, other) in [(first, second), (second, first)] {
                if let Some(view) = View::fit(case, run, vec![*other]).filter(|view| is_all(view, lacking)) {
                    view.classify(lacking, &mut labels);
                }
            }
        }
        _ => {}
    }
    (cost + scatter(case, run), labels)
}

/// What moves what sensors show, rather than how readings scatter around it: the causes that do, and the mean of times that scatter.
fn moving(case: &Case) -> Vec<Cause> {
    case.causes.iter().filter_map(of_mean).collect()
}

/// What a cause does to what a sensor shows, on average. None for one that only scatters readings.
fn of_mean(cause: &Cause) -> Option<Cause> {
    match (cause.kind, cause.place) {
        (Kind::JitterOut, _) => {
            Some(Cause { kind: Kind::DelayOut, p: [LATE * cause.p[0], 0.0, 0.0, 0.0], ..*cause })
        }
        (kind, Place::Output(_)) if kind.statistical() => None,
        _ => Some(*cause),
    }
}

fn is_same(a: &Cause, b: &Cause) -> bool {
    (a.kind, a.place) == (b.kind, b.place)
}

/// The real state at the start of each segment.
fn real_starts(run: &Run) -> Vec<State> {
    (0..run.states.len() / SEGMENT).map(|segment| run.states[segment * SEGMENT]).collect()
}

/// Twice the log-likelihood ratio of causes that change how readings scatter.
fn scatter(case: &Case, run: &Run) -> f64 {
    case.causes.iter().map(|c| likelihood(case, run, c)).sum()
}

fn likelihood(case: &Case, run: &Run, cause: &Cause) -> f64 {
    let a = cause.p[0];
    let (Place::Output(o), true) = (cause.place, cause.kind.statistical()) else { return 0.0 };
    let noise = run.noise[o];
    let count = run.readings[o].len() as f64;
    let excess = |variance: f64| count * (variance - variance.ln_1p());
    match cause.kind {
        Kind::Noise => excess((a / noise).powi(2)),
        Kind::Quantization => excess((a / noise).powi(2) / 12.0),
        // 10 to 50 times the noise: 30 on average, squared.
        Kind::Outliers => count * a * 1000.0,
        Kind::DropsOut => {
            let lost = case.duration * case.system.sample_rate - count;
            2.0 * lost.max(0.0) * 1000f64.ln()
        }
        Kind::JitterOut => of_times(case, run, o, a),
        _ => {
            let plain = case.shown(o, &run.states, &[]);
            let at = |t: f64| plain.partition_point(|(s, _)| *s < t - 1e-9).min(plain.len() - 1);
            let excess = |(t, y): &(f64, f64)| ((y - plain[at(*t)].1) / noise).powi(2) - 1.0;
            run.readings[o].iter().map(excess).sum::<f64>().max(0.0)
        }
    }
}

/// What the scatter of readings that are taken late by chance, with this standard deviation of their times, is worth. Nobody knows when
/// each was taken: around where the mean of the times has it, it scatters by how fast it changes times that deviation.
fn of_times(case: &Case, run: &Run, output: usize, spread: f64) -> f64 {
    let plain = case.shown(output, &run.states, &[]);
    let slopes = plain.windows(3).map(|y| (y[2].1 - y[0].1) / (y[2].0 - y[0].0));
    let variances = slopes.map(|slope| (slope * spread / run.noise[output]).powi(2));
    variances.map(|variance| variance - variance.ln_1p()).sum()
}

impl<'a> View<'a> {
    /// Fits the machine with these causes. None where no cause of the case moves a reading.
    fn fit(case: &'a Case, run: &'a Run, causes: Vec<Cause>) -> Option<Self> {
        let moving = moving(case);
        if moving.is_empty() {
            return None;
        }
        let mut view = Self {
            case,
            run,
            target: Vec::new(),
            plain: case.acting(&run.commands, run.states.len(), &[]),
            parameters: run.parameters.clone(),
            starts: real_starts(run),
            causes,
            shown: Vec::new(),
            rest: Vec::new(),
            cost: 0.0,
        };
        view.target = view.sensors(&moving);
        view.settle(|cost| cost < NOTHING);
        Some(view)
    }

    /// The same machine with a further cause, fitted until little enough is left.
    pub(crate) fn with(&self, cause: Cause, enough: impl Fn(f64) -> bool) -> Self {
        let causes = self.causes.iter().copied().chain([cause]).collect();
        let mut view = self.moved(self.parameters.clone(), self.starts.clone(), causes);
        view.settle(enough);
        view
    }

    /// Another machine that is held to the same sensors' values.
    fn moved(&self, parameters: Vec<f64>, starts: Vec<State>, causes: Vec<Cause>) -> Self {
        let (target, plain) = (self.target.clone(), self.plain.clone());
        Self { target, plain, parameters, starts, causes, shown: Vec::new(), rest: Vec::new(), ..*self }
    }

    /// The real machine, but for the cause that this one lacks.
    pub(crate) fn real(&self, lacking: &Cause) -> Self {
        let mut others = moving(self.case);
        others.retain(|cause| !is_same(cause, lacking));
        let mut view = self.moved(self.run.parameters.clone(), real_starts(self.run), others);
        view.settle(|_| true);
        view
    }

    /// What the same machine with a further cause leaves of the sensors' values.
    pub(crate) fn left_with(&self, cause: Cause) -> f64 {
        let causes: Vec<Cause> = self.causes.iter().copied().chain([cause]).collect();
        square(&minus(&self.target, &self.show(&self.parameters, &self.starts, &causes)))
    }

    fn settle(&mut self, enough: impl Fn(f64) -> bool) {
        self.shown = self.show(&self.parameters, &self.starts, &self.causes);
        self.rest = minus(&self.target, &self.shown);
        self.cost = square(&self.rest);
        for _ in 0..STEPS {
            let before = self.cost;
            if enough(before) || !self.follow() || self.cost > (1.0 - LEAST) * before {
                break;
            }
        }
    }

    /// One damped Gauss-Newton step. False where none lowers the sum of squares.
    fn follow(&mut self) -> bool {
        let slopes = self.slopes();
        let (by_free, by_start) = self.step(&slopes);
        // A machine that runs away shows no slope to follow.
        if !by_start.iter().chain([&by_free]).flatten().all(|step| step.is_finite()) {
            return false;
        }
        for part in [1.0, 0.4, 0.1] {
            let (mut parameters, mut causes) = (self.parameters.clone(), self.causes.clone());
            for ((free, size, _), step) in slopes.global.iter().zip(&by_free) {
                match *free {
                    Free::Machine(k) => parameters[k] += part * size * step,
                    Free::Cause(of, k) => causes[of].p[k] += part * size * step,
                }
            }
            let mut starts = self.starts.clone();
            for (segment, steps) in by_start.iter().enumerate() {
                for (i, step) in steps.iter().enumerate() {
                    *self.variable(&mut starts[segment], i) += part * slopes.local_steps[i][segment] * step;
                }
            }
            let shown = self.show(&parameters, &starts, &causes);
            let rest = minus(&self.target, &shown);
            let cost = square(&rest);
            if cost < self.cost {
                (self.parameters, self.starts, self.causes) = (parameters, starts, causes);
                (self.shown, self.rest, self.cost) = (shown, rest, cost);
                return true;
            }
        }
        false
    }

    /// The step of parameters and of every segment's initial state, in units of the slopes' steps. Initial states are
    /// eliminated segment by segment; a parameter that would leave its bounds stops there.
    fn step(&self, slopes: &Slopes) -> (DVector<f64>, Vec<DVector<f64>>) {
        let p = slopes.global.len();
        let mut matrix = DMatrix::zeros(p, p);
        let mut right = DVector::zeros(p);
        let mut eliminated = Vec::new();
        for (segment, rest) in self.rest.iter().enumerate() {
            let columns = |all: &mut dyn Iterator<Item = &Values>| -> DMatrix<f64> {
                let columns: Vec<_> = all.map(|v| v[segment].column(0)).collect();
                if columns.is_empty() {
                    DMatrix::zeros(rest.len(), 0)
                } else {
                    DMatrix::from_columns(&columns)
                }
            };
            let local = columns(&mut slopes.local.iter());
            let global = columns(&mut slopes.global.iter().map(|(_, _, v)| v));
            let mut own = local.tr_mul(&local);
            damp(&mut own, 1e-10);
            let follow = inverse(&own) * local.transpose();
            let (to_rest, to_global) = (&follow * rest, &follow * &global);
            right += global.tr_mul(&(rest - &local * &to_rest));
            matrix += global.tr_mul(&(&global - &local * &to_global));
            eliminated.push((to_rest, to_global));
        }
        damp(&mut matrix, 1e-9);
        let mut stopped: Vec<Option<f64>> = vec![None; p];
        let by_parameter = loop {
            let free: Vec<usize> = (0..p).filter(|k| stopped[*k].is_none()).collect();
            let mut all = DVector::from_iterator(p, stopped.iter().map(|s| s.unwrap_or(0.0)));
            let side = &right - &matrix * &all;
            let sub = matrix.select_rows(&free).select_columns(&free);
            let found = inverse(&sub) * side.select_rows(&free);
            free.iter().zip(found.iter()).for_each(|(k, x)| all[*k] = *x);
            let mut more = false;
            for k in free {
                let (low, high) = self.room(&slopes.global[k]);
                if all[k] < low || all[k] > high {
                    stopped[k] = Some(all[k].clamp(low, high));
                    more = true;
                }
            }
            if !more {
                break all;
            }
        };
        let by_start =
            eliminated.into_iter().map(|(to_rest, to_global)| to_rest - to_global * &by_parameter).collect();
        (by_parameter, by_start)
    }

    /// How far what is free may still go down and up, in units of its step.
    pub(crate) fn room(&self, (free, size, _): &(Free, f64, Values)) -> (f64, f64) {
        let ((low, high), value) = match *free {
            Free::Machine(k) => {
                let bounds = self.case.system.parameters[k].bounds;
                (bounds.unwrap_or((f64::NEG_INFINITY, f64::INFINITY)), self.parameters[k])
            }
            Free::Cause(of, k) => {
                let Cause { kind, p, .. } = self.causes[of];
                let inner = if kind.two_sided() { -WIDEST } else { WIDEST.recip() };
                let (a, b) = (inner * p[k], WIDEST * p[k]);
                ((a.min(b), a.max(b)), p[k])
            }
        };
        let (down, up) = ((low - value) / size, (high - value) / size);
        (down.min(up).min(0.0), down.max(up).max(0.0))
    }

    fn variable<'s>(&self, s: &'s mut State, i: usize) -> &'s mut f64 {
        let joints = self.case.system.joints.len();
        match i {
            i if i < joints => &mut s.q[i],
            i if i < 2 * joints => &mut s.v[i - joints],
            i => &mut s.x[i - 2 * joints],
        }
    }

    /// Slopes at the fitted point.
    pub(crate) fn slopes(&self) -> Slopes {
        let system = self.case.system;
        let mut slopes = Slopes { local: Vec::new(), local_steps: Vec::new(), global: Vec::new() };
        for i in 0..2 * system.joints.len() + system.extras {
            let mut starts = self.starts.clone();
            let mut sizes = Vec::new();
            for s in &mut starts {
                let x = self.variable(s, i);
                let size = 1e-4 * x.abs().max(0.1);
                *x += size;
                sizes.push(size);
            }
            let moved = self.show(&self.parameters, &starts, &self.causes);
            slopes.local.push(minus(&moved, &self.shown));
            slopes.local_steps.push(sizes);
        }
        for (k, p) in system.parameters.iter().enumerate() {
            let Some((_, high)) = p.bounds else { continue };
            let size = 1e-3 * p.value.abs().max(p.spread * 0.1);
            let size = if self.parameters[k] + size > high { -size } else { size };
            let mut parameters = self.parameters.clone();
            parameters[k] += size;
            let moved = self.show(&parameters, &self.starts, &self.causes);
            slopes.global.push((Free::Machine(k), size, minus(&moved, &self.shown)));
        }
        for (of, cause) in self.causes.iter().enumerate().filter(|(_, cause)| !cause.kind.statistical()) {
            for k in 0..cause.kind.names().2.len() {
                let size = STEP * cause.p[k].abs();
                if size == 0.0 {
                    continue;
                }
                let mut causes = self.causes.clone();
                causes[of].p[k] += size;
                let moved = self.show(&self.parameters, &self.starts, &causes);
                slopes.global.push((Free::Cause(of, k), size, minus(&moved, &self.shown)));
            }
        }
        slopes
    }

    /// What a further cause changes at the fitted point.
    pub(crate) fn change(&self, cause: &Cause) -> Values {
        let causes: Vec<Cause> = self.causes.iter().chain([cause]).copied().collect();
        minus(&self.show(&self.parameters, &self.starts, &causes), &self.shown)
    }

    /// Sensor values of a machine with these causes. What sensors make of the motion is taken from the recorded one.
    fn show(&self, parameters: &[f64], starts: &[State], causes: &[Cause]) -> Values {
        let acts = causes.iter().any(|cause| matches!(cause.place, Place::Input(_)));
        let acting = acts.then(|| self.case.acting(&self.run.commands, self.run.states.len(), causes));
        let values = self.play(parameters, starts, causes, acting.as_ref().unwrap_or(&self.plain));
        if !causes.iter().any(|cause| matches!(cause.place, Place::Output(_))) {
            return values;
        }
        let sensed = minus(&self.sensors(causes), &self.sensors(&[]));
        values.iter().zip(&sensed).map(|(a, b)| a + b).collect()
    }

    /// What the sensors show along the recorded motion, in noise units.
    fn sensors(&self, causes: &[Cause]) -> Values {
        let system = self.case.system;
        let outputs = system.outputs.len();
        let per = (SEGMENT as f64 * H * system.sample_rate).round() as usize;
        let mut values = vec![DVector::zeros(per * outputs); self.starts.len()];
        for o in 0..outputs {
            let shown = self.case.shown(o, &self.run.states, causes);
            for (segment, values) in values.iter_mut().enumerate() {
                for k in 0..per {
                    values[k * outputs + o] = shown[segment * per + k].1 / self.run.noise[o];
                }
            }
        }
        values
    }

    /// Sensor values in noise units over every segment.
    fn play(&self, parameters: &[f64], starts: &[State], causes: &[Cause], u: &[[f64; N]]) -> Values {
        let system = self.case.system;
        let machine = Machine::new(system, parameters, causes);
        let every = (1.0 / system.sample_rate / H).round() as usize;
        let one = |(segment, start): (usize, &State)| {
            let from = segment * SEGMENT;
            let mut s = *start;
            let mut hidden = machine.hidden();
            let mut values = Vec::with_capacity(SEGMENT / every * system.outputs.len());
            for (i, u) in u.iter().enumerate().skip(from).take(SEGMENT) {
                if i % every == 0 {
                    for (o, noise) in self.run.noise.iter().enumerate() {
                        values.push(reading(system, o, &s) / noise);
                    }
                }
                machine.step(&mut s, &mut hidden, u, i as f64 * H);
            }
            DVector::from_vec(values)
        };
        starts.iter().enumerate().map(one).collect()
    }
}

/// Adds a little to the diagonal, so that what the sensors hardly see moves little.
fn damp(matrix: &mut DMatrix<f64>, share: f64) {
    for k in 0..matrix.nrows() {
        matrix[(k, k)] = matrix[(k, k)] * (1.0 + share) + 1e-12;
    }
}

fn minus(a: &Values, b: &Values) -> Values {
    a.iter().zip(b).map(|(a, b)| a - b).collect()
}

fn square(values: &Values) -> f64 {
    values.iter().map(DVector::norm_squared).sum()
}
