//! Short windows with free initial states.
//!
//! The log is cut into windows of a fraction of a second. Each has an initial state of its own, fitted together with
//! the shared parameters; nothing drifts over more than a window, so closed loops and unstable plants are no trouble
//! (multiple shooting without continuity: Bock 1983; the states are eliminated window by window).

use nalgebra::{DMatrix, DVector};

use crate::fit::Local;
use crate::simulator::{Event, Prediction, Run, Simulator, Transition, wrapped};

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
}

/// How much earlier than its stamp a reading is taken at most: the largest delay of a reading (s).
#[must_use]
pub fn lateness(events: &[Event]) -> f64 {
    events.iter().filter_map(|e| Some(e.reading?.stamp - e.time)).fold(0.0, f64::max)
}

/// The events of a window: from its first reading to its last. `lateness` as [`lateness`] gives it.
#[must_use]
pub fn locate(events: &[Event], lateness: f64, from: f64, to: f64) -> Option<(usize, usize)> {
    let inside = |e: &Event| e.reading.is_some_and(|r| r.stamp >= from && r.stamp < to);
    // Events are in the order of time, which is the stamp or earlier.
    let begin = events.partition_point(|e| e.time < from - lateness - 1e-9);
    let first = begin + events[begin..].iter().position(inside)?;
    let stop = events.partition_point(|e| e.time < to);
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
}

/// The cost of the windows at the parameters θ, initial states eliminated.
///
/// `variance` per output weighs the residuals; each window's state is refined by two Gauss–Newton steps first.
pub fn shoot(
    simulator: &dyn Simulator,
    theta: &[f64],
    windows: &mut [Window],
    variance: &[f64],
) -> (Local, Residuals) {
    let (n, p) = (simulator.states(), simulator.parameters());
    let mut run = simulator.run(theta);
    let mut plain = simulator.run_at(theta);
    let mut total = Local { cost: 0.0, information: vec![0.0; p * p], gradient: vec![0.0; p] };
    let mut residuals =
        Residuals { squares: vec![0.0; variance.len()], counts: vec![0; variance.len()], scores: Vec::new() };
    let mut normal = Normal::new(n, p);
    // Initial states are settled without the derivatives by θ, which would be most of the work.
    let mut settling = Normal::new(n, 0);
    let late = lateness(run.events());
    for window in windows {
        let Some((first, end)) = locate(run.events(), late, window.from, window.to) else { continue };
        if n > 0 {
            settling.settle(&mut *plain, first, end, window, variance);
        }
        normal.march(&mut *run, first, end, window, variance, Some(&mut residuals));
        let before = total.gradient.clone();
        normal.eliminate(window, &mut total);
        residuals.scores.push(total.gradient.iter().zip(&before).map(|(after, b)| after - b).collect());
    }
    for (count, v) in residuals.counts.iter().zip(variance) {
        total.cost += *count as f64 * v.ln();
    }
    (total, residuals)
}

/// The normal equations of one window.
struct Normal {
    n: usize,
    p: usize,
    squares: f64,
    /// JᵀJ over `[state | θ]`.
    information: DMatrix<f64>,
    /// Jᵀe over the same.
    gradient: DVector<f64>,
    by_state: Vec<f64>,
    by_parameter: Vec<f64>,
    scratch: Vec<f64>,
    transition: Transition,
    prediction: Prediction,
}

impl Normal {
    fn new(n: usize, p: usize) -> Self {
        Normal {
            n,
            p,
            squares: 0.0,
            information: DMatrix::zeros(n + p, n + p),
            gradient: DVector::zeros(n + p),
            by_state: vec![0.0; n * n],
            by_parameter: vec![0.0; n * p],
            scratch: vec![0.0; n * n.max(p)],
            transition: Transition::default(),
            prediction: Prediction::default(),
        }
    }

