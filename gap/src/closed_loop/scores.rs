//! Scores of many runs, with intervals.

use parallax_runtime::random::{Purpose, stream};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::LoopScore;
use crate::report::{Interval, WORST_SHARE};

/// Draws of the bootstrap.
const DRAWS: usize = 2000;

/// The score of every run of every episode; `None` where the machine left all bounds.
pub(super) type Runs = Vec<Vec<Option<f64>>>;

/// Means over episodes drawn again with replacement, each with one of its runs (Efron & Tibshirani, "An Introduction to the
/// Bootstrap", 1993, chapter 8): the spread over initial states and over what happens by chance. All rows are drawn alike,
/// so that their differences are those of the same episodes.
pub(super) struct Draws {
    recorded: Vec<f64>,
    /// Which episodes and which of their runs.
    chosen: Vec<Vec<(usize, usize)>>,
}

impl Draws {
    pub(super) fn new(recorded: Vec<f64>, runs: usize, seed: u64) -> Self {
        let mut random: ChaCha8Rng = stream(seed, Purpose::Node, "closed loop");
        let episodes = recorded.len();
        let mut choose = || (random.random_range(0..episodes), random.random_range(0..runs));
        let chosen = (0..DRAWS).map(|_| (0..episodes).map(|_| choose()).collect()).collect();
        Self { recorded, chosen }
    }

    /// The recorded score.
    pub(super) fn recorded(&self) -> Interval {
        let all = self.chosen.iter().map(|draw| mean(draw.iter().map(|(e, _)| self.recorded[*e])));
        Interval::of(mean(self.recorded.iter().copied()), all.collect())
    }

    /// What a system predicts.
    pub(super) fn row(&self, runs: &Runs) -> LoopScore {
        let of = runs.iter().map(Vec::len).sum();
        let lost = runs.iter().flatten().filter(|score| score.is_none()).count();
        if lost == of {
            return LoopScore { score: None, difference: None, agrees: false, lost, of };
        }
        let (score, difference): (Vec<f64>, Vec<f64>) =
            self.chosen.iter().filter_map(|draw| self.drawn(runs, draw)).unzip();
        let (value, away) = self.means(runs);
        let difference = Interval::of(away, difference);
        let agrees = lost == 0 && difference.low <= 0.0 && difference.high >= 0.0;
        LoopScore { score: Some(Interval::of(value, score)), difference: Some(difference), agrees, lost, of }
    }

    /// The part of the difference between `before` and the recorded score that `after` closes.
    pub(super) fn closed(&self, before: &Runs, after: &Runs) -> Option<Interval> {
        let share = |b: f64, a: f64| (1.0 - a.abs() / b.abs().max(1e-300)).clamp(WORST_SHARE, 1.0);
        let all = self
            .chosen
            .iter()
            .filter_map(|draw| Some(share(self.drawn(before, draw)?.1, self.drawn(after, draw)?.1)));
        let all: Vec<f64> = all.collect();
        let (b, a) = (self.means(before).1, self.means(after).1);
        (!all.is_empty() && b.is_finite() && a.is_finite()).then(|| Interval::of(share(b, a), all))
    }

    /// The mean score over all episodes, and how far it is from the recorded one.
    fn means(&self, runs: &Runs) -> (f64, f64) {
        let episodes = runs.iter().zip(&self.recorded).filter_map(|(runs, recorded)| {
            let kept: Vec<f64> = runs.iter().flatten().copied().collect();
            (!kept.is_empty()).then(|| (mean(kept.into_iter()), *recorded))
        });
        let (found, recorded): (Vec<f64>, Vec<f64>) = episodes.unzip();
        let found = mean(found.into_iter());
        (found, found - mean(recorded.into_iter()))
    }

    /// The same of one draw; of a run that was lost, the next one of its episode stands for it.
    fn drawn(&self, runs: &Runs, draw: &[(usize, usize)]) -> Option<(f64, f64)> {
        let pick = |(episode, run): &(usize, usize)| {
            let of = &runs[*episode];
            let found = (0..of.len()).find_map(|k| of[(run + k) % of.len()])?;
            Some((found, self.recorded[*episode]))
        };
        let (found, recorded): (Vec<f64>, Vec<f64>) = draw.iter().filter_map(pick).unzip();
        let value = mean(found.iter().copied());
        (!found.is_empty()).then(|| (value, value - mean(recorded.into_iter())))
    }
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0), |(sum, count), value| (sum + value, count + 1));
    sum / f64::from(count)
}
