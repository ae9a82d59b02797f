//! Why an effect lost: its evidence against the winner's, its best fit, and where it explains the log worse.
//!
//! The comparison by time and by region adds up, over the readings of the fitted stretches, what each reading
//! costs under the effect's filter beyond what it costs under the winner's: e²/σ² + log σ² of its innovation. A
//! region stands out when more of the whole difference falls on it than its share of the readings.

mod readings;

use std::collections::BTreeMap;
use std::fmt;

use parallax_model::effect::Effect;
use serde::{Deserialize, Serialize};

use crate::answers::{as_fitted, fitted_effects};
use crate::filter::Pass;
use crate::hypothesis::EffectAt;
use crate::library;
use crate::options::Pattern;
use crate::posterior::Posterior;
use crate::readings::ReadingEffect;
use crate::report::{Absorbed, Value};
use crate::search::Fit;
use crate::setup::{Range, Setup};

pub(crate) use readings::of_readings;

/// What became of an effect.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Fate {
    /// It is the answer.
    Leads,
    /// It belongs to the answer's class: this data cannot tell them apart.
    Alike,
    /// Another answer is more probable.
    Loses,
    /// It led, but with it held-out time is certainly predicted worse than without any effect.
    Refuted,
    /// A calibrated parameter does the same.
    Absorbed {
        /// The parameter.
        by: String,
    },
    /// Its best fit is not what it says it is: a limit that leaves next to nothing, or that readings exceed; a lag that is
    /// over before it shows.
    Impossible,
    /// An effect on how readings scatter that they do not show, or not for itself.
    NotShown {
        /// Why it is not named, as the end of a sentence.
        reason: String,
    },
    /// It could not be tested.
    NotTestable {
        /// Why, as the end of a sentence.
        reason: String,
    },
}

/// A stretch of time or a region that an effect explains worse than the winner does.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Worse {
    /// `time`, or the quantity that is in the region.
    pub quantity: String,
    /// Where it begins.
    pub from: f64,
    /// Where it ends.
    pub to: f64,
    /// Share of the readings that lie there.
    pub readings: f64,
    /// Share of the whole difference in −2 log likelihood that falls there; may exceed 1 where others gain.
    pub share: f64,
}

/// Why an effect is not the answer, or that it is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Explanation {
    /// The effect, `coulomb@joint:axis`.
    pub effect: String,
    /// What became of it.
    pub fate: Fate,
    /// The leading answer.
    pub winner: String,
    /// Log evidence of the effect beyond the winner's: below zero where it is worse. Absent where it was not fitted.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub evidence: Option<f64>,
    /// Log evidence beyond that of no effect at all.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub against_no_effect: Option<f64>,
    /// Root mean square error over the horizon with the effect, in noise units.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<f64>,
    /// The same with the winner.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub winner_error: Option<f64>,
    /// Its best fit.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub parameters: BTreeMap<String, Value>,
    /// Where it explains the log worse than the winner, the worst first.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub worse: Vec<Worse>,
}

/// What an explanation is drawn from.
#[derive(Clone, Copy, Debug)]
pub struct Evidence<'a> {
    /// The system and the recording.
    pub setup: &'a Setup,
    /// The nominal model, refitted.
    pub null: &'a Fit,
    /// The answers.
    pub posterior: &'a Posterior,
    /// Effects that calibrated parameters cover.
    pub absorbed: &'a [Absorbed],
    /// Effects that could not be tested.
    pub not_testable: &'a [library::NotTestable],
}

