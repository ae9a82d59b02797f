//! Commands that are lost or are not: a spike and a slab for each, by variational inference in a factorised posterior
//! (Carbonetto & Stephens 2012).

use super::{Kick, Kicks};
use crate::readings::banded::dot;

/// Sweeps of the variational inference, at most.
const SWEEPS: usize = 60;

/// Change of a probability that ends the sweeps.
const SETTLED: f64 = 1e-4;

/// Share of commands that is lost, where the inference begins.
const FIRST_RATE: f64 = 0.05;

/// What the innovations say of commands that are lost.
#[derive(Clone, Debug)]
pub(in crate::readings) struct Lost {
    /// Share of commands that is lost.
    pub(in crate::readings) rate: f64,
    /// Commands of which the opposite of what is believed is likelier, by their index: that they are lost, or arrived.
    pub(in crate::readings) otherwise: Vec<usize>,
    /// A lower bound of the log likelihood, less what stating the losses costs, against what is believed.
    pub(in crate::readings) gain: f64,
    /// Commands whose loss would show.
    pub(in crate::readings) of: usize,
}

impl Kicks {
    /// Commands of which some are lost: one p for each, that the opposite of what is believed is true, in a factorised
    /// posterior.
    pub(in crate::readings) fn lost(&self) -> Lost {
        let n = self.readings as f64;
        let count = self.kicks.len() as f64;
        let is_lost = |(kick, p): (&Kick, &f64)| if kick.held { 1.0 - p } else { *p };
        let rate_of =
            |p: &[f64]| (self.kicks.iter().zip(p).map(is_lost).sum::<f64>() / count).clamp(0.5 / count, 0.9);
        let mut variance = self.energy / n;
        let mut p = vec![FIRST_RATE; self.kicks.len()];
        let mut rate = rate_of(&p);
        // What the probabilities of the others leave along each response.
        let mut along = self.by_gram(&p);
        for _ in 0..SWEEPS {
            let mut moved: f64 = 0.0;
            let odds = (rate / (1.0 - rate)).ln();
            for k in 0..p.len() {
                let own = self.gram[k][0];
                let left = self.along[k] - along[k] + own * p[k];
                let odds = if self.kicks[k].held { -odds } else { odds };
                let fresh = 1.0 / (1.0 + (-(odds + (left - 0.5 * own) / variance)).exp());
                let change = fresh - p[k];
                if change != 0.0 {
                    self.shift(&mut along, k, change);
                    p[k] = fresh;
                    moved = moved.max(change.abs());
                }
            }
            rate = rate_of(&p);
            variance = self.left(&p, &along) / n;
            if moved < SETTLED {
                break;
            }
        }
        let entropy = |p: f64| if p > 0.0 { -p * p.ln() } else { 0.0 };
        let given = |p: f64| p * rate.ln() + (1.0 - p) * (1.0 - rate).ln() + entropy(p) + entropy(1.0 - p);
        let stated: f64 = self.kicks.iter().zip(&p).map(is_lost).map(given).sum();
        let gain = -0.5 * n * variance.ln() + stated + 0.5 * self.in_time()
            // What is paid for the rate.
            - 0.5 * count.ln();
        let likelier = self.kicks.iter().zip(&p).filter(|(_, p)| **p > 0.5);
        Lost { rate, otherwise: likelier.map(|(kick, _)| kick.command).collect(), gain, of: p.len() }
    }

    /// The expected squared innovations that shares of these probabilities leave; `along` is G p.
    fn left(&self, p: &[f64], along: &[f64]) -> f64 {
        let doubt: f64 = p.iter().zip(&self.gram).map(|(p, row)| p * (1.0 - p) * row[0]).sum();
        (self.energy - 2.0 * dot(p, &self.along) + dot(p, along) + doubt).max(1e-9 * self.energy)
    }
}
