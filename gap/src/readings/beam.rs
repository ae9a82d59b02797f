//! Which commands never arrived: all that may have become of them, the likeliest of it kept.
//!
//! Each command arrives, or the one before stays in force. What that changes of the filter's walk follows its linear recursion
//! ([`crate::filter::Chain`]), so that the likelihood of any sequence of losses is that of a switching linear system, which is
//! searched in the order of time: hypotheses that differ only in what lies far back are one, and those that are far behind are
//! dropped (Tugnait 1982, "Detection and estimation for abruptly changing systems", section on merging and pruning).

use rayon::prelude::*;

use crate::experiment::Held;
use crate::filter::{Chain, Link};

/// Hypotheses that are kept: as many as the work allows, which grows with the square of the number of states.
const WIDTHS: (usize, usize) = (48, 512);
const WORK: usize = 2048;

/// Log weight behind the best from which one is dropped.
const BEHIND: f64 = 14.0;

/// Rounds in which the rate of losses and the size of the innovations are taken from what was found.
const ROUNDS: usize = 2;

/// Share of commands that is lost, where the search begins.
pub(super) const FIRST_RATE: f64 = 0.05;

/// Log likelihood that the loss of a command must change for the command to tell how many are lost, and such commands from which
/// they do.
const SHOWS: f64 = 6.0;
const ENOUGH: usize = 20;

/// Share of its squared size that a response must add with a reading to go on.
const FADED: f64 = 1e-4;

/// Commands of one input along stretches of a walk.
pub(super) struct Beam<'a> {
    /// What was sent, what acts in the walk, and what in the run beside it, which differs from that in every command.
    pub(super) sent: &'a Held,
    pub(super) acted: &'a Held,
    pub(super) other: Held,
    /// Index of the command in force after each event.
    pub(super) in_force: Vec<usize>,
    /// The stretches, and whether each is fitted.
    pub(super) stretches: Vec<(Chain, bool)>,
}

/// What is likeliest.
#[derive(Clone, Debug)]
pub(super) struct Losses {
    /// Whether each command was lost.
    pub(super) lost: Vec<bool>,
    /// Share of the commands that change anything, and how many tell it.
    pub(super) rate: f64,
    pub(super) of: usize,
    /// Log likelihood with what losses may have happened, less what stating them costs, against what acts in the walk.
    pub(super) gain: f64,
    /// The same of the stretches that are fitted.
    pub(super) trained: f64,
}

/// A loss of a hypothesis, and the one before it.
#[derive(Clone, Copy, Debug)]
struct Node {
    command: usize,
    before: Option<usize>,
}

/// One hypothesis.
#[derive(Clone, Copy, Debug)]
struct Branch {
    /// Log weight of its likeliest sequence, and of all that were merged into it.
    best: f64,
    all: f64,
    /// Log likelihood of the likeliest sequence against the walk's.
    fit: f64,
    /// Which of the last commands were lost, the last one in the lowest bit.
    recent: u64,
    /// Its last loss.
    last: Option<usize>,
    /// The value in force.
    value: f64,
    /// Where its deviation is among all of them.
    at: usize,
}

/// Hypotheses side by side.
struct Branches {
    states: usize,
    kept: Vec<Branch>,
    deviations: Vec<f64>,
    /// Deviations that nobody has.
    free: Vec<usize>,
    nodes: Vec<Node>,
}

/// What a search along one stretch found.
struct Found {
    lost: Vec<usize>,
    all: f64,
    fit: f64,
}

