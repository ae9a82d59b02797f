//! From a graph and its episodes to tables.

use std::borrow::Cow;

use parallax_runtime::graph::Graph;
use parallax_runtime::time::Nanos;
use rayon::prelude::*;

use super::candidates::Reach;
use super::from_output::{self, OutputDelay};
use super::rings::{Lifetimes, Moment, NEVER};
use super::rows::slot;
use super::trainable::TrainableDelay;
use super::{CompileError, CompileOptions, CompiledGraph, CompiledNode};
use crate::episode::Episode;
use crate::supergraph::{Dag, DagInput, DagNode, Embedding, Partitioning, Plan, PlanOptions, plan};

/// One connection as it is compiled.
pub(super) struct Edge {
    pub(super) from: usize,
    pub(super) to: usize,
    pub(super) window: usize,
    /// Messages in a row.
    pub(super) candidates: usize,
    pub(super) trainable: Option<TrainableDelay>,
    pub(super) from_output: Option<OutputDelay>,
    /// Whether the receiver reads at all: its outputs are not given.
    pub(super) read: bool,
}

impl Edge {
    /// Between which bounds the delay lies, where it is known only at run time.
    fn reach(&self) -> Option<Reach> {
        let trainable = self.trainable.map(|delay| delay.reach());
        trainable.or_else(|| self.from_output.map(|delay| delay.reach()))
    }

    /// What the tables call sent: when the sender's steps end, or, where their outputs decide that, when they start.
    fn sent<'e>(&self, episode: &'e Episode) -> &'e [Nanos] {
        let steps = &episode.nodes[self.from];
        if self.from_output.is_some() { &steps.start } else { &steps.end }
    }

    /// When a message counts as sent, and, if its delay is known only at run time, when it arrives at the earliest; 0 for
    /// an initial message.
    pub(super) fn times(&self, episode: &Episode, seq: i64) -> (Nanos, Option<Nanos>) {
        let Ok(seq) = usize::try_from(seq) else { return (0, self.reach().map(|_| 0)) };
        let sent = self.sent(episode)[seq];
        (sent, self.reach().map(|reach| sent.saturating_add(reach.min)))
    }
}

/// One episode on its way into the tables.
pub(super) struct Track<'a> {
    pub(super) episode: &'a Episode,
    /// Per connection the numbers in every row of the receiver, `[step][candidate]`.
    pub(super) seen: Vec<Cow<'a, [i64]>>,
    /// Per node and step when it is executed; [`NEVER`] where it is left out.
    pub(super) moment: Vec<Vec<Moment>>,
    /// Per moment the step's number, −1 where the slot stays empty.
    pub(super) at: Vec<i32>,
    /// Per node and step the place of its output.
    pub(super) place: Vec<Vec<u32>>,
    /// Per node the place of its initial message.
    pub(super) initial: Vec<u32>,
}

