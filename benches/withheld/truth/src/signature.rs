//! How visible a cause is in a case, and what cannot be told from it, by the generator's own simulations.
//!
//! The healthy machine is fitted to what the faulty one shows without noise: its calibrated parameters within their
//! bounds, and the initial state of every short segment. What is left, in units of the sensors' noise, is the cause's
//! signature; its square is the detectability. The fit is nonlinear: what a large cause and other parameters have in
//! common beyond the first order is no part of the signature. Others are alike when their change of the sensors' values,
//! less what the fit would follow to first order, points the same way.

use crate::case::{Case, Run, reading, stream};
use crate::effect::{Cause, Kind, Place, draw, label, table};
use crate::least_squares::{inverse, orthonormal, remove};
use crate::mechanics::{H, Machine};
use crate::system::{N, State};
use nalgebra::{DMatrix, DVector};

/// Steps of a segment (0.4 s).
const SEGMENT: usize = 4000;
/// Cosine above which two causes count as one class.
const ALIKE: f64 = 0.97;
/// Sizes that are tried of a cause that comes near, and the cosine from which it does.
const SIZES: usize = 6;
const NEAR: f64 = 0.3;
/// Steps of the fit, at most.
const STEPS: usize = 5;
/// Sum of squares below which nothing is left to fit.
const NOTHING: f64 = 0.01;

/// Sensor values in noise units, by segment.
type Values = Vec<DVector<f64>>;

/// The healthy machine, fitted.
struct View<'a> {
    case: &'a Case,
    run: &'a Run,
    /// What acts on the healthy machine.
    plain: Vec<[f64; N]>,
    parameters: Vec<f64>,
    starts: Vec<State>,
    nominal: Values,
    rest: Values,
    cost: f64,
}

/// What small changes do to the sensor values.
struct Slopes {
    /// By variable of the initial state, then by segment; in units of a step.
    local: Vec<Values>,
    local_steps: Vec<Vec<f64>>,
    /// By calibrated parameter; its index, the size of a step, and the values.
    global: Vec<(usize, f64, Values)>,
}

/// Twice the log-likelihood ratio that the causes are worth.
pub(crate) fn detectability(case: &Case, run: &Run) -> f64 {
    let view = View::fit(case, run);
    view.map_or(0.0, |view| view.cost) + scatter(case, run)
}

/// Twice the log-likelihood ratio that the causes are worth, and the labels of the class.
pub(crate) fn judge(case: &Case, run: &Run) -> (f64, Vec<String>) {
    let own = |c: &Cause| label(case.system, c.kind, c.place);
    let mut labels: Vec<String> = case.causes.iter().map(own).collect();
    let Some(view) = View::fit(case, run) else { return (scatter(case, run), labels) };
    if let [cause] = case.causes.as_slice()
        && !cause.kind.statistical()
        && view.cost > NOTHING
    {
        view.alike(&mut labels);
    }
    (view.cost + scatter(case, run), labels)
}

/// Causes that move what sensors show, rather than how readings scatter around it.
fn moving(case: &Case) -> Vec<Cause> {
    let moves = |c: &&Cause| !(c.kind.statistical() && matches!(c.place, Place::Output(_)));
    case.causes.iter().filter(moves).copied().collect()
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
        _ => {
            let plain = case.shown(o, &run.states, &[]);
            let at = |t: f64| plain.partition_point(|(s, _)| *s < t - 1e-9).min(plain.len() - 1);
            let excess = |(t, y): &(f64, f64)| ((y - plain[at(*t)].1) / noise).powi(2) - 1.0;
            run.readings[o].iter().map(excess).sum::<f64>().max(0.0)
        }
    }
}

impl<'a> View<'a> {
    /// Fits the healthy machine. None where no cause moves a reading.
    fn fit(case: &'a Case, run: &'a Run) -> Option<Self> {
        let causes = moving(case);
        if causes.is_empty() {
            return None;
        }
        let plain = case.acting(&run.commands, run.states.len(), &[]);
        let starts: Vec<State> =
            (0..run.states.len() / SEGMENT).map(|segment| run.states[segment * SEGMENT]).collect();
        let mut view = Self {
            case,
            run,
            plain,
            parameters: run.parameters.clone(),
            starts,
            nominal: Vec::new(),
            rest: Vec::new(),
            cost: 0.0,
        };
        view.nominal = view.play(&view.parameters, &view.starts, &[], &view.plain);
        let target = view.sensors(&causes);
        view.rest = minus(&target, &view.nominal);
        view.cost = square(&view.rest);
        for _ in 0..STEPS {
            let before = view.cost;
            if before < NOTHING || !view.follow(&target) || view.cost > 0.99 * before {
                break;
            }
        }
        Some(view)
    }

