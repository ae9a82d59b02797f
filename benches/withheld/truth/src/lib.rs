//! Recordings with a known cause, for judging a diagnosis that cannot see it.
//!
//! Everything here is written apart from the project's models: equations of motion derived by hand, an integrator of
//! 0.1 ms steps with true stick-slip, commands that arrive through a queue, sensors with a latency of their own. What
//! crosses over to the diagnosis is one folder: `recording.toml`, tables, and the nominal `system.toml`.
//!
//! A cause that never acts in its recording, such as a stop that is not reached or a limit beyond the commands, is no
//! cause: its magnitude is drawn again, a limit a little closer each time, until it leaves a trace: each of a pair's on its
//! own, and the second one also beside the first, so that both do. So is a supply whose sag takes more than half of some
//! command: none gives less to who asks for more.

// Equations of motion are read by index, as they are written.
#![allow(clippy::needless_range_loop)]

mod alike;
mod case;
mod channel;
mod drive;
mod effect;
mod folder;
mod least_squares;
mod mechanics;
mod signature;
mod system;
#[cfg(test)]
mod tests;

use case::{Case, Run, stream};
use effect::{Cause, Kind, Place};
use rand::RngExt;
use rand::seq::SliceRandom;
use serde::{Deserialize, Serialize};
use std::cmp::Ordering;
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
    /// One effect of a machine whose joints' forces scatter from one moment to the next, as those of real ones do.
    Rough,
    /// No effect, the same.
    RoughNull,
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
    /// Where it acts: `input:`, `joint:`, `output:` or `parameter:` and a key of `system.toml`.
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
    /// Twice the log-likelihood ratio that the cause is worth after the best refit, not only to first order, of the
    /// calibrated parameters within their bounds. Of a rough machine it is what it would be of a calm one.
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
    /// An experiment that cannot be played.
    #[error("the experiment cannot be played: {0}")]
    Experiment(&'static str),
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
        Set::Null | Set::RoughNull => Vec::new(),
        Set::Single | Set::Pair | Set::PoorExcitation | Set::Short | Set::Rough => effect::table(system),
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

/// Detectability from which a cause acts in its recording.
const ACTS: f64 = 0.1;

/// A machine that is so many times its range off ran away.
const ASTRAY: f64 = 200.0;

/// How often a cause that does not act is drawn again; after that it is written as it is.
const REDRAWS: u64 = 20;

fn case(plan: &Plan, seed: u64) -> Result<Case, TruthError> {
    let unknown = || TruthError::Unknown { system: plan.system, effect: plan.effect };
    let system = *system::ALL.get(plan.system).ok_or_else(unknown)?;
    let duration = if plan.set == Set::Short { 6.0 } else { 20.0 };
    let noise = case::noises(system, seed);
    let poor = plan.set == Set::PoorExcitation;
    let alone = |causes: Vec<Cause>| Case { system, causes, duration, poor, rough: false, seed, take: 0 };
    let mut rng = stream(seed, 4);
    let mut drawn = |(kind, place): (Kind, Place), beside: Option<Cause>| {
        let member = u64::from(beside.is_some());
        let noise = if let Place::Output(o) = place { noise[o] } else { 0.0 };
        let first = effect::draw(system, kind, place, duration, noise, &mut rng);
        let again = (0..REDRAWS).map(|k| {
            let mut rng = stream(seed, 400 + 100 * member + k);
            effect::draw(system, kind, place, duration, noise, &mut rng).closer(system, k)
        });
        let both = |cause: &Cause| beside.is_none_or(|other| both_act(&alone(vec![other, *cause])));
        let mut all = std::iter::once(first).chain(again);
        all.find(|cause| acts(&alone(vec![*cause])) && both(cause)).unwrap_or(first)
    };
    let all = causes(plan.set, system);
    let mut causes = Vec::new();
    if !matches!(plan.set, Set::Null | Set::RoughNull) {
        let first = *all.get(plan.effect).ok_or_else(unknown)?;
        causes.push(drawn(first, None));
        if plan.set == Set::Pair {
            let others: Vec<_> = all.iter().filter(|c| c.1 != first.1).collect();
            let second = others[stream(seed, 5).random_range(0..others.len())];
            causes.push(drawn(*second, Some(causes[0])));
        }
    }
    let rough = matches!(plan.set, Set::Rough | Set::RoughNull);
    Ok(Case { rough, ..alone(causes) })
}

/// Whether a case's cause leaves a trace in its recording, and may be one. A machine that ran away is judged by the caller.
fn acts(case: &Case) -> bool {
    let run = case.run();
    is_supply(case, &run) && (!sound(case, &run) || signature::detectability(case, &run) >= ACTS)
}

/// Whether each of a pair's causes leaves a trace beside the other: friction may keep a machine from the stop that it would reach
/// without.
fn both_act(case: &Case) -> bool {
    let run = case.run();
    !sound(case, &run) || signature::least_beside(case, &run) >= ACTS
}

/// Most of a command that the inner resistance of a supply may take: beyond one half whoever asks for more gets less (maximum
/// power transfer), and beyond all of it the supply would push back.
const SAGS: f64 = 0.5;

/// Whether a supply that sags under its load is one that exists, for the commands of the run.
fn is_supply(case: &Case, run: &Run) -> bool {
    case.causes.iter().all(|cause| match (cause.kind, cause.place) {
        (Kind::SupplySag, Place::Input(i)) => run.commands.iter().all(|u| cause.p[0] * u[i].abs() <= SAGS),
        _ => true,
    })
}

fn sound(case: &Case, run: &Run) -> bool {
    let fine = |x: &f64| x.is_finite() && x.abs() < 1e6;
    let near =
        |s: &system::State| case.system.joints.iter().zip(s.q).all(|(j, q)| q.abs() < ASTRAY * j.range);
    run.states.iter().all(|s| near(s) && s.q.iter().chain(&s.v).chain(&s.x).all(fine))
}

/// Writes the case's folder and returns what is true of it.
///
/// # Errors
/// [`TruthError`]: a plan that does not exist, a motion that diverged, or a file that cannot be written.
pub fn write(plan: &Plan, seed: u64, folder: &Path) -> Result<Answer, TruthError> {
    let case = case(plan, seed)?;
    let run = case.run();
    if !sound(&case, &run) {
        return Err(TruthError::Diverged);
    }
    folder::write(&case, &run, folder)?;
    let (detectability, class) = if case.rough {
        // What sensors show is compared with what they would show without: forces that scatter are no cause.
        let calm = Case { rough: false, ..case.clone() };
        signature::judge(&calm, &calm.run())
    } else {
        signature::judge(&case, &run)
    };
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

/// Commands of an experiment: each value holds from its time on.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Experiment {
    /// Times from the start (s), increasing.
    pub times: Vec<f64>,
    /// How long it lasts (s).
    pub duration: f64,
    /// Values by the commands' signals, one at each time. A command that is not here stays at rest.
    pub commands: BTreeMap<String, Vec<f64>>,
}

/// Plays an experiment on the machine of the case that [`write()`] made from the same plan and seed, and writes a second
/// recording of it: the same real parameters, the same cause, fresh noise. The commands are played as they are, except
/// on the quadrotor, whose loop goes on and has them added.
///
/// # Errors
/// [`TruthError`]: a plan that does not exist, commands that do not fit the machine, a motion that diverged, or a file
/// that cannot be written.
pub fn replay(plan: &Plan, seed: u64, experiment: &Experiment, folder: &Path) -> Result<(), TruthError> {
    let mut case = case(plan, seed)?;
    let system = case.system;
    let wrong = |what| Err(TruthError::Experiment(what));
    let Experiment { times, duration, commands } = experiment;
    if !(1.0..=600.0).contains(duration)
        || times.windows(2).any(|w| w[0].partial_cmp(&w[1]) != Some(Ordering::Less))
    {
        return wrong("it must last 1 s to 600 s, and its times must increase");
    }
    if commands.keys().any(|signal| system.inputs.iter().all(|i| i.signal != signal)) {
        return wrong("the machine has no such command");
    }
    if commands.values().any(|v| v.len() != times.len() || v.iter().any(|x| !x.is_finite())) {
        return wrong("every command needs a number at each time");
    }
    (case.duration, case.take) = (*duration, 1);
    let ticks = (duration * system.command_rate).ceil() as usize;
    let wishes: Vec<[f64; system::N]> = (0..ticks)
        .map(|k| {
            let t = k as f64 / system.command_rate;
            // Times are written with rounding: a tick belongs to the value that begins with it.
            let held = times.partition_point(|time| *time <= t + 1e-6);
            std::array::from_fn(|i| {
                let Some(input) = system.inputs.get(i) else { return 0.0 };
                let values = commands.get(input.signal).filter(|_| held > 0);
                values.map_or(input.rest, |values| values[held - 1])
            })
        })
        .collect();
    let run = case.recorded(Some(&wishes));
    if !sound(&case, &run) {
        return Err(TruthError::Diverged);
    }
    folder::write(&case, &run, folder)
}
