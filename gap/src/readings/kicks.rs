//! What each single command leaves in the innovations: the difference that it makes if the one before it stays in force
//! for one more period.
//!
//! A command that is lost leaves all of that difference, one that is late a share of it, and one that arrives in time
//! none. The shares that the innovations show tell lost commands from late ones, which their variance alone does not.
//! Responses of commands that follow each other overlap, so that all shares are judged together ([`gaussian`]).

mod gaussian;

use rayon::prelude::*;

use super::banded::dot;
use crate::experiment::Held;
use crate::filter::Noise;
use crate::innovation::{Segment, walk_plain};
use crate::library;
use crate::search::Fit;
use crate::setup::Setup;
use crate::statistics::{median, root_mean_square};

pub(super) use gaussian::Late;

/// Runs in which every command is held once, at most.
const RUNS: f64 = 32.0;

/// Readings of the fastest output that a command's response covers, at least.
const COVERED: f64 = 8.0;

/// Share of the largest change of a command below which one counts as that large where it stands for another.
const LEAST_CHANGE: f64 = 0.05;

/// Share of the unit below which a command that could not have been later tells nothing of lateness.
const LEAST_LATE: f64 = 0.02;

/// A command whose value differs from the one before.
#[derive(Clone, Debug)]
struct Kick {
    /// Its index among the commands.
    command: usize,
    /// By how much the value differs.
    change: f64,
    /// By how much it was late (s).
    late: f64,
    /// Index of the first reading after it, in the order of their stamps.
    first: usize,
    /// What holding the command before it adds to each whitened innovation from there on, with the sign reversed.
    response: Vec<f64>,
}

/// All kicks of one input, beside the innovations.
#[derive(Clone, Debug)]
pub(super) struct Kicks {
    kicks: Vec<Kick>,
    /// Number of readings that weigh, and the sum of their squared whitened innovations.
    readings: usize,
    energy: f64,
    /// Order of the readings by stamp, and the stamps (s) and whitened innovations as the walk gave them.
    order: Vec<usize>,
    pub(super) stamp: Vec<f64>,
    pub(super) whitened: Vec<f64>,
    /// Sum of the logarithms of the innovations' variances, and each of them in the order of the walk.
    volume: f64,
    log_variance: Vec<f64>,
    /// ⟨response k, innovations⟩.
    along: Vec<f64>,
    /// ⟨response k, response k + d⟩ for each k and d.
    gram: Vec<Vec<f64>>,
}

