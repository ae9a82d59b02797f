//! `parallax kinds`: the kinds of node that a graph may name, what they take and what they send.

use anyhow::anyhow;
use clap::Args;
use parallax_model::system::Suggestion;
use parallax_runtime::node::{Layout, NodeContext, Parameters};
use parallax_runtime::registry::{InputPort, NodeKind, Registry};
use serde_json::{Value, json};

use super::failure::{Failure, Outcome};
use super::output;
use super::python;

/// What the kinds begin with that play a recording: one for nearly every other kind.
const PLAYBACK: &str = parallax_nodes::playback::PREFIX;

#[derive(Args)]
pub(crate) struct Arguments {
    /// One kind, in full: every number of its messages, and its parameters.
    kind: Option<String>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let registry = python::registry();
    let all = || registry.names().filter_map(|name| Some((name, registry.get(name)?)));
    match &arguments.kind {
        Some(name) => {
            let kind = registry.get(name).ok_or_else(|| unknown(&registry, name))?;
            if arguments.json { output::json(&told(name, kind))? } else { print(name, kind) }
        }
        None if arguments.json => {
            output::json(&all().map(|(name, kind)| told(name, kind)).collect::<Vec<_>>())?;
        }
        None => {
            let row = |(name, kind): (&str, &NodeKind)| {
                let inputs: Vec<String> = kind.inputs().iter().map(|port| port.name.clone()).collect();
                vec![name.to_owned(), inputs.join(", "), kind.output().name.clone(), nature(kind).to_owned()]
            };
            let own = all().filter(|(name, _)| !name.starts_with(PLAYBACK));
            output::table(&["kind", "inputs", "sends", ""], &own.map(row).collect::<Vec<_>>());
            output::line(format!("`{PLAYBACK}KIND` sends what a node of that kind sent in a recording"));
            output::line("`parallax kinds KIND` says what one of them takes and sends, number by number");
        }
    }
    Ok(Outcome::Done)
}

fn unknown(registry: &Registry, name: &str) -> Failure {
    let suggestion = Suggestion::nearest(name, registry.names());
    Failure::input(anyhow!("`{name}` is none of the kinds that `parallax kinds` lists{suggestion}"))
}

/// What is to be known of a kind beside its messages.
fn nature(kind: &NodeKind) -> &'static str {
    match kind {
        kind if kind.is_by_graph() => "follows from its graph",
        kind if kind.is_external() => "runs in another program",
        kind if kind.node_model().is_some() => "also in compiled graphs",
        kind if kind.is_stand_in() => "stands in for hardware",
        kind if !kind.is_deterministic() => "not deterministic",
        _ => "",
    }
}

/// The parameters of a kind that is a model, with what they are where nothing is stated; those that need a statement have no value.
fn parameters(name: &str, kind: &NodeKind) -> Vec<(String, Option<f64>)> {
    let Some(model) = kind.node_model() else { return Vec::new() };
    let context =
        NodeContext { name: name.to_owned(), rate: 100.0, seed: 0, parameters: Parameters::default() };
    let node = model.node(&context).ok();
    let names = model.model().params().into_iter().enumerate();
    names.map(|(k, leaf)| (leaf, node.as_ref().and_then(|node| node.params().get(k).copied()))).collect()
}

fn told(name: &str, kind: &NodeKind) -> Value {
    let layout = |layout: &Layout| json!({ "message": layout.name, "leaves": layout.leaves });
    let input = |port: &InputPort| {
        let mut input = layout(&port.layout);
        input["name"] = json!(port.name);
        input
    };
    let parameters =
        parameters(name, kind).into_iter().map(|(name, value)| json!({ "name": name, "value": value }));
    json!({
        "kind": name,
        "inputs": kind.inputs().iter().map(input).collect::<Vec<_>>(),
        "output": layout(kind.output()),
        "data_bytes": kind.data_capacity(),
        "parameters": parameters.collect::<Vec<_>>(),
        "compiled": kind.node_model().is_some(),
        "by_graph": kind.is_by_graph(),
        "external": kind.is_external(),
        "stand_in": kind.is_stand_in(),
        "deterministic": kind.is_deterministic(),
    })
}

fn print(name: &str, kind: &NodeKind) {
    let columns = output::columns(100);
    let line = |text: String| output::line(output::folded(&text, columns));
    let nature = nature(kind);
    line(if nature.is_empty() { name.to_owned() } else { format!("{name}: {nature}") });
    for port in kind.inputs() {
        line(format!("  input  {}: {}", port.name, port.layout));
    }
    if kind.is_by_graph() || kind.is_external() {
        line("  its inputs and messages follow from the graph".to_owned());
    } else {
        line(format!("  sends  {}", kind.output()));
    }
    if kind.data_capacity() > 0 {
        line(format!("  and up to {} bytes of data with each message", kind.data_capacity()));
    }
    let rows: Vec<Vec<String>> = parameters(name, kind)
        .into_iter()
        .map(|(name, value)| vec![name, value.map_or_else(|| "to be stated".to_owned(), output::number)])
        .collect();
    if !rows.is_empty() {
        output::table(&["parameter", "where nothing is stated"], &rows);
    }
}
