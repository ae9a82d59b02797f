//! `parallax graph`: a graph, its schedule, its supergraph and its delays, in words and in pictures.

use std::path::{Path, PathBuf};

use anyhow::anyhow;
use clap::Args;
use parallax_runtime::graph::{Graph, GraphSpec, JitterPolicy, Scheduling};
use parallax_runtime::recording::Recording;
use parallax_runtime::time::{Nanos, SECOND, from_seconds, to_seconds};
use parallax_sim::delays::{self, DelayFit, Measured};
use parallax_sim::supergraph::SupergraphError;
use parallax_sim::{Episode, generate};
use serde_json::{Value, json};

use super::args::{duration, graph_spec, validate};
use super::delays::describe;
use super::failure::{Failure, Outcome, Sort};
use super::output;
use super::supergraph::{self, Found};
use crate::plot;

#[derive(Args)]
pub(crate) struct Arguments {
    /// A recording (.mcap), a graph.toml, or the name of a graph that comes with the program.
    what: String,
    /// Draw the graph, its schedule and its supergraph: a page, or a picture.
    #[arg(long, value_name = "FILE.html|FILE.svg")]
    plot: Option<PathBuf>,
    /// Where the drawn stretch of the schedule begins; by default, where all nodes have come to run.
    #[arg(long, value_name = "SECONDS", requires = "plot", value_parser = begin, allow_negative_numbers = true)]
    from: Option<Nanos>,
    /// How long the drawn stretch is; by default, four periods of the slowest node.
    #[arg(long = "for", value_name = "SECONDS", requires = "plot", value_parser = duration, allow_negative_numbers = true)]
    span: Option<Nanos>,
    /// How much of a schedule is drawn from a graph that was not recorded.
    #[arg(long, value_name = "SECONDS", default_value = "10", value_parser = duration, allow_negative_numbers = true)]
    duration: Nanos,
    /// Seed of that schedule.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// A time in a run, as nanoseconds.
fn begin(text: &str) -> Result<Nanos, String> {
    match text.parse::<f64>() {
        Ok(seconds) if (0.0..9e9).contains(&seconds) => Ok(from_seconds(seconds)),
        Ok(_) => Err("it must be at least zero and finite".into()),
        Err(_) => Err("it must be a number of seconds, such as 0.5".into()),
    }
}

/// A graph, and one schedule of it.
struct Shown {
    graph: Graph,
    episode: Episode,
    /// What a recording says about its delays.
    measured: Option<(Vec<DelayFit>, Vec<Measured>)>,
    /// Its slots by every method, the one that compiled graphs use first; or why there are none.
    slots: Result<Vec<Found>, SupergraphError>,
    /// Where the schedule comes from.
    source: String,
}

impl Shown {
    fn read(arguments: &Arguments) -> Result<Self, Failure> {
        let path = Path::new(&arguments.what);
        let is_recording = path.is_file() && path.extension().is_none_or(|extension| extension != "toml");
        if path.is_dir() {
            return Err(Failure::input(anyhow!(
                "{} is a folder; give a recording, a graph.toml or a graph's name",
                path.display()
            )));
        }
        if is_recording { Self::of_recording(path) } else { Self::of_graph(arguments) }
    }

    fn of_recording(path: &Path) -> Result<Self, Failure> {
        let recording = Recording::read(path).input()?;
        if recording.is_imported() {
            return Err(Failure::input(anyhow!(
                "{} is an imported log: it has signals and no graph; `parallax info` says what is in it",
                path.display()
            )));
        }
        let graph = validate(&recording.graph)?;
        let episode = Episode::from_recording(&graph, &recording).input()?;
        let measured: Vec<Measured> = delays::measured(&recording);
        let measured: (Vec<DelayFit>, Vec<Measured>) =
            measured.into_iter().filter_map(|measured| Some((delays::fit(&measured)?, measured))).unzip();
        let source = format!("{} s recorded in {}", to_seconds(recording.duration), path.display());
        if let Some(end) = &recording.truncated {
            eprintln!("warning: {} is only the beginning of a recording: {end}", path.display());
        }
        let slots = supergraph::find(&graph, &episode);
        Ok(Self { graph, episode, measured: Some(measured), slots, source })
    }

    fn of_graph(arguments: &Arguments) -> Result<Self, Failure> {
        let graph = validate(&graph_spec(&arguments.what, &[], &[])?)?;
        let episode = generate(&graph, arguments.seed, arguments.duration).input()?;
        let source =
            format!("{} s drawn from the graph, seed {}", to_seconds(arguments.duration), arguments.seed);
        let slots = supergraph::find(&graph, &episode);
        Ok(Self { graph, episode, measured: None, slots, source })
    }
}

pub(crate) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let shown = Shown::read(arguments)?;
    if let Some(out) = &arguments.plot {
        draw(&shown, arguments, out)?;
    }
    if arguments.json {
        output::json(&summary(&shown))?;
    } else {
        print(&shown);
        if let Some(out) = &arguments.plot {
            output::line(format!("written to {}", out.display()));
        }
    }
    Ok(Outcome::Done)
}