    fn march(
        &mut self,
        run: &mut dyn Run,
        first: usize,
        end: usize,
        window: &Window,
        variance: &[f64],
        mut residuals: Option<&mut Residuals>,
    ) {
        let (n, p) = (self.n, self.p);
        self.squares = 0.0;
        self.information.fill(0.0);
        self.gradient.fill(0.0);
        self.by_parameter.fill(0.0);
        self.by_state.fill(0.0);
        for i in 0..n {
            self.by_state[i * n + i] = 1.0;
        }
        let mut x = window.state.clone();
        let mut row = vec![0.0; n + p];
        for index in first..end {
            let reading = run.events()[index].reading;
            if let Some(reading) = reading.filter(|r| r.stamp >= window.from && r.stamp < window.to) {
                run.observe(index, &x, &mut self.prediction);
                let e = wrapped(reading.value - self.prediction.value, run.wrap(reading.output));
                let weight = 1.0 / variance[reading.output];
                if let Some(residuals) = residuals.as_deref_mut() {
                    residuals.squares[reading.output] += e * e;
                    residuals.counts[reading.output] += 1;
                }
                self.squares += e * e * weight;
                for (j, entry) in row.iter_mut().take(n).enumerate() {
                    *entry =
                        -(0..n).map(|i| self.prediction.by_state[i] * self.by_state[i * n + j]).sum::<f64>();
                }
                for j in 0..p {
                    let through: f64 =
                        (0..n).map(|i| self.prediction.by_state[i] * self.by_parameter[i * p + j]).sum();
                    row[n + j] = -(through + self.prediction.by_parameter[j]);
                }
                for i in 0..n + p {
                    self.gradient[i] += row[i] * e * weight;
                    for j in 0..=i {
                        self.information[(i, j)] += row[i] * row[j] * weight;
                    }
                }
            }
            if index + 1 < end {
                run.advance(index, &mut x, &mut self.transition);
                for i in 0..n {
                    for j in 0..n {
                        self.scratch[i * n + j] = (0..n)
                            .map(|k| self.transition.by_state[i * n + k] * self.by_state[k * n + j])
                            .sum();
                    }
                }
                self.by_state.copy_from_slice(&self.scratch[..n * n]);
                for i in 0..n {
                    for j in 0..p {
                        let through: f64 = (0..n)
                            .map(|k| self.transition.by_state[i * n + k] * self.by_parameter[k * p + j])
                            .sum();
                        self.scratch[i * p + j] = through + self.transition.by_parameter[i * p + j];
                    }
                }
                self.by_parameter.copy_from_slice(&self.scratch[..n * p]);
            }
        }
        for i in 0..n + p {
            for j in 0..i {
                self.information[(j, i)] = self.information[(i, j)];
            }
        }
    }

    /// Squared residuals and the weak prior of the initial state.
    fn cost(&self, window: &Window) -> f64 {
        let prior: f64 = window
            .state
            .iter()
            .zip(&window.guess)
            .zip(&window.std)
            .map(|((x, g), s)| ((x - g) / s).powi(2))
            .sum();
        self.squares + prior
    }

    /// Hessian and gradient of the initial state, its prior included.
    fn state_system(&self, window: &Window) -> (DMatrix<f64>, DVector<f64>) {
        let n = self.n;
        let mut a = self.information.view((0, 0), (n, n)).into_owned();
        let mut g = self.gradient.rows(0, n).into_owned();
        for i in 0..n {
            let precision = window.std[i].powi(-2);
            a[(i, i)] += precision;
            g[i] += precision * (window.state[i] - window.guess[i]);
        }
        (a, g)
    }

    /// Damped Gauss–Newton on the initial state alone, from where the window's state is.
    fn settle(&mut self, run: &mut dyn Run, first: usize, end: usize, window: &mut Window, variance: &[f64]) {
        self.march(run, first, end, window, variance, None);
        let mut cost = self.cost(window);
        // At other parameters the state found before may lie beyond a stop or a turn: the guess never does.
        let found = std::mem::replace(&mut window.state, window.guess.clone());
        self.march(run, first, end, window, variance, None);
        let guessed = self.cost(window);
        if guessed < cost {
            cost = guessed;
        } else {
            window.state = found;
            self.march(run, first, end, window, variance, None);
        }
        for _ in 0..4 {
            let Some(step) = self.state_step(window) else { return };
            let before = window.state.clone();
            let mut share = 1.0;
            let gain = loop {
                for ((x, b), d) in window.state.iter_mut().zip(&before).zip(step.iter()) {
                    *x = b + share * d;
                }
                self.march(run, first, end, window, variance, None);
                let trial = self.cost(window);
                if trial < cost {
                    break cost - trial;
                }
                share *= 0.3;
                if share < 0.02 {
                    window.state = before;
                    return;
                }
            };
            cost -= gain;
            if gain < 1e-3 * cost.max(1e-3) {
                return;
            }
        }
    }

    fn state_step(&self, window: &Window) -> Option<DVector<f64>> {
        let (a, g) = self.state_system(window);
        a.cholesky().map(|c| -c.solve(&g))
    }

    /// Adds the window to the total, its state projected out (Schur complement).
    fn eliminate(&self, window: &Window, total: &mut Local) {
        let (n, p) = (self.n, self.p);
        total.cost += self.cost(window);
        let cross = self.information.view((0, n), (n, p));
        let (a, g) = self.state_system(window);
        let reduced = if n == 0 { None } else { a.cholesky() };
        for i in 0..p {
            let solved = reduced.as_ref().map(|c| c.solve(&cross.column(i).into_owned()));
            total.gradient[i] += self.gradient[n + i] - solved.as_ref().map_or(0.0, |s| s.dot(&g));
            for j in 0..p {
                let through = solved.as_ref().map_or(0.0, |s| s.dot(&cross.column(j)));
                total.information[i * p + j] += self.information[(n + i, n + j)] - through;
            }
        }
    }
}
