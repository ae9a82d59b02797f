//! The covariance matrix adaptation evolution strategy.
//!
//! N. Hansen, *The CMA Evolution Strategy: A Tutorial* (arXiv:1604.00772, 2016): weighted recombination of the best,
//! cumulative step-size adaptation, and a full covariance that learns by the rank-one and rank-μ updates. Restarts with
//! a population twice as large are those of A. Auger and N. Hansen, *A Restart CMA Evolution Strategy With Increasing
//! Population Size* (CEC 2005).

use nalgebra::{DMatrix, DVector, SymmetricEigen};
use serde::{Deserialize, Serialize};

use super::normal::{draw, stream};
use super::{Ask, Best, Bounds, FitError, Solver, Stop, Tell, View, ranked};

/// Settings of [`CmaEs`]. Rates that are absent are the tutorial's for the number of parameters and the population.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CmaOptions {
    /// Points in a generation, λ; absent: `4 + 3 ln n`.
    pub population: Option<usize>,
    /// How many of them the next mean is made of, μ; absent: half.
    pub parents: Option<usize>,
    /// Generations before the first restart, and after each.
    pub generations: usize,
    /// How often it starts again, each time with twice the population.
    pub restarts: usize,
    /// First step size σ, in widths of the box.
    pub sigma: f64,
    /// c_σ, how fast the step size's path forgets.
    pub path_rate: Option<f64>,
    /// c_c, how fast the covariance's path forgets.
    pub covariance_path_rate: Option<f64>,
    /// c_1, rate of the rank-one update.
    pub rank_one_rate: Option<f64>,
    /// c_μ, rate of the rank-μ update.
    pub rank_mu_rate: Option<f64>,
    /// d_σ, damping of the step size.
    pub damping: Option<f64>,
    /// It has converged when losses differ by less than this, …
    pub loss_tolerance: f64,
    /// … or when steps are smaller than this, in widths of the box.
    pub step_tolerance: f64,
    /// It ends when a loss is as low as this.
    pub target: Option<f64>,
    /// How much of the data counts.
    pub share: f64,
    /// Whether single precision will do for the losses, where an evaluator has it: about twice as fast, and enough until
    /// losses differ by less than 1 ‰.
    pub single: bool,
    /// Seed of all it draws.
    pub seed: u64,
}

impl Default for CmaOptions {
    fn default() -> Self {
        Self {
            population: None,
            parents: None,
            generations: 1000,
            restarts: 0,
            sigma: 0.3,
            path_rate: None,
            covariance_path_rate: None,
            rank_one_rate: None,
            rank_mu_rate: None,
            damping: None,
            loss_tolerance: 1e-12,
            step_tolerance: 1e-10,
            target: None,
            share: 1.0,
            single: false,
            seed: 1,
        }
    }
}

/// What follows from options, number of parameters and population.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Rates {
    population: usize,
    weights: Vec<f64>,
    mass: f64,
    path: f64,
    covariance_path: f64,
    rank_one: f64,
    rank_mu: f64,
    damping: f64,
    /// The expected length of a standard normal vector.
    chi: f64,
}

impl Rates {
    /// Equations 49 to 58 of the tutorial, and its table 1.
    fn new(options: &CmaOptions, parameters: usize, population: usize) -> Self {
        let n = parameters as f64;
        let parents = options.parents.unwrap_or(population / 2).clamp(1, population);
        let log = |x: f64| x.ln();
        let half = match options.parents {
            Some(parents) => parents as f64 + 0.5,
            None => (population as f64 + 1.0) / 2.0,
        };
        let raw: Vec<f64> = (1..=parents).map(|i| (log(half) - log(i as f64)).max(1e-12)).collect();
        let sum: f64 = raw.iter().sum();
        let weights: Vec<f64> = raw.iter().map(|w| w / sum).collect();
        let mass = 1.0 / weights.iter().map(|w| w * w).sum::<f64>();
        let path = options.path_rate.unwrap_or((mass + 2.0) / (n + mass + 5.0));
        let rank_one = options.rank_one_rate.unwrap_or(2.0 / ((n + 1.3).powi(2) + mass));
        let rank_mu = 2.0 * (0.25 + mass + 1.0 / mass - 2.0) / ((n + 2.0).powi(2) + mass);
        let damping = 1.0 + 2.0 * (((mass - 1.0) / (n + 1.0)).sqrt() - 1.0).max(0.0) + path;
        Self {
            population,
            weights,
            mass,
            path,
            covariance_path: options
                .covariance_path_rate
                .unwrap_or((4.0 + mass / n) / (n + 4.0 + 2.0 * mass / n)),
            rank_one,
            rank_mu: options.rank_mu_rate.unwrap_or(rank_mu).min(1.0 - rank_one),
            damping: options.damping.unwrap_or(damping),
            chi: n.sqrt() * (1.0 - 1.0 / (4.0 * n) + 1.0 / (21.0 * n * n)),
        }
    }
}