impl Beam<'_> {
    /// The likeliest losses; `rate` is the share that is believed lost, and is better afterwards.
    pub(super) fn losses(&self, rate: &mut f64) -> Losses {
        let count = self.changes().max(1) as f64;
        let energy = |chain: &Chain| {
            let reads = chain.links.iter().filter_map(|link| match link {
                Link::Read { innovation, variance, .. } => Some(innovation * innovation / variance),
                Link::Advance { .. } => None,
            });
            reads.fold((0.0_f64, 0.0_f64), |(n, energy), e| (n + 1.0, energy + e))
        };
        let energies: Vec<(f64, f64)> = self.stretches.iter().map(|(chain, _)| energy(chain)).collect();
        let total = energies.iter().fold((0.0, 0.0), |sum: (f64, f64), e| (sum.0 + e.0, sum.1 + e.1));
        let sizes = self.sizes();
        let mut scale = (total.1 / total.0.max(1.0)).max(1e-9);
        let (mut found, mut of) = (Vec::<Found>::new(), 0);
        for _ in 0..ROUNDS {
            found = self.stretches.par_iter().map(|(chain, _)| self.search(chain, scale, *rate)).collect();
            let gained: f64 = found.iter().map(|f| f.fit).sum();
            scale = ((total.1 - 2.0 * scale * gained) / total.0.max(1.0)).max(1e-9);
            (*rate, of) = self.rate(&found, &sizes, scale);
        }
        let mut lost = vec![false; self.sent.values.len()];
        found.iter().flat_map(|f| &f.lost).for_each(|k| lost[*k] = true);
        // Against innovations as they are, whose size is free in either case.
        let gain = |chosen: &dyn Fn(bool) -> bool| {
            let own = found.iter().zip(&energies).zip(&self.stretches);
            let own = own.filter(|(_, (_, trained))| chosen(*trained)).map(|(own, _)| own);
            let (n, energy, fit, stated) =
                own.fold((0.0, 0.0, 0.0, 0.0), |(n, energy, fit, stated), (f, own)| {
                    (n + own.0, energy + own.1, fit + f.fit, stated + f.all - f.fit)
                });
            let left: f64 = (1.0 - 2.0 * scale * fit / f64::max(energy, 1e-300)).max(1e-9);
            -0.5 * n * left.ln() + stated - 0.5 * count.ln()
        };
        Losses { lost, rate: *rate, of, gain: gain(&|_| true), trained: gain(&|trained| trained) }
    }

    /// Share of the commands that is lost, told by those whose loss would show, and how many these are.
    fn rate(&self, found: &[Found], sizes: &[f64], scale: f64) -> (f64, usize) {
        let shows = |k: &usize| sizes[*k] > 2.0 * SHOWS * scale;
        let telling = (0..sizes.len()).filter(shows).count();
        let losses = found.iter().flat_map(|f| &f.lost);
        let (losses, of) = if telling >= ENOUGH {
            (losses.filter(|k| shows(k)).count(), telling)
        } else {
            (losses.count(), self.changes().max(1))
        };
        ((losses as f64).clamp(0.5, 0.9 * of as f64) / of as f64, of)
    }

    /// What the other one has in place of a command, less that.
    fn unit(&self, command: usize) -> f64 {
        self.other.values[command] - self.acted.values[command]
    }

    /// Commands that change anything.
    fn changes(&self) -> usize {
        self.sent.values.windows(2).filter(|pair| pair[0] != pair[1]).count()
    }

    /// What the loss of each command alone would leave in the innovations, squared; in units of their variance.
    fn sizes(&self) -> Vec<f64> {
        let mut sizes = vec![0.0; self.sent.values.len()];
        self.each_begin(|chain, first, k| {
            sizes[k] = self.response(chain, first, k, self.sent.values[k - 1] - self.sent.values[k]).1;
        });
        sizes
    }

    /// By how much the commands that are believed lost were not quite lost: the mean square of the share of each that acted after all,
    /// weighed by how well each shows, and the part of it that is of the noise of the readings.
    pub(super) fn arrived(&self) -> (f64, f64) {
        let (mut squares, mut sizes, mut count) = (0.0, 0.0, 0.0);
        self.each_begin(|chain, first, k| {
            let change = self.sent.values[k] - self.acted.values[k];
            if change == 0.0 {
                return;
            }
            let (along, size) = self.response(chain, first, k, change);
            if size > 0.0 {
                squares += along * along / size;
                sizes += size;
                count += 1.0;
            }
        });
        if sizes > 0.0 { (squares / sizes, count / sizes) } else { (0.0, 0.0) }
    }

    /// Calls for each command that comes within a stretch, with the link from which on it acts.
    fn each_begin(&self, mut call: impl FnMut(&Chain, usize, usize)) {
        for (chain, _) in &self.stretches {
            let mut last = None;
            for (first, link) in chain.links.iter().enumerate() {
                let Link::Advance { event, .. } = *link else { continue };
                let k = self.in_force[event];
                if last.is_some_and(|last| last != k) && k > 0 {
                    call(chain, first, k);
                }
                last = Some(k);
            }
        }
    }

    /// What another value of one command, which acts from a link on, adds to the predictions: its product with the innovations, and
    /// with itself, in units of their variance.
    fn response(&self, chain: &Chain, first: usize, command: usize, change: f64) -> (f64, f64) {
        let n = chain.states;
        let (mut deviation, mut moved) = (vec![0.0; n], vec![0.0; n]);
        let (mut along, mut size) = (0.0, 0.0);
        let share =
            |event: usize| if self.in_force[event] == command { change / self.unit(command) } else { 0.0 };
        for link in &chain.links[first..] {
            match *link {
                Link::Advance { event, at } => {
                    advance(chain.transition(at), share(event), &mut deviation, &mut moved);
                }
                Link::Read { event, innovation, variance, at } => {
                    let (by_state, gain, direct) = chain.reading(at);
                    let off = seen(by_state, &deviation) + share(event) * direct;
                    let more = off * off / variance;
                    along += off * innovation / variance;
                    size += more;
                    if more > 0.0 && more < FADED * size {
                        break;
                    }
                    deviation.iter_mut().zip(gain).for_each(|(d, gain)| *d -= gain * off);
                }
            }
        }
        (along, size)
    }

    fn search(&self, chain: &Chain, scale: f64, rate: f64) -> Found {
        let n = chain.states;
        let weights = ((1.0 - rate).ln(), rate.ln());
        let mut branches = Branches {
            states: n,
            kept: Vec::new(),
            deviations: Vec::new(),
            free: Vec::new(),
            nodes: Vec::new(),
        };
        let mut command: Option<usize> = None;
        let mut moved = vec![0.0; n];
        for link in &chain.links {
            match *link {
                Link::Advance { event, at } => {
                    let k = self.in_force[event];
                    match command {
                        None => branches.begin(self.acted.values[k]),
                        // Where several commands come at once, only the last of them acts.
                        Some(last) => (last + 1..=k)
                            .for_each(|next| branches.grow(next, self.sent.values[next], weights)),
                    }
                    command = Some(k);
                    let (acted, unit) = (self.acted.values[k], self.unit(k));
                    for branch in &branches.kept {
                        let deviation = &mut branches.deviations[branch.at..branch.at + n];
                        advance(chain.transition(at), (branch.value - acted) / unit, deviation, &mut moved);
                    }
                }
                Link::Read { event, innovation, variance, at } => {
                    let (by_state, gain, direct) = chain.reading(at);
                    let k = self.in_force[event];
                    let (acted, unit) = (self.acted.values[k], self.unit(k));
                    let precision = 0.5 / (variance * scale);
                    for branch in &mut branches.kept {
                        let deviation = &mut branches.deviations[branch.at..branch.at + n];
                        let off = seen(by_state, deviation) + (branch.value - acted) / unit * direct;
                        let fit = off * (2.0 * innovation - off) * precision;
                        branch.fit += fit;
                        branch.best += fit;
                        branch.all += fit;
                        deviation.iter_mut().zip(gain).for_each(|(d, gain)| *d -= gain * off);
                    }
                }
            }
        }
        let all = log_sum(branches.kept.iter().map(|b| b.all));
        let best = branches.kept.iter().max_by(|a, b| a.best.total_cmp(&b.best));
        let Some(best) = best else { return Found { lost: Vec::new(), all: 0.0, fit: 0.0 } };
        let mut lost = Vec::new();
        let mut at = best.last;
        while let Some(node) = at.map(|at| branches.nodes[at]) {
            lost.push(node.command);
            at = node.before;
        }
        Found { lost, all, fit: best.fit }
    }
}

