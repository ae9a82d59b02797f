//! The closed-loop score: what a task costs under its controller, as recorded and as simulated.
//!
//! Errors of prediction say how well a simulator follows a machine; whether that matters is for a task to say. Here the
//! loop is closed: the controller that ran on the machine runs on the simulated machine, under the nominal system, under
//! the nominal system with its parameters refitted, and under the corrected one. Where the corrected system's score lies
//! with the recorded one and the refitted system's does not, the effect matters for this task.
//!
//! - The task is a file ([`Task`]): a cost at an instant, perhaps a controller of equations.
//! - A controller of equations is stepped when the recorded commands are stamped, or at its rate; readings come at their
//!   recorded stamps. The recording is cut into episodes; each starts from the states that explain its first readings and
//!   from the controller's states, found by running the controller along the recording.
//! - A recorded graph brings its own controller. All its nodes run under the simulated clock from the run's start, with
//!   delays drawn as they were measured; nodes that stand in for hardware are left out, and those that sense them give the
//!   simulated machine's readings.
//! - What happens by chance is drawn anew for every run: the start within its uncertainty, the noise of readings, delays,
//!   and the corrected system's own jitter, drops and outliers. Disturbances that no named effect describes are not
//!   simulated, nor is the uncertainty of fitted parameters part of the intervals.

mod controller;
mod cost;
mod episode;
mod error;
mod graph;
mod scores;
mod start;
mod trace;
mod variant;
mod world;

#[cfg(test)]
mod tests;

use parallax_model::system::{EffectEntry, System, Task};
use parallax_runtime::random::derived;
use parallax_runtime::recording::Recording;
use parallax_runtime::recording::log::Log;
use parallax_runtime::registry::Registry;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::diagnosis::Diagnosis;
use crate::report::{Interval, Overlay};
use cost::{NoNumber, score};
use episode::Course;
pub use error::ClosedLoopError;
use graph::Around;
use scores::{Draws, Runs};
use trace::{Bound, Trace};
use variant::{Seen, Variant};

/// How often each episode is simulated.
const RUNS: usize = 20;

/// Scores of a task in closed loop.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ClosedLoop {
    /// The task's name.
    pub task: String,
    /// Its cost at an instant, as the task file states it.
    pub cost: String,
    /// Unit of the cost, a label.
    pub unit: String,
    /// What closes the loop.
    pub controller: Controlled,
    /// How many episodes were scored.
    pub episodes: usize,
    /// How long each is at most (s).
    pub horizon_s: f64,
    /// How often each was simulated.
    pub runs: usize,
    /// How far a controller of equations, on the recorded readings, misses the recorded commands: root mean square over
    /// their deviation, the largest of all commands. A controller that is not the one that ran scores another loop.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub miss: Option<f64>,
    /// The recorded score: the mean over episodes, and its spread over them.
    pub recorded: Interval,
    /// With the system as it was given.
    pub nominal: LoopScore,
    /// With its calibrated parameters refitted.
    pub refitted: LoopScore,
    /// With the leading answer's effects; `null` where the diagnosis found none.
    pub with_effect: Option<LoopScore>,
    /// The part of the refitted system's difference from the recorded score that the effects close.
    pub closed: Option<Interval>,
    /// The first episode, for plots: measured, and simulated once with the refitted system and with the effects.
    #[serde(skip)]
    pub episode: Vec<Overlay>,
}

/// What closes a loop.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Controlled {
    /// The equations of the task file.
    Policy,
    /// The nodes of the recorded graph.
    Graph,
}

/// What a simulated closed loop costs.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LoopScore {
    /// Mean over episodes and runs, with its 95 % interval over initial states and chance; `null` where every run was lost.
    pub score: Option<Interval>,
    /// That less the recorded score, on the same episodes.
    pub difference: Option<Interval>,
    /// Whether no run was lost and the difference may be zero.
    pub agrees: bool,
    /// Runs in which the machine left all bounds: they have no score.
    pub lost: usize,
    /// Runs in all.
    pub of: usize,
}

