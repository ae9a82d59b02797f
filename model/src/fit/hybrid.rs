//! A short evolution, then Gauss–Newton on all of the data in pieces: the default.
//!
//! Simulations over a whole recording have many local minima: a swing too many or too few fits nothing that comes after.
//! Over its beginning there are few. So the evolution looks at the beginning only, and Gauss–Newton refines its leaders
//! there. From then on the data that count grow, by smaller steps where a larger one leaves the predictions behind (a
//! swing over the top that depends on little). Once parameters are known from enough of them, all count, cut into pieces that
//! each begin in a state of their own (multiple shooting, H. G. Bock 1981): no error grows over more than a piece, and what
//! holds the pieces together is made tighter until they are one. Where that ends badly, or the machine cannot be started
//! anywhere but at its beginning, the data grow until they are all there. Where the loss aimed at is not reached,
//! everything starts again with another seed.

mod dialogue;
mod options;
mod points;

use serde::{Deserialize, Serialize};

pub use options::HybridOptions;
use points::{apart, distinct, ends};

use super::marquardt::not_worse;
use super::normal::{even, stream};
use super::{Best, Bounds, CmaEs, CmaOptions, FitError, LevenbergMarquardt, MarquardtOptions, Stop, View};

/// No round tries more than so many times what the first one does.
const MOST_EFFORT: usize = 4;
/// So many times the loss aimed at is not worth refining.
const HOPELESS: f64 = 4.0;
/// So many times the loss aimed at, where a further share begins, is too large a step.
const FAR: f64 = 100.0;
/// Pieces are left out where points that fit a share of the data are not further from the loss aimed at on all of them.
const NEAR: f64 = 4.0;
/// Of the places along swept parameters it goes on from one whose loss is less by this, …
const WORTH: f64 = 1.0;
/// … so often.
const SWEEPS: usize = 3;
/// So many rounds are enough where they do not end alike.
const ENOUGH_ROUNDS: usize = 4;
/// Steps from one share to the next are made smaller until they are by this factor.
const SMALLEST_STEP: f64 = 1.08;

