//! Where an episode begins: the states that explain its first readings.

use nalgebra::{DMatrix, DVector};
use parallax_runtime::random::{Purpose, stream};
use rand_distr::{Distribution, StandardNormal};

use crate::shooting::{lateness, locate};
use crate::simulator::{Prediction, Simulator, Transition, wrapped};

/// Most steps of the fit.
const STEPS: usize = 20;

/// A state and how well it is known.
#[derive(Clone, Debug)]
pub(super) struct Start {
    /// When (s).
    pub(super) time: f64,
    state: DVector<f64>,
    /// A square root of its covariance.
    spread: DMatrix<f64>,
}

/// Readings of a stretch, compared with what a state predicts.
struct Compared {
    /// −2 log likelihood and prior, up to constants.
    cost: f64,
    information: DMatrix<f64>,
    gradient: DVector<f64>,
    readings: usize,
}

impl Start {
    /// Fits the states at `from` (s) to the readings until `to`, beginning from `guess` and its standard deviations; `noise`
    /// is each output's. `None` where nothing is read there, or the model cannot follow what is.
    ///
    /// Damped Gauss–Newton steps (Levenberg 1944; Nocedal & Wright, "Numerical Optimization", section 10.3). The covariance
    /// is that of the residuals: a model that follows its readings badly knows its state less well.
    pub(super) fn fit(
        simulator: &dyn Simulator,
        span: (f64, f64),
        guess: (&[f64], &[f64]),
        noise: &[f64],
    ) -> Option<Self> {
        let mut run = simulator.run_at(&vec![0.0; simulator.parameters()]);
        let late = lateness(run.events());
        let (first, end) = locate(run.events(), late, span.0 - late, span.1)?;
        let time = run.events()[first].time;
        let (mean, std) = simulator.start(guess.0, guess.1, time);
        let n = mean.len();
        let mean = DVector::from_vec(mean);
        let precision = DVector::from_iterator(n, std.iter().map(|s| s.max(1e-12).powi(-2)));
        let mut compare = |state: &DVector<f64>| {
            let away = state - &mean;
            let mut found = Compared {
                cost: away.component_mul(&away).dot(&precision),
                information: DMatrix::from_diagonal(&precision),
                gradient: -precision.component_mul(&away),
                readings: 0,
            };
            let mut x: Vec<f64> = state.iter().copied().collect();
            let mut by = DMatrix::identity(n, n);
            let (mut transition, mut prediction) = (Transition::default(), Prediction::default());
            for index in first..end {
                if let Some(reading) = run.events()[index].reading {
                    run.observe(index, &x, &mut prediction);
                    let output = reading.output;
                    let error = wrapped(reading.value - prediction.value, run.wrap(output)) / noise[output];
                    let row =
                        DVector::from_column_slice(&prediction.by_state).transpose() * &by / noise[output];
                    found.cost += error * error;
                    found.gradient += row.transpose() * error;
                    found.information += row.transpose() * row;
                    found.readings += 1;
                }
                if index + 1 < end {
                    run.advance(index, &mut x, &mut transition);
                    by = DMatrix::from_row_slice(n, n, &transition.by_state) * by;
                }
            }
            found
        };
        let mut state = mean.clone();
        let mut at = compare(&state);
        let mut damping = 1e-3;
        for _ in 0..STEPS {
            let mut damped = at.information.clone();
            for i in 0..n {
                damped[(i, i)] *= 1.0 + damping;
            }
            let Some(step) = damped.cholesky().map(|factor| factor.solve(&at.gradient)) else { break };
            let there = &state + &step;
            let found = compare(&there);
            if found.cost < at.cost {
                let gained = at.cost - found.cost;
                (state, at) = (there, found);
                damping *= 0.1;
                if gained < 1e-6 * (1.0 + at.cost) {
                    break;
                }
            } else {
                damping *= 10.0;
                if damping > 1e9 {
                    break;
                }
            }
        }
        if !at.cost.is_finite() {
            return None;
        }
        let excess = (at.cost / at.readings.saturating_sub(n).max(1) as f64).max(1.0);
        let covariance = at.information.cholesky()?.inverse() * excess;
        Some(Start { time, state, spread: covariance.cholesky()?.unpack() })
    }

    /// A state as it may have been.
    pub(super) fn draw(&self, seed: u64) -> Vec<f64> {
        let mut random = stream(seed, Purpose::Node, "start");
        let n = self.state.len();
        let normal = DVector::from_iterator(n, (0..n).map(|_| StandardNormal.sample(&mut random)));
        (&self.state + &self.spread * normal).iter().copied().collect()
    }
}
