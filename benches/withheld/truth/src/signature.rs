//! How visible a cause is in a case, and what cannot be told from it, by the generator's own simulations.
//!
//! A signature is the change of the sensors' values, in units of their noise, that a cause makes over short segments
//! with a free initial state, after the span of the calibrated parameters has been projected out.

use crate::case::{Case, Run, noises, reading, stream};
use crate::effect::{Cause, Kind, Place, draw, label, table};
use crate::mechanics::{H, Machine};
use crate::system::{N, State};

/// Steps of a segment (0.4 s).
const SEGMENT: usize = 4000;
/// Cosine above which two causes count as one class.
const ALIKE: f64 = 0.97;

struct View<'a> {
    case: &'a Case,
    run: &'a Run,
    plain: Vec<[f64; N]>,
    nominal: Vec<Vec<f64>>,
    local: Vec<Vec<Vec<f64>>>,
    global: Vec<Vec<f64>>,
}

/// Twice the log-likelihood ratio that the causes are worth, and the labels of the class.
pub(crate) fn judge(case: &Case, run: &Run) -> (f64, Vec<String>) {
    if case.causes.is_empty() {
        return (0.0, Vec::new());
    }
    let mut view = View::new(case, run);
    let own = |c: &Cause| label(case.system, c.kind, c.place);
    let mut labels: Vec<String> = case.causes.iter().map(own).collect();
    let statistical: f64 = case.causes.iter().map(|c| view.likelihood(c)).sum();
    let lasting: Vec<Cause> = case.causes.iter().filter(|c| !c.kind.statistical()).copied().collect();
    if lasting.is_empty() {
        return (statistical, labels);
    }
    let truth = view.signature(&lasting);
    let power = dot(&truth, &truth);
    if case.causes.len() == 1 && power > 0.0 {
        for (i, (kind, place)) in table(case.system).into_iter().enumerate() {
            let name = label(case.system, kind, place);
            if kind.statistical() || labels.contains(&name) {
                continue;
            }
            let noise = match place {
                Place::Output(o) => run.noise[o],
                _ => 0.0,
            };
            let mut rng = stream(0, 100 + i as u64);
            let other = view.signature(&[draw(case.system, kind, place, case.duration, noise, &mut rng)]);
            let size = (power * dot(&other, &other)).sqrt();
            if size > 0.0 && dot(&truth, &other).abs() >= ALIKE * size {
                labels.push(name);
            }
        }
    }
    (power + statistical, labels)
}

impl<'a> View<'a> {
    fn new(case: &'a Case, run: &'a Run) -> Self {
        let plain = case.acting(&run.commands, run.states.len(), &[]);
        let mut view = Self { case, run, plain, nominal: Vec::new(), local: Vec::new(), global: Vec::new() };
        let system = case.system;
        view.nominal = view.play(&run.parameters, &[], &view.plain, |_| {});
        let joints = system.joints.len();
        let mut local: Vec<Vec<Vec<f64>>> = vec![Vec::new(); view.nominal.len()];
        for i in 0..2 * joints + system.extras {
            let moved = view.play(&run.parameters, &[], &view.plain, |s| {
                let x = match i {
                    i if i < joints => &mut s.q[i],
                    i if i < 2 * joints => &mut s.v[i - joints],
                    i => &mut s.x[i - 2 * joints],
                };
                *x += 1e-4 * x.abs().max(0.1);
            });
            for (columns, (moved, nominal)) in local.iter_mut().zip(moved.iter().zip(&view.nominal)) {
                orthonormal(columns, moved.iter().zip(nominal).map(|(a, b)| a - b).collect());
            }
        }
        view.local = local;
        for (k, p) in system.parameters.iter().enumerate().filter(|(_, p)| p.bounds.is_some()) {
            let mut parameters = run.parameters.clone();
            parameters[k] += 1e-3 * p.value.abs().max(p.spread * 0.1);
            let moved = view.play(&parameters, &[], &view.plain, |_| {});
            let column = view.projected(&moved);
            orthonormal(&mut view.global, column);
        }
        view
    }