/// What is put into the machine's place beside the nominal system.
#[derive(Clone, Copy, Debug, Default)]
pub struct Corrections<'a> {
    /// Parameters of the nominal system, refitted without any effect.
    pub refitted: &'a [(String, f64)],
    /// Parameters of the corrected system.
    pub calibrated: &'a [(String, f64)],
    /// Effects of the corrected system; none where there is none.
    pub effects: &'a [EffectEntry],
}

impl<'a> From<&'a Diagnosis> for Corrections<'a> {
    fn from(found: &'a Diagnosis) -> Self {
        Self { refitted: &found.refitted, calibrated: &found.calibrated, effects: &found.effects }
    }
}

/// The simulated machine has left all bounds.
#[derive(Clone, Copy, Debug)]
struct Lost;

/// A task that fits its machine and its recordings, ready to be scored.
pub struct Prepared<'a> {
    task: Task,
    system: System,
    bound: Bound,
    seen: Vec<Seen>,
    around: Option<Around<'a>>,
    /// The episodes of each recording (s).
    spans: Vec<Vec<(f64, f64)>>,
    /// The recorded scores, one an episode.
    recorded: Vec<f64>,
}

/// Checks a task against the system and the recordings that are diagnosed. `graph` is the recording of a graph, where there
/// is one alone, with the kinds of its nodes; it closes the loop where the task file has no controller. `horizon` is that
/// of the diagnosis.
///
/// # Errors
///
/// [`ClosedLoopError`] when names, commands or times do not fit, nothing closes the loop, or the recorded cost is no number.
pub fn prepare<'a>(
    task: &Task,
    system: &System,
    logs: &[Log],
    graph: Option<(&'a Recording, &Registry)>,
    horizon: Option<f64>,
) -> Result<Prepared<'a>, ClosedLoopError> {
    let graph = graph.filter(|(recording, _)| !task.has_policy() && !recording.is_imported());
    if graph.is_none() && !task.has_policy() {
        return Err(ClosedLoopError::NoController { file: task.system.file.clone() });
    }
    // A graph runs from its beginning, whatever part of it is diagnosed.
    let whole = graph.map(|(recording, _)| [recording.log()]);
    let logs = whole.as_ref().map_or(logs, |whole| whole);
    let bound = Bound::new(task, system, logs)?;
    let around = graph.map(|(recording, registry)| Around::new(recording, registry, system, &logs[0]));
    let around = around.transpose()?;
    let seen = logs.iter().map(|log| Seen::new(system, log, horizon)).collect::<Result<Vec<_>, _>>()?;
    let mut prepared = Prepared {
        task: task.clone(),
        system: system.clone(),
        bound,
        spans: Vec::new(),
        recorded: Vec::new(),
        seen,
        around,
    };
    prepared.cut()?;
    prepared.score_recorded()?;
    if prepared.around.is_none() {
        prepared.courses()?;
    }
    Ok(prepared)
}

/// A run's score, and its signals where they are kept.
type Scored = (f64, Option<Trace>);

/// The scores of all runs, and the signals of the one that kept them.
fn shown(all: Vec<Vec<Option<Scored>>>) -> (Runs, Option<Trace>) {
    let mut kept = None;
    let mut score = |run: Option<Scored>| {
        let (score, trace) = run?;
        kept = trace.or(kept.take());
        Some(score)
    };
    let scores = all.into_iter().map(|runs| runs.into_iter().map(&mut score).collect()).collect();
    (scores, kept)
}