impl Kicks {
    /// From walks of a fitted model along the whole log, under its commands and under others, each of which comes `late`
    /// (s), or not at all where that is its whole period.
    ///
    /// Nothing where the commands hardly change.
    pub(super) fn new(setup: &Setup, fit: &Fit, noise: &Noise, input: usize, late: f64) -> Option<Self> {
        let segments: Vec<Segment> = setup.train.iter().chain(&setup.test).cloned().collect();
        let walked = |setup: &Setup| {
            let simulator = library::simulator(setup, &fit.hypothesis, fit.residuals.clone());
            walk_plain(&simulator, &segments, &setup.noise, noise, fit.theta())
        };
        let plain = walked(setup);
        let held = &setup.experiment.inputs[input];
        let changes: Vec<usize> =
            (1..held.values.len()).filter(|&k| held.values[k] != held.values[k - 1]).collect();
        let mut between: Vec<f64> = changes.windows(2).map(|c| held.times[c[1]] - held.times[c[0]]).collect();
        if between.len() < 10 {
            return None;
        }
        let memory = setup.horizon.min(RUNS * median(&mut between)).max(COVERED * setup.period);
        let runs = combs(held, &changes, memory);
        let until_next = |k: usize| held.times.get(k + 1).map_or(0.0, |next| next - held.times[k]);
        let lateness = |k: usize| until_next(k).min(late);
        // What a stretch's first readings tell is the state, whose guess knows nothing of what the hypothesis says of their times.
        let told: Vec<usize> = (0..plain.readings()).filter(|k| plain.weighs(*k)).collect();
        let stamp: Vec<f64> = told.iter().map(|k| plain.stamp[*k]).collect();
        let mut order: Vec<usize> = (0..told.len()).collect();
        order.sort_by(|a, b| stamp[*a].total_cmp(&stamp[*b]));
        let stamps: Vec<f64> = order.iter().map(|k| stamp[*k]).collect();
        let found: Vec<Option<Vec<Kick>>> = runs
            .par_iter()
            .map(|run| {
                let mut disturbed = setup.clone();
                for &k in run {
                    let other = &mut disturbed.experiment.inputs[input];
                    if lateness(k) < until_next(k) {
                        other.times[k] += lateness(k);
                    } else {
                        other.values[k] = held.values[k - 1];
                    }
                }
                let other = walked(&disturbed);
                (other.stamp == plain.stamp).then(|| {
                    let kick = |(number, &k): (usize, &usize)| {
                        let until = run.get(number + 1).map_or(f64::INFINITY, |next| held.times[*next]);
                        let first = stamps.partition_point(|s| *s <= held.times[k]);
                        let end = stamps.partition_point(|s| *s <= until.min(held.times[k] + memory));
                        let change = |at: &usize| {
                            let r = told[*at];
                            (plain.innovation[r] - other.innovation[r]) / plain.variance[r].sqrt()
                        };
                        let response = order[first..end].iter().map(change).collect();
                        Kick {
                            command: k,
                            change: held.values[k] - held.values[k - 1],
                            late: lateness(k),
                            first,
                            response,
                        }
                    };
                    run.iter().enumerate().map(kick).collect()
                })
            })
            .collect();
        let mut kicks: Vec<Kick> = found.into_iter().collect::<Option<Vec<_>>>()?.concat();
        kicks.retain(|kick| kick.late > 0.0 && !kick.response.is_empty());
        kicks.sort_by_key(|kick| kick.command);
        let all = plain.whitened();
        let whitened: Vec<f64> = told.iter().map(|k| all[*k]).collect();
        let log_variance: Vec<f64> = told.iter().map(|k| plain.variance[*k].ln()).collect();
        let innovations: Vec<f64> = order.iter().map(|k| whitened[*k]).collect();
        let finite = innovations.iter().chain(kicks.iter().flat_map(|k| &k.response)).all(|v| v.is_finite());
        if kicks.len() < 10 || !finite {
            return None;
        }
        let along = kicks.iter().map(|k| dot(&k.response, &innovations[k.first..])).collect();
        let gram = (0..kicks.len())
            .map(|k| {
                let own = &kicks[k];
                let later = kicks[k..].iter().take_while(|o| o.first < own.first + own.response.len());
                later.map(|o| dot(&own.response[o.first - own.first..], &o.response)).collect()
            })
            .collect();
        let energy = innovations.iter().map(|e| e * e).sum();
        Some(Kicks {
            kicks,
            readings: innovations.len(),
            energy,
            order,
            stamp,
            whitened,
            volume: log_variance.iter().sum(),
            log_variance,
            along,
            gram,
        })
    }

    /// The same with every command late by `unit` (s): responses in proportion to the time. What one shows that could be
    /// late by hardly anything is not believed.
    pub(super) fn in_units_of(mut self, unit: f64) -> Self {
        let scale = |kick: &Kick| if kick.late < LEAST_LATE * unit { 0.0 } else { unit / kick.late };
        let scales: Vec<f64> = self.kicks.iter().map(scale).collect();
        self.scale(&scales);
        self.kicks.iter_mut().for_each(|kick| kick.late = unit);
        self
    }

    /// The same if every command changed by as much as another one, half of the log away, does.
    pub(super) fn exchanged(&self) -> Self {
        let count = self.kicks.len();
        self.with_changes(|k| self.kicks[(k + count / 2) % count].change)
    }

    /// The same if every command changed by as much, each in its own direction: what a force that scatters leaves, whatever the
    /// commands.
    pub(super) fn even(&self) -> Self {
        let usual = root_mean_square(&self.kicks.iter().map(|k| k.change).collect::<Vec<f64>>());
        self.with_changes(|_| usual)
    }

    /// The same if each changed by so much, in the direction in which it did: responses are in proportion.
    fn with_changes(&self, other: impl Fn(usize) -> f64) -> Self {
        let least = self.least_change();
        let scale = |(k, kick): (usize, &Kick)| other(k) / kick.change.abs().max(least);
        let scales: Vec<f64> = self.kicks.iter().enumerate().map(scale).collect();
        let mut kicks = self.clone();
        kicks.scale(&scales);
        kicks
    }

    fn scale(&mut self, scales: &[f64]) {
        for (k, kick) in self.kicks.iter_mut().enumerate() {
            kick.response.iter_mut().for_each(|r| *r *= scales[k]);
            self.along[k] *= scales[k];
            for (d, g) in self.gram[k].iter_mut().enumerate() {
                *g *= scales[k] * scales[k + d];
            }
        }
    }

