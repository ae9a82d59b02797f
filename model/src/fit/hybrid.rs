//! A short evolution, then Gauss–Newton on more and more of the data: the default.
//!
//! Simulations over a whole recording have many local minima: a swing too many or too few fits nothing that comes after.
//! Over its beginning there are few. So the evolution looks at the beginning only, Gauss–Newton refines its leaders there,
//! and the data that count then grow until they are all. Where the loss aimed at is not reached, everything starts again
//! with another seed.

use serde::{Deserialize, Serialize};

use super::{
    Ask, Best, Bounds, CmaEs, CmaOptions, FitError, LevenbergMarquardt, MarquardtOptions, Solver, Stop, Tell,
};

/// Settings of [`Hybrid`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct HybridOptions {
    /// Points in a generation of the evolution; absent: 8 for each parameter, at least 64.
    pub population: Option<usize>,
    /// Generations of the evolution.
    pub generations: usize,
    /// First step size of the evolution, in widths of the box.
    pub sigma: f64,
    /// The shares of the data that count, one after the other; the evolution sees the first.
    pub shares: Vec<f64>,
    /// How many of the evolution's leaders Gauss–Newton refines at first; on each further share half as many.
    pub leaders: usize,
    /// Most Gauss–Newton steps on each share.
    pub iterations: usize,
    /// A gain in the loss that is not worth a step.
    pub gain: f64,
    /// How often everything starts again where the target is not reached.
    pub restarts: usize,
    /// The loss aimed at, over all of the data. Absent: it starts again until two rounds end at the same loss.
    pub target: Option<f64>,
    /// Seed of all it draws.
    pub seed: u64,
}

impl Default for HybridOptions {
    fn default() -> Self {
        Self {
            population: None,
            generations: 25,
            sigma: 0.3,
            shares: vec![0.1, 0.2, 0.4, 0.7, 1.0],
            leaders: 8,
            iterations: 20,
            gain: 1e-2,
            restarts: 8,
            target: None,
            seed: 1,
        }
    }
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
enum Phase {
    Evolution(Box<CmaEs>),
    Refinement { stage: usize, search: LevenbergMarquardt },
    Done(Stop),
}

/// The default: a short search by evolution, then Gauss–Newton.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Hybrid {
    options: HybridOptions,
    bounds: Bounds,
    start: Vec<f64>,
    population: usize,
    round: usize,
    phase: Phase,
    best: Option<Best>,
    /// What the rounds ended at.
    ends: Vec<f64>,
}

impl Hybrid {
    /// A search that begins at `start`.
    ///
    /// # Errors
    ///
    /// [`FitError`] when the start does not fit the bounds, or an option is impossible.
    pub fn new(bounds: Bounds, start: &[f64], options: HybridOptions) -> Result<Self, FitError> {
        let shares = &options.shares;
        let rising = shares.windows(2).all(|pair| pair[0] < pair[1]);
        if !rising || shares.first().is_none_or(|first| *first <= 0.0) || shares.last() != Some(&1.0) {
            let value = shares.first().copied().unwrap_or(0.0);
            let problem = "the shares have to rise from above zero to one";
            return Err(FitError::Option { name: "shares", value, problem });
        }
        let population = options.population.unwrap_or((8 * bounds.len()).max(64));
        let mut search = Self {
            population,
            start: start.to_vec(),
            round: 0,
            phase: Phase::Done(Stop::Failed),
            best: None,
            ends: Vec::new(),
            bounds,
            options,
        };
        search.phase = Phase::Evolution(search.evolution()?);
        if search.bounds.is_empty() {
            search.phase = Phase::Done(Stop::Converged);
        }
        Ok(search)
    }

    fn evolution(&self) -> Result<Box<CmaEs>, FitError> {
        let options = CmaOptions {
            population: Some(self.population),
            generations: self.options.generations,
            sigma: self.options.sigma,
            share: self.options.shares[0],
            // Rounds are told apart by their seed: each evolution counts its own restarts.
            seed: self.options.seed.wrapping_add((self.round as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15)),
            ..CmaOptions::default()
        };
        CmaEs::new(self.bounds.clone(), &self.start, options).map(Box::new)
    }

    fn refinement(&self, stage: usize, starts: &[Vec<f64>]) -> Result<Phase, FitError> {
        let options = MarquardtOptions {
            iterations: self.options.iterations,
            gain: self.options.gain,
            share: self.options.shares[stage],
            target: None,
            ..MarquardtOptions::default()
        };
        let search = LevenbergMarquardt::new(self.bounds.clone(), starts, options)?;
        Ok(Phase::Refinement { stage, search })
    }

