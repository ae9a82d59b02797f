//! The kind `estimator`: an estimator of any `system.toml`.

use std::path::Path;

use parallax_model::filter::{Compensation, Compensator, PlantProcess, Process, Scaling, Source};
use parallax_model::plant::Plant;
use parallax_model::system::{Initial, Input, System};
use parallax_runtime::graph::{GraphSpec, NodeSpec};
use parallax_runtime::node::Layout;
use parallax_runtime::registry::NodeKind;

use super::bands::bands;
use super::model::{Count, Estimator, Listened, Shown};
use super::settings::{EstimatorError, Points, Sends, Settings, check, known};

/// The name of the kind.
const KIND: &str = "estimator";

/// A kind of node that estimates the states of a `system.toml`. Its ports are the nodes whose leaves the system's inputs and
/// outputs name, its message holds the states, `stamp` (the time that they are for, s), their deviations `STATE_std`, the last
/// normalised innovation squared `nis` with its 95 % band `nis_low` and `nis_high`, and counts: `updates`, those `outside` of the
/// band, readings that came too `late`, steps that were `blind` to commands they had to know, covariances `repaired`. `sends`
/// replaces it by a message of another name with some of these.
pub fn kind() -> NodeKind {
    NodeKind::by_graph(|spec, node, layout| shape(spec, node, layout).map_err(|error| error.to_string()))
}

/// Puts the text of the `system` that each estimator names into the graph, so that a recording holds all that a replay needs.
/// Files are relative to `folder`. A graph that holds the text already, such as one that was identified, keeps it.
///
/// # Errors
///
/// [`EstimatorError::File`].
pub fn embed(spec: &mut GraphSpec, folder: &Path) -> Result<(), EstimatorError> {
    let without_text = |node: &&mut NodeSpec| node.kind == KIND && !node.parameters.contains_key("equations");
    for node in spec.nodes.iter_mut().filter(without_text) {
        let Some(file) = node.parameters.get("system").and_then(|file| file.as_str()) else { continue };
        let text = read(&folder.join(file))?;
        node.parameters.insert("equations".into(), text.into());
    }
    Ok(())
}

fn read(path: &Path) -> Result<String, EstimatorError> {
    let file = || path.display().to_string();
    std::fs::read_to_string(path).map_err(|source| EstimatorError::File { file: file(), source })
}

fn system(settings: &Settings, spec: &GraphSpec) -> Result<System, EstimatorError> {
    let (text, file) = match (&settings.equations, &settings.system, &spec.plant) {
        (Some(text), file, _) => (text.clone(), file.clone().unwrap_or("equations".into())),
        (None, Some(file), _) => (read(Path::new(file))?, file.clone()),
        (None, None, Some(plant)) => (plant.system.clone(), "the graph's plant".into()),
        (None, None, None) => return Err(EstimatorError::NoSystem),
    };
    Ok(System::parse(&text, &file)?)
}

/// Ports, as signals name them.
struct Ports<'a> {
    file: &'a str,
    layout: &'a dyn Fn(&str) -> Option<Layout>,
    found: Vec<(String, Layout)>,
}

impl Ports<'_> {
    /// The node and the leaf that a signal names.
    fn resolve(&mut self, what: &str, signal: &str) -> Result<(String, usize), EstimatorError> {
        let bound = signal.split_once('.').and_then(|(node, leaf)| {
            let layout = (self.layout)(node)?;
            Some((node.to_owned(), layout.leaf(leaf)?, layout))
        });
        let Some((node, leaf, layout)) = bound else {
            return Err(EstimatorError::Signal {
                file: self.file.to_owned(),
                what: what.to_owned(),
                signal: signal.to_owned(),
            });
        };
        if !self.found.iter().any(|(name, _)| *name == node) {
            self.found.push((node.clone(), layout));
        }
        Ok((node, leaf))
    }

    fn stamp(&self, node: &str) -> Option<usize> {
        self.found.iter().find(|(name, _)| name == node).and_then(|(_, layout)| layout.leaf("stamp"))
    }
}

