//! Commands that come late where they are large: what takes long to send, or starts from rest. That is no chance
//! ([`super::late`]), and no effect of the library: a cause outside of it that is known.
//!
//! Between which values a command is small and by how much it is late where it is not say all of it, so that walks along the log under
//! the commands as they would have acted find all three.

use parallax_model::effect::{Effect, Place};

use super::acted::{Acted, TOLD, is_only, refitted};
use super::golden::golden;
use super::late::{moved_by, of_all};
use super::{LogDensity, ReadingEffect, found};
use crate::experiment::Held;
use crate::hypothesis::{EffectAt, Slot};
use crate::innovation::walk_plain;
use crate::library;
use crate::plot::format::{number, unit};
use crate::report::Value;
use crate::search::{self, Fit, INEXACT};
use crate::setup::Setup;
use crate::statistics::quantile;

/// Shares of the values that commands have that are small, those about their median, and steps in which these are refined.
const SMALL: [f64; 7] = [0.05, 0.15, 0.3, 0.45, 0.6, 0.75, 0.9];
const FINER: [f64; 4] = [0.1, 0.04, 0.015, 0.005];

/// Values at either end that are tried together at last.
const NEXT: [isize; 3] = [1, 2, 3];

/// Further searches, each from the fit that the one before led to, at most.
const ROUNDS: usize = 8;

/// Times that are tried first, from half a period to the longest, in equal ratios, and steps of the search between them.
const TIMES: usize = 9;
const GOLDEN: usize = 9;

/// Difference of −2 log likelihood to commands that are all late by the same time from which they are looked at closer: what fits to one
/// of these models is noise to the other, until its parameters are fitted again.
const SHOWS: f64 = 5.0;

/// Large commands, and small ones between them, of which there must be as many.
const FEWEST: usize = 10;

/// Share of the mean squared error of short windows down to which they must bring it where it stays above that of an exact model.
const LEFT: f64 = 0.15;

/// What the effect's parameters are called.
const LATE: &str = "delay";
const BELOW: &str = "below";
const ABOVE: &str = "above";

/// What was found, in words.
pub(crate) fn in_words(found: &ReadingEffect) -> String {
    let text =
        |name: &str| found.parameters.get(name).map(|v| format!("{}{}", number(v.value, 3), unit(&v.unit)));
    let beyond = [BELOW, ABOVE].into_iter().filter_map(|side| Some(format!("{side} {}", text(side)?)));
    format!(
        "{} acts {} late where the command is {}, which no effect of the library does",
        found.place,
        text(LATE).unwrap_or_default(),
        beyond.collect::<Vec<_>>().join(" or ")
    )
}

/// Commands of one input, and the values that they have, in order.
struct Commands<'a> {
    recorded: &'a Held,
    input: usize,
    values: Vec<f64>,
}

/// The first value that is small and the first beyond it that is not, by their place in the order, and by how much the others are
/// late (s).
#[derive(Clone, Copy, Debug)]
struct Way {
    low: usize,
    high: usize,
    late: f64,
}