/// Turns a graph and its episodes into tables.
///
/// Steps on which no step of the supervisor depends are left out, except those of nodes to be kept; so is everything
/// after the supervisor's last step.
///
/// ```
/// use parallax_runtime::graph::Graph;
/// use parallax_sim::compiled::{CompileOptions, compile};
/// use parallax_sim::generate_many;
/// # fn example(graph: &Graph) -> Result<(), Box<dyn std::error::Error>> {
/// let episodes = generate_many(graph, 7, 10_000_000_000, 20)?;
/// let compiled = compile(graph, &episodes, &CompileOptions::default())?;
/// println!("{} slots, {:.0} % filled", compiled.slots.len(), 100.0 * compiled.efficiency());
/// # Ok(())
/// # }
/// ```
///
/// # Errors
///
/// [`CompileError`] when there is nothing to compile, the episodes are not of this graph, or an option names what is
/// not there.
pub fn compile(
    graph: &Graph,
    episodes: &[Episode],
    options: &CompileOptions,
) -> Result<CompiledGraph, CompileError> {
    check(graph, episodes, options)?;
    let mut edges = edges(graph, options);
    for edge in edges.iter_mut() {
        if let Some(reach) = edge.reach() {
            let most = episodes
                .par_iter()
                .map(|episode| reach.most(edge.sent(episode), edge.window, &episode.nodes[edge.to].start));
            edge.candidates = most.max().unwrap_or(edge.window);
        }
    }
    let seen: Vec<Vec<Cow<'_, [i64]>>> = episodes
        .par_iter()
        .map(|episode| edges.iter().enumerate().map(|(index, edge)| numbers(episode, index, edge)).collect())
        .collect();
    let stateful = stateful(graph, options);
    let plan = slots(graph, episodes, &seen, &edges, &stateful, options)?;

    let executed = plan.vertices();
    let Plan { supergraph: found, episodes: partitionings, embeddings } = plan;
    let warm_up = partitionings.iter().map(|partitioning| partitioning.warm_up).max().unwrap_or(0);
    let supervisor = graph.supervisor();
    let lengths: Vec<u32> = episodes.iter().map(|episode| episode.nodes[supervisor].len() as u32).collect();
    let steps = lengths.iter().max().map_or(0, |&length| length as usize);
    let count = found.labels.len();
    if (warm_up + steps).saturating_mul(count) > i32::MAX as usize {
        return Err(CompileError::TooLarge { steps: (warm_up + steps).saturating_mul(count) });
    }
    let mut tracks: Vec<Track<'_>> = episodes
        .par_iter()
        .zip(seen)
        .zip(partitionings.par_iter().zip(&embeddings))
        .map(|((episode, seen), (partitioning, embeddings))| {
            place_steps(episode, seen, partitioning, embeddings, warm_up, count, warm_up + steps)
        })
        .collect();

    // A node's place in the order of the slots, counted among the slots of the node.
    let mut ordinal = Vec::with_capacity(count);
    for (index, label) in found.labels.iter().enumerate() {
        ordinal.push(found.labels[..index].iter().filter(|other| *other == label).count());
    }
    let lives: Vec<Vec<Lifetimes>> = tracks.par_iter().map(|track| lifetimes(track, &edges)).collect();
    let history: Vec<usize> = (0..graph.nodes().len())
        .map(|node| lives.iter().map(|lives| lives[node].places()).max().unwrap_or(1))
        .collect();
    tracks
        .par_iter_mut()
        .zip(&lives)
        .for_each(|(track, lives)| place_messages(track, lives, &history, &ordinal));

    let slots = (0..count)
        .into_par_iter()
        .map(|index| {
            let node = found.labels[index] as usize;
            let inputs = graph.nodes()[node].inputs.iter().filter(|&&connection| edges[connection].read);
            let inputs: Vec<(usize, &Edge)> =
                inputs.map(|&connection| (connection, &edges[connection])).collect();
            slot(&tracks, index, count, node, &inputs, &lengths, warm_up)
        })
        .collect();
    let nodes = graph.nodes().iter().zip(&history).zip(stateful).enumerate();
    Ok(CompiledGraph {
        nodes: nodes
            .map(|(index, ((plan, &history), stateful))| CompiledNode {
                name: plan.name.clone(),
                history,
                stateful,
                pinned: options.pinned.contains(&index),
            })
            .collect(),
        slots,
        episodes: episodes.len(),
        steps,
        lengths,
        warm_up,
        executed,
        supergraph: found,
    })
}

/// Whether everything that is named is there.
fn check(graph: &Graph, episodes: &[Episode], options: &CompileOptions) -> Result<(), CompileError> {
    let nodes = graph.nodes().len();
    if episodes.is_empty() {
        return Err(CompileError::NoEpisodes);
    }
    if let Some(&node) = options.keep.iter().chain(&options.pinned).find(|&&node| node >= nodes) {
        return Err(CompileError::NoNode { node, nodes });
    }
    if let Some(found) = options.stateful.as_ref().map(Vec::len).filter(|&found| found != nodes) {
        return Err(CompileError::Stateful { found, nodes });
    }
    for (place, trainable) in options.trainable.iter().enumerate() {
        let connection = trainable.connection;
        let wrong = |problem: &str| Err(CompileError::Trainable { connection, problem: problem.to_owned() });
        if connection >= graph.connections().len() {
            return wrong("the graph has no such connection");
        }
        if options.trainable[..place].iter().any(|other| other.connection == connection) {
            return wrong("it is listed twice");
        }
        if trainable.min < 0 || trainable.max < trainable.min {
            return wrong("its bounds have to be 0 <= min <= max");
        }
        if graph.connections()[connection].blocking {
            return wrong("its receiver waits for its messages; make it non-blocking");
        }
    }
    for (index, episode) in episodes.iter().enumerate() {
        episode.check(graph).map_err(|problem| CompileError::Episode { episode: index, problem })?;
    }
    from_output::check(graph, episodes, options)?;
    let supervisor = graph.supervisor();
    if episodes.iter().all(|episode| episode.nodes[supervisor].is_empty()) {
        return Err(CompileError::NoSteps { node: graph.nodes()[supervisor].name.clone() });
    }
    Ok(())
}

fn edges(graph: &Graph, options: &CompileOptions) -> Vec<Edge> {
    let connections = graph.connections().iter().enumerate();
    let edges = connections.map(|(index, plan)| {
        let trainable = options.trainable.iter().find(|trainable| trainable.connection == index);
        Edge {
            from: plan.from,
            to: plan.to,
            window: plan.window,
            candidates: plan.window,
            trainable: trainable.map(|trainable| TrainableDelay {
                min: trainable.min,
                max: trainable.max,
                interpolation: trainable.interpolation,
                skip: plan.skip,
            }),
            from_output: from_output::of_connection(graph, options, index),
            read: plan.to == graph.supervisor() || !options.pinned.contains(&plan.to),
        }
    });
    edges.collect()
}