/// The evolving distribution, in widths of the box around the start.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CmaEs {
    options: CmaOptions,
    bounds: Bounds,
    start: Vec<f64>,
    scale: Vec<f64>,
    rates: Rates,
    mean: Vec<f64>,
    sigma: f64,
    covariance: Vec<f64>,
    /// Eigenvectors, column by column, and the roots of the eigenvalues.
    axes: Vec<f64>,
    lengths: Vec<f64>,
    path: Vec<f64>,
    covariance_path: Vec<f64>,
    round: usize,
    generation: usize,
    /// Best losses of the last generations, newest last.
    history: Vec<f64>,
    /// The generation that was asked for, in units of the search.
    asked: Vec<Vec<f64>>,
    best: Option<Best>,
    /// The better half of the last generation, best first.
    leaders: Vec<Best>,
    stop: Option<Stop>,
}

impl CmaEs {
    /// A search that begins at `start`.
    ///
    /// # Errors
    ///
    /// [`FitError`] when the start does not fit the bounds, or an option is impossible.
    pub fn new(bounds: Bounds, start: &[f64], options: CmaOptions) -> Result<Self, FitError> {
        bounds.check(start)?;
        let positive = |name, value: f64| match value > 0.0 && value.is_finite() {
            true => Ok(()),
            false => Err(FitError::Option { name, value, problem: "it has to be above zero" }),
        };
        positive("sigma", options.sigma)?;
        positive("share", options.share)?;
        let n = bounds.len().max(1);
        let population = options.population.unwrap_or(4 + (3.0 * (n as f64).ln()) as usize);
        if population < 2 {
            let problem = "a generation needs at least two points";
            return Err(FitError::Option { name: "population", value: population as f64, problem });
        }
        if options.parents.is_some_and(|parents| parents == 0 || parents > population) {
            let value = options.parents.unwrap_or(0) as f64;
            let problem = "the parents have to be at least one and at most the population";
            return Err(FitError::Option { name: "parents", value, problem });
        }
        let scale = (0..bounds.len()).map(|i| bounds.scale(i, start[i])).collect();
        let rates = Rates::new(&options, n, population);
        let mut search = Self {
            sigma: options.sigma,
            rates,
            start: start.to_vec(),
            scale,
            mean: Vec::new(),
            covariance: Vec::new(),
            axes: Vec::new(),
            lengths: Vec::new(),
            path: Vec::new(),
            covariance_path: Vec::new(),
            round: 0,
            generation: 0,
            history: Vec::new(),
            asked: Vec::new(),
            best: None,
            leaders: Vec::new(),
            stop: bounds.is_empty().then_some(Stop::Converged),
            bounds,
            options,
        };
        search.reset();
        Ok(search)
    }

    /// An isotropic distribution around the start; of a restart, around a point drawn from the box.
    fn reset(&mut self) {
        let n = self.bounds.len();
        let mut random = stream(self.options.seed, self.round as u64, u64::MAX);
        let drawn = draw(&mut random, n);
        self.mean = (0..n)
            .map(|i| {
                let start = self.bounds.unfold(i, self.start[i]) / self.scale[i];
                if self.round == 0 { start } else { start + 0.5 * self.options.sigma * drawn[i] }
            })
            .collect();
        self.sigma = self.options.sigma;
        self.covariance = identity(n);
        self.axes = identity(n);
        self.lengths = vec![1.0; n];
        self.path = vec![0.0; n];
        self.covariance_path = vec![0.0; n];
        self.history.clear();
        self.generation = 0;
    }