    /// The same if these shares were in the innovations as well.
    pub(super) fn with(&self, shares: &[f64]) -> Self {
        let mut kicks = self.clone();
        let more = self.by_gram(shares);
        kicks.energy += 2.0 * dot(shares, &self.along) + dot(shares, &more);
        kicks.along.iter_mut().zip(&more).for_each(|(along, more)| *along += more);
        kicks
    }

    /// The same on part of the log: readings whose stamps are `within` it, and commands whose responses begin there.
    pub(super) fn part(&self, within: impl Fn(f64) -> bool) -> Self {
        let mut part = self.clone();
        let inside: Vec<bool> = self.order.iter().map(|at| within(self.stamp[*at])).collect();
        let volumes = self.order.iter().zip(&inside).filter(|(_, inside)| **inside);
        part.volume = volumes.map(|(at, _)| self.log_variance[*at]).sum();
        part.readings = inside.iter().filter(|inside| **inside).count();
        let innovation =
            |(k, inside): (usize, &bool)| if *inside { self.whitened[self.order[k]] } else { 0.0 };
        let innovations: Vec<f64> = inside.iter().enumerate().map(innovation).collect();
        part.energy = innovations.iter().map(|e| e * e).sum();
        for (along, kick) in part.along.iter_mut().zip(&part.kicks) {
            *along = dot(&kick.response, &innovations[kick.first..]);
        }
        let own = |kick: &Kick| if inside[kick.first] { 1.0 } else { 0.0 };
        let scales: Vec<f64> = part.kicks.iter().map(own).collect();
        part.scale(&scales);
        part
    }

    /// What each share takes off the innovations' squares, to first order.
    pub(super) fn explained(&self, shares: &[f64]) -> Vec<f64> {
        self.along.iter().zip(shares).map(|(along, share)| along * share).collect()
    }

    /// By how much each response shows: the sum of its squares.
    pub(super) fn energies(&self) -> impl Iterator<Item = f64> + '_ {
        self.gram.iter().map(|row| row[0])
    }

    /// The commands, by their index.
    pub(super) fn commands(&self) -> Vec<usize> {
        self.kicks.iter().map(|kick| kick.command).collect()
    }

    /// Sum over all commands of the squared response of each reading, in the order of the walk: the variance that shares
    /// of unit variance add.
    pub(super) fn squares(&self) -> Vec<f64> {
        let mut squares = vec![0.0; self.readings];
        for kick in &self.kicks {
            for (at, r) in self.order[kick.first..].iter().zip(&kick.response) {
                squares[*at] += r * r;
            }
        }
        squares
    }

    fn least_change(&self) -> f64 {
        LEAST_CHANGE * self.kicks.iter().map(|k| k.change.abs()).fold(0.0, f64::max)
    }

    /// By how much commands were late, half of them more (s).
    pub(super) fn lateness(&self) -> f64 {
        median(&mut self.kicks.iter().map(|k| k.late).collect::<Vec<_>>())
    }

    /// G x.
    fn by_gram(&self, x: &[f64]) -> Vec<f64> {
        let mut out = vec![0.0; x.len()];
        for (k, row) in self.gram.iter().enumerate() {
            out[k] += row[0] * x[k];
            for (d, g) in row.iter().enumerate().skip(1) {
                out[k] += g * x[k + d];
                out[k + d] += g * x[k];
            }
        }
        out
    }

    /// −2 log likelihood of commands that are all in time.
    fn in_time(&self) -> f64 {
        let n = self.readings as f64;
        n * (self.energy / n).ln()
    }
}