/// Explains every effect that one of the patterns fits, in the order of their evidence.
#[must_use]
pub fn explain(evidence: &Evidence<'_>, patterns: &[Pattern]) -> Vec<Explanation> {
    let Evidence { posterior, .. } = *evidence;
    let fits = |at: &EffectAt| patterns.iter().any(|pattern| pattern.fits(at));
    let winner = Winner::of(evidence);
    let mut fitted: Vec<(&Fit, Fate)> = Vec::new();
    for (index, answer) in posterior.answers.iter().chain(&posterior.refuted).enumerate() {
        let members = [&answer.fit].into_iter().chain(&answer.alike);
        for (member, fit) in members.enumerate() {
            // Of the sums that were tried, only those that are the answer say something of an effect.
            let single = fit.hypothesis.effects.len() == 1;
            if (single || index == 0) && fit.hypothesis.effects.iter().any(fits) {
                let fate = match (index, member) {
                    (0, _) if winner.way.is_some() => Fate::Loses,
                    (0, 0) => Fate::Leads,
                    (0, _) => Fate::Alike,
                    (index, _) if index >= posterior.answers.len() => Fate::Refuted,
                    _ => Fate::Loses,
                };
                fitted.push((fit, fate));
            }
        }
    }
    fitted.sort_by(|a, b| posterior.cost(a.0).total_cmp(&posterior.cost(b.0)));
    let mut out: Vec<Explanation> =
        fitted.into_iter().map(|(fit, fate)| of_fit(evidence, &winner, fit, fate)).collect();
    out.extend(of_ways(evidence, &winner, &fits));
    let plain = |effect: String, fate: Fate| Explanation {
        effect,
        fate,
        winner: winner.label.clone(),
        evidence: None,
        against_no_effect: None,
        error: None,
        winner_error: None,
        parameters: BTreeMap::new(),
        worse: Vec::new(),
    };
    for absorbed in evidence.absorbed {
        let Ok(exact) = absorbed.effect.parse::<Pattern>() else { continue };
        let (known, _) = library::candidates(evidence.setup);
        if known.iter().any(|at| exact.fits(at) && fits(at)) {
            out.push(plain(absorbed.effect.clone(), Fate::Absorbed { by: absorbed.by.clone() }));
        }
    }
    for n in evidence.not_testable.iter().filter(|n| fits(&n.effect)) {
        out.push(plain(n.effect.label(), Fate::NotTestable { reason: n.reason.clone() }));
    }
    if !evidence.setup.stop.asked() {
        let (known, _) = library::candidates(evidence.setup);
        let labels: Vec<String> = out.iter().map(|e| e.effect.clone()).collect();
        let missing = known.iter().filter(|at| fits(at)).map(EffectAt::label);
        out.extend(
            missing.filter(|label| !labels.contains(label)).map(|label| plain(label, Fate::Impossible)),
        );
    }
    // Forms of one effect share a label: what was fitted stands for those that were not.
    let mut seen = Vec::new();
    out.retain(|e| {
        let again = seen.contains(&e.effect);
        seen.push(e.effect.clone());
        !again
    });
    out
}

/// The leading answer.
struct Winner<'a> {
    fit: &'a Fit,
    /// What its commands are, where that is not the delay that is fitted.
    way: Option<&'a ReadingEffect>,
    label: String,
    /// −2 log evidence.
    cost: f64,
}

impl<'a> Winner<'a> {
    fn of(evidence: &Evidence<'a>) -> Self {
        let Evidence { null, posterior, .. } = *evidence;
        let (fit, way) = (posterior.leader(null), posterior.leading_way());
        let label = way.map_or_else(|| fit.hypothesis.label(), |way| as_fitted(way).label());
        Winner { fit, way, label, cost: posterior.cost(fit) + way.map_or(0.0, |way| way.evidence) }
    }
}

/// What commands may be that are late on average.
fn of_ways(
    evidence: &Evidence<'_>,
    winner: &Winner<'_>,
    fits: &dyn Fn(&EffectAt) -> bool,
) -> Vec<Explanation> {
    let Evidence { null, posterior, .. } = *evidence;
    let mut out = Vec::new();
    for answer in &posterior.answers {
        let Some(fit) = answer.late_on_average() else { continue };
        for (way, _) in answer.ways() {
            let at = Effect::from_name(&way.name).zip(way.place.parse().ok());
            if !at.is_some_and(|(effect, place)| fits(&EffectAt { effect, place })) {
                continue;
            }
            let cost = posterior.cost(fit) + way.evidence;
            let leads = winner.way == Some(way);
            out.push(Explanation {
                effect: as_fitted(way).label(),
                fate: if leads { Fate::Leads } else { Fate::Loses },
                winner: winner.label.clone(),
                evidence: Some(0.5 * (winner.cost - cost)),
                against_no_effect: Some(0.5 * (posterior.cost(null) - cost)),
                error: Some(fit.shooting_error.max(0.0).sqrt()),
                winner_error: Some(winner.fit.shooting_error.max(0.0).sqrt()),
                parameters: way.parameters.clone(),
                worse: Vec::new(),
            });
        }
    }
    out
}