    /// Sensor values in noise units over every segment, each started from the truth.
    fn play(
        &self,
        parameters: &[f64],
        causes: &[Cause],
        u: &[[f64; N]],
        start: impl Fn(&mut State),
    ) -> Vec<Vec<f64>> {
        let system = self.case.system;
        let machine = Machine::new(system, parameters, causes);
        let every = (1.0 / system.sample_rate / H).round() as usize;
        (0..self.run.states.len() / SEGMENT)
            .map(|segment| {
                let from = segment * SEGMENT;
                let mut s = self.run.states[from];
                start(&mut s);
                let mut hidden = machine.hidden();
                let mut values = Vec::new();
                for i in from..from + SEGMENT {
                    if i % every == 0 {
                        for (o, noise) in self.run.noise.iter().enumerate() {
                            values.push(reading(system, o, &s) / noise);
                        }
                    }
                    machine.step(&mut s, &mut hidden, &u[i], i as f64 * H);
                }
                values
            })
            .collect()
    }

    fn projected(&self, moved: &[Vec<f64>]) -> Vec<f64> {
        let mut all = Vec::new();
        for ((moved, nominal), columns) in moved.iter().zip(&self.nominal).zip(&self.local) {
            let mut r: Vec<f64> = moved.iter().zip(nominal).map(|(a, b)| a - b).collect();
            columns.iter().for_each(|c| remove(&mut r, c));
            all.extend(r);
        }
        all
    }

    fn signature(&mut self, causes: &[Cause]) -> Vec<f64> {
        let system = self.case.system;
        let inputs = causes.iter().any(|c| matches!(c.place, Place::Input(_)));
        let joints = causes.iter().any(|c| matches!(c.place, Place::Joint(_)));
        let acting = inputs.then(|| self.case.acting(&self.run.commands, self.run.states.len(), causes));
        let mut moved = if inputs || joints {
            self.play(&self.run.parameters, causes, acting.as_ref().unwrap_or(&self.plain), |_| {})
        } else {
            self.nominal.clone()
        };
        for o in 0..system.outputs.len() {
            if !causes.iter().any(|c| c.place == Place::Output(o)) {
                continue;
            }
            let plain = self.case.shown(o, &self.run.states, &[]);
            let shown = self.case.shown(o, &self.run.states, causes);
            let per = (SEGMENT as f64 * H * system.sample_rate).round() as usize;
            for (segment, values) in moved.iter_mut().enumerate() {
                for k in 0..per {
                    let at = segment * per + k;
                    values[k * system.outputs.len() + o] += (shown[at].1 - plain[at].1) / self.run.noise[o];
                }
            }
        }
        let mut r = self.projected(&moved);
        self.global.iter().for_each(|c| remove(&mut r, c));
        r
    }

    /// Twice the log-likelihood ratio of a cause that changes how values scatter.
    fn likelihood(&mut self, cause: &Cause) -> f64 {
        let a = cause.p[0];
        let (Place::Output(o), true) = (cause.place, cause.kind.statistical()) else {
            return if cause.kind.statistical() {
                let r = self.signature(&[*cause]);
                dot(&r, &r)
            } else {
                0.0
            };
        };
        let noise = noises(self.case.system, self.case.seed)[o];
        let count = self.run.readings[o].len() as f64;
        let excess = |variance: f64| count * (variance - variance.ln_1p());
        match cause.kind {
            // Without a stated noise, more of it is no gap.
            Kind::Noise if !self.run.declared => 0.0,
            Kind::Noise => excess((a / noise).powi(2)),
            Kind::Quantization => excess((a / noise).powi(2) / 12.0),
            // 10 to 50 times the noise: 30 on average, squared.
            Kind::Outliers => count * a * 1000.0,
            Kind::DropsOut => {
                let lost = self.case.duration * self.case.system.sample_rate - count;
                2.0 * lost.max(0.0) * 1000f64.ln()
            }
            _ => {
                let plain = self.case.shown(o, &self.run.states, &[]);
                let at = |t: f64| plain.partition_point(|(s, _)| *s < t - 1e-9).min(plain.len() - 1);
                let excess = |(t, y): &(f64, f64)| ((y - plain[at(*t)].1) / noise).powi(2) - 1.0;
                self.run.readings[o].iter().map(excess).sum::<f64>().max(0.0)
            }
        }
    }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

fn remove(r: &mut [f64], unit: &[f64]) {
    let part = dot(r, unit);
    r.iter_mut().zip(unit).for_each(|(r, u)| *r -= part * u);
}

/// Adds a column to an orthonormal basis, unless it lies in its span.
fn orthonormal(basis: &mut Vec<Vec<f64>>, mut column: Vec<f64>) {
    let before = dot(&column, &column).sqrt();
    for _ in 0..2 {
        basis.iter().for_each(|b| remove(&mut column, b));
    }
    let size = dot(&column, &column).sqrt();
    if size > 1e-6 * before && size > 0.0 {
        column.iter_mut().for_each(|x| *x /= size);
        basis.push(column);
    }
}