impl Branches {
    fn begin(&mut self, value: f64) {
        self.deviations.resize(self.states, 0.0);
        self.kept.push(Branch { best: 0.0, all: 0.0, fit: 0.0, recent: 0, last: None, value, at: 0 });
    }

    /// What may become of one command, under each hypothesis of those before.
    fn grow(&mut self, command: usize, sent: f64, (arrives, is_lost): (f64, f64)) {
        for k in 0..self.kept.len() {
            let branch = &mut self.kept[k];
            branch.recent <<= 1;
            if branch.value == sent {
                continue;
            }
            let mut other = *branch;
            other.best += is_lost;
            other.all += is_lost;
            other.recent |= 1;
            other.last = Some(self.nodes.len());
            self.nodes.push(Node { command, before: branch.last });
            branch.best += arrives;
            branch.all += arrives;
            branch.value = sent;
            let from = branch.at;
            other.at = self.free.pop().unwrap_or(self.deviations.len());
            if other.at == self.deviations.len() {
                self.deviations.resize(other.at + self.states, 0.0);
            }
            self.deviations.copy_within(from..from + self.states, other.at);
            self.kept.push(other);
        }
        self.prune();
    }

    /// Merges hypotheses that differ only in what lies far back, and drops those that are far behind. What is dropped counts as the
    /// mean of what is kept: most of it differs in commands of which nobody can tell.
    fn prune(&mut self) {
        let free = &mut self.free;
        self.kept.sort_unstable_by(|a, b| {
            a.recent.cmp(&b.recent).then(b.best.total_cmp(&a.best)).then(a.at.cmp(&b.at))
        });
        self.kept.dedup_by(|later, kept| {
            let same = later.recent == kept.recent && later.value == kept.value;
            if same {
                kept.all = log_sum([kept.all, later.all].into_iter());
                free.push(later.at);
            }
            same
        });
        let width = (WORK / (self.states * self.states).max(1)).clamp(WIDTHS.0, WIDTHS.1);
        let before = log_sum(self.kept.iter().map(|b| b.all));
        let least = self.kept.iter().map(|b| b.all).fold(f64::NEG_INFINITY, f64::max) - BEHIND;
        self.kept.retain(|b| {
            let keeps = b.all >= least;
            if !keeps {
                free.push(b.at);
            }
            keeps
        });
        if self.kept.len() > width {
            self.kept
                .select_nth_unstable_by(width, |a, b| b.all.total_cmp(&a.all).then(a.recent.cmp(&b.recent)));
            free.extend(self.kept.drain(width..).map(|b| b.at));
        }
        let dropped = before - log_sum(self.kept.iter().map(|b| b.all));
        self.kept.iter_mut().for_each(|b| b.all += dropped);
    }
}

/// `deviation` ← Φ `deviation`, and a `share` of what the other command adds; `moved` is room for it.
fn advance((transition, added): (&[f64], &[f64]), share: f64, deviation: &mut [f64], moved: &mut [f64]) {
    for ((value, row), added) in moved.iter_mut().zip(transition.chunks(deviation.len().max(1))).zip(added) {
        *value = row.iter().zip(&*deviation).map(|(a, b)| a * b).sum::<f64>() + share * added;
    }
    deviation.copy_from_slice(moved);
}

/// What a deviation adds to a reading.
fn seen(by_state: &[f64], deviation: &[f64]) -> f64 {
    by_state.iter().zip(deviation).map(|(h, d)| h * d).sum()
}

fn log_sum(of: impl Iterator<Item = f64> + Clone) -> f64 {
    let most = of.clone().fold(f64::NEG_INFINITY, f64::max);
    if most.is_finite() { most + of.map(|x| (x - most).exp()).sum::<f64>().ln() } else { most }
}

#[cfg(test)]
mod tests;