fn numbers<'a>(episode: &'a Episode, index: usize, edge: &Edge) -> Cow<'a, [i64]> {
    match edge.reach() {
        None => Cow::Borrowed(&episode.connections[index].seq),
        Some(reach) => {
            let starts = &episode.nodes[edge.to].start;
            Cow::Owned(reach.candidates(edge.sent(episode), edge.window, edge.candidates, starts))
        }
    }
}

/// Whether each node's steps depend on its earlier ones.
fn stateful(graph: &Graph, options: &CompileOptions) -> Vec<bool> {
    let given = options.stateful.as_ref();
    let nodes = graph.nodes().iter().enumerate().map(|(index, plan)| {
        let by_kind = || plan.kind.node_model().is_none_or(|kind| !kind.model().state().is_empty());
        !options.pinned.contains(&index) && given.map_or_else(by_kind, |given| given[index])
    });
    nodes.collect()
}

/// Cuts the episodes and finds the slots.
fn slots(
    graph: &Graph,
    episodes: &[Episode],
    seen: &[Vec<Cow<'_, [i64]>>],
    edges: &[Edge],
    stateful: &[bool],
    options: &CompileOptions,
) -> Result<Plan, CompileError> {
    let dags = episodes.iter().zip(seen).map(|(episode, seen)| {
        let nodes = graph.nodes().iter().enumerate().map(|(index, plan)| DagNode {
            start: &episode.nodes[index].start,
            stateful: stateful[index],
            keep: options.keep.contains(&index),
            inputs: plan
                .inputs
                .iter()
                .filter(|&&connection| edges[connection].read)
                .map(|&connection| DagInput {
                    from: edges[connection].from as u32,
                    window: edges[connection].candidates,
                    seq: &seen[connection],
                })
                .collect(),
        });
        Dag { nodes: nodes.collect() }
    });
    let dags: Vec<Dag<'_>> = dags.collect();
    let plan_options = PlanOptions { cut: options.cut, start: options.start, method: options.method };
    Ok(plan(&dags, graph.supervisor() as u32, &plan_options)?)
}

/// Writes down when every step of an episode is executed.
fn place_steps<'a>(
    episode: &'a Episode,
    seen: Vec<Cow<'a, [i64]>>,
    partitioning: &Partitioning,
    embeddings: &[Embedding],
    warm_up: usize,
    slots: usize,
    passes: usize,
) -> Track<'a> {
    let mut track = Track {
        episode,
        seen,
        moment: episode.nodes.iter().map(|steps| vec![NEVER; steps.len()]).collect(),
        at: vec![-1; slots * passes],
        place: episode.nodes.iter().map(|steps| vec![0; steps.len()]).collect(),
        initial: Vec::new(),
    };
    let first = warm_up - partitioning.warm_up;
    for (pass, (steps, embedding)) in partitioning.steps.iter().zip(embeddings).enumerate() {
        for (&(node, seq), &slot) in steps.iter().zip(&embedding.slots) {
            let moment = (first + pass) * slots + slot as usize;
            track.moment[node as usize][seq as usize] = moment as Moment;
            track.at[moment] = seq as i32;
        }
    }
    track
}

/// From when to when the messages of every node are needed.
fn lifetimes(track: &Track<'_>, edges: &[Edge]) -> Vec<Lifetimes> {
    let mut read: Vec<Vec<Moment>> = track.moment.iter().map(|moments| vec![NEVER; moments.len()]).collect();
    let mut initial = vec![NEVER; read.len()];
    for (edge, seen) in edges.iter().zip(&track.seen).filter(|(edge, _)| edge.read) {
        for (&moment, row) in track.moment[edge.to].iter().zip(seen.chunks_exact(edge.candidates)) {
            if moment == NEVER {
                continue;
            }
            for &seq in row {
                let last = match usize::try_from(seq) {
                    Ok(seq) => &mut read[edge.from][seq],
                    Err(_) => &mut initial[edge.from],
                };
                *last = moment.max(*last);
            }
        }
    }
    let nodes = track.moment.iter().zip(read).zip(initial);
    nodes
        .map(|((moments, read), initial)| {
            let runs = |&(&moment, _): &(&Moment, Moment)| moment != NEVER;
            let (made, read) = moments.iter().zip(read).filter(runs).unzip();
            Lifetimes { made, read, initial }
        })
        .collect()
}

/// Gives every message of an episode its place.
fn place_messages(track: &mut Track<'_>, lives: &[Lifetimes], history: &[usize], ordinal: &[usize]) {
    for (node, (lives, &history)) in lives.iter().zip(history).enumerate() {
        let wish = |message: usize| ordinal[lives.made[message] as usize % ordinal.len()];
        let (places, initial) = lives.assign(history, wish);
        let running = track.moment[node].iter().enumerate().filter(|(_, moment)| **moment != NEVER);
        for ((seq, _), place) in running.zip(places) {
            track.place[node][seq] = place;
        }
        track.initial.push(initial);
    }
}