fn draw(shown: &Shown, arguments: &Arguments, out: &Path) -> Result<(), Failure> {
    let Shown { graph, episode, measured, slots, source } = shown;
    let (from, span) = plot::schedule::default_range(graph, episode);
    let from = arguments.from.unwrap_or(from);
    let span = arguments.span.unwrap_or(span);
    let last = episode.nodes.iter().filter_map(|steps| steps.end.last()).copied().max().unwrap_or(0);
    if episode.steps() == 0 {
        return Err(Failure::input(anyhow!("{source}: there is no step to draw")));
    }
    if from >= last.max(1) {
        return Err(Failure::input(anyhow!(
            "--from {} s lies behind the last step, which ended at {} s",
            to_seconds(from),
            to_seconds(last)
        )));
    }
    if span > 100 * SECOND {
        return Err(Failure::input(anyhow!("--for {} s: a plot shows at most 100 s", to_seconds(span))));
    }
    let mut figures = vec![plot::graph::figure(graph), plot::schedule::figure(graph, episode, from, span)];
    if let Some(found) = slots.as_ref().ok().and_then(|slots| slots.first()) {
        figures.extend(plot::supergraph::figure(graph, &found.plan.supergraph, &found.about()));
    }
    if let Some((fits, measured)) = measured.as_ref().filter(|(fits, _)| !fits.is_empty()) {
        figures.push(plot::delays::figure(fits, measured));
    }
    plot::write(out, &format!("Graph {}", graph.spec().name), source, figures)
}

/// What a node's ticks and starts are subject to.
fn node_policy(scheduling: Scheduling, advance: bool) -> String {
    let mut words = vec![match scheduling {
        Scheduling::Frequency => "keeps frequency",
        Scheduling::Phase => "keeps phase",
    }];
    words.extend(advance.then_some("advance"));
    words.join(", ")
}

/// How a connection is read.
fn connection_policy(blocking: bool, skip: bool, jitter: JitterPolicy) -> String {
    let mut words = vec![if blocking { "blocking" } else { "latest" }];
    words.extend(skip.then_some("skip"));
    words.extend((jitter == JitterPolicy::Buffer).then_some("buffer"));
    words.join(", ")
}

fn print(shown: &Shown) {
    let Shown { graph, episode, slots, source, .. } = shown;
    let spec: &GraphSpec = graph.spec();
    let (nodes, connections) = (graph.nodes().len(), graph.connections().len());
    output::line(format!(
        "{}: {nodes} nodes, {connections} connections, stepped by {}; {source}",
        spec.name, spec.supervisor
    ));
    let rows: Vec<Vec<String>> = spec
        .nodes
        .iter()
        .zip(graph.nodes())
        .zip(&episode.nodes)
        .map(|((spec, plan), steps)| {
            vec![
                spec.name.clone(),
                spec.kind.clone(),
                spec.rate.to_string(),
                output::seconds(to_seconds(plan.grid.phase())),
                steps.len().to_string(),
                node_policy(plan.scheduling, plan.advance),
                describe(&plan.computation),
            ]
        })
        .collect();
    output::table(&["node", "kind", "rate (Hz)", "phase", "steps", "policy", "computation"], &rows);
    let rows: Vec<Vec<String>> = graph
        .connections()
        .iter()
        .enumerate()
        .map(|(index, plan)| {
            vec![
                graph.connection_name(index),
                connection_policy(plan.blocking, plan.skip, plan.jitter),
                plan.window.to_string(),
                describe(&plan.delay),
            ]
        })
        .collect();
    if !rows.is_empty() {
        output::table(&["connection", "policy", "window", "delay"], &rows);
    }
    match slots {
        Ok(_) if episode.steps() == 0 => output::line("note: no supergraph: the schedule has no step"),
        Ok(slots) => supergraph::print(slots),
        Err(error) => output::line(format!("note: no supergraph: {error}")),
    }
}

fn summary(shown: &Shown) -> Value {
    let Shown { graph, episode, measured, slots, source } = shown;
    let spec = graph.spec();
    let nodes: Vec<Value> = spec
        .nodes
        .iter()
        .zip(graph.nodes())
        .zip(&episode.nodes)
        .map(|((spec, plan), steps)| {
            json!({
                "name": spec.name, "kind": spec.kind, "rate_hz": spec.rate, "phase_s": to_seconds(plan.grid.phase()),
                "steps": steps.len(), "scheduling": plan.scheduling, "advance": plan.advance,
                "computation": plan.computation, "expected_s": plan.computation.expected(),
            })
        })
        .collect();
    let connections: Vec<Value> = graph
        .connections()
        .iter()
        .enumerate()
        .map(|(index, plan)| {
            json!({
                "name": graph.connection_name(index), "blocking": plan.blocking, "window": plan.window,
                "skip": plan.skip, "jitter": plan.jitter, "delay": plan.delay, "expected_s": plan.delay.expected(),
            })
        })
        .collect();
    json!({
        "graph": spec.name, "supervisor": spec.supervisor, "source": source, "nodes": nodes,
        "connections": connections, "measured_delays": measured.as_ref().map(|(fits, _)| fits),
        "supergraphs": slots.as_ref().ok().map(|slots| {
            slots.iter().map(|found| found.summary(graph)).collect::<Vec<_>>()
        }),
    })
}