fn of_fit(evidence: &Evidence<'_>, winner: &Winner<'_>, fit: &Fit, fate: Fate) -> Explanation {
    let Evidence { setup, null, posterior, .. } = *evidence;
    let leads = fate == Fate::Leads;
    let beyond = |cost: f64| 0.5 * (cost - posterior.cost(fit));
    let parameters = fitted_effects(setup, fit).into_iter().flat_map(|effect| effect.parameters).collect();
    Explanation {
        effect: fit.hypothesis.label(),
        fate,
        winner: winner.label.clone(),
        evidence: Some(beyond(winner.cost)),
        against_no_effect: Some(beyond(posterior.cost(null))),
        error: Some(fit.shooting_error.max(0.0).sqrt()),
        winner_error: Some(winner.fit.shooting_error.max(0.0).sqrt()),
        parameters,
        worse: if leads { Vec::new() } else { worse(setup, null, fit, winner.fit) },
    }
}

/// Pieces into which each quantity is cut.
const PIECES: usize = 8;

/// Regions that are named, at most.
const NAMED: usize = 4;

/// Difference in −2 log likelihood from which regions are looked for.
const LEAST: f64 = 4.0;

/// What each reading costs under a filter, by output and stamp.
fn costs(pass: &Pass) -> BTreeMap<(usize, u64), f64> {
    (0..pass.readings()).map(|k| ((pass.output[k], pass.stamp[k].to_bits()), pass.cost_of(k))).collect()
}

fn worse(setup: &Setup, null: &Fit, fit: &Fit, winner: &Fit) -> Vec<Worse> {
    let (own, best) = (costs(&fit.innovation.pass), costs(&winner.innovation.pass));
    let pass = &null.innovation.pass;
    let system = setup.equations.system();
    let n = system.states.len();
    let stride = pass.state.len() / pass.readings().max(1);
    // Time, commands, states as the nominal model's filter saw them.
    let mut names: Vec<String> = vec!["time".into()];
    names.extend(system.inputs.iter().map(|input| input.name.clone()));
    names.extend(system.states.iter().map(|state| state.name.clone()));
    let mut columns: Vec<Vec<f64>> = vec![Vec::new(); names.len()];
    let mut differences = Vec::new();
    for k in 0..pass.readings() {
        let key = (pass.output[k], pass.stamp[k].to_bits());
        let (Some(a), Some(b)) = (own.get(&key), best.get(&key)) else { continue };
        if stride < n {
            continue;
        }
        differences.push(a - b);
        let inputs = setup.experiment.inputs.iter().map(|held| held.at(pass.stamp[k]));
        let states = pass.state[k * stride..k * stride + n].iter().copied();
        let row = [pass.stamp[k]].into_iter().chain(inputs).chain(states);
        for (column, value) in columns.iter_mut().zip(row) {
            column.push(value);
        }
    }
    let total: f64 = differences.iter().sum();
    if total.is_nan() || total < LEAST {
        return Vec::new();
    }
    let count = differences.len() as f64;
    let mut found: Vec<(f64, Worse)> = Vec::new();
    for (name, column) in names.iter().zip(&columns) {
        let range = Range::of(column);
        if range.width().is_nan() || range.width() <= 0.0 || range.width().is_infinite() {
            continue;
        }
        let mut sums = [(0.0, 0.0); PIECES];
        for (value, difference) in column.iter().zip(&differences) {
            let at = ((value - range.low) / range.width() * PIECES as f64) as usize;
            let piece = &mut sums[at.min(PIECES - 1)];
            *piece = (piece.0 + difference, piece.1 + 1.0);
        }
        let excess = |(sum, readings): (f64, f64)| sum / total - readings / count;
        let Some(first) = (0..PIECES).max_by(|a, b| excess(sums[*a]).total_cmp(&excess(sums[*b]))) else {
            continue;
        };
        // Neighbours that are worse too belong to the region.
        let (mut from, mut to) = (first, first + 1);
        while from > 0 && excess(sums[from - 1]) > 0.25 * excess(sums[first]) {
            from -= 1;
        }
        while to < PIECES && excess(sums[to]) > 0.25 * excess(sums[first]) {
            to += 1;
        }
        let (sum, readings) =
            sums[from..to].iter().fold((0.0, 0.0), |(s, r), piece| (s + piece.0, r + piece.1));
        let edge = |k: usize| range.low + range.width() * k as f64 / PIECES as f64;
        let region = Worse {
            quantity: name.clone(),
            from: edge(from),
            to: edge(to),
            readings: readings / count,
            share: sum / total,
        };
        found.push((region.share - region.readings, region));
    }
    found.retain(|(excess, _)| *excess > 0.1);
    found.sort_by(|a, b| b.0.total_cmp(&a.0));
    found.into_iter().take(NAMED).map(|(_, region)| region).collect()
}

