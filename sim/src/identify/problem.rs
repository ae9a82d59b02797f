//! Recordings, and what to find in them, as a computation graph that is ready to run.

use std::ops::Range;

use parallax_runtime::graph::Graph;
use parallax_runtime::recording::Recording;
use parallax_runtime::registry::Registry;
use parallax_runtime::time::to_seconds;

use super::coordinate::{Coordinate, Sort};
use super::error::IdentifyError;
use super::simulators::{augmentation, feeds, longest};
use super::spec::{Output, Scatter, Specification, Target, Transform, Unknown};
use crate::batch::Place;
use crate::compiled::{CompileOptions, CompiledGraph, compile};
use crate::episode::Episode;

/// A specification bound to recordings: the augmented computation graph (van der Heijden et al., "REX", section 3.3 and
/// figure 4), what is unknown in it, and what its predictions are compared with.
#[derive(Debug, Clone)]
pub struct Problem {
    pub(super) graph: Graph,
    pub(super) compiled: CompiledGraph,
    pub(super) coordinates: Vec<Coordinate>,
    pub(super) outputs: Vec<Compared>,
    pub(super) given: Vec<Recorded>,
    pub(super) episodes: usize,
    /// The coordinates that are delays which scatter.
    pub(super) scattered: Vec<usize>,
    /// Per recording: from when on it counts, until when fits see it, until when it counts, s.
    pub(super) spans: Vec<[f64; 3]>,
    specification: Specification,
}

/// Delays that scatter are taken to make errors at most so many times as large as the noise: a local minimum makes them
/// larger by far.
const SCATTERED: f64 = 4.0;

/// What a node sent that is not simulated: `[episode][step][leaf]`.
#[derive(Debug, Clone)]
pub(super) struct Recorded {
    pub(super) node: String,
    pub(super) steps: usize,
    pub(super) values: Vec<f64>,
}

/// A leaf that is compared.
#[derive(Debug, Clone)]
pub(super) struct Compared {
    pub(super) name: String,
    pub(super) node: usize,
    /// The leaf that is the prediction, or those that make it up; none is the constant 1.
    pub(super) leaf: usize,
    pub(super) terms: Vec<Option<usize>>,
    pub(super) names: Vec<String>,
    pub(super) wrap: Option<f64>,
    pub(super) noise: Option<f64>,
    /// About what recorded values lie, where a constant is among the coefficients: sums are taken around it, so that few
    /// digits are lost.
    pub(super) centre: f64,
    /// `[episode][step]`, not a number where nothing was recorded.
    pub(super) values: Vec<Vec<f64>>,
    /// When the steps started, s, likewise.
    pub(super) times: Vec<Vec<f64>>,
}

impl Compared {
    /// The recorded values among these steps of an episode.
    pub(super) fn counted(&self, episode: usize, steps: &Range<usize>) -> impl Iterator<Item = f64> {
        self.values[episode][steps.clone()].iter().copied().filter(|value| value.is_finite())
    }

    /// The steps of an episode that count, up to `until` (s).
    pub(super) fn counts(&self, episode: usize, step: usize, from: f64, until: f64) -> bool {
        let time = self.times[episode].get(step);
        time.is_some_and(|time| from <= *time && *time < until) && self.values[episode][step].is_finite()
    }
}