    /// The point of the box that stands for a point of the search.
    fn point(&self, y: &[f64]) -> Vec<f64> {
        y.iter().enumerate().map(|(i, y)| self.bounds.fold(i, y * self.scale[i])).collect()
    }

    /// The centre of the distribution, in the box.
    #[must_use]
    pub fn mean(&self) -> Vec<f64> {
        self.point(&self.mean)
    }

    /// The better half of the last generation, best first: points that other methods may start from.
    #[must_use]
    pub fn leaders(&self) -> &[Best] {
        &self.leaders
    }

    fn sample(&self) -> Vec<Vec<f64>> {
        let n = self.mean.len();
        let mut random = stream(self.options.seed, self.round as u64, self.generation as u64);
        (0..self.rates.population)
            .map(|_| {
                let z = draw(&mut random, n);
                (0..n)
                    .map(|i| {
                        let along: f64 = (0..n).map(|k| self.axes[k * n + i] * self.lengths[k] * z[k]).sum();
                        self.mean[i] + self.sigma * along
                    })
                    .collect()
            })
            .collect()
    }

    /// Moves the distribution to the best of a generation: algorithm 2 of the paper, equations 24 to 37 of the tutorial.
    fn adapt(&mut self, order: &[usize]) {
        let n = self.mean.len();
        let rates = &self.rates;
        let steps: Vec<Vec<f64>> = order[..rates.weights.len()]
            .iter()
            .map(|&k| self.asked[k].iter().zip(&self.mean).map(|(x, m)| (x - m) / self.sigma).collect())
            .collect();
        let mean_step: Vec<f64> =
            (0..n).map(|i| rates.weights.iter().zip(&steps).map(|(w, y)| w * y[i]).sum()).collect();
        for (m, y) in self.mean.iter_mut().zip(&mean_step) {
            *m += self.sigma * y;
        }

        // C^(-1/2) of the step: along every axis in units of its length.
        let along: Vec<f64> = (0..n)
            .map(|k| {
                let axis = &self.axes[k * n..(k + 1) * n];
                axis.iter().zip(&mean_step).map(|(a, y)| a * y).sum::<f64>() / self.lengths[k]
            })
            .collect();
        let gain = (rates.path * (2.0 - rates.path) * rates.mass).sqrt();
        for i in 0..n {
            let whitened: f64 = (0..n).map(|k| self.axes[k * n + i] * along[k]).sum();
            self.path[i] = (1.0 - rates.path) * self.path[i] + gain * whitened;
        }
        let length = self.path.iter().map(|p| p * p).sum::<f64>().sqrt();
        let age = 1.0 - (1.0 - rates.path).powi(2 * (self.generation as i32 + 1));
        let moves = length / age.sqrt() < (1.4 + 2.0 / (n as f64 + 1.0)) * rates.chi;
        let held = if moves { 1.0 } else { 0.0 };
        let gain = held * (rates.covariance_path * (2.0 - rates.covariance_path) * rates.mass).sqrt();
        for (p, y) in self.covariance_path.iter_mut().zip(&mean_step) {
            *p = (1.0 - rates.covariance_path) * *p + gain * y;
        }
        // What a stalled path loses of the variance.
        let loss = (1.0 - held) * rates.rank_one * rates.covariance_path * (2.0 - rates.covariance_path);
        for i in 0..n {
            for j in 0..=i {
                let rank_mu: f64 = rates.weights.iter().zip(&steps).map(|(w, y)| w * y[i] * y[j]).sum();
                let value = (1.0 - rates.rank_one - rates.rank_mu + loss) * self.covariance[i * n + j]
                    + rates.rank_one * self.covariance_path[i] * self.covariance_path[j]
                    + rates.rank_mu * rank_mu;
                self.covariance[i * n + j] = value;
                self.covariance[j * n + i] = value;
            }
        }
        self.sigma *= (rates.path / rates.damping * (length / rates.chi - 1.0)).min(1.0).exp();
        self.decompose();
    }