/// Deals the changes to runs, so that within each no two come closer than `memory` (s).
fn combs(held: &Held, changes: &[usize], memory: f64) -> Vec<Vec<usize>> {
    let mut runs: Vec<Vec<usize>> = Vec::new();
    for &k in changes {
        let free =
            |run: &&mut Vec<usize>| run.last().is_none_or(|last| held.times[k] - held.times[*last] >= memory);
        match runs.iter_mut().find(free) {
            Some(run) => run.push(k),
            None => runs.push(vec![k]),
        }
    }
    runs
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;

    /// Commands whose responses fade over a few readings, with shares that `share` draws for each change.
    fn kicks(mut share: impl FnMut(&mut ChaCha8Rng, f64) -> f64, size: f64) -> Kicks {
        let mut random = ChaCha8Rng::seed_from_u64(5);
        let (count, length) = (400_usize, 6_usize);
        let readings = count + length;
        let mut innovations: Vec<f64> = (0..readings).map(|_| StandardNormal.sample(&mut random)).collect();
        let mut kicks = Vec::new();
        for k in 0..count {
            let change: f64 = StandardNormal.sample(&mut random);
            let response: Vec<f64> = (0..length).map(|i| size * change * 0.6_f64.powi(i as i32)).collect();
            let share = share(&mut random, change);
            for (e, r) in innovations[k..].iter_mut().zip(&response) {
                *e += share * r;
            }
            kicks.push(Kick { command: k + 1, change, late: 0.01, first: k, response });
        }
        let along = kicks.iter().map(|k| dot(&k.response, &innovations[k.first..])).collect();
        let gram = (0..count)
            .map(|k| {
                let later = kicks[k..].iter().take_while(|o| o.first < k + length);
                later.map(|o| dot(&kicks[k].response[o.first - k..], &o.response)).collect()
            })
            .collect();
        let energy = innovations.iter().map(|e| e * e).sum();
        let stamp = (0..readings).map(|k| 0.01 * k as f64).collect();
        Kicks {
            kicks,
            readings,
            energy,
            order: (0..readings).collect(),
            stamp,
            whitened: innovations,
            volume: 0.0,
            log_variance: vec![0.0; readings],
            along,
            gram,
        }
    }

    #[test]
    fn times_that_scatter_are_told_from_none() {
        let tardy = kicks(|random, _| random.random_range(0.0..0.6), 3.0);
        let late = tardy.late(0.05);
        // Evenly over six tenths of a period of 10 ms.
        let spread = 0.01 * 0.6 / 12.0_f64.sqrt();
        assert!((late.spread / spread - 1.0).abs() < 0.3, "{} against {spread}", late.spread);
        assert!(late.log_evidence > 20.0);

        // What each was late by, told by six readings each.
        let mut random = ChaCha8Rng::seed_from_u64(9);
        let drawn: Vec<f64> = (0..400).map(|_| random.random_range(0.0..0.6)).collect();
        let mut next = drawn.iter();
        let tardy = kicks(|_, _| *next.next().expect("one for each"), 30.0);
        let late = tardy.late(0.05);
        let found = tardy.shares(&late).expect("a solution");
        let error =
            |k: &[f64]| root_mean_square(&k.iter().zip(&drawn).map(|(a, b)| a - b).collect::<Vec<_>>());
        assert!(error(&found) < 0.5 * error(&vec![0.3; 400]), "{}", error(&found));
        // Those that are late already by as much have the same times, and what is left is little.
        let rest = kicks(|_, _| 0.0, 30.0).with(&drawn);
        let again = rest.late(0.05);
        assert!((again.spread / late.spread - 1.0).abs() < 0.05, "{} and {}", again.spread, late.spread);

        let punctual = kicks(|_, _| 0.0, 3.0);
        let late = punctual.late(0.05);
        let gain = |kicks: &Kicks, late: &Late| kicks.plain() - kicks.scattered(&vec![0.0; 400], late);
        assert!(gain(&punctual, &late) < 10.0 && gain(&tardy, &tardy.late(0.05)) > 2000.0);
        let half = tardy.part(|stamp| stamp < 2.0);
        assert!((half.late(0.05).spread / again.spread - 1.0).abs() < 0.2);
        assert!(punctual.late(0.05).log_evidence < 1.0);
    }

    #[test]
    fn a_force_that_scatters_is_no_lateness() {
        let tardy = kicks(|random, _| random.random_range(0.0..0.6), 3.0);
        // As large at every command, whatever that changes.
        let pushed = kicks(
            |random, change| {
                let force: f64 = StandardNormal.sample(random);
                0.5 * force / change
            },
            3.0,
        );
        assert!(pushed.late(0.05).log_evidence > 20.0, "{:?}", pushed.late(0.05));
        assert!(tardy.go_with_changes(&tardy.late(0.05), 0.05));
        assert!(!pushed.go_with_changes(&pushed.late(0.05), 0.05));
    }

    #[test]
    fn commands_that_are_all_late_by_the_same_time_do_not_scatter() {
        let delayed = kicks(|_, _| 0.5, 3.0);
        let late = delayed.late(0.05);
        assert!(late.log_evidence < 2.0 && late.gain > 50.0, "{late:?}");
    }
}