/// Commands that acted late where they were large under a hypothesis.
pub(super) fn under(setup: &Setup, base: &Fit, input: usize, place: &Place) -> Option<Acted> {
    let recorded = &setup.experiment.inputs[input];
    if recorded.times.len() <= 2 * FEWEST {
        return None;
    }
    let mut values = recorded.values.clone();
    values.sort_by(f64::total_cmp);
    values.dedup();
    let commands = Commands { recorded, input, values };
    let all_late = EffectAt { effect: Effect::Delay, place: place.clone() };
    let longest = library::hypothesis(setup, std::slice::from_ref(&all_late)).fitted.last()?.high;
    let shortest = 0.5 * recorded.period();
    let ratio = (longest / shortest).powf(1.0 / (TIMES - 1) as f64);
    let mut times: Vec<f64> = (0..TIMES).map(|k| shortest * ratio.powi(k as i32)).collect();
    // Where all were found to be late, those that are not show best under a model that has all others as late.
    let without = is_only(base, &all_late).then(|| {
        times.push(of_all(base, place));
        commands.without_delay(setup, base, of_all(base, place))
    });
    let from = without.as_ref().unwrap_or(base);
    let mut way = commands.first_way(setup, from, &times, ratio)?;

    let refit = |way: Way| {
        let mut there = setup.clone();
        there.experiment.inputs[input] = commands.moved(way);
        refitted(&there, from)
    };
    let mut fit = refit(way);
    let better = |other: &Fit, fit: &Fit| other.innovation.evidence_cost < fit.innovation.evidence_cost - 1.0;
    // Calibrated parameters that make up for a time that is far off hide the right one until they are fitted to it.
    for late in &times {
        if fit.shooting_error <= INEXACT {
            break;
        }
        let next = Way { late: *late, ..way };
        let other = refit(next);
        if better(&other, &fit) {
            (way, fit) = (next, other);
        }
    }
    // What nobody knew of was noise: the less of it is left, the clearer they show.
    for _ in 0..ROUNDS {
        let mut clean = setup.clone();
        let (next, _) = commands.refined(way, ratio.sqrt(), |way| commands.cost(&mut clean, &fit, way));
        let closer = refit(next);
        if !better(&closer, &fit) {
            break;
        }
        (way, fit) = (next, closer);
    }
    // So do values at the edges, some of which were not sent in the time that is fitted.
    for (low, high) in NEXT.into_iter().flat_map(|step| [(-step, 0), (step, 0), (0, -step), (0, step)]) {
        while fit.shooting_error > INEXACT && !setup.stop.asked() {
            let Some(next) = commands.wider(way, low, high) else { break };
            let other = refit(next);
            if !better(&other, &fit) {
                break;
            }
            (way, fit) = (next, other);
        }
    }
    // The three numbers are paid for.
    let cost = fit.innovation.evidence_cost + 3.0 * (recorded.values.len() as f64).ln();
    let told = -0.5 * (cost - base.innovation.evidence_cost);
    if told < TOLD || fit.shooting_error > INEXACT.max(LEFT * base.shooting_error) {
        return None;
    }
    let effect = commands.effect(way, setup, place, told);
    let (acted, error) = (commands.moved(way), fit.shooting_error);
    Some(Acted {
        input,
        recorded: recorded.clone(),
        acted,
        effect,
        by_chance: false,
        wholly: false,
        cost,
        error,
    })
}