    /// The axes of the covariance.
    fn decompose(&mut self) {
        let n = self.mean.len();
        let SymmetricEigen { eigenvectors, eigenvalues } =
            DMatrix::from_row_slice(n, n, &self.covariance).symmetric_eigen();
        let largest = eigenvalues.max().max(f64::MIN_POSITIVE);
        let lengths: DVector<f64> = eigenvalues.map(|value| value.max(1e-14 * largest).sqrt());
        self.axes = eigenvectors.iter().copied().collect();
        self.lengths = lengths.iter().copied().collect();
    }

    /// Why this start has come to its end, if it has (appendix B.3 of the tutorial).
    fn ended(&self, losses: &[f64], order: &[usize]) -> Option<Stop> {
        let best = losses[order[0]];
        if self.options.target.is_some_and(|target| self.best.as_ref().is_some_and(|b| b.loss <= target)) {
            return Some(Stop::Target);
        }
        if !best.is_finite() && self.history.len() > 10 {
            return Some(Stop::Failed);
        }
        let n = self.mean.len();
        let span = 10 + (30 * n).div_ceil(self.rates.population);
        if self.history.len() >= span {
            let recent = &self.history[self.history.len() - span..];
            let (low, high) =
                recent.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), &x| (l.min(x), h.max(x)));
            let worst = losses[order[order.len() - 1]];
            if high - low <= self.options.loss_tolerance && worst - best <= self.options.loss_tolerance {
                return Some(Stop::Converged);
            }
        }
        let widest = self.lengths.iter().fold(0.0, |a: f64, b| a.max(*b));
        if self.sigma * widest < self.options.step_tolerance {
            return Some(Stop::Converged);
        }
        let narrowest = self.lengths.iter().fold(f64::INFINITY, |a: f64, b| a.min(*b));
        if widest / narrowest >= 1e7 || !self.sigma.is_finite() {
            return Some(Stop::Converged);
        }
        (self.generation >= self.options.generations).then_some(Stop::Budget)
    }
}

impl Solver for CmaEs {
    fn ask(&mut self) -> Ask {
        if let Some(stop) = self.stop {
            return Ask::Done(stop);
        }
        if self.asked.is_empty() {
            self.asked = self.sample();
        }
        let points = self.asked.iter().map(|y| self.point(y)).collect();
        Ask::Losses { points, view: View::whole(self.options.share), single: self.options.single }
    }

    fn tell(&mut self, answer: Tell) {
        let Tell::Losses(losses) = answer else { panic!("it asked for losses") };
        assert_eq!(losses.len(), self.asked.len(), "a loss for every point asked for");
        let order = ranked(&losses);
        let asked: Vec<Vec<f64>> =
            order.iter().take(losses.len().div_ceil(2)).map(|&k| self.point(&self.asked[k])).collect();
        self.leaders.clear();
        for (point, &k) in asked.into_iter().zip(&order) {
            if losses[k].is_finite() {
                self.leaders.push(Best { point, loss: losses[k] });
            }
        }
        if let Some(Best { point, loss }) = self.leaders.first() {
            Best::keep(&mut self.best, point, *loss);
        }
        let best = losses[order[0]];
        self.history.push(if best.is_finite() { best } else { f64::MAX });
        if best.is_finite() {
            self.adapt(&order);
        }
        self.generation += 1;
        let ended = self.ended(&losses, &order);
        self.asked.clear();
        match ended {
            Some(Stop::Target) => self.stop = Some(Stop::Target),
            Some(stop) if self.round >= self.options.restarts => {
                self.stop = Some(if self.best.is_none() { Stop::Failed } else { stop });
            }
            Some(_) => {
                self.round += 1;
                self.rates = Rates::new(&self.options, self.bounds.len().max(1), 2 * self.rates.population);
                self.reset();
            }
            None => {}
        }
    }

    fn best(&self) -> Option<&Best> {
        self.best.as_ref()
    }

    fn progress(&self) -> f64 {
        let rounds = self.options.restarts as f64 + 1.0;
        let share = self.generation as f64 / self.options.generations.max(1) as f64;
        if self.stop.is_some() { 1.0 } else { ((self.round as f64 + share) / rounds).min(1.0) }
    }
}

fn identity(n: usize) -> Vec<f64> {
    (0..n * n).map(|at| if at % (n + 1) == 0 { 1.0 } else { 0.0 }).collect()
}