impl Prepared<'_> {
    /// Cuts the recordings into episodes. A graph's nodes cannot begin in the middle of a run: it has one episode.
    fn cut(&mut self) -> Result<(), ClosedLoopError> {
        let task = &self.task;
        for seen in &self.seen {
            let end = seen.end();
            let first = task.horizon.map_or(task.to.unwrap_or(end), |horizon| task.from + horizon);
            let last = task.to.unwrap_or(end).max(first);
            // What was recorded last holds a little longer.
            let slack = 2.0 * seen.period();
            if last > end + slack || first <= task.from {
                return Err(ClosedLoopError::Horizon {
                    file: task.system.file.clone(),
                    title: seen.log.title.clone(),
                    from: task.from,
                    to: last,
                    end,
                });
            }
            let length = first - task.from;
            let count = match self.around {
                Some(_) => 1,
                None => ((last + slack - task.from) / length).floor().max(1.0) as usize,
            };
            let span = |k: usize| (task.from + k as f64 * length, task.from + (k + 1) as f64 * length);
            self.spans.push((0..count).map(span).collect());
        }
        Ok(())
    }

    fn score_recorded(&mut self) -> Result<(), ClosedLoopError> {
        let equations = &self.bound.equations.cost;
        for (seen, spans) in self.seen.iter().zip(&self.spans) {
            let trace = self.bound.recorded(&seen.experiment, &seen.log);
            for (input, source) in equations.system().inputs.iter().zip(&self.bound.sources) {
                if trace.channel(*source).values.is_empty() {
                    return Err(ClosedLoopError::Silent {
                        title: seen.log.title.clone(),
                        signal: input.signal.clone(),
                        name: input.name.clone(),
                    });
                }
            }
            for (from, to) in spans {
                let found = score(equations, &self.bound.sources, &trace, *from, *to);
                self.recorded.push(found.map_err(|fault| self.not_finite(&seen.log, &fault))?);
            }
        }
        Ok(())
    }

    fn not_finite(&self, log: &Log, fault: &NoNumber) -> ClosedLoopError {
        let terminal = self.task.terminal.as_ref().filter(|_| fault.output > 0);
        let expression = terminal.unwrap_or(&self.task.cost);
        let names = self.bound.equations.cost.system().inputs.iter().zip(&fault.inputs);
        let used = names.filter(|(input, _)| {
            let lets = &self.bound.equations.cost.system().lets;
            expression
                .names()
                .chain(lets.iter().flat_map(|l| l.expression.names()))
                .any(|name| name == input.name)
        });
        let given: Vec<String> = used.map(|(input, value)| format!("{} = {value}", input.name)).collect();
        ClosedLoopError::NotFinite {
            at: expression.location().to_string(),
            what: if terminal.is_some() { "terminal cost" } else { "cost" },
            title: log.title.clone(),
            value: fault.value,
            time: fault.time,
            given: if given.is_empty() { "nothing that was recorded".into() } else { given.join(", ") },
        }
    }

    fn courses(&self) -> Result<Vec<Course<'_>>, ClosedLoopError> {
        let each = self.seen.iter().zip(&self.spans);
        each.map(|(seen, spans)| Course::new(&self.bound, self.task.policy, seen, spans.clone())).collect()
    }

    /// Closes the loop around the machine as it was believed, as it was refitted, and with what a diagnosis found. The same
    /// `seed` gives the same scores.
    ///
    /// # Errors
    ///
    /// [`ClosedLoopError`] when a corrected system cannot stand in the machine's place, no state can be told from the
    /// readings at the beginning of an episode, or a node of the graph gives up.
    pub fn scores(&self, found: Corrections<'_>, seed: u64) -> Result<ClosedLoop, ClosedLoopError> {
        let rows = [
            Some((&[][..], &[][..])),
            Some((found.refitted, &[][..])),
            (!found.effects.is_empty() || found.calibrated != found.refitted)
                .then_some((found.calibrated, found.effects)),
        ];
        let courses = if self.around.is_none() { self.courses()? } else { Vec::new() };
        let mut found: Vec<(Runs, Option<Trace>)> = Vec::new();
        for (values, effects) in rows.into_iter().flatten() {
            let variants = self
                .seen
                .iter()
                .map(|seen| Variant::new(seen, values, effects))
                .collect::<Result<Vec<_>, _>>()?;
            found.push(match &self.around {
                Some(around) => self.run_graph(around, &variants[0], seed)?,
                None => self.run_courses(&courses, &variants, seed)?,
            });
        }
        let draws = Draws::new(self.recorded.clone(), RUNS, seed);
        let with_effect = found.get(2);
        Ok(ClosedLoop {
            task: self.task.system.name.clone(),
            cost: self.task.cost.text().to_owned(),
            unit: self.task.unit.clone(),
            controller: if self.around.is_some() { Controlled::Graph } else { Controlled::Policy },
            episodes: self.recorded.len(),
            horizon_s: self.spans[0].first().map_or(0.0, |(from, to)| to - from),
            runs: RUNS,
            miss: courses.iter().map(|course| course.miss).reduce(f64::max),
            recorded: draws.recorded(),
            nominal: draws.row(&found[0].0),
            refitted: draws.row(&found[1].0),
            with_effect: with_effect.map(|(runs, _)| draws.row(runs)),
            closed: with_effect.and_then(|(runs, _)| draws.closed(&found[1].0, runs)),
            episode: self.overlays(found[1].1.as_ref(), with_effect.and_then(|(_, trace)| trace.as_ref())),
        })
    }

    fn run_courses(
        &self,
        courses: &[Course<'_>],
        variants: &[Variant<'_>],
        seed: u64,
    ) -> Result<(Runs, Option<Trace>), ClosedLoopError> {
        let episodes: Vec<(usize, usize)> = courses
            .iter()
            .enumerate()
            .flat_map(|(k, course)| (0..course.spans.len()).map(move |e| (k, e)))
            .collect();
        let equations = &self.bound.equations.cost;
        let all = episodes.into_par_iter().map(|(k, episode)| {
            let (course, variant) = (&courses[k], &variants[k]);
            let (from, to) = course.spans[episode];
            let start = variant.start(from, to)?;
            let run = |run: usize| {
                let seed = derived(seed, &format!("recording {k}, episode {episode}, run {run}"));
                let trace = course.run(variant, episode, variant.world(&start, seed)).ok()?;
                let score = score(equations, &self.bound.sources, &trace, from, to).ok()?;
                Some((score, ((k, episode, run) == (0, 0, 0)).then_some(trace)))
            };
            Ok((0..RUNS).into_par_iter().map(run).collect())
        });
        Ok(shown(all.collect::<Result<_, ClosedLoopError>>()?))
    }

    fn run_graph(
        &self,
        around: &Around<'_>,
        variant: &Variant<'_>,
        seed: u64,
    ) -> Result<(Runs, Option<Trace>), ClosedLoopError> {
        let (from, to) = self.spans[0][0];
        let start = variant.start(0.0, to)?;
        let equations = &self.bound.equations.cost;
        let run = |run: usize| {
            let seed = derived(seed, &format!("graph, run {run}"));
            let found = around.run(&self.bound, &self.system, variant.world(&start, seed), to, seed)?;
            let Ok(trace) = found else { return Ok(None) };
            let score = score(equations, &self.bound.sources, &trace, from, to).ok();
            Ok(score.map(|score| (score, (run == 0).then_some(trace))))
        };
        let all = (0..RUNS).into_par_iter().map(run).collect::<Result<_, ClosedLoopError>>()?;
        Ok(shown(vec![all]))
    }

    /// The first episode's readings beside those of a run with the refitted system, and of one with the effects.
    fn overlays(&self, before: Option<&Trace>, after: Option<&Trace>) -> Vec<Overlay> {
        let (Some(seen), Some(before)) = (self.seen.first(), before) else { return Vec::new() };
        let (from, to) = self.spans[0][0];
        let recorded = self.bound.recorded(&seen.experiment, &seen.log).part(from, to);
        let each = self.system.outputs.iter().zip(recorded.readings).enumerate();
        each.map(|(output, (stated, held))| {
            let along = |trace: &Trace| held.times.iter().map(|t| trace.readings[output].at(*t)).collect();
            Overlay {
                output: stated.name.clone(),
                unit: stated.unit.clone(),
                noise: seen.noise(output),
                before: along(before),
                after: after.map_or_else(|| along(before), along),
                stamp: held.times.clone(),
                measured: held.values,
            }
        })
        .collect()
    }
}
