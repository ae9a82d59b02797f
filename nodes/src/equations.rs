//! A system described by equations as a node: it simulates the stretch of a graph that no node records.
//!
//! A `system.toml` binds its inputs to signals `NODE.LEAF`. [`kind`] makes a kind of node with one port for every such
//! node, which integrates the equations from tick to tick. Message k holds the outputs at tick k, under the commands
//! seen then, and `stamp`, the time of the tick; the commands hold until the next tick. The effects that the system states
//! (`[[effect]]`, as a diagnosis adds them to a corrected system) act as the diagnosis has them act, with the tick as the
//! integrator's longest step; what belongs to a graph (a delay) or to chance (jitter) is an error that says so.
//!
//! ```
//! use parallax_model::system::System;
//! use parallax_nodes::{equations, pendulum, registry};
//!
//! let graph = pendulum::graph().validate(&registry())?;
//! let system = System::parse(pendulum::SYSTEM, "system.toml")?;
//! let layout = |node: &str| graph.index(node).map(|node| graph.nodes()[node].kind.output().clone());
//! let kind = equations::kind(&system, layout)?;
//! assert_eq!(kind.inputs()[0].name, "motor");
//! assert_eq!(kind.output().leaves, ["angle", "stamp"]);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

use std::collections::BTreeMap;

use parallax_model::Scalar;
use parallax_model::node_model::{FlatModel, NodeStep, Scratch};
use parallax_model::plant::{Plant, Unfit};
use parallax_model::program::Program;
use parallax_model::system::{Initial, Parameter as Declared, Point, System, SystemError};
use parallax_runtime::model_node::{ModelKind, ModelStart};
use parallax_runtime::node::{Layout, NodeContext, NodeError};
use parallax_runtime::registry::NodeKind;
use parallax_runtime::tuning::Parameter;
use serde::Deserialize;

/// Why a system cannot be a node of a graph.
#[derive(Debug, thiserror::Error)]
pub enum EquationsError {
    /// The equations are not whole.
    #[error(transparent)]
    System(#[from] SystemError),
    /// An input is bound to something that is no node's leaf.
    #[error(
        "{file}: input `{input}` is bound to the signal `{signal}`; in a graph that has to be NODE.LEAF, a leaf of a \
         node's messages"
    )]
    Signal {
        /// The file.
        file: String,
        /// The input.
        input: String,
        /// What it is bound to.
        signal: String,
    },
    /// An effect that the system states cannot act in a node.
    #[error(transparent)]
    Effect(#[from] Unfit),
    /// An output's name cannot name a leaf.
    #[error("{file}: the output `{output}` cannot name a leaf; `stamp` is the time of the tick")]
    Output {
        /// The file.
        file: String,
        /// The output.
        output: String,
    },
}

/// Where a command comes from: leaf `leaf` of the newest message at `port`.
#[derive(Clone, Debug)]
struct Command {
    port: String,
    leaf: usize,
}

/// The equations, integrated from tick to tick.
#[derive(Clone, Debug)]
struct Tick {
    name: String,
    parameters: Vec<String>,
    states: Vec<String>,
    outputs: Vec<String>,
    /// For each input, what it is the mean of: one command, as a rule.
    commands: Vec<Vec<Command>>,
    /// See [`Plant::tick_program`].
    program: Program,
}

/// What may stand in a graph.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Settings {
    /// Where states start.
    initial: BTreeMap<String, f64>,
    /// Values of parameters, instead of the nominal ones.
    parameters: BTreeMap<String, f64>,
}