/// The actuators of a system, and which of their leaves each input is.
fn actuators(
    inputs: &[Input],
    ports: &mut Ports<'_>,
) -> Result<(Vec<Listened>, Vec<Vec<Source>>), EstimatorError> {
    let (mut actuators, mut sources) = (Vec::<Listened>::new(), Vec::new());
    for input in inputs {
        let mut of = Vec::new();
        for signal in [&input.signal].into_iter().chain(&input.others) {
            let (port, place) = ports.resolve(&format!("input `{}`", input.name), signal)?;
            let actuator = actuators.iter().position(|known| known.port == port).unwrap_or_else(|| {
                actuators.push(Listened { stamp: ports.stamp(&port), port, leaves: Vec::new() });
                actuators.len() - 1
            });
            let leaves = &mut actuators[actuator].leaves;
            let leaf = leaves.iter().position(|known| *known == place).unwrap_or_else(|| {
                leaves.push(place);
                leaves.len() - 1
            });
            of.push(Source { actuator, leaf });
        }
        sources.push(of);
    }
    Ok((actuators, sources))
}

fn shape(
    spec: &GraphSpec,
    node: &NodeSpec,
    layout: &dyn Fn(&str) -> Option<Layout>,
) -> Result<NodeKind, EstimatorError> {
    let settings: Settings = serde_json::from_value(serde_json::Value::Object(node.parameters.clone()))?;
    let system = system(&settings, spec)?;
    let plant = Plant::alone(system.equations()?)?;
    let process = PlantProcess::new(&plant);

    let mut ports = Ports { file: &system.file, layout, found: Vec::new() };
    let mut sensors: Vec<Listened> = Vec::new();
    let mut readings: Vec<Vec<usize>> = Vec::new();
    for (index, output) in system.outputs.iter().enumerate() {
        let (port, leaf) = ports.resolve(&format!("output `{}`", output.name), &output.signal)?;
        let sensor = sensors.iter().position(|known| known.port == port).unwrap_or_else(|| {
            sensors.push(Listened { stamp: ports.stamp(&port), port, leaves: Vec::new() });
            readings.push(Vec::new());
            sensors.len() - 1
        });
        sensors[sensor].leaves.push(leaf);
        readings[sensor].push(index);
    }
    let (actuators, inputs) = actuators(&system.inputs, &mut ports)?;
    let found = ports.found;

    let states = process.state_names().to_vec();
    let state_names = || states.iter().map(String::as_str);
    known("parameters", &settings.parameters, system.parameters.iter().map(|p| p.name.as_str()))?;
    known("noise", &settings.noise, system.outputs.iter().map(|output| output.name.as_str()))?;
    known("disturbance", &settings.disturbance, state_names())?;
    known("delay", &settings.delay, found.iter().map(|(name, _)| name.as_str()))?;
    known("initial", &settings.initial, state_names())?;
    known("std", &settings.std, state_names())?;
    known("circular", &settings.circular, state_names())?;

    let mut mean = Vec::with_capacity(states.len());
    let mut std = Vec::with_capacity(states.len());
    for (index, name) in states.iter().enumerate() {
        let stated = match system.states.get(index).map(|state| &state.initial) {
            // What effects add is at rest at first.
            None => Some(0.0),
            Some(Initial::Fixed(value) | Initial::Calibrated { value, .. }) => Some(*value),
            Some(Initial::Free | Initial::Signal(_)) => None,
        };
        let missing = |table, why| EstimatorError::Missing { table, name: name.clone(), why };
        let value = settings.initial.get(name).copied().or(stated);
        mean.push(value.ok_or_else(|| missing("initial", "the system leaves open where it starts"))?);
        let value = settings.std.get(name).copied().or(system.states.get(index).is_none().then_some(0.0));
        let value = value.ok_or_else(|| missing("std", "how far from `initial` it may be at first"))?;
        std.push(check(format!("std.{name}"), value, true)?);
    }
    if settings.disturbance.is_empty() {
        return Err(EstimatorError::Missing {
            table: "disturbance",
            name: states.last().cloned().unwrap_or_default(),
            why: "without noise that drives it a filter comes to believe itself alone",
        });
    }
    let disturbed: Vec<usize> =
        (0..states.len()).filter(|state| settings.disturbance.contains_key(&states[*state])).collect();

    // Parameters of the model, in the order of its names.
    let nominal = plant.equations().nominal();
    let declared = system.parameters.iter().zip(nominal);
    let mut params: Vec<f64> =
        declared.map(|(p, nominal)| settings.parameters.get(&p.name).copied().unwrap_or(nominal)).collect();
    for output in &system.outputs {
        let value = settings.noise.get(&output.name).copied().or(output.noise);
        let (table, name) = ("noise", output.name.clone());
        let why = "the system does not state the noise of its sensor";
        let value = value.ok_or(EstimatorError::Missing { table, name, why })?;
        params.push(check(format!("noise.{}", output.name), value, false)?);
    }
    for state in &disturbed {
        let name = &states[*state];
        params.push(check(format!("disturbance.{name}"), settings.disturbance[name], true)?);
    }
    for port in sensors.iter().chain(&actuators).map(|node| &node.port) {
        let value = settings.delay.get(port).copied().unwrap_or(0.0);
        params.push(check(format!("delay.{port}"), value, true)?);
    }
    params.push(check("ahead".into(), settings.ahead, true)?);

    let Points { alpha, beta, kappa } = settings.scaling;
    let how = Compensation {
        scaling: Scaling { alpha, beta, kappa },
        disturbed,
        wraps: system.outputs.iter().map(|output| output.wrap).collect(),
        circular: states.iter().map(|state| settings.circular.get(state).copied()).collect(),
        sensors: readings,
        actuators: actuators.iter().map(|actuator| actuator.leaves.len()).collect(),
        inputs,
        step: settings.step,
        steps: settings.steps,
        reorder: settings.reorder,
        mean,
        std,
        bands: bands(process.outputs()),
    };
    let (layout, message) = message(&system.name, &states, settings.sends.as_ref())?;
    let estimator = Estimator {
        name: system.name.clone(),
        compensator: Compensator::new(process, how)?,
        parameters: system.parameters.iter().map(|parameter| parameter.name.clone()).collect(),
        states,
        readings: system.outputs.iter().map(|output| output.name.clone()).collect(),
        sensors,
        actuators,
        predicts: settings.predict,
        message,
    };
    let kind = estimator.kind(layout, params);
    Ok(found.into_iter().fold(kind, |kind, (name, layout)| kind.input_with_layout(name, layout)))
}

