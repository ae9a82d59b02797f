//! Schedules drawn from a graph and its delays, without running its nodes.

use parallax_runtime::data::Data;
use parallax_runtime::graph::Graph;
use parallax_runtime::random::derived;
use parallax_runtime::recording::{Change, Fault, Loss, RecordingSink, SinkError, StepView};
use parallax_runtime::time::Nanos;
use rayon::prelude::*;

use crate::episode::Episode;
use crate::executor::Executor;
use crate::outcome::SimError;

/// Draws the schedule of one run: bit for bit that of [`Executor`] with this seed, whatever the graph's policies. Only
/// what follows from outputs cannot be known here: a computation delay that does is what the graph expects of it (tables
/// compiled from the schedule may decide it [at run time](crate::compiled::OutputDelays)), and no node gives up.
///
/// ```
/// use parallax_runtime::graph::GraphSpec;
/// # use parallax_runtime::registry::Registry;
/// # fn example(spec: GraphSpec, registry: &Registry) -> Result<(), Box<dyn std::error::Error>> {
/// let episode = parallax_sim::generate(&spec.validate(registry)?, 7, 10_000_000_000)?;
/// println!("{} steps in 10 s", episode.steps());
/// # Ok(())
/// # }
/// ```
///
/// # Errors
///
/// [`SimError::Duration`] when `duration` is not positive.
pub fn generate(graph: &Graph, seed: u64, duration: Nanos) -> Result<Episode, SimError> {
    let mut sink = EpisodeSink { graph, episode: Episode::empty(graph, duration) };
    Executor::new(graph.clone(), seed).timing_only().run(duration, &mut sink)?;
    Ok(sink.episode)
}

/// Draws the schedules of many runs, each from a seed of its own that follows from `seed` and its number: the same for
/// any number of threads.
///
/// # Errors
///
/// As [`generate`].
pub fn generate_many(
    graph: &Graph,
    seed: u64,
    duration: Nanos,
    episodes: usize,
) -> Result<Vec<Episode>, SimError> {
    (0..episodes)
        .into_par_iter()
        .map(|episode| generate(graph, derived(seed, &format!("episode {episode}")), duration))
        .collect()
}

/// Keeps the timing of a run.
struct EpisodeSink<'a> {
    graph: &'a Graph,
    episode: Episode,
}

impl RecordingSink for EpisodeSink<'_> {
    fn message(&mut self, _: usize, _: u64, _: Nanos, _: &[f64], _: &Data) -> Result<(), SinkError> {
        Ok(())
    }

    fn step(&mut self, node: usize, step: &StepView<'_>) -> Result<(), SinkError> {
        let steps = &mut self.episode.nodes[node];
        steps.due.push(step.due);
        steps.start.push(step.start);
        steps.end.push(step.end);
        for (&connection, window) in self.graph.nodes()[node].inputs.iter().zip(step.inputs) {
            let consumption = &mut self.episode.connections[connection];
            for message in window.stamps() {
                consumption.seq.push(message.seq.map_or(-1, |seq| seq as i64));
                consumption.received.push(message.received);
            }
        }
        Ok(())
    }

    fn loss(&mut self, _: &Loss) -> Result<(), SinkError> {
        Ok(())
    }

    fn fault(&mut self, _: &Fault) -> Result<(), SinkError> {
        Ok(())
    }

    fn change(&mut self, _: &Change) -> Result<(), SinkError> {
        Ok(())
    }
}
