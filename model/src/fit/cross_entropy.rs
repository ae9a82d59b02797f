//! The cross-entropy method.
//!
//! P.-T. de Boer, D. P. Kroese, S. Mannor and R. Y. Rubinstein, *A Tutorial on the Cross-Entropy Method* (Annals of
//! Operations Research 134, 2005), section 5.1 for continuous problems: independent normal distributions are moved to mean
//! and spread of an elite, smoothed, the spread with a rate that falls so that it does not collapse too early.

use serde::{Deserialize, Serialize};

use super::normal::{draw, stream};
use super::{Ask, Best, Bounds, FitError, Solver, Stop, Tell, View, ranked};

/// Settings of [`CrossEntropy`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CrossEntropyOptions {
    /// Points in a generation; absent: 20 for each parameter, at least 100.
    pub population: Option<usize>,
    /// The share of them that is the elite.
    pub elite: f64,
    /// How much a new mean counts.
    pub smoothing: f64,
    /// How much a new spread counts at first.
    pub spread_smoothing: f64,
    /// Generations.
    pub generations: usize,
    /// First standard deviation, in widths of the box.
    pub sigma: f64,
    /// It has converged when all standard deviations are below this, in widths of the box.
    pub step_tolerance: f64,
    /// It ends when a loss is as low as this.
    pub target: Option<f64>,
    /// How much of the data counts.
    pub share: f64,
    /// Seed of all it draws.
    pub seed: u64,
}

impl Default for CrossEntropyOptions {
    fn default() -> Self {
        Self {
            population: None,
            elite: 0.1,
            smoothing: 0.9,
            spread_smoothing: 0.8,
            generations: 200,
            sigma: 0.3,
            step_tolerance: 1e-8,
            target: None,
            share: 1.0,
            seed: 1,
        }
    }
}

/// The cross-entropy method: its distribution, and what it waits for.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CrossEntropy {
    options: CrossEntropyOptions,
    bounds: Bounds,
    population: usize,
    scale: Vec<f64>,
    mean: Vec<f64>,
    std: Vec<f64>,
    generation: usize,
    asked: Vec<Vec<f64>>,
    best: Option<Best>,
    stop: Option<Stop>,
}

impl CrossEntropy {
    /// A search that begins at `start`.
    ///
    /// # Errors
    ///
    /// [`FitError`] when the start does not fit the bounds, or an option is impossible.
    pub fn new(bounds: Bounds, start: &[f64], options: CrossEntropyOptions) -> Result<Self, FitError> {
        bounds.check(start)?;
        let share_of = |name, value: f64| match value > 0.0 && value <= 1.0 {
            true => Ok(()),
            false => {
                Err(FitError::Option { name, value, problem: "it has to be above zero and at most one" })
            }
        };
        share_of("elite", options.elite)?;
        share_of("smoothing", options.smoothing)?;
        share_of("spread_smoothing", options.spread_smoothing)?;
        share_of("share", options.share)?;
        let population = options.population.unwrap_or((20 * bounds.len()).max(100));
        if population < 2 {
            let problem = "a generation needs at least two points";
            return Err(FitError::Option { name: "population", value: population as f64, problem });
        }
        let scale: Vec<f64> = (0..bounds.len()).map(|i| bounds.scale(i, start[i])).collect();
        Ok(Self {
            population,
            mean: start.iter().enumerate().map(|(i, x)| bounds.unfold(i, *x) / scale[i]).collect(),
            std: vec![options.sigma; bounds.len()],
            scale,
            generation: 0,
            asked: Vec::new(),
            best: None,
            stop: bounds.is_empty().then_some(Stop::Converged),
            bounds,
            options,
        })
    }

    fn point(&self, y: &[f64]) -> Vec<f64> {
        y.iter().enumerate().map(|(i, y)| self.bounds.fold(i, y * self.scale[i])).collect()
    }

    fn adapt(&mut self, order: &[usize]) {
        let count = ((self.options.elite * self.population as f64).round() as usize).max(1);
        let elite: Vec<&Vec<f64>> = order[..count].iter().map(|&k| &self.asked[k]).collect();
        let rate = self.options.smoothing;
        // Equation 5.2 of the tutorial, with its exponent.
        let age = 1.0 - 1.0 / (self.generation as f64 + 1.0);
        let spread = self.options.spread_smoothing * (1.0 - age.powi(7));
        for i in 0..self.mean.len() {
            let mean = elite.iter().map(|y| y[i]).sum::<f64>() / count as f64;
            let variance = elite.iter().map(|y| (y[i] - mean).powi(2)).sum::<f64>() / count as f64;
            self.mean[i] = rate * mean + (1.0 - rate) * self.mean[i];
            self.std[i] = spread * variance.sqrt() + (1.0 - spread) * self.std[i];
        }
    }
}

impl Solver for CrossEntropy {
    fn ask(&mut self) -> Ask {
        if let Some(stop) = self.stop {
            return Ask::Done(stop);
        }
        if self.asked.is_empty() {
            let mut random = stream(self.options.seed, u64::MAX, self.generation as u64);
            let n = self.mean.len();
            let one = |z: Vec<f64>| (0..n).map(|i| self.mean[i] + self.std[i] * z[i]).collect();
            self.asked = (0..self.population).map(|_| one(draw(&mut random, n))).collect();
        }
        let points = self.asked.iter().map(|y| self.point(y)).collect();
        Ask::Losses { points, view: View::whole(self.options.share), single: false }
    }

    fn tell(&mut self, answer: Tell) {
        let Tell::Losses(losses) = answer else { panic!("it asked for losses") };
        assert_eq!(losses.len(), self.asked.len(), "a loss for every point asked for");
        let order = ranked(&losses);
        let leader = self.point(&self.asked[order[0]]);
        Best::keep(&mut self.best, &leader, losses[order[0]]);
        if losses[order[0]].is_finite() {
            self.adapt(&order);
        }
        self.asked.clear();
        self.generation += 1;
        let reached = self.best.as_ref().zip(self.options.target);
        if reached.is_some_and(|(best, target)| best.loss <= target) {
            self.stop = Some(Stop::Target);
        } else if self.std.iter().all(|std| *std < self.options.step_tolerance) {
            self.stop = Some(Stop::Converged);
        } else if self.generation >= self.options.generations {
            self.stop = Some(if self.best.is_some() { Stop::Budget } else { Stop::Failed });
        }
    }

    fn best(&self) -> Option<&Best> {
        self.best.as_ref()
    }

    fn progress(&self) -> f64 {
        let share = self.generation as f64 / self.options.generations.max(1) as f64;
        if self.stop.is_some() { 1.0 } else { share.min(1.0) }
    }
}
