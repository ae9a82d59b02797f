//! The innovation likelihood: an extended Kalman filter along the log, with derivatives by the parameters.
//!
//! Each reading is predicted from the earlier ones; the difference is the innovation. Process noise enters as white
//! acceleration of unknown intensity, so that a model that is wrong is corrected by the readings and charged for it,
//! instead of drifting away (Kristensen, Madsen & Jørgensen 2004, "Parameter estimation in stochastic grey-box
//! models"). Derivatives of the innovations hold the gain fixed: the recursion of the prediction-error method
//! (Ljung, "System Identification", section 11.3).

use crate::simulator::{Prediction, Run, Transition, wrapped};

/// Noise intensities.
#[derive(Clone, Debug, PartialEq)]
pub struct Noise {
    /// Natural logarithm of the process noise, a variance per second in units of each state's `scale` squared.
    pub log_process: f64,
    /// Natural logarithm of the variance of each output's noise.
    pub log_output: Vec<f64>,
}

/// What is known of the state before the first reading of a segment.
#[derive(Clone, Debug)]
pub struct Start {
    /// Index of the first event of the segment.
    pub first: usize,
    /// Index after the last event of the segment.
    pub end: usize,
    /// The state guessed at the first event.
    pub state: Vec<f64>,
    /// Its standard deviation; large where nothing is known.
    pub std: Vec<f64>,
}

/// The walk of a filter along a log, linearised.
#[derive(Clone, Debug, Default)]
pub struct Pass {
    states: usize,
    parameters: usize,
    /// Innovations, reading by reading.
    pub innovation: Vec<f64>,
    /// Their predicted variances.
    pub variance: Vec<f64>,
    /// ∂innovation/∂θ, readings × parameters.
    pub by_parameter: Vec<f64>,
    /// Output of each reading.
    pub output: Vec<usize>,
    /// Stamp of each reading (s).
    pub stamp: Vec<f64>,
    /// Event index of each reading.
    pub event: Vec<usize>,
    /// State after each reading, readings × states.
    pub state: Vec<f64>,
    tape: Vec<Tape>,
    by_state: Vec<f64>,
    output_by_state: Vec<f64>,
    gain: Vec<f64>,
    start_variance: Vec<f64>,
}

/// The steps of a pass, kept to evaluate other noise intensities without the model.
#[derive(Clone, Copy, Debug)]
enum Tape {
    Begin(usize),
    Advance { dt: f64, by_state: usize },
    Read(usize),
}

/// Scratch space of the covariance recursion.
struct Covariance {
    n: usize,
    p: Vec<f64>,
    scratch: Vec<f64>,
    half: Vec<f64>,
}

impl Covariance {
    fn new(n: usize) -> Self {
        Covariance { n, p: vec![0.0; n * n], scratch: vec![0.0; n * n], half: vec![0.0; n * n] }
    }

    fn reset(&mut self, variance: &[f64]) {
        self.p.fill(0.0);
        for (i, v) in variance.iter().enumerate() {
            self.p[i * self.n + i] = *v;
        }
    }

    /// P ← Φ P Φᵀ + dt (Φ_½ B Φ_½ᵀ), with Φ_½ = (I + Φ)/2: the noise enters, on average, in the middle of the step.
    fn advance(&mut self, phi: &[f64], dt: f64, intensity: &[f64]) {
        let n = self.n;
        for i in 0..n {
            for j in 0..n {
                self.scratch[i * n + j] = (0..n).map(|k| phi[i * n + k] * self.p[k * n + j]).sum();
                self.half[i * n + j] = 0.5 * (phi[i * n + j] + f64::from(u8::from(i == j)));
            }
        }
        for i in 0..n {
            for j in 0..=i {
                let propagated: f64 = (0..n).map(|k| self.scratch[i * n + k] * phi[j * n + k]).sum();
                let added: f64 =
                    (0..n).map(|k| self.half[i * n + k] * intensity[k] * self.half[j * n + k]).sum();
                let value = propagated + dt * added;
                self.p[i * n + j] = value;
                self.p[j * n + i] = value;
            }
        }
    }

    /// Variance of the innovation of a reading with gradient `h`, writing the gain.
    fn innovate(&self, h: &[f64], noise: f64, gain: &mut [f64]) -> f64 {
        let n = self.n;
        let mut variance = noise;
        for i in 0..n {
            gain[i] = (0..n).map(|j| self.p[i * n + j] * h[j]).sum();
            variance += h[i] * gain[i];
        }
        for g in gain.iter_mut() {
            *g /= variance;
        }
        variance
    }

