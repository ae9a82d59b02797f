//! Answers that are a delay of commands, weighed as what else such commands may be: late by chance, or lost now and then.

use parallax_model::effect::{Effect, PlaceKind};
use rayon::prelude::*;

use super::{Answer, Posterior};
use crate::fit::TEMPERATURE;
use crate::hypothesis::EffectAt;
use crate::options::Options;
use crate::readings::{self, ReadingEffect, Way};
use crate::search::Fit;
use crate::setup::Setup;

/// Natural logarithm of a weight, relative to the largest, below which an answer's commands are not looked at.
const WITHIN: f64 = -12.0;

/// What the commands of an answer that is a delay of theirs may be else.
#[derive(Clone, Debug)]
pub(crate) struct Times {
    /// The delay's place in the class.
    member: usize,
    /// Each way in which they may be late on average, with its share of the delay's probability.
    ways: Vec<(ReadingEffect, f64)>,
}

impl Posterior {
    /// Weighs what else the commands of answers may be that are a delay of them. A delay, times that scatter about it, and losses that
    /// amount to it have the prior of one effect each; an answer that may be it in other ways as well is no less likely for that.
    pub(crate) fn weigh_times(
        &mut self,
        setup: &Setup,
        null: &Fit,
        options: &Options,
        possible: &(dyn Fn(&ReadingEffect) -> bool + Sync),
    ) {
        let largest =
            self.answers.iter().flat_map(|answer| &answer.logs).copied().fold(self.log_no_gap, f64::max);
        self.answers.par_iter_mut().for_each(|answer| {
            let Some((member, delay)) = delay_of_commands(answer) else { return };
            if answer.logs[member] < largest + WITHIN {
                return;
            }
            let at = |way: &Way| EffectAt { effect: way.effect, place: delay.place.clone() };
            let ways = readings::odds(setup, answer.member(member), &delay).into_iter();
            let weight = |way: &Way| {
                let prior = options.weight(&at(way)) / options.weight(&delay);
                prior * (way.log_evidence / TEMPERATURE).exp()
            };
            let weighed: Vec<(ReadingEffect, f64)> = ways
                .filter(|way| possible(&way.found))
                .map(|way| {
                    let weight = weight(&way);
                    (way.found, weight)
                })
                .collect();
            let total = 1.0 + weighed.iter().map(|(_, weight)| weight).sum::<f64>();
            answer.logs[member] += (total / (1.0 + weighed.len() as f64)).max(1.0).ln();
            let ways = weighed.into_iter().map(|(effect, weight)| (effect, weight / total)).collect();
            answer.times = Some(Times { member, ways });
        });
        self.settle_on_best(null);
    }

    /// What the commands of the leading answer are, where that is likelier than the answer's own delay.
    pub(crate) fn leading_way(&self) -> Option<&ReadingEffect> {
        let first = self.answers.first()?;
        let own = first.probability - first.ways().map(|(_, probability)| probability).sum::<f64>();
        let likeliest = first.ways().max_by(|a, b| a.1.total_cmp(&b.1));
        likeliest.filter(|(_, probability)| *probability > own).map(|(way, _)| way)
    }
}

/// The member of a class that is a delay of commands alone, and that delay.
fn delay_of_commands(answer: &Answer) -> Option<(usize, EffectAt)> {
    let all = answer.members.iter().enumerate();
    let mut alone = all.filter_map(|(member, (effects, ..))| Some((member, effects.first()?, effects.len())));
    let is_delay = |at: &EffectAt| at.effect == Effect::Delay && at.place.kind == PlaceKind::Input;
    alone.find(|(_, at, count)| *count == 1 && is_delay(at)).map(|(member, at, _)| (member, at.clone()))
}

impl Answer {
    fn member(&self, of: usize) -> &Fit {
        of.checked_sub(1).map_or(&self.fit, |other| &self.alike[other])
    }

    /// What its commands may be instead of late by the same time, each with its probability.
    pub(crate) fn ways(&self) -> impl Iterator<Item = (&ReadingEffect, f64)> {
        self.times.iter().flat_map(|times| {
            let probability = self.members.get(times.member).map_or(0.0, |(_, probability, _)| *probability);
            times.ways.iter().map(move |(effect, share)| (effect, share * probability))
        })
    }

    /// The fit with the delay that these are weighed beside.
    pub(crate) fn late_on_average(&self) -> Option<&Fit> {
        self.times.as_ref().map(|times| self.member(times.member))
    }

    /// The probability of the likeliest way in which it may be so.
    pub(super) fn likeliest(&self) -> f64 {
        let others: f64 = self.ways().map(|(_, probability)| probability).sum();
        self.ways().map(|(_, probability)| probability).fold(self.probability - others, f64::max)
    }
}
