//! A system described by equations as a node: it simulates the stretch of a graph that no node records.
//!
//! A `system.toml` binds its inputs to signals `NODE.LEAF`. [`kind`] makes a kind of node with one port for every such
//! node, which integrates the equations from tick to tick. Message k holds the outputs at tick k, under the commands
//! seen then, and `stamp`, the time of the tick; the commands hold until the next tick.
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
use parallax_model::program::{Program, Workspace};
use parallax_model::system::{Equations, Initial, System, SystemError};
use parallax_model::trace::{Traced, trace_fn};
use parallax_runtime::model_node::{ModelKind, ModelStart};
use parallax_runtime::node::{Layout, NodeContext, NodeError};
use parallax_runtime::registry::NodeKind;
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
    /// A recorded departure from the equations needs more than the equations.
    #[error(
        "{file}, line {line}: a node cannot have the effect `{effect}` yet; take it out of this copy of the file"
    )]
    Effect {
        /// The file.
        file: String,
        /// The line.
        line: usize,
        /// The effect.
        effect: String,
    },
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
    commands: Vec<Command>,
    /// From parameters, states, commands, time and period to the next states and the outputs of now.
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
/// a nominal value.
///
/// # Errors
///
/// [`EquationsError`] when the system is not whole, or an input is not bound to a leaf of a node.
pub fn kind(system: &System, layout: impl Fn(&str) -> Option<Layout>) -> Result<NodeKind, EquationsError> {
    let file = || system.file.clone();
    if let Some(effect) = system.effects.first() {
        let (line, effect) = (effect.line, effect.name.clone());
        return Err(EquationsError::Effect { file: file(), line, effect });
    }
    let equations = system.equations()?;
    let (mut commands, mut ports) = (Vec::new(), Vec::<(String, Layout)>::new());
    for input in &system.inputs {
        let bound = input.signal.split_once('.').and_then(|(node, leaf)| {
            let layout = layout(node)?;
            Some((node.to_owned(), layout.leaf(leaf)?, layout))
        });
        let Some((port, leaf, layout)) = bound else {
            let (input, signal) = (input.name.clone(), input.signal.clone());
            return Err(EquationsError::Signal { file: file(), input, signal });
        };
        if !ports.iter().any(|(name, _)| *name == port) {
            ports.push((port.clone(), layout));
        }
        commands.push(Command { port, leaf });
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
        states: system.states.iter().map(|state| state.name.clone()).collect(),
        outputs: outputs.clone(),
        commands,
        program: tick_program(&equations),
    };
    let nominal = equations.nominal();
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
        params.push(1.0 / context.rate);
        let state = states.iter().map(|state| match (settings.initial.get(&state.name), &state.initial) {
            (Some(value), _) | (None, Initial::Fixed(value) | Initial::Calibrated { value, .. }) => {
                Ok(*value)
            }
            (None, Initial::Free | Initial::Signal(_)) => Err(context.parameter_error(format!(
                "the system leaves open where the state `{0}` starts; set `initial = {{ {0} = ... }}`",
                state.name
            ))),
        });
        Ok(ModelStart { params, state: state.collect::<Result<_, _>>()? })
    };
    let initial = vec![0.0; outputs.len()];
    let kind = NodeKind::from_model(layout, initial, ModelKind::flat(tick, start));
    Ok(ports.into_iter().fold(kind, |kind, (name, layout)| kind.input_with_layout(name, layout)))
}

/// From parameters, states, commands, time and period to the next states and the outputs of now: one step of the classical
/// Runge–Kutta method, with the equations as a function that is called four times.
fn tick_program(equations: &Equations) -> Program {
    let system = equations.system();
    let program = equations.program();
    let (parameters, states) = (system.parameters.len(), system.states.len());
    let mut inputs = program.inputs().to_vec();
    inputs.push("period".into());
    let mut outputs: Vec<String> =
        system.states.iter().map(|state| format!("state.{}", state.name)).collect();
    outputs.extend(system.outputs.iter().map(|output| format!("output.{}", output.name)));
    trace_fn(&system.name, &inputs, &outputs, |all| {
        let (before, period) = all.split_at(all.len() - 1);
        let period = period[0];
        let evaluate = |x: &[Traced], after: Option<Traced>| {
            let mut point = before.to_vec();
            point[parameters..parameters + states].copy_from_slice(x);
            if let (Some(after), Some(time)) = (after, point.last_mut()) {
                *time += after;
            }
            let mut values = vec![Traced::constant(0.0); program.outputs().len()];
            Traced::call_values("equations", &point, &mut values, |point, values| {
                program.evaluate(point, &mut Workspace::new(), values);
            });
            values
        };
        let along = |x: &[Traced], slope: &[Traced], dt: Traced| -> Vec<Traced> {
            x.iter().zip(slope).map(|(x, slope)| *x + *slope * dt).collect()
        };
        let x = before[parameters..parameters + states].to_vec();
        let half = period * 0.5;
        let now = evaluate(&x, None);
        let k1 = &now[..states];
        let k2 = evaluate(&along(&x, k1, half), Some(half));
        let k3 = evaluate(&along(&x, &k2, half), Some(half));
        let k4 = evaluate(&along(&x, &k3, period), Some(period));
        let mut out: Vec<Traced> =
            (0..states).map(|i| x[i] + (k1[i] + k4[i] + (k2[i] + k3[i]) * 2.0) * (period / 6.0)).collect();
        out.extend(&now[states..]);
        out
    })
}

/// `two_link_arm` as `TwoLinkArm`, a message's name.
fn camel(name: &str) -> String {
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
        for (place, command) in given[parameters + states..].iter_mut().zip(&self.commands) {
            *place = step.leaf(&command.port, command.leaf);
        }
        given[inputs - 2] = step.due;
        given[inputs - 1] = params[parameters];
        self.program.evaluate(given, &mut scratch.workspace, results);
        let (next, seen) = results.split_at(states);
        state.copy_from_slice(next);
        let (readings, stamp) = output.split_at_mut(seen.len());
        readings.copy_from_slice(seen);
        stamp[0] = step.due;
    }
}