/// Before the last view a gain has to be this share of the loss aimed at, …
const ON_THE_WAY: f64 = 2e-3;
/// … or, where none is, so many times as large.
const LARGER: f64 = 10.0;

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
enum Phase {
    Scouting {
        points: Vec<Vec<f64>>,
    },
    Evolution(Box<CmaEs>),
    Refinement {
        share: f64,
        search: LevenbergMarquardt,
    },
    /// States at the cuts are found for these.
    Cutting {
        points: Vec<Vec<f64>>,
    },
    Shooting {
        step: usize,
        search: LevenbergMarquardt,
    },
    /// The model at the best point is looked for.
    Looking {
        point: Vec<f64>,
        stop: Stop,
    },
    Sweeping {
        points: Vec<Vec<f64>>,
        stop: Stop,
    },
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
    /// The best scouts of this round.
    scouts: Vec<Best>,
    /// The largest share of this round that is fitted, with where its search ended, best first.
    held: Option<(f64, Vec<Best>)>,
    /// Whether all of the data have been looked at in pieces in this round.
    cut: bool,
    /// Whether what is refined on all of the data came from the pieces.
    shot: bool,
    /// Whether all of the data have been looked at without pieces in this round.
    #[serde(default)]
    leapt: bool,
    /// How often parameters have been swept, and the loss before.
    #[serde(default)]
    swept: (usize, Option<f64>),
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
        if options.tightness.iter().any(|value| !(*value > 0.0 && value.is_finite())) {
            let value = options.tightness.iter().copied().fold(f64::INFINITY, f64::min);
            let problem = "it has to be above zero";
            return Err(FitError::Option { name: "tightness", value, problem });
        }
        // Whole blocks of lanes.
        let population = options.population.unwrap_or((8 * bounds.len()).next_multiple_of(32).max(64));
        let mut search = Self {
            population,
            start: start.to_vec(),
            round: 0,
            phase: Phase::Done(Stop::Failed),
            best: None,
            held: None,
            cut: false,
            shot: false,
            leapt: false,
            swept: (0, None),
            scouts: Vec::new(),
            ends: Vec::new(),
            bounds,
            options,
        };
        search.evolution(&search.start)?;
        search.phase = search.scouting()?;
        if search.bounds.is_empty() {
            search.phase = Phase::Done(Stop::Converged);
        }
        Ok(search)
    }

    /// How many times as much a round tries as the first: most fits need one, and some need more than others.
    fn effort(&self) -> usize {
        (self.round + 1).min(MOST_EFFORT)
    }

    fn leaders(&self) -> usize {
        self.options.leaders.max(1) * self.effort()
    }

    /// The seed of this round.
    fn seed(&self) -> u64 {
        self.options.seed.wrapping_add((self.round as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15))
    }

    /// Points all over the box, where it is one on all sides.
    fn scouting(&self) -> Result<Phase, FitError> {
        let (low, high) = (self.bounds.low(), self.bounds.high());
        let closed = low.iter().zip(high).all(|(low, high)| (high - low).is_finite());
        if self.options.scouts == 0 || !closed {
            return Ok(Phase::Evolution(self.evolution(&self.start)?));
        }
        let mut random = stream(self.seed(), u64::MAX, 0);
        let mut points = vec![self.start.clone()];
        points.extend((1..self.options.scouts * self.effort()).map(|_| {
            low.iter()
                .zip(high)
                .map(|(low, high)| low + (high - low) * even(&mut random))
                .collect::<Vec<f64>>()
        }));
        Ok(Phase::Scouting { points })
    }

    fn evolution(&self, start: &[f64]) -> Result<Box<CmaEs>, FitError> {
        let options = CmaOptions {
            population: Some(self.population),
            generations: self.options.generations,
            sigma: self.options.sigma,
            share: self.options.shares[0],
            single: true,
            // Rounds are told apart by their seed: each evolution counts its own restarts.
            seed: self.seed(),
            ..CmaOptions::default()
        };
        CmaEs::new(self.bounds.clone(), start, options).map(Box::new)
    }

    fn marquardt(
        &self,
        view: View,
        bounds: Bounds,
        starts: &[Vec<f64>],
    ) -> Result<LevenbergMarquardt, FitError> {
        let HybridOptions { iterations, .. } = self.options;
        // Only the end has to be exact.
        let last = view == View::whole(1.0);
        let share = if view.pieces > 1 { 1.0 } else { view.share };
        let gain = match self.options.target {
            _ if last => self.options.gain,
            Some(target) => self.options.gain.max(ON_THE_WAY * target * share),
            None => self.options.gain * LARGER,
        };
        // Pieces that do not come near it are left.
        let worth = self.options.target.filter(|_| view.pieces > 1).map(|target| HOPELESS * target);
        let options = MarquardtOptions { iterations, gain, view, worth, ..MarquardtOptions::default() };
        LevenbergMarquardt::new(bounds, starts, options)
    }

    fn refinement(&self, share: f64, starts: &[Vec<f64>]) -> Result<Phase, FitError> {
        let search = self.marquardt(View::whole(share), self.bounds.clone(), starts)?;
        Ok(Phase::Refinement { share, search })
    }

    /// Goes on from the share that is fitted: to all of the data in pieces, or to the next share.
    fn grow(&mut self) -> Result<Phase, FitError> {
        let Some((held, ends)) = &self.held else { return self.next_round() };
        let shares = &self.options.shares;
        if self.may_cut() && *held >= self.options.enough {
            if self.options.target.is_some() && self.alike() == 1 && !std::mem::replace(&mut self.leapt, true)
            {
                return self.refinement(1.0, &apart(ends, 1, &self.bounds));
            }
            return Ok(self.cutting());
        }
        let Some(next) = shares.iter().find(|share| *share > held) else { return self.next_round() };
        let passed = shares.iter().filter(|share| *share < held).count();
        let most = (self.leaders() >> passed.min(8)).max(2);
        self.refinement(*next, &apart(ends, most, &self.bounds))
    }

    /// Tries a smaller share than one that went wrong; where that is hardly more than what is fitted, the pieces are left.
    fn shrink(&mut self, share: f64) -> Result<Phase, FitError> {
        let Some((held, ends)) = &self.held else { return self.next_round() };
        if share > SMALLEST_STEP * held {
            return self.refinement((share * held).sqrt(), &apart(ends, 2, &self.bounds));
        }
        // The first share alone says too little.
        match self.may_cut() && *held > self.options.shares[0] {
            true => Ok(self.cutting()),
            false => self.next_round(),
        }
    }

    fn may_cut(&self) -> bool {
        self.pieces() > 1 && !self.options.tightness.is_empty() && !self.cut
    }

    fn cutting(&mut self) -> Phase {
        self.cut = true;
        let ends = self.held.as_ref().map_or(&[][..], |(_, ends)| ends);
        Phase::Cutting { points: apart(ends, self.options.shooters.max(1) * self.effort(), &self.bounds) }
    }

    fn shooting(&self, step: usize, starts: &[Vec<f64>]) -> Result<Phase, FitError> {
        let all = starts.first().map_or(0, Vec::len);
        let bounds = self.bounds.clone().and_open(all.saturating_sub(self.bounds.len()));
        Ok(Phase::Shooting { step, search: self.marquardt(self.in_pieces(step), bounds, starts)? })
    }

    fn pieces(&self) -> usize {
        self.options.pieces.unwrap_or(1)
    }

    fn in_pieces(&self, step: usize) -> View {
        let tightness = self.options.tightness.get(step).copied().unwrap_or(0.0);
        // What the points fit already.
        let share = self.held.as_ref().map_or(1.0, |(share, _)| *share);
        View { share, pieces: self.pieces(), tightness }
    }

    /// Goes on where a phase has ended.
    fn advance(&mut self) {
        let next = match &self.phase {
            Phase::Scouting { .. } => return,
            Phase::Evolution(evolution) => {
                let mut starts = apart(evolution.leaders(), self.leaders(), &self.bounds);
                starts.extend(apart(&self.scouts, 2 * self.leaders(), &self.bounds));
                match starts.is_empty() {
                    true => self.next_round(),
                    false => self.refinement(self.options.shares[0], &starts),
                }
            }
            Phase::Refinement { share, search } => {
                let (share, mut ends) = (*share, ends(search));
                match ends.first().map(|end| end.loss) {
                    None => self.next_round(),
                    Some(least) if share >= 1.0 => {
                        self.ends.push(least);
                        match self.is_good_enough() {
                            Some(stop) => Ok(self.sweep(stop)),
                            // With the pieces it may come out elsewhere, or without.
                            None if self.leapt && self.may_cut() => Ok(self.cutting()),
                            None if std::mem::take(&mut self.shot) => self.grow(),
                            None => self.next_round(),
                        }
                    }
                    Some(least) if share > self.options.shares[0] && self.is_far(HOPELESS, share, least) => {
                        self.shrink(share)
                    }
                    Some(least) => {
                        // What fits the beginning far worse will not fit the whole better.
                        ends.retain(|end| end.loss <= not_worse(least));
                        self.held = Some((share, ends));
                        self.grow()
                    }
                }
            }
            Phase::Cutting { .. } => return,
            Phase::Shooting { step, search } => {
                let (step, ends) = (*step, ends(search));
                let points = distinct(&ends);
                if ends.first().is_none_or(|end| self.is_far(HOPELESS, 1.0, end.loss)) {
                    self.grow()
                } else if step + 1 < self.options.tightness.len() {
                    self.shooting(step + 1, &points)
                } else {
                    let n = self.bounds.len();
                    self.shot = true;
                    self.refinement(1.0, &points.iter().map(|point| point[..n].to_vec()).collect::<Vec<_>>())
                }
            }
            Phase::Looking { .. } | Phase::Sweeping { .. } => return,
            Phase::Done(stop) => Ok(Phase::Done(*stop)),
        };
        self.phase = next.unwrap_or(Phase::Done(Stop::Failed));
    }

    /// Ends, unless parameters are to be swept from where it would.
    fn sweep(&mut self, stop: Stop) -> Phase {
        let (count, before) = self.swept;
        let Some(best) = &self.best else { return Phase::Done(stop) };
        let worth = before.is_none_or(|before| best.loss < before - WORTH);
        if self.options.swept.is_empty() || count >= SWEEPS || !worth {
            return Phase::Done(stop);
        }
        self.swept = (count + 1, Some(best.loss));
        Phase::Looking { point: best.point.clone(), stop }
    }

    fn next_round(&mut self) -> Result<Phase, FitError> {
        if self.round >= self.options.restarts {
            // Who asks gets an answer to all of the data, a bad one if need be.
            if self.best.is_none()
                && let Some((_, ends)) = self.held.take()
            {
                return self.refinement(1.0, &apart(&ends, 1, &self.bounds));
            }
            let stop = if self.best.is_some() { Stop::Budget } else { Stop::Failed };
            return Ok(Phase::Done(stop));
        }
        self.round += 1;
        self.scouts.clear();
        (self.held, self.cut, self.shot, self.leapt) = (None, false, false, false);
        self.scouting()
    }

    /// Whether a loss on this share of the data is so many times the one aimed at.
    fn is_far(&self, times: f64, share: f64, loss: f64) -> bool {
        self.options.target.is_some_and(|target| loss > times * target * share)
    }

    /// Whether the last round ended well.
    fn is_good_enough(&self) -> Option<Stop> {
        let least = self.best.as_ref()?.loss;
        let near = |end: &&f64| **end <= least + 1e-3 * least.abs() + 10.0 * self.options.gain;
        let alike = self.ends.iter().filter(near).count() >= self.alike();
        match self.options.target {
            Some(target) => {
                let ends = alike || self.ends.len() >= ENOUGH_ROUNDS;
                (least <= target && ends).then_some(Stop::Target)
            }
            None => alike.then_some(Stop::Converged),
        }
    }

    fn alike(&self) -> usize {
        self.options.alike.unwrap_or(if self.options.target.is_some() { 1 } else { 2 })
    }
}