impl Problem {
    /// Binds a specification to recordings of one graph.
    ///
    /// # Errors
    ///
    /// [`IdentifyError`] names the entry that does not fit.
    pub fn new(
        recordings: &[Recording],
        registry: &Registry,
        specification: &Specification,
    ) -> Result<Self, IdentifyError> {
        let first = recordings.first().ok_or(IdentifyError::NoRecording)?;
        if let Some(other) = recordings.iter().position(|recording| recording.graph != first.graph) {
            return Err(IdentifyError::OtherGraph { recording: other + 1 });
        }
        if specification.outputs.is_empty() {
            return Err(IdentifyError::NoOutput);
        }
        if specification.unknowns.is_empty() && specification.delays.is_empty() {
            return Err(IdentifyError::NoUnknown);
        }
        if !(0.0..1.0).contains(&specification.hold_out) {
            let problem = format!("{} is no share of the time below 1", specification.hold_out);
            return Err(IdentifyError::Value { whose: "hold_out".into(), problem });
        }
        let recorded = first.graph.validate(registry)?;
        let mut episodes = Vec::with_capacity(recordings.len());
        for (index, recording) in recordings.iter().enumerate() {
            let episode = Episode::from_recording(&recorded, recording)
                .map_err(|source| IdentifyError::Episode { recording: index + 1, source })?;
            episodes.push(episode);
        }
        let augmented = augmentation(&recorded, specification)?.apply(registry, &episodes, 0)?;
        let graph = augmented.graph;
        let measured: Vec<usize> = indices(&graph, specification.outputs.iter().map(|o| o.node.as_str()))?;
        let simulated: Vec<usize> = indices(&graph, specification.nodes.iter().map(|s| s.node.as_str()))?;
        let pinned: Vec<usize> = (0..graph.nodes().len())
            .filter(|index| !measured.contains(index) && !simulated.contains(index))
            .collect();
        let options = CompileOptions {
            keep: measured,
            pinned: pinned.clone(),
            trainable: augmented.trainable,
            ..CompileOptions::default()
        };
        let compiled = compile(&graph, &augmented.episodes, &options)?;
        let given = pinned.iter().map(|&node| given(&graph, node, recordings)).collect();
        let outputs = specification.outputs.iter();
        let mut outputs =
            outputs.map(|output| compared(&graph, output, recordings)).collect::<Result<Vec<_>, _>>()?;
        outputs.iter_mut().for_each(|output| leave_out_what_does_not_run(output, &compiled));
        let coordinates = coordinates(&graph, specification, recordings.len())?;
        let spans = recordings.iter().map(|recording| span(recording, specification)).collect();
        let episodes = recordings.len();
        let specification = specification.clone();
        let scattered = scattered(&graph, &coordinates, &specification, &pinned)?;
        let problem =
            Self { graph, compiled, coordinates, outputs, given, episodes, scattered, spans, specification };
        problem.check_data()?;
        Ok(problem)
    }

    fn check_data(&self) -> Result<(), IdentifyError> {
        for output in &self.outputs {
            if self.samples(output, 1.0) <= output.terms.len() {
                return Err(IdentifyError::NoData { output: output.name.clone() });
            }
        }
        Ok(())
    }

    /// Until when an episode counts where only a share of the fitted time does.
    pub(super) fn until(&self, episode: usize, share: f64) -> f64 {
        let [from, until, _] = self.spans[episode];
        if share >= 1.0 { until } else { from + share * (until - from) }
    }

    /// How many values of an output count.
    pub(super) fn samples(&self, output: &Compared, share: f64) -> usize {
        let of = |episode: usize| {
            let (from, until) = (self.spans[episode][0], self.until(episode, share));
            (0..output.times[episode].len()).filter(|&k| output.counts(episode, k, from, until)).count()
        };
        (0..self.episodes).map(of).sum()
    }

    /// What was asked for.
    pub fn specification(&self) -> &Specification {
        &self.specification
    }

    /// Whether one or two humps are told of the delay that scatters, which is the only one then.
    pub(super) fn asks_for_humps(&self) -> bool {
        self.specification.delays.iter().any(|delay| delay.scatter == Some(Scatter::Mixture))
    }

    /// The graph with its simulators.
    pub fn graph(&self) -> &Graph {
        &self.graph
    }