/// A kind of node that simulates `system`. `layout` gives the messages of the nodes that its inputs and outputs name.
/// Where the outputs are just the leaves of one node's messages, a node of this kind can take that node's place.
///
/// In a graph, `initial.STATE` says where a state starts, which the system may leave open, and `parameters.NAME` replaces
/// a nominal value. All parameters of the system may be set while the node runs.
///
/// # Errors
///
/// [`EquationsError`] when the system is not whole, an input is not bound to a leaf of a node, or the system states an
/// effect that cannot act in a node.
pub fn kind(system: &System, layout: impl Fn(&str) -> Option<Layout>) -> Result<NodeKind, EquationsError> {
    let file = || system.file.clone();
    let plant = Plant::alone(system.equations()?)?;
    let (mut commands, mut ports) = (Vec::<Vec<Command>>::new(), Vec::<(String, Layout)>::new());
    for input in &system.inputs {
        let mut sources = Vec::new();
        for signal in [&input.signal].into_iter().chain(&input.others) {
            let bound = signal.split_once('.').and_then(|(node, leaf)| {
                let layout = layout(node)?;
                Some((node.to_owned(), layout.leaf(leaf)?, layout))
            });
            let Some((port, leaf, layout)) = bound else {
                let (input, signal) = (input.name.clone(), signal.clone());
                return Err(EquationsError::Signal { file: file(), input, signal });
            };
            if !ports.iter().any(|(name, _)| *name == port) {
                ports.push((port.clone(), layout));
            }
            sources.push(Command { port, leaf });
        }
        commands.push(sources);
    }
    let mut outputs: Vec<String> = system.outputs.iter().map(|output| output.name.clone()).collect();
    let legal = |name: &str| {
        name.starts_with(|c: char| c.is_ascii_lowercase())
            && name.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_')
    };
    if let Some(output) = outputs.iter().find(|name| *name == "stamp" || !legal(name)) {
        return Err(EquationsError::Output { file: file(), output: output.clone() });
    }
    outputs.push("stamp".into());

    // Where one node's messages hold just these outputs, the system can stand in that node's place.
    let sensor = system.outputs.first().and_then(|output| output.signal.split_once('.'));
    let layout = sensor
        .and_then(|(node, _)| layout(node))
        .filter(|layout| layout.leaves == outputs)
        .unwrap_or(Layout { name: format!("system/{}", camel(&system.name)), leaves: outputs.clone() });
    let tick = Tick {
        name: system.name.clone(),
        parameters: system.parameters.iter().map(|parameter| parameter.name.clone()).collect(),
        states: plant.state_names().into_iter().chain(plant.memory_names()).collect(),
        outputs: outputs.clone(),
        commands,
        program: plant.tick_program(),
    };
    let nominal = plant.equations().nominal();
    let memory = plant.memory_names().len();
    let (parameters, states) = (system.parameters.clone(), system.states.clone());
    let start = move |context: &NodeContext| -> Result<ModelStart, NodeError> {
        let settings: Settings = context.parameters()?;
        let known = |names: &mut dyn Iterator<Item = &str>, given: &BTreeMap<String, f64>, what: &str| {
            let names: Vec<&str> = names.collect();
            match given.keys().find(|name| !names.contains(&name.as_str())) {
                Some(name) => Err(context.parameter_error(format!(
                    "the system has no {what} `{name}` (it has: {})",
                    names.join(", ")
                ))),
                None => Ok(()),
            }
        };
        known(&mut states.iter().map(|state| state.name.as_str()), &settings.initial, "state")?;
        known(&mut parameters.iter().map(|p| p.name.as_str()), &settings.parameters, "parameter")?;
        let values = parameters.iter().zip(&nominal);
        let mut params: Vec<f64> = values
            .map(|(p, nominal)| settings.parameters.get(&p.name).copied().unwrap_or(*nominal))
            .collect();
        let state = states.iter().map(|state| match (settings.initial.get(&state.name), &state.initial) {
            (Some(value), _) | (None, Initial::Fixed(value) | Initial::Calibrated { value, .. }) => {
                Ok(*value)
            }
            (None, Initial::Free | Initial::Signal(_)) => Err(context.parameter_error(format!(
                "the system leaves open where the state `{0}` starts; set `initial = {{ {0} = ... }}`",
                state.name
            ))),
        });
        let state: Vec<f64> = state.collect::<Result<_, _>>()?;
        // Nothing has been commanded yet; what remembers commands settles at the first one.
        let inputs = vec![0.0; plant.equations().system().inputs.len()];
        let mut state =
            plant.start(&Point { parameters: &params, states: &state, inputs: &inputs, time: 0.0 });
        state.resize(state.len() + memory, 0.0);
        params.push(1.0 / context.rate);
        Ok(ModelStart { params, state })
    };
    let initial = vec![0.0; outputs.len()];
    let model = ModelKind::flat(tick, start);
    let settable = |parameter: &Declared| Parameter::new(&parameter.name, &parameter.unit);
    let model = system.parameters.iter().map(settable).fold(model, ModelKind::with_settable);
    let kind = NodeKind::from_model(layout, initial, model);
    Ok(ports.into_iter().fold(kind, |kind, (name, layout)| kind.input_with_layout(name, layout)))
}

/// `two_link_arm` as `TwoLinkArm`, a message's name.
pub(crate) fn camel(name: &str) -> String {
    let parts = name.split(|c: char| !c.is_ascii_alphanumeric()).filter(|part| !part.is_empty());
    parts.map(|part| part[..1].to_ascii_uppercase() + &part[1..]).collect()
}

impl FlatModel for Tick {
    fn name(&self) -> &str {
        &self.name
    }
    fn params(&self) -> Vec<String> {
        self.parameters.iter().cloned().chain(["period".into()]).collect()
    }
    fn state(&self) -> Vec<String> {
        self.states.clone()
    }
    fn output(&self) -> Vec<String> {
        self.outputs.clone()
    }

    #[inline(always)]
    fn step<T: Scalar>(
        &self,
        params: &[T],
        state: &mut [T],
        step: &NodeStep<'_, T>,
        scratch: &mut Scratch<T>,
        output: &mut [T],
    ) {
        let (inputs, outputs) = (self.program.inputs().len(), self.program.outputs().len());
        scratch.values.resize(inputs + outputs, step.due);
        let (given, results) = scratch.values.split_at_mut(inputs);
        let (parameters, states) = (self.parameters.len(), self.states.len());
        given[..parameters].copy_from_slice(&params[..parameters]);
        given[parameters..parameters + states].copy_from_slice(state);
        for (place, sources) in given[parameters + states..].iter_mut().zip(&self.commands) {
            let sum = sources.iter().map(|s| step.leaf(&s.port, s.leaf)).reduce(|sum, value| sum + value);
            *place = sum.unwrap_or(T::constant(0.0)) / sources.len() as f64;
        }
        let first = T::select(step.seq.eq(T::constant(0.0)), T::constant(1.0), T::constant(0.0));
        given[inputs - 3..].copy_from_slice(&[step.due, params[parameters], first]);
        self.program.evaluate(given, &mut scratch.workspace, results);
        let (next, seen) = results.split_at(states);
        state.copy_from_slice(next);
        let (readings, stamp) = output.split_at_mut(seen.len());
        readings.copy_from_slice(seen);
        stamp[0] = step.due;
    }
}
