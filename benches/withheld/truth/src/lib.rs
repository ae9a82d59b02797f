//! Recordings with a known cause, for judging a diagnosis that cannot see it.
//!
//! Everything here is written apart from the project's models: equations of motion derived by hand, an integrator of
//! 0.1 ms steps with true stick-slip, commands that arrive through a queue, sensors with a latency of their own. What
//! crosses over to the diagnosis is one folder: `recording.toml`, tables, and the nominal `system.toml`.

// Equations of motion are read by index, as they are written.
#![allow(clippy::needless_range_loop)]

mod case;
mod channel;
mod drive;
mod effect;
mod folder;
mod mechanics;
mod signature;
mod system;
#[cfg(test)]
mod tests;

use case::{Case, stream};
use effect::{Kind, Place};
use rand::RngExt;
use rand::seq::SliceRandom;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// A set of cases.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Set {
    /// One effect of the table, in the table's form, 20 s of data.
    Single,
    /// No effect: noise and real parameters vary.
    Null,
    /// One effect of the table's families in another functional form.
    OtherForm,
    /// Two effects at different places.
    Pair,
    /// A cause of no table.
    Outside,
    /// One effect under a single sine.
    PoorExcitation,
    /// One effect, 6 s of data.
    Short,
}

/// Which case: its set, its machine, and the index of its cause in that machine's list for the set.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Plan {
    /// The set.
    pub set: Set,
    /// Index into [`systems`].
    pub system: usize,
    /// Index of the cause; [`effects`] lists those of singles. Null cases ignore it.
    pub effect: usize,
}

/// An effect of the table at a place.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EffectAt {
    /// The effect's name.
    pub name: String,
    /// Where it acts: `input:`, `joint:` or `output:` and a key of `system.toml`.
    pub place: String,
}

/// What is true of a case.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Answer {
    /// The set.
    pub set: Set,
    /// The machine's name.
    pub system: String,
    /// The true causes; empty for null cases and for causes outside the table.
    pub effects: Vec<Truth>,
    /// The cause that no table has.
    pub outside: Option<String>,
    /// Twice the log-likelihood ratio that the cause is worth after the best refit of the calibrated parameters.
    pub detectability: f64,
    /// `name@place` of the cause and of what this recording cannot tell from it (cosine of signatures at least 0.97).
    pub class: Vec<String>,
}

/// A true cause.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Truth {
    /// The effect's name, or its family's for another form.
    pub name: String,
    /// Where it acts.
    pub place: String,
    /// The functional form.
    pub form: String,
    /// Its parameters in SI units of the place.
    pub parameters: BTreeMap<String, f64>,
}

/// Why a case could not be written.
#[derive(Debug, thiserror::Error)]
pub enum TruthError {
    /// A file could not be written.
    #[error("cannot write {path}: {source}", path = path.display())]
    Write {
        /// The file or folder.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// The plan names a machine or cause that does not exist.
    #[error("no cause {effect} of machine {system} in this set")]
    Unknown {
        /// The plan's machine.
        system: usize,
        /// The plan's cause.
        effect: usize,
    },
    /// The machine left all bounds: the case is of no use.
    #[error("the motion diverged")]
    Diverged,
}

/// Names of the machines.
pub fn systems() -> &'static [&'static str] {
    const NAMES: [&str; 5] = ["motor-pendulum", "position-servo", "two-link-arm", "quadrotor", "linear-axis"];
    &NAMES
}

/// Every effect of the table at every place of a machine, except those in the span of a calibrated parameter.
pub fn effects(system: usize) -> Vec<EffectAt> {
    let Some(system) = system::ALL.get(system) else { return Vec::new() };
    let at = |(kind, place): (Kind, Place)| EffectAt {
        name: kind.names().0.to_owned(),
        place: effect::place_name(system, place),
    };
    effect::table(system).into_iter().map(at).collect()
}

