//! An episode under a controller of equations: readings at their recorded stamps, steps of the controller, commands.

use parallax_model::system::Policy;

use super::controller::Controller;
use super::trace::{Bound, Source, Trace};
use super::variant::{Seen, Variant};
use super::world::World;
use super::{ClosedLoopError, Lost};
use crate::statistics::{median, standard_deviation};

/// What is kept of the recording before an episode, for values that are known late (s, beside the latency).
const BEFORE: f64 = 1.0;

/// Share of the controller's period by which stamps that mean the same time may differ.
const SCATTER: f64 = 0.01;

/// The largest miss that is stated.
const MOST_MISSED: f64 = 1e3;

/// What happens next. At one stamp, what comes from outside comes first, then readings, then the controller; a reading that
/// shows a command follows it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum What {
    /// A command that the controller does not give.
    Given(usize, usize),
    Reading(usize),
    Step,
    Echo(usize),
}

/// A recording, the controller's steps in it, and the controller as it was at the beginning of every episode.
pub(super) struct Course<'a> {
    bound: &'a Bound,
    recorded: Trace,
    policy: Policy,
    /// When the controller steps (s).
    ticks: Vec<f64>,
    /// By how much a value may be younger than the latency (s): stamps scatter.
    slack: f64,
    /// The episodes (s).
    pub(super) spans: Vec<(f64, f64)>,
    /// Before its first step of each episode.
    controllers: Vec<Controller>,
    /// Root mean square of what the controller commands on the recorded readings less the recorded commands, over the
    /// deviation of these; the largest of all commands.
    pub(super) miss: f64,
}

impl<'a> Course<'a> {
    /// Runs the controller along the recording, without closing any loop.
    pub(super) fn new(
        bound: &'a Bound,
        policy: Policy,
        seen: &Seen,
        spans: Vec<(f64, f64)>,
    ) -> Result<Self, ClosedLoopError> {
        let recorded = bound.recorded(&seen.experiment, &seen.log);
        let ticks = match policy.rate {
            Some(rate) => (0..=(seen.end() * rate + 1e-9) as usize).map(|k| k as f64 / rate).collect(),
            None => {
                let mut all: Vec<f64> =
                    bound.commands.iter().flat_map(|k| &recorded.commands[*k].times).copied().collect();
                all.sort_by(f64::total_cmp);
                all.dedup();
                all
            }
        };
        let first = |name: &str| {
            let inputs = &bound.equations.controller.system().inputs[..bound.equations.signals];
            let read = inputs.iter().position(|input| input.signal == name || input.name == name);
            let read = read.and_then(|index| recorded.channel(bound.sources[index]).values.first());
            read.or_else(|| seen.log.signal(name).ok()?.values.first()).copied()
        };
        let mut controller = Controller::new(&bound.equations, first)?;
        let mut periods: Vec<f64> = ticks.windows(2).map(|pair| pair[1] - pair[0]).collect();
        let slack = SCATTER * median(&mut periods);
        let mut course =
            Self { bound, recorded, policy, ticks, slack, spans, controllers: Vec::new(), miss: 0.0 };
        let mut errors = vec![0.0; bound.commands.len()];
        for tick in &course.ticks {
            while course.spans.get(course.controllers.len()).is_some_and(|span| span.0 <= *tick) {
                course.controllers.push(controller.clone());
            }
            let commands = controller.step(*tick, &course.known(&course.recorded, *tick));
            for ((error, command), input) in errors.iter_mut().zip(commands).zip(&bound.commands) {
                *error += (command - course.recorded.commands[*input].at(*tick)).powi(2);
            }
        }
        course.controllers.resize(course.spans.len(), controller);
        let count = course.ticks.len().max(1) as f64;
        let relative = |(error, input): (&f64, &usize)| {
            let size = standard_deviation(&course.recorded.commands[*input].values);
            // A command that never changes has no size of its own.
            ((error / count).sqrt() / size.max(f64::MIN_POSITIVE)).min(MOST_MISSED)
        };
        course.miss = errors.iter().zip(&bound.commands).map(relative).fold(0.0, f64::max);
        Ok(course)
    }

    /// What the controller knows at a time: everything that is old enough.
    fn known(&self, trace: &Trace, time: f64) -> Vec<f64> {
        let newest = time - self.policy.latency + self.slack;
        let latest = |source: &Source| trace.channel(*source).at(newest);
        self.bound.sources.iter().map(latest).collect()
    }

    /// Everything that happens in an episode, in order.
    fn events(&self, variant: &Variant<'_>, (from, to): (f64, f64)) -> Vec<(f64, What)> {
        let within = |times: &[f64]| {
            let end = times.partition_point(|t| *t < to);
            times.partition_point(|t| *t < from).min(end)..end
        };
        let mut events: Vec<(f64, What)> =
            self.ticks[within(&self.ticks)].iter().map(|t| (*t, What::Step)).collect();
        for (output, held) in self.recorded.readings.iter().enumerate() {
            let what = if variant.machine().shows_command(output) {
                What::Echo(output)
            } else {
                What::Reading(output)
            };
            events.extend(held.times[within(&held.times)].iter().map(|t| (*t, what)));
        }
        for (input, held) in self.recorded.commands.iter().enumerate() {
            if !self.bound.commands.contains(&input) {
                events.extend(within(&held.times).map(|k| (held.times[k], What::Given(input, k))));
            }
        }
        events.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        events
    }

    /// Closes the loop of episode `index` around a machine on its way.
    pub(super) fn run(&self, variant: &Variant<'_>, index: usize, mut world: World) -> Result<Trace, Lost> {
        let span = self.spans[index];
        let mut trace = self.recorded.part(span.0 - self.policy.latency - BEFORE, span.0);
        // Before its first sample a signal is what its first sample says.
        for (held, recorded) in trace
            .readings
            .iter_mut()
            .zip(&self.recorded.readings)
            .chain(trace.commands.iter_mut().zip(&self.recorded.commands))
        {
            if let (true, Some(first)) = (held.times.is_empty(), recorded.values.first()) {
                held.push(span.0 - BEFORE, *first);
            }
        }
        let mut controller = self.controllers[index].clone();
        let begin = world.begin();
        // Until the loop closes, the machine follows what was recorded.
        for (input, held) in trace.commands.iter().enumerate() {
            for (time, value) in held.times.iter().zip(&held.values).filter(|(t, _)| **t >= begin) {
                world.command(input, *time, *value);
            }
        }
        for (time, what) in self.events(variant, span) {
            match what {
                What::Given(input, k) => {
                    let value = self.recorded.commands[input].values[k];
                    world.command(input, time, value);
                    trace.commands[input].push(time, value);
                }
                What::Reading(output) | What::Echo(output) => {
                    if let Some(value) = world.read(output, time) {
                        trace.readings[output].push(time, value);
                    }
                }
                What::Step => {
                    let commands = controller.step(time, &self.known(&trace, time));
                    for (value, input) in commands.into_iter().zip(&self.bound.commands) {
                        if !value.is_finite() {
                            return Err(Lost);
                        }
                        world.command(*input, time, value);
                        trace.commands[*input].push(time, value);
                    }
                }
            }
            if world.is_lost() {
                return Err(Lost);
            }
        }
        Ok(trace)
    }
}