    /// The names of what is searched for, linear coefficients aside.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.coordinates.iter().map(|coordinate| coordinate.name.as_str())
    }

    /// Where the search begins, between 0 and 1.
    pub fn start(&self) -> Vec<f64> {
        self.coordinates.iter().map(|c| c.place_of(c.start)).collect()
    }

    /// The loss that predictions have which are right but for the noise, where all outputs declare theirs: the mean of the
    /// χ² distribution and three standard deviations.
    pub fn noise_floor(&self) -> Option<f64> {
        let declared = self.outputs.iter().all(|output| output.noise.is_some());
        let samples: usize = self.outputs.iter().map(|output| self.samples(output, 1.0)).sum();
        let n = samples as f64;
        // Delays that scatter are noise of unknown size, until their spreads are found.
        let scatter = if self.scattered.is_empty() { 1.0 } else { SCATTERED * SCATTERED };
        declared.then(|| scatter * (n + 3.0 * (2.0 * n).sqrt()))
    }

    /// A number that tells this problem from others.
    pub(super) fn fingerprint(&self) -> String {
        let mut text = String::new();
        for c in &self.coordinates {
            text += &format!("{} {:?} {} {} {:?};", c.name, c.transform, c.low, c.high, c.prior);
        }
        for output in &self.outputs {
            let sum: f64 = output.values.iter().flatten().filter(|value| value.is_finite()).sum();
            text += &format!("{} {:?} {} {sum};", output.name, output.noise, self.samples(output, 1.0));
        }
        let hash = text.bytes().fold(0xcbf2_9ce4_8422_2325u64, |hash, byte| {
            (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3)
        });
        format!("{hash:016x}")
    }
}

fn indices<'n>(graph: &Graph, names: impl Iterator<Item = &'n str>) -> Result<Vec<usize>, IdentifyError> {
    names.map(|name| index(graph, name, &format!("outputs.\"{name}\""))).collect()
}

fn index(graph: &Graph, name: &str, whose: &str) -> Result<usize, IdentifyError> {
    graph.index(name).ok_or_else(|| IdentifyError::Unknown {
        whose: whose.to_owned(),
        what: "node",
        name: name.to_owned(),
        known: graph.nodes().iter().map(|node| node.name.as_str()).collect::<Vec<_>>().join(", "),
    })
}

/// What a node sent in all recordings; steps of which no message is recorded hold the one before.
fn given(graph: &Graph, node: usize, recordings: &[Recording]) -> Recorded {
    let plan = &graph.nodes()[node];
    let leaves = plan.kind.initial_message().len();
    let tracks = || recordings.iter().filter_map(|recording| recording.node(&plan.name));
    let steps = tracks().map(|track| track.steps.len()).max().unwrap_or(0);
    let mut values = Vec::with_capacity(recordings.len() * steps * leaves);
    for track in tracks() {
        let mut last = track.initial.clone();
        for step in 0..steps as u64 {
            if let Some(message) = track.message(step) {
                last.clone_from(&message.payload);
            }
            values.extend_from_slice(&last);
        }
    }
    Recorded { node: plan.name.clone(), steps, values }
}

fn leaf(names: &[String], name: &str, whose: &str, what: &'static str) -> Result<usize, IdentifyError> {
    names.iter().position(|known| known == name).ok_or_else(|| IdentifyError::Unknown {
        whose: whose.to_owned(),
        what,
        name: name.to_owned(),
        known: if names.is_empty() { "none".into() } else { names.join(", ") },
    })
}