fn causes(set: Set, system: &system::System) -> Vec<(Kind, Place)> {
    match set {
        Set::OtherForm => effect::other_forms(system),
        Set::Outside => effect::outside(system),
        Set::Null => Vec::new(),
        Set::Single | Set::Pair | Set::PoorExcitation | Set::Short => effect::table(system),
    }
}

/// Plans spread evenly over machines, and within a machine over the kinds of causes and their places.
pub fn plans(set: Set, count: usize, seed: u64) -> Vec<Plan> {
    let orders: Vec<Vec<usize>> = system::ALL
        .iter()
        .enumerate()
        .map(|(s, system)| {
            let all = causes(set, system);
            let mut order: Vec<usize> = (0..all.len()).collect();
            order.shuffle(&mut stream(seed, s as u64));
            // Kinds take turns: a machine with many places does not repeat one kind before the others had theirs.
            let mut turn: Vec<(usize, usize)> = Vec::new();
            for (at, &i) in order.iter().enumerate() {
                turn.push((order[..at].iter().filter(|&&k| all[k].0 == all[i].0).count(), i));
            }
            turn.sort_by_key(|(turn, _)| *turn);
            turn.into_iter().map(|(_, i)| i).collect()
        })
        .collect();
    (0..count)
        .map(|i| {
            let (system, round) = (i % orders.len(), i / orders.len());
            let order = &orders[system];
            Plan { set, system, effect: if order.is_empty() { 0 } else { order[round % order.len()] } }
        })
        .collect()
}

fn case(plan: &Plan, seed: u64) -> Result<Case, TruthError> {
    let unknown = || TruthError::Unknown { system: plan.system, effect: plan.effect };
    let system = *system::ALL.get(plan.system).ok_or_else(unknown)?;
    let duration = if plan.set == Set::Short { 6.0 } else { 20.0 };
    let noise = case::noises(system, seed);
    let mut rng = stream(seed, 4);
    let mut drawn = |(kind, place): (Kind, Place)| {
        let noise = if let Place::Output(o) = place { noise[o] } else { 0.0 };
        effect::draw(system, kind, place, duration, noise, &mut rng)
    };
    let all = causes(plan.set, system);
    let mut causes = Vec::new();
    if plan.set != Set::Null {
        let first = *all.get(plan.effect).ok_or_else(unknown)?;
        causes.push(drawn(first));
        if plan.set == Set::Pair {
            let others: Vec<_> = all.iter().filter(|c| c.1 != first.1).collect();
            let second = others[stream(seed, 5).random_range(0..others.len())];
            causes.push(drawn(*second));
        }
    }
    Ok(Case { system, causes, duration, poor: plan.set == Set::PoorExcitation, seed })
}

/// Writes the case's folder and returns what is true of it.
///
/// # Errors
/// [`TruthError`]: a plan that does not exist, a motion that diverged, or a file that cannot be written.
pub fn write(plan: &Plan, seed: u64, folder: &Path) -> Result<Answer, TruthError> {
    let case = case(plan, seed)?;
    let run = case.run();
    let sound =
        |s: &system::State| s.q.iter().chain(&s.v).chain(&s.x).all(|x| x.is_finite() && x.abs() < 1e6);
    if !run.states.iter().all(sound) {
        return Err(TruthError::Diverged);
    }
    folder::write(&case, &run, folder)?;
    let (detectability, class) = signature::judge(&case, &run);
    let truth = |c: &effect::Cause| Truth {
        name: c.kind.names().0.to_owned(),
        place: effect::place_name(case.system, c.place),
        form: c.kind.names().1.to_owned(),
        parameters: effect::parameters(c),
    };
    let outside = (plan.set == Set::Outside).then(|| class.first().cloned()).flatten();
    let effects = if outside.is_some() { Vec::new() } else { case.causes.iter().map(truth).collect() };
    Ok(Answer { set: plan.set, system: case.system.name.to_owned(), effects, outside, detectability, class })
}