    /// P ← P − K s Kᵀ.
    fn update(&mut self, gain: &[f64], variance: f64) {
        let n = self.n;
        for i in 0..n {
            for j in 0..n {
                self.p[i * n + j] -= gain[i] * variance * gain[j];
            }
            // Rounding must not make a variance negative where the reading pins the state down.
            let diagonal = &mut self.p[i * n + i];
            *diagonal = diagonal.max(0.0);
        }
    }
}

/// Runs the filter over the segments at the run's parameters.
///
/// `scale` gives the size of the process noise per state, zero for a state that only integrates another one.
pub fn filter(
    run: &mut dyn Run,
    starts: &[Start],
    states: usize,
    parameters: usize,
    scale: &[f64],
    noise: &Noise,
) -> Pass {
    let (n, p) = (states, parameters);
    let mut pass = Pass { states: n, parameters: p, ..Pass::default() };
    let intensity = intensities(scale, noise);
    let mut covariance = Covariance::new(n);
    let mut transition = Transition::default();
    let mut prediction = Prediction::default();
    let mut gain = vec![0.0; n];
    let mut sensitivity = vec![0.0; n * p];
    let mut advanced = vec![0.0; n * p];
    for start in starts {
        let mut x = start.state.clone();
        let variance: Vec<f64> = start.std.iter().map(|s| s * s).collect();
        covariance.reset(&variance);
        sensitivity.fill(0.0);
        pass.tape.push(Tape::Begin(pass.start_variance.len()));
        pass.start_variance.extend_from_slice(&variance);
        for index in start.first..start.end {
            if let Some(reading) = run.events()[index].reading {
                run.observe(index, &x, &mut prediction);
                let innovation = wrapped(reading.value - prediction.value, run.wrap(reading.output));
                let s = covariance.innovate(
                    &prediction.by_state,
                    noise.log_output[reading.output].exp(),
                    &mut gain,
                );
                let row = pass.by_parameter.len();
                for j in 0..p {
                    let through: f64 = (0..n).map(|i| prediction.by_state[i] * sensitivity[i * p + j]).sum();
                    pass.by_parameter.push(-(through + prediction.by_parameter[j]));
                }
                for i in 0..n {
                    x[i] += gain[i] * innovation;
                    for j in 0..p {
                        sensitivity[i * p + j] += gain[i] * pass.by_parameter[row + j];
                    }
                }
                covariance.update(&gain, s);
                pass.tape.push(Tape::Read(pass.innovation.len()));
                pass.innovation.push(innovation);
                pass.variance.push(s);
                pass.output.push(reading.output);
                pass.stamp.push(reading.stamp);
                pass.event.push(index);
                pass.state.extend_from_slice(&x);
                pass.output_by_state.extend_from_slice(&prediction.by_state);
                pass.gain.extend_from_slice(&gain);
            }
            if index + 1 < start.end {
                let dt = run.events()[index + 1].time - run.events()[index].time;
                run.advance(index, &mut x, &mut transition);
                covariance.advance(&transition.by_state, dt, &intensity);
                for i in 0..n {
                    for j in 0..p {
                        let through: f64 =
                            (0..n).map(|k| transition.by_state[i * n + k] * sensitivity[k * p + j]).sum();
                        advanced[i * p + j] = through + transition.by_parameter[i * p + j];
                    }
                }
                std::mem::swap(&mut sensitivity, &mut advanced);
                pass.tape.push(Tape::Advance { dt, by_state: pass.by_state.len() });
                pass.by_state.extend_from_slice(&transition.by_state);
            }
        }
    }
    pass
}

fn intensities(scale: &[f64], noise: &Noise) -> Vec<f64> {
    scale.iter().map(|s| s * s * noise.log_process.exp()).collect()
}

impl Pass {
    /// −2 log of the likelihood, up to a constant that is the same for every hypothesis on these readings.
    #[must_use]
    pub fn cost(&self) -> f64 {
        self.innovation.iter().zip(&self.variance).map(|(e, s)| e * e / s + s.ln()).sum()
    }

    /// How many readings were predicted.
    #[must_use]
    pub fn readings(&self) -> usize {
        self.innovation.len()
    }

    /// Innovations divided by their predicted standard deviation.
    #[must_use]
    pub fn whitened(&self) -> Vec<f64> {
        self.innovation.iter().zip(&self.variance).map(|(e, s)| e / s.sqrt()).collect()
    }