fn compared(graph: &Graph, output: &Output, recordings: &[Recording]) -> Result<Compared, IdentifyError> {
    let name = format!("{}.{}", output.node, output.leaf);
    let whose = format!("outputs.\"{name}\"");
    let wrong = |problem: String| Err::<Compared, _>(IdentifyError::Value { whose: whose.clone(), problem });
    if output.noise.is_some_and(|noise| !(noise.is_finite() && noise > 0.0)) {
        return wrong("the noise has to be above zero".into());
    }
    if output.wrap.is_some() && !output.linear.is_empty() {
        return wrong("what wraps cannot be linear in anything".into());
    }
    let node = index(graph, &output.node, &whose)?;
    let predicted = &graph.nodes()[node].kind.output().leaves;
    let mut terms = Vec::with_capacity(output.linear.len());
    for term in &output.linear {
        let place = term.leaf.as_ref().map(|name| leaf(predicted, name, &whose, "leaf of its prediction"));
        terms.push(place.transpose()?);
    }
    let place = if terms.is_empty() { leaf(predicted, &output.leaf, &whose, "leaf")? } else { 0 };
    let (mut values, mut times) = (Vec::new(), Vec::new());
    for recording in recordings {
        let Some(track) = recording.node(&output.node) else { continue };
        let measured = leaf(&track.layout.leaves, &output.leaf, &whose, "recorded leaf")?;
        let value =
            |step: usize| track.message(step as u64).map_or(f64::NAN, |message| message.payload[measured]);
        values.push((0..track.steps.len()).map(value).collect());
        times.push(track.steps.iter().map(|step| to_seconds(step.start)).collect());
    }
    let names = output.linear.iter().map(|term| term.name.clone()).collect();
    let Output { wrap, noise, .. } = *output;
    let finite = || values.iter().flatten().filter(|value: &&f64| value.is_finite());
    let centre = match terms.contains(&None) {
        true => finite().sum::<f64>() / finite().count().max(1) as f64,
        false => 0.0,
    };
    Ok(Compared { name, node, leaf: place, terms, names, wrap, noise, centre, values, times })
}

/// Steps after the supervisor's last one belong to no pass: nothing is predicted for them.
fn leave_out_what_does_not_run(output: &mut Compared, compiled: &CompiledGraph) {
    let mut runs: Vec<Vec<bool>> = output.values.iter().map(|values| vec![false; values.len()]).collect();
    for slot in compiled.slots.iter().filter(|slot| slot.node == output.node) {
        for (episode, runs) in runs.iter_mut().enumerate() {
            for row in compiled.row(episode, 0)..compiled.row(episode + 1, 0) {
                if slot.rows.run[row] != 0 {
                    runs[slot.rows.seq[row] as usize] = true;
                }
            }
        }
    }
    for (values, runs) in output.values.iter_mut().zip(runs) {
        values.iter_mut().zip(runs).filter(|(_, runs)| !runs).for_each(|(value, _)| *value = f64::NAN);
    }
}

fn coordinates(
    graph: &Graph,
    specification: &Specification,
    recordings: usize,
) -> Result<Vec<Coordinate>, IdentifyError> {
    let mut found: Vec<Coordinate> = Vec::new();
    for unknown in &specification.unknowns {
        let whose = format!("`{}`", unknown.name);
        if unknown.targets.is_empty() {
            return Err(IdentifyError::Value { whose, problem: "it sets nothing; name what it sets".into() });
        }
        let state = unknown.targets.iter().any(|target| matches!(target, Target::State { .. }));
        let places = unknown.targets.iter().map(|target| place(graph, target, &whose));
        let places = places.collect::<Result<Vec<_>, _>>()?;
        let transform = unknown.transform.unwrap_or_else(|| Transform::suited(unknown.low, unknown.high));
        // Every recording begins in a state of its own.
        for recording in if state { 0..recordings } else { 0..1 } {
            let many = state && recordings > 1;
            let name =
                if many { format!("{}[{}]", unknown.name, recording + 1) } else { unknown.name.clone() };
            let mut coordinate = Coordinate {
                name,
                unit: unknown.unit.clone(),
                sort: if state { Sort::State } else { Sort::Parameter },
                places: places.clone(),
                recording: many.then_some(recording),
                low: unknown.low,
                high: unknown.high,
                transform,
                start: unknown.start.unwrap_or(unknown.low),
                prior: unknown.prior,
            };
            coordinate.check(&whose)?;
            if unknown.start.is_none() {
                coordinate.start = coordinate.value(0.5);
            }
            taken(&found, &coordinate, unknown)?;
            found.push(coordinate);
        }
    }
    for delay in &specification.delays {
        let whose = format!("delays.\"{}\"", delay.name);
        let edges = &graph.spec().connections;
        let Some(connection) = edges.iter().position(|edge| feeds(delay, edge)) else { continue };
        let (low, high) = (delay.min, longest(delay));
        let coordinate = Coordinate {
            name: delay.name.clone(),
            unit: "s".into(),
            sort: Sort::Delay,
            places: vec![Place::Delay { connection }],
            recording: None,
            low,
            high,
            transform: Transform::Linear,
            start: delay.start.unwrap_or(0.5 * (low + high)),
            prior: delay.prior,
        };
        coordinate.check(&whose)?;
        found.push(coordinate);
    }
    Ok(found)
}