impl fmt::Display for Explanation {
    /// A few lines for a terminal.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Explanation { effect, winner, .. } = self;
        match &self.fate {
            Fate::Leads => writeln!(f, "{effect} is the answer")?,
            Fate::Alike => {
                writeln!(
                    f,
                    "{effect} belongs to the answer's class: this data cannot tell it from {winner}"
                )?;
            }
            Fate::Loses => writeln!(f, "{effect} loses to {winner}")?,
            Fate::Refuted => {
                writeln!(
                    f,
                    "{effect} is left out: with it held-out time is predicted worse than without any effect, or far worse than with another answer"
                )?;
            }
            Fate::Absorbed { by } => {
                writeln!(f, "{effect} is not fitted: the calibrated parameter `{by}` does the same here")?;
            }
            Fate::Impossible => writeln!(
                f,
                "{effect} is not an answer: its best fit would be a limit that leaves next to nothing or that readings \
                 exceed, or a lag that is over before it shows"
            )?,
            Fate::NotShown { reason } => writeln!(f, "{effect} is not named: {reason}")?,
            Fate::NotTestable { reason } => writeln!(f, "{effect} is not testable: {reason}")?,
        }
        let against_winner = self.evidence.filter(|_| self.fate != Fate::Leads);
        if let Some(evidence) = against_winner {
            writeln!(f, "  evidence    {evidence:+.1} in log evidence against {winner}")?;
        }
        if let Some(null) = self.against_no_effect {
            let label = if against_winner.is_none() { "evidence" } else { "" };
            writeln!(f, "  {label:10}  {null:+.1} against no effect at all")?;
        }
        if !self.parameters.is_empty() {
            let parameters = self.parameters.iter().map(|(name, v)| {
                let unit = if v.unit.is_empty() { String::new() } else { format!(" {}", v.unit) };
                format!("{name} {:.4} ± {:.2}{unit}", Short(v.value), Short(v.std))
            });
            writeln!(f, "  best fit    {}", parameters.collect::<Vec<_>>().join(", "))?;
        }
        if let (Some(error), Some(best)) = (self.error, self.winner_error) {
            let than =
                if self.fate == Fate::Leads { String::new() } else { format!(", {best:.2} with {winner}") };
            writeln!(f, "  error       {error:.2} noise units over the horizon{than}")?;
        }
        for (k, worse) in self.worse.iter().enumerate() {
            writeln!(
                f,
                "  {:10}  {} {:.4} to {:.4}: {:.0} % of the difference, {:.0} % of the readings",
                if k == 0 { "worse at" } else { "" },
                worse.quantity,
                Short(worse.from),
                Short(worse.to),
                100.0 * worse.share,
                100.0 * worse.readings
            )?;
        }
        Ok(())
    }
}

/// A number with as many significant digits as the precision says.
struct Short(f64);

impl fmt::Display for Short {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let digits = f.precision().unwrap_or(4);
        let size = if self.0 == 0.0 || !self.0.is_finite() { 0 } else { self.0.abs().log10().floor() as i32 };
        if (-4..=6).contains(&size) {
            let decimals = (digits as i32 - 1 - size).max(0) as usize;
            write!(f, "{:.decimals$}", self.0)
        } else {
            write!(f, "{:.*e}", digits - 1, self.0)
        }
    }
}