/// The estimator's message: its own, or what `sends` says.
fn message(
    system: &str,
    states: &[String],
    sends: Option<&Sends>,
) -> Result<(Layout, Vec<(String, Shown)>), EstimatorError> {
    let mut own: Vec<(String, Shown)> = Vec::new();
    own.extend(states.iter().enumerate().map(|(k, state)| (state.clone(), Shown::State(k))));
    own.push(("stamp".into(), Shown::Stamp));
    own.extend(states.iter().enumerate().map(|(k, state)| (format!("{state}_std"), Shown::Std(k))));
    own.extend([
        ("nis".into(), Shown::Nis),
        ("nis_low".into(), Shown::NisLow),
        ("nis_high".into(), Shown::NisHigh),
        ("updates".into(), Shown::Count(Count::Updates)),
        ("outside".into(), Shown::Count(Count::Outside)),
        ("late".into(), Shown::Count(Count::Late)),
        ("blind".into(), Shown::Count(Count::Blind)),
        ("repaired".into(), Shown::Count(Count::Repaired)),
    ]);
    let leaves = |message: &[(String, Shown)]| message.iter().map(|(name, _)| name.clone()).collect();
    let Some(Sends { message, leaves: names, values }) = sends else {
        let legal = |name: &str| {
            name.starts_with(|c: char| c.is_ascii_lowercase())
                && name.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_')
        };
        let twice = |name: &String| own.iter().filter(|(other, _)| other == name).count() > 1;
        if let Some(state) = states.iter().find(|state| !legal(state) || twice(state)) {
            return Err(EstimatorError::Leaf { state: state.clone() });
        }
        let layout =
            Layout { name: format!("estimator/{}", crate::equations::camel(system)), leaves: leaves(&own) };
        return Ok((layout, own));
    };
    if names.len() != values.len() {
        return Err(EstimatorError::Sends { leaves: names.len(), values: values.len() });
    }
    let chosen = names.iter().zip(values).map(|(leaf, value)| {
        let shown = own.iter().find(|(name, _)| name == value).map(|(_, shown)| *shown);
        let known = || own.iter().map(|(name, _)| name.as_str()).collect::<Vec<_>>().join(", ");
        let (table, name) = ("sends.values", value.clone());
        shown.map(|shown| (leaf.clone(), shown)).ok_or_else(|| EstimatorError::Unknown {
            table,
            name,
            known: known(),
        })
    });
    let chosen = chosen.collect::<Result<Vec<_>, _>>()?;
    Ok((Layout { name: message.clone(), leaves: names.clone() }, chosen))
}