    /// The rows of ∂(whitened innovation)/∂θ, the gain held fixed; readings × parameters.
    #[must_use]
    pub fn whitened_by_parameter(&self) -> Vec<f64> {
        let p = self.parameters.max(1);
        self.by_parameter
            .chunks(p)
            .zip(&self.variance)
            .flat_map(|(row, s)| row.iter().map(move |d| d / s.sqrt()))
            .collect()
    }

    /// Adds this pass's JᵀJ and Jᵀe of the whitened innovations to `information` (p × p) and `gradient` (p).
    pub fn accumulate(&self, information: &mut [f64], gradient: &mut [f64]) {
        let p = self.parameters;
        if p == 0 {
            return;
        }
        for ((row, e), s) in self.by_parameter.chunks(p).zip(&self.innovation).zip(&self.variance) {
            for i in 0..p {
                gradient[i] += row[i] * e / s;
                for j in 0..=i {
                    information[i * p + j] += row[i] * row[j] / s;
                }
            }
        }
        for i in 0..p {
            for j in 0..i {
                information[j * p + i] = information[i * p + j];
            }
        }
    }

    /// −2 log likelihood at another noise, around the walk that was linearised. Needs no model evaluation.
    #[must_use]
    pub fn cost_at(&self, scale: &[f64], noise: &Noise) -> f64 {
        let n = self.states;
        let intensity = intensities(scale, noise);
        let output: Vec<f64> = noise.log_output.iter().map(|r| r.exp()).collect();
        let mut covariance = Covariance::new(n);
        // Deviation from the stored walk, which follows the stored gains.
        let mut deviation = vec![0.0; n];
        let mut advanced = vec![0.0; n];
        let mut gain = vec![0.0; n];
        let mut cost = 0.0;
        for step in &self.tape {
            match *step {
                Tape::Begin(at) => {
                    covariance.reset(&self.start_variance[at..at + n]);
                    deviation.fill(0.0);
                }
                Tape::Advance { dt, by_state } => {
                    let phi = &self.by_state[by_state..by_state + n * n];
                    covariance.advance(phi, dt, &intensity);
                    for i in 0..n {
                        advanced[i] = (0..n).map(|k| phi[i * n + k] * deviation[k]).sum();
                    }
                    std::mem::swap(&mut deviation, &mut advanced);
                }
                Tape::Read(k) => {
                    let h = &self.output_by_state[k * n..(k + 1) * n];
                    let s = covariance.innovate(h, output[self.output[k]], &mut gain);
                    let shift: f64 = (0..n).map(|i| h[i] * deviation[i]).sum();
                    let innovation = self.innovation[k] - shift;
                    for i in 0..n {
                        deviation[i] += gain[i] * innovation - self.gain[k * n + i] * self.innovation[k];
                    }
                    covariance.update(&gain, s);
                    cost += innovation * innovation / s + s.ln();
                }
            }
        }
        cost
    }

    /// The noise that makes the innovations likeliest around this walk: a coordinate search on the logarithms.
    ///
    /// `limits` bound each output's log variance, equal ones fix it; `process_floor` bounds the process noise.
    #[must_use]
    pub fn refit_noise(
        &self,
        scale: &[f64],
        noise: &Noise,
        limits: &[(f64, f64)],
        process_floor: f64,
    ) -> Noise {
        let mut best = noise.clone();
        let mut cost = self.cost_at(scale, &best);
        let process = scale.iter().any(|s| *s > 0.0);
        let mut step = 1.5_f64;
        while step > 0.08 {
            let mut improved = false;
            for coordinate in 0..=best.log_output.len() {
                for direction in [-1.0, 1.0] {
                    let mut trial = best.clone();
                    if coordinate == 0 {
                        if !process {
                            continue;
                        }
                        trial.log_process = (trial.log_process + direction * step).max(process_floor);
                    } else {
                        let (low, high) = limits[coordinate - 1];
                        let value = &mut trial.log_output[coordinate - 1];
                        *value = (*value + direction * step).clamp(low, high);
                    }
                    if trial == best {
                        continue;
                    }
                    let trial_cost = self.cost_at(scale, &trial);
                    if trial_cost < cost {
                        (best, cost, improved) = (trial, trial_cost, true);
                        break;
                    }
                }
            }
            if !improved {
                step /= 2.0;
            }
        }
        best
    }
}