    /// Goes on where a phase has ended.
    fn advance(&mut self) {
        let next = match &self.phase {
            Phase::Evolution(evolution) => {
                let starts = apart(evolution.leaders(), self.options.leaders, &self.bounds);
                match starts.is_empty() {
                    true => self.next_round(),
                    false => self.refinement(0, &starts),
                }
            }
            Phase::Refinement { stage, search } => {
                let (stage, last) = (*stage, self.options.shares.len() - 1);
                let mut ends: Vec<Best> = Vec::new();
                for (point, loss) in search.ends() {
                    if let Some(loss) = loss.filter(|loss| loss.is_finite()) {
                        ends.push(Best { point: point.to_vec(), loss });
                    }
                }
                ends.sort_by(|a, b| a.loss.total_cmp(&b.loss));
                if ends.is_empty() {
                    self.next_round()
                } else if stage == last {
                    self.ends.push(ends[0].loss);
                    match self.is_good_enough() {
                        Some(stop) => Ok(Phase::Done(stop)),
                        None => self.next_round(),
                    }
                } else {
                    // What fits the beginning far worse will not fit the whole better.
                    let least = ends[0].loss;
                    ends.retain(|end| end.loss <= 2.0 * least.abs() + least + 10.0);
                    let most = (self.options.leaders >> (stage + 1)).max(2);
                    let starts = apart(&ends, most, &self.bounds);
                    self.refinement(stage + 1, &starts)
                }
            }
            Phase::Done(stop) => Ok(Phase::Done(*stop)),
        };
        self.phase = next.unwrap_or(Phase::Done(Stop::Failed));
    }

    fn next_round(&mut self) -> Result<Phase, FitError> {
        if self.round >= self.options.restarts {
            let stop = if self.best.is_some() { Stop::Budget } else { Stop::Failed };
            return Ok(Phase::Done(stop));
        }
        self.round += 1;
        Ok(Phase::Evolution(self.evolution()?))
    }

    /// Whether the last round ended well.
    fn is_good_enough(&self) -> Option<Stop> {
        let least = self.best.as_ref()?.loss;
        match self.options.target {
            Some(target) => (least <= target).then_some(Stop::Target),
            None => {
                let near = |end: &&f64| **end <= least + 1e-3 * least.abs() + 10.0 * self.options.gain;
                (self.ends.iter().filter(near).count() >= 2).then_some(Stop::Converged)
            }
        }
    }
}

/// The first `count` points, best first, that lie apart from each other.
fn apart(points: &[Best], count: usize, bounds: &Bounds) -> Vec<Vec<f64>> {
    let mut found: Vec<Vec<f64>> = Vec::new();
    let mut losses: Vec<f64> = Vec::new();
    for Best { point, loss } in points {
        let near = |other: &Vec<f64>| {
            let square = point.iter().zip(other).enumerate().map(|(i, (a, b))| {
                let width = bounds.scale(i, *a);
                ((a - b) / width).powi(2)
            });
            square.sum::<f64>().sqrt() < 1e-3
        };
        // Where not everything is determined, one minimum has many points.
        let same = |other: &f64| (loss - other).abs() <= 1e-3 + 1e-7 * loss.abs();
        if found.len() < count && !found.iter().any(near) && !losses.iter().any(same) {
            found.push(point.clone());
            losses.push(*loss);
        }
    }
    found
}

impl Solver for Hybrid {
    fn ask(&mut self) -> Ask {
        loop {
            let ask = match &mut self.phase {
                Phase::Evolution(evolution) => evolution.ask(),
                Phase::Refinement { search, .. } => search.ask(),
                Phase::Done(stop) => return Ask::Done(*stop),
            };
            match ask {
                Ask::Done(_) => self.advance(),
                ask => return ask,
            }
        }
    }

    fn tell(&mut self, answer: Tell) {
        match &mut self.phase {
            Phase::Evolution(evolution) => {
                evolution.tell(answer);
                if self.options.shares[0] == 1.0
                    && let Some(Best { point, loss }) = evolution.best()
                {
                    Best::keep(&mut self.best, point, *loss);
                }
            }
            Phase::Refinement { stage, search } => {
                search.tell(answer);
                if *stage + 1 == self.options.shares.len()
                    && let Some(Best { point, loss }) = search.best()
                {
                    Best::keep(&mut self.best, point, *loss);
                }
            }
            Phase::Done(_) => panic!("it asked for nothing"),
        }
    }

    /// Before anything was seen of all the data: the best of what is being searched, with its loss on less.
    fn best(&self) -> Option<&Best> {
        let searched = match &self.phase {
            Phase::Evolution(evolution) => evolution.best(),
            Phase::Refinement { search, .. } => search.best(),
            Phase::Done(_) => None,
        };
        self.best.as_ref().or(searched)
    }

    fn progress(&self) -> f64 {
        let stages = self.options.shares.len() as f64 + 1.0;
        let within = match &self.phase {
            Phase::Evolution(evolution) => evolution.progress(),
            Phase::Refinement { stage, search } => *stage as f64 + 1.0 + search.progress(),
            Phase::Done(_) => return 1.0,
        };
        // Most fits need one round, or two that agree.
        let rounds = if self.options.target.is_some() { 1 } else { 2 }.max(self.round + 1) as f64;
        ((self.round as f64 + within / stages) / rounds).min(1.0)
    }
}
