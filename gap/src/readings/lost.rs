//! Commands that never arrived, one by one: the machine went on with the one before.

use parallax_model::effect::Place;

use super::acted::{Acted, TOLD, refitted};
use super::found;
use super::kicks::{Kicks, Lost};
use super::scatter;
use crate::report::Value;
use crate::search::Fit;
use crate::setup::Setup;

/// Rounds in which further losses are looked for, at most.
const ROUNDS: usize = 8;

/// Share of the commands beyond which it is no loss but another effect.
const MOST: f64 = 0.4;

/// Losses from which they are an effect, and the share of the commands from which fewer are as well: one of a thousand that
/// seems to be lost is where the model is off by a little.
pub(super) const FEWEST: usize = 3;
pub(super) const RAREST: f64 = 0.01;

/// The losses at one input under a hypothesis, and −2 log evidence with them.
pub(super) fn under(setup: &Setup, base: &Fit, input: usize, place: &Place) -> Option<Acted> {
    let recorded = &setup.experiment.inputs[input];
    let (mut clean, mut fit) = (setup.clone(), base.clone());
    let mut first: Option<Lost> = None;
    for _ in 0..ROUNDS {
        let Some(lost) = round(&clean, &fit, input) else { break };
        let held = &mut clean.experiment.inputs[input];
        for &k in &lost.commands {
            held.values[k] = held.values[k - 1];
        }
        fit = refitted(&clean, base);
        first.get_or_insert(lost);
    }
    let first = first?;
    let acted = clean.experiment.inputs[input].clone();
    let differ = |k: &usize| acted.values[*k] != recorded.values[*k];
    let changes = |k: &usize| recorded.values[*k] != recorded.values[*k - 1];
    let trained = |k: &usize| setup.train.iter().any(|s| (s.from..s.to).contains(&recorded.times[*k]));
    let all: Vec<usize> = (1..recorded.values.len()).filter(changes).collect();
    let code = |of: usize, lost: usize| {
        let (of, lost) = (of as f64, lost as f64);
        let rate = (lost / of.max(1.0)).clamp(1e-6, 1.0 - 1e-6);
        -2.0 * (lost * rate.ln() + (of - lost) * (1.0 - rate).ln()) + of.max(1.0).ln()
    };
    let count = |which: &dyn Fn(&usize) -> bool| all.iter().filter(|k| which(k)).count();
    let cost = fit.innovation.evidence_cost + code(count(&trained), count(&|k| trained(k) && differ(k)));
    let losses = count(&differ);
    let rate = losses as f64 / all.len().max(1) as f64;
    let accident = losses < FEWEST && rate < RAREST;
    if rate > MOST || losses == 0 || accident {
        return None;
    }
    let std = (rate * (1.0 - rate) / all.len() as f64).sqrt();
    let value = Value { value: rate, std, unit: String::new() };
    let density = scatter::density_at_input(setup, base, input, (f64::INFINITY, rate.sqrt()));
    let effect = found(
        "drops",
        place.to_string(),
        ("rate", value),
        -2.0 * first.gain,
        true,
        density.unwrap_or_default(),
    );
    let error = fit.shooting_error;
    Some(Acted { input, recorded: recorded.clone(), acted, effect, cost, error })
}

/// Losses that one look at the innovations shows.
fn round(setup: &Setup, fit: &Fit, input: usize) -> Option<Lost> {
    let lost = Kicks::new(setup, fit, &fit.innovation.noise, input, f64::INFINITY)?.lost();
    (lost.gain > TOLD && lost.rate < MOST && !lost.commands.is_empty()).then_some(lost)
}
