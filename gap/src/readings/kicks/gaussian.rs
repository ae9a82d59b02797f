//! Commands that are late by times of any mean that scatter: the marginal likelihood of a linear model with Gaussian shares
//! and a banded information matrix (Rasmussen & Williams 2006, section 2.1).

use super::Kicks;
use crate::readings::banded::{Cholesky, dot};
use crate::readings::golden::golden;

/// Points at which a spread is tried first, and steps of the search between the best of them.
const GRID: usize = 17;
const GOLDEN: usize = 10;

/// Rounds in which the ratio of a spread to the size of the innovations follows that size, which depends on it.
const REFINED: usize = 3;

/// What the innovations say of commands that are late by chance.
#[derive(Clone, Copy, Debug)]
pub(in crate::readings) struct Late {
    /// Standard deviation of the time by which they are late (s), and that of this estimate.
    pub(in crate::readings) spread: f64,
    pub(in crate::readings) std: f64,
    /// Log evidence against commands that are all late by the same time.
    pub(in crate::readings) log_evidence: f64,
    /// Log likelihood at the peak against commands in time.
    pub(in crate::readings) gain: f64,
    /// The standard deviation of the shares, in units of the innovations' own.
    ratio: f64,
}

impl Kicks {
    /// −2 log likelihood, up to a constant, of shares of any mean and of the given standard deviation in units of the
    /// innovations' own, which is free as well and comes with it, squared.
    fn cost(&self, ratio: f64) -> (f64, f64) {
        let ones = self.by_gram(&vec![1.0; self.kicks.len()]);
        let total: f64 = ones.iter().sum();
        let (mut ee, mut em, mut mm) = (self.energy, self.along.iter().sum::<f64>(), total);
        let mut volume = 0.0;
        if ratio > 0.0 {
            let precision = ratio.powi(-2);
            let Some(band) = Cholesky::new(&self.gram, precision) else {
                return (f64::INFINITY, 1.0);
            };
            let (e, m) = (band.half(&self.along), band.half(&ones));
            ee -= dot(&e, &e);
            em -= dot(&e, &m);
            mm -= dot(&m, &m);
            volume = band.log_determinant - self.kicks.len() as f64 * precision.ln();
        }
        let left = if mm > 0.0 { ee - em * em / mm } else { ee };
        let n = self.readings as f64;
        let variance = left.max(1e-9) / n;
        (n * variance.ln() + volume, variance)
    }

    /// Commands that are late by a time of any mean that scatters.
    pub(in crate::readings) fn late(&self, most: f64) -> Late {
        let unit = self.lateness();
        // From where it changes nothing to where commands are others.
        let typical = (self.readings as f64 / self.gram.iter().map(|row| row[0]).sum::<f64>()).sqrt();
        let (low, high) = ((1e-2 * typical).ln(), (1e2 * typical).min(most / unit).ln());
        if low >= high {
            return Late { spread: 0.0, std: 0.0, log_evidence: f64::NEG_INFINITY, gain: 0.0, ratio: 0.0 };
        }
        let at = |x: f64| -0.5 * self.cost(x.exp()).0;
        let step = (high - low) / (GRID - 1) as f64;
        let grid: Vec<(f64, f64)> = (0..GRID).map(|k| low + k as f64 * step).map(|x| (x, at(x))).collect();
        let best = grid.iter().max_by(|a, b| a.1.total_cmp(&b.1)).map_or(low, |p| p.0);
        let x = golden(((best - step).max(low), (best + step).min(high)), GOLDEN, at);
        let top = at(x);
        // The curvature over a step in which the likelihood changes visibly.
        let near = 0.1;
        let curvature = (2.0 * top - at(x - near) - at(x + near)) / (near * near);
        let width = if curvature > 0.0 { curvature.powf(-0.5).min(high - low) } else { high - low };
        let log_evidence =
            top - at(f64::NEG_INFINITY) + (std::f64::consts::TAU.sqrt() * width / (high - low)).min(1.0).ln();
        let spread = x.exp() * self.cost(x.exp()).1.sqrt() * unit;
        Late { spread, std: width * spread, log_evidence, gain: top + 0.5 * self.in_time(), ratio: x.exp() }
    }

    /// Whether commands that are late so are likelier than kicks at the same times that are all alike: a force that scatters kicks the
    /// machine where its commands do and in their direction, more so than noise which knows no directions, but not in proportion to
    /// what they change.
    pub(in crate::readings) fn go_with_changes(&self, late: &Late, most: f64) -> bool {
        late.gain > self.even().late(most).gain
    }

    /// What each command was most likely late by where they scatter so, in units of its response.
    pub(in crate::readings) fn shares(&self, late: &Late) -> Option<Vec<f64>> {
        let (ones, precision) = (vec![1.0; self.kicks.len()], late.ratio.powi(-2));
        let band = Cholesky::new(&self.gram, precision).filter(|_| late.ratio > 0.0)?;
        let of_mean = self.by_gram(&ones);
        let (e, m) = (band.half(&self.along), band.half(&of_mean));
        let information = of_mean.iter().sum::<f64>() - dot(&m, &m);
        let mean = (self.along.iter().sum::<f64>() - dot(&e, &m)) / information;
        let left: Vec<f64> = self.along.iter().zip(&of_mean).map(|(along, m)| along - mean * m).collect();
        let shares: Vec<f64> = band.solve(&left).iter().map(|share| mean + share).collect();
        shares.iter().all(|share| share.is_finite()).then_some(shares)
    }

    /// −2 log likelihood of commands that are all late by the same time, whatever it is, up to a constant; the scale of the innovations
    /// is free.
    pub(in crate::readings) fn of_same(&self) -> f64 {
        self.cost(0.0).0 + self.volume
    }

    /// The same of commands that are late by times of any mean and of this standard deviation (s).
    pub(in crate::readings) fn of_spread(&self, spread: f64) -> f64 {
        let share = spread / self.lateness();
        let ratio = (0..REFINED).fold(share, |ratio, _| share / self.cost(ratio).1.sqrt());
        self.cost(ratio).0 + self.volume
    }

    /// −2 log likelihood of the innovations as they are, up to a constant.
    pub(in crate::readings) fn plain(&self) -> f64 {
        self.energy + self.volume
    }

    /// The same, their scale free, of commands that scatter so by any mean, of which each was late `already` by so many units.
    pub(in crate::readings) fn scattered(&self, already: &[f64], late: &Late) -> f64 {
        self.with(already).cost(late.ratio).0 + self.readings as f64 + self.volume
    }
}