/// The coordinates that are delays which scatter. What such a delay feeds has to be compared and to reach no state: then
/// every message has its own, and no other feels it.
fn scattered(
    graph: &Graph,
    coordinates: &[Coordinate],
    specification: &Specification,
    pinned: &[usize],
) -> Result<Vec<usize>, IdentifyError> {
    let mut found = Vec::new();
    for delay in specification.delays.iter().filter(|delay| delay.scatter.is_some()) {
        let of = |c: &Coordinate| c.sort == Sort::Delay && c.name == delay.name;
        let Some(coordinate) = coordinates.iter().position(of) else { continue };
        let compared = specification.outputs.iter().any(|output| output.node == delay.to);
        let sends_on = graph.index(&delay.to).is_some_and(|node| {
            let edges = graph.connections().iter();
            edges.filter(|edge| edge.from == node).any(|edge| !pinned.contains(&edge.to))
        });
        if !compared || sends_on {
            let why = if compared { "sends on to a node that is simulated" } else { "is not compared" };
            return Err(IdentifyError::Value {
                whose: format!("delays.\"{}\"", delay.name),
                problem: format!(
                    "`{}` {why}: the spread of a delay is found only where it ends at a node whose output is compared and goes \
                     nowhere else (a sensor); leave `scatter` out, and its mean is found",
                    delay.to
                ),
            });
        }
        found.push(coordinate);
    }
    let mixture = specification.delays.iter().find(|delay| delay.scatter == Some(Scatter::Mixture));
    if let (Some(delay), true) = (mixture, found.len() > 1) {
        return Err(IdentifyError::Value {
            whose: format!("delays.\"{}\"", delay.name),
            problem: "the humps of a delay are found only where no other one scatters".to_owned(),
        });
    }
    Ok(found)
}

fn taken(found: &[Coordinate], new: &Coordinate, unknown: &Unknown) -> Result<(), IdentifyError> {
    let same = |other: &&Coordinate| {
        other.recording == new.recording && other.places.iter().any(|place| new.places.contains(place))
    };
    match found.iter().find(same) {
        Some(other) => Err(IdentifyError::Value {
            whose: format!("`{}`", unknown.name),
            problem: format!("it sets what `{}` sets already", other.name),
        }),
        None => Ok(()),
    }
}

fn place(graph: &Graph, target: &Target, whose: &str) -> Result<Place, IdentifyError> {
    let (Target::Parameter { node, leaf: name } | Target::State { node, leaf: name }) = target;
    let index = index(graph, node, whose)?;
    let kind = graph.nodes()[index].kind.node_model().ok_or_else(|| IdentifyError::Value {
        whose: whose.to_owned(),
        problem: format!("node `{node}` is plain Rust, not a model; give its place to a model under `nodes`"),
    })?;
    Ok(match target {
        Target::Parameter { .. } => {
            Place::Param { node: index, leaf: leaf(&kind.model().params(), name, whose, "parameter")? }
        }
        Target::State { .. } => {
            Place::State { node: index, leaf: leaf(&kind.model().state(), name, whose, "leaf of a state")? }
        }
    })
}

fn span(recording: &Recording, specification: &Specification) -> [f64; 3] {
    let (from, to) = specification.span;
    let end = to_seconds(recording.duration).min(to);
    // Before that, what a sensor sees may be from before the first state.
    let from = from.max(specification.delays.iter().map(longest).sum());
    [from, end - specification.hold_out * (end - from).max(0.0), end]
}