impl Commands<'_> {
    /// The best way under a fit that knows of none, where it explains more than all commands late by the same time do.
    fn first_way(&self, setup: &Setup, base: &Fit, times: &[f64], ratio: f64) -> Option<Way> {
        let mut clean = setup.clone();
        let mut cost = |way: Way| self.cost(&mut clean, base, way);
        let all = |late: f64| Way { low: 0, high: 0, late };
        let as_sent = cost(all(0.0));
        let same = times.iter().fold(as_sent, |least, late| least.min(cost(all(*late))));
        let (mut least, mut way) = (f64::INFINITY, all(0.0));
        for small in SMALL {
            for late in times {
                let next = self.about_median(small, *late);
                let at = if self.can_tell(next) { cost(next) } else { f64::INFINITY };
                if at < least {
                    (least, way) = (at, next);
                }
            }
        }
        if !least.is_finite() || as_sent - least < TOLD {
            return None;
        }
        (way, least) = self.refined(way, ratio, cost);
        (same - least >= SHOWS).then_some(way)
    }

    /// The nominal model, fitted to commands that are all late as in `base`, which has nothing but that.
    fn without_delay(&self, setup: &Setup, base: &Fit, late: f64) -> Fit {
        let mut there = setup.clone();
        there.experiment.inputs[self.input].times.iter_mut().for_each(|time| *time += late);
        let of_base = |slot: &Slot| base.hypothesis.fitted.iter().position(|f| f.slot == *slot);
        let nominal = library::hypothesis(setup, &[]).fitted;
        let start = nominal.iter().map(|f| of_base(&f.slot).map_or(f.null, |k| base.theta()[k]));
        search::null_from(&there, &base.innovation.noise, &start.collect::<Vec<f64>>())
    }

    /// What was found, as an effect.
    fn effect(&self, way: Way, setup: &Setup, place: &Place, told: f64) -> ReadingEffect {
        let value = Value { value: way.late, std: 0.0, unit: "s".into() };
        let name = Effect::Delay.name();
        let mut effect =
            found(name, place.to_string(), (LATE, value), -2.0 * told, true, LogDensity::default());
        let unit = setup.experiment.input_units.get(self.input).cloned().unwrap_or_default();
        // Where none lie beyond there is no bound.
        let below = (way.low > 0).then(|| (BELOW, self.values[way.low]));
        let above = (way.high < self.values.len()).then(|| (ABOVE, self.values[way.high - 1]));
        for (name, value) in below.into_iter().chain(above) {
            effect.parameters.insert(name.into(), Value { value, std: 0.0, unit: unit.clone() });
        }
        effect
    }

    fn about_median(&self, small: f64, late: f64) -> Way {
        let value = |share: f64| quantile(&mut self.recorded.values.clone(), share);
        let (first, last) = (value(0.5 * (1.0 - small)), value(0.5 * (1.0 + small)));
        let low = self.values.partition_point(|v| *v < first);
        Way { low, high: self.values.partition_point(|v| *v <= last), late }
    }

    /// Whether each is large.
    fn large(&self, way: Way) -> impl Iterator<Item = bool> {
        let small = &self.values[way.low..way.high];
        let (first, last) = (small.first().copied(), small.last().copied());
        let is_small =
            move |v: &f64| first.is_some_and(|first| first <= *v) && last.is_some_and(|last| *v <= last);
        self.recorded.values.iter().map(move |v| !is_small(v))
    }

    /// Whether there are enough of both.
    fn can_tell(&self, way: Way) -> bool {
        let ordered = way.low < way.high && way.high <= self.values.len();
        let many = |large: usize| (FEWEST..=self.recorded.values.len() - FEWEST).contains(&large);
        ordered && many(self.large(way).filter(|large| *large).count())
    }

    /// With so many values more that are small at either end, where enough of both are left.
    fn wider(&self, way: Way, low: isize, high: isize) -> Option<Way> {
        let moved = way.low.checked_add_signed(low).zip(way.high.checked_add_signed(high));
        moved.map(|(low, high)| Way { low, high, ..way }).filter(|way| self.can_tell(*way))
    }

    /// The commands as they acted.
    fn moved(&self, way: Way) -> Held {
        moved_by(self.recorded, self.large(way).map(|large| if large { way.late } else { 0.0 }).enumerate())
    }

    /// −2 log likelihood of the innovations under them, their scale free.
    fn cost(&self, clean: &mut Setup, fit: &Fit, way: Way) -> f64 {
        clean.experiment.inputs[self.input] = self.moved(way);
        let simulator = library::simulator(clean, &fit.hypothesis, fit.residuals.clone());
        let pass = walk_plain(&simulator, &clean.train, &clean.noise, &fit.innovation.noise, fit.theta());
        let n = pass.readings() as f64;
        let energy: f64 = pass.whitened().iter().map(|e| e * e).sum();
        let cost = n * (energy / n).ln() + pass.variance.iter().map(|v| v.ln()).sum::<f64>();
        if cost.is_finite() { cost } else { f64::INFINITY }
    }

    /// The best one near, and its cost, from steps of `ratio` in time and of the shares.
    fn refined(&self, mut way: Way, ratio: f64, mut cost: impl FnMut(Way) -> f64) -> (Way, f64) {
        let range = ((way.late / ratio).ln(), (way.late * ratio).ln());
        way.late = golden(range, GOLDEN, |late| -cost(Way { late: late.exp(), ..way })).exp();
        let mut least = cost(way);
        // To a single value in the end.
        for step in FINER.map(|share| (share * self.values.len() as f64) as usize).into_iter().chain([1]) {
            let step = step as isize;
            for (low, high) in [(-step, 0), (step, 0), (0, -step), (0, step)] {
                loop {
                    let next = self.wider(way, low, high);
                    let at = next.map_or(f64::INFINITY, &mut cost);
                    let Some(next) = next.filter(|_| at < least) else { break };
                    (least, way) = (at, next);
                }
            }
        }
        (way, least)
    }
}
