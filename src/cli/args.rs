//! Values that several commands take.

use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use parallax_model::system::Suggestion;
use parallax_nodes::command_file::CommandFile;
use parallax_nodes::{estimator, playback};
use parallax_runtime::graph::{Graph, GraphSpec};
use parallax_runtime::registry::Registry;
use parallax_runtime::time::{Nanos, from_seconds};
use serde_json::Value;

use super::failure::{Failure, Sort};

/// A positive number of seconds, as nanoseconds.
pub(crate) fn duration(text: &str) -> Result<Nanos, String> {
    match text.parse::<f64>() {
        Ok(seconds) if seconds > 0.0 && seconds < 9e9 => Ok(from_seconds(seconds).max(1)),
        Ok(_) => Err("it must be above zero and finite".into()),
        Err(_) => Err("it must be a number of seconds, such as 20 or 0.5".into()),
    }
}

/// `NODE.KEY=VALUE`: a change to one node of a graph.
#[derive(Clone, Debug)]
pub(crate) struct NodeChange {
    node: String,
    key: String,
    value: Value,
}

impl std::str::FromStr for NodeChange {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let form = "it must look like NODE.KEY=VALUE, such as camera.rate=30";
        let (place, value) = text.split_once('=').ok_or(form)?;
        let (node, key) = place.split_once('.').ok_or(form)?;
        if node.is_empty() || key.is_empty() {
            return Err(form.into());
        }
        // What is no JSON is a plain word.
        let value = serde_json::from_str(value).unwrap_or_else(|_| Value::String(value.into()));
        Ok(Self { node: node.into(), key: key.into(), value })
    }
}

impl NodeChange {
    fn apply(&self, spec: &mut GraphSpec) -> anyhow::Result<()> {
        let Self { node: name, key, value } = self;
        let names: Vec<String> = spec.nodes.iter().map(|node| node.name.clone()).collect();
        let node = spec.node_mut(name).ok_or_else(|| {
            let suggestion = Suggestion::nearest(name, names.iter().map(String::as_str));
            anyhow!(
                "--node {name}.{key}: the graph has no node `{name}`{suggestion} (it has: {})",
                names.join(", ")
            )
        })?;
        match key.as_str() {
            "rate" => {
                node.rate =
                    value.as_f64().with_context(|| format!("--node {name}.rate: {value} is no number"))?;
            }
            "core" => {
                let core = value.as_u64().and_then(|core| usize::try_from(core).ok());
                node.core =
                    Some(core.with_context(|| format!("--node {name}.core: {value} is no core's number"))?);
            }
            _ => {
                node.parameters.insert(key.clone(), value.clone());
            }
        }
        Ok(())
    }
}

/// `NODE=FILE`: a node that sends what a command file says.
#[derive(Clone, Debug)]
pub(crate) struct Play {
    node: String,
    file: PathBuf,
}

impl std::str::FromStr for Play {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text.split_once('=') {
            Some((node, file)) if !node.is_empty() && !file.is_empty() => {
                Ok(Self { node: node.into(), file: file.into() })
            }
            _ => Err("it must look like NODE=FILE, such as motor=experiment.csv".into()),
        }
    }
}

/// The graph named or stored at `graph`, with changes, and with nodes that play command files.
pub(crate) fn graph_spec(graph: &str, changes: &[NodeChange], play: &[Play]) -> Result<GraphSpec, Failure> {
    let mut spec = match parallax_nodes::graph(graph) {
        Some(spec) => spec,
        None => read_graph(Path::new(graph))?,
    };
    for change in changes {
        change.apply(&mut spec).map_err(Failure::input)?;
    }
    for Play { node, file } in play {
        let commands = CommandFile::read(file).input()?;
        playback::put(&mut spec, node, &commands, &crate::cli::python::registry())
            .with_context(|| format!("--play {node}={}", file.display()))
            .map_err(Failure::input)?;
    }
    Ok(spec)
}

fn read_graph(path: &Path) -> Result<GraphSpec, Failure> {
    let text = std::fs::read_to_string(path)
        .with_context(|| {
            let names = parallax_nodes::GRAPHS.join(", ");
            format!("{} cannot be read; give the path of a graph.toml, or one of: {names}", path.display())
        })
        .map_err(Failure::input)?;
    let in_file = || path.display().to_string();
    let mut spec = GraphSpec::from_toml(&text).with_context(in_file).map_err(Failure::input)?;
    let folder = path.parent().unwrap_or(Path::new("."));
    estimator::embed(&mut spec, folder).with_context(in_file).map_err(Failure::input)?;
    Ok(spec)
}

/// The graph checked against the known kinds of node; its warnings are printed.
pub(crate) fn validate(spec: &GraphSpec) -> Result<Graph, Failure> {
    validate_with(spec, &crate::cli::python::registry())
}

/// As [`validate`], against these kinds.
pub(crate) fn validate_with(spec: &GraphSpec, registry: &Registry) -> Result<Graph, Failure> {
    let graph = spec.validate(registry).input()?;
    for warning in graph.warnings() {
        eprintln!("warning: {warning}");
    }
    Ok(graph)
}

/// Makes the folder that `path` is to lie in.
pub(crate) fn make_parent(path: &Path) -> Result<(), Failure> {
    let Some(parent) = path.parent().filter(|parent| !parent.as_os_str().is_empty()) else { return Ok(()) };
    std::fs::create_dir_all(parent)
        .with_context(|| format!("the folder {} cannot be made", parent.display()))
        .map_err(Failure::input)
}