    /// One damped Gauss-Newton step. False where none lowers the sum of squares.
    fn follow(&mut self, target: &Values) -> bool {
        let slopes = self.slopes();
        let (by_parameter, by_start) = self.step(&slopes);
        for part in [1.0, 0.4, 0.1] {
            let mut parameters = self.parameters.clone();
            for ((k, size, _), step) in slopes.global.iter().zip(&by_parameter) {
                parameters[*k] += part * size * step;
            }
            let mut starts = self.starts.clone();
            for (segment, steps) in by_start.iter().enumerate() {
                for (i, step) in steps.iter().enumerate() {
                    *self.variable(&mut starts[segment], i) += part * slopes.local_steps[i][segment] * step;
                }
            }
            let nominal = self.play(&parameters, &starts, &[], &self.plain);
            let rest = minus(target, &nominal);
            let cost = square(&rest);
            if cost < self.cost {
                (self.parameters, self.starts, self.nominal) = (parameters, starts, nominal);
                (self.rest, self.cost) = (rest, cost);
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

    /// How far a parameter may still go down and up, in units of its step.
    fn room(&self, (k, size, _): &(usize, f64, Values)) -> (f64, f64) {
        let (low, high) =
            self.case.system.parameters[*k].bounds.unwrap_or((f64::NEG_INFINITY, f64::INFINITY));
        (((low - self.parameters[*k]) / size).min(0.0), ((high - self.parameters[*k]) / size).max(0.0))
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
    fn slopes(&self) -> Slopes {
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
            let moved = self.play(&self.parameters, &starts, &[], &self.plain);
            slopes.local.push(minus(&moved, &self.nominal));
            slopes.local_steps.push(sizes);
        }
        for (k, p) in system.parameters.iter().enumerate() {
            let Some((_, high)) = p.bounds else { continue };
            let size = 1e-3 * p.value.abs().max(p.spread * 0.1);
            let size = if self.parameters[k] + size > high { -size } else { size };
            let mut parameters = self.parameters.clone();
            parameters[k] += size;
            let moved = self.play(&parameters, &self.starts, &[], &self.plain);
            slopes.global.push((k, size, minus(&moved, &self.nominal)));
        }
        slopes
    }

    /// Adds the labels of all effects of the table that look like the cause.
    fn alike(&self, labels: &mut Vec<String>) {
        let case = self.case;
        let slopes = self.slopes();
        let span = Span::new(self, &slopes);
        let truth = span.beyond(&self.rest);
        let power = truth.norm_squared();
        for (i, (kind, place)) in table(case.system).into_iter().enumerate() {
            let name = label(case.system, kind, place);
            if kind.statistical() || labels.contains(&name) {
                continue;
            }
            let noise = match place {
                Place::Output(o) => self.run.noise[o],
                _ => 0.0,
            };
            if self.shifted(kind) {
                labels.push(name);
                continue;
            }
            // A signature depends on the size of a large cause: the true one's where it is the same effect elsewhere, else
            // some that might as well be there, as long as they come near.
            let mut rng = stream(0, 100 + i as u64);
            let mut sizes = Vec::new();
            if let [cause] = case.causes.as_slice()
                && (kind.names().0, kind.names().2) == (cause.kind.names().0, cause.kind.names().2)
            {
                sizes.push(Cause { kind, place, p: cause.p });
            }
            sizes.extend((0..SIZES).map(|_| draw(case.system, kind, place, case.duration, noise, &mut rng)));
            for cause in sizes {
                let other = span.beyond(&self.change(&cause));
                let size = (power * other.norm_squared()).sqrt();
                let along = truth.dot(&other);
                let along = if kind.two_sided() { along.abs() } else { along };
                if size > 0.0 && along >= ALIKE * size {
                    labels.push(name);
                    break;
                }
                if along < NEAR * size {
                    break;
                }
            }
        }
    }

    /// Whether it is the true cause's delay at the other end of a machine with one command and one sensor: the laws of motion
    /// are the same at all times, so that nobody can tell the two apart, however large they are.
    fn shifted(&self, kind: Kind) -> bool {
        let system = self.case.system;
        let one = system.inputs.len() == 1 && system.outputs.len() == 1;
        one && [self.case.causes[0].kind, kind].iter().all(|kind| kind.names().0 == "delay")
    }

    /// What a cause changes at the fitted point.
    fn change(&self, cause: &Cause) -> Values {
        let causes = [*cause];
        if let Place::Output(_) = cause.place {
            return minus(&self.sensors(&causes), &self.sensors(&[]));
        }
        let acting = matches!(cause.place, Place::Input(_))
            .then(|| self.case.acting(&self.run.commands, self.run.states.len(), &causes));
        let u = acting.as_ref().unwrap_or(&self.plain);
        minus(&self.play(&self.parameters, &self.starts, &causes, u), &self.nominal)
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

/// What the fit follows to first order.
struct Span {
    local: Vec<Vec<DVector<f64>>>,
    global: Vec<DVector<f64>>,
}

impl Span {
    fn new(view: &View, slopes: &Slopes) -> Self {
        let mut local = vec![Vec::new(); view.starts.len()];
        for (segment, columns) in local.iter_mut().enumerate() {
            for values in &slopes.local {
                orthonormal(columns, values[segment].clone());
            }
        }
        let mut span = Self { local, global: Vec::new() };
        for column in &slopes.global {
            // A parameter at its bound does not follow.
            let (low, high) = view.room(column);
            if low < 0.0 && high > 0.0 {
                let column = span.beyond(&column.2);
                orthonormal(&mut span.global, column);
            }
        }
        span
    }

    /// The part outside the span, as one row.
    fn beyond(&self, values: &Values) -> DVector<f64> {
        let mut all = Vec::<f64>::new();
        for (values, columns) in values.iter().zip(&self.local) {
            let mut r = values.clone();
            columns.iter().for_each(|c| remove(&mut r, c));
            all.extend(r.iter());
        }
        let mut all = DVector::from_vec(all);
        self.global.iter().for_each(|c| remove(&mut all, c));
        all
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
