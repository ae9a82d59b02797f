//! A corrected system by itself, as a node of a graph, does what the diagnosis has it do.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use parallax::gap::bind::bind;
use parallax::gap::equations::EquationsSimulator;
use parallax::gap::simulator::{Prediction, Simulator, Transition};
use parallax::model::plant::Plant;
use parallax::model::system::System;
use parallax::nodes::{equations, pendulum};
use parallax::runtime::graph::GraphSpec;
use parallax::runtime::node::{ErasedNode, Layout, NodeError, Step};
use parallax::runtime::recording::Recording;
use parallax::runtime::registry::{NodeKind, Registry};
use parallax::runtime::time::{SECOND, to_seconds};
use parallax::sim::Executor;

/// Two nodes at 100 Hz; a command acts on the plant the moment that it is sent.
const GRAPH: &str = r#"
name = "loop"
supervisor = "camera"
[[node]]
name = "motor"
kind = "source"
rate = 100.0
[[node]]
name = "camera"
kind = "plant"
rate = 100.0
parameters = { initial = { q = 2.5, v = 0.0 } }
[[connection]]
from = "motor"
to = "camera"
blocking = true
"#;

/// Commands that reach the limits and reverse.
struct Source;

impl ErasedNode for Source {
    fn step_into(&mut self, step: &Step<'_>, output: &mut [f64]) -> Result<(), NodeError> {
        let t = to_seconds(step.due);
        let voltage = 2.0 + 3.0 * (3.0 * t).sin() + 1.5 * (11.0 * t).cos();
        output.copy_from_slice(&[voltage, voltage + 0.5 * t, voltage - 0.5 * t]);
        Ok(())
    }
}

/// The pendulum under the mean of two leaves, which differ by as much as they lie off it.
#[test]
fn an_input_may_be_the_mean_of_several_leaves() {
    let text = pendulum::SYSTEM.replace("initial = \"camera.angle\"", "");
    let mean = text.replace("signal = \"motor.voltage\"", "mean_of = [\"motor.above\", \"motor.below\"]");
    assert_ne!(text, mean);
    let angles = |text: &str| {
        let recording = record(&System::parse(text, "system.toml").unwrap());
        recording.log().signal("camera.angle").unwrap().values.clone()
    };
    let off = angles(&text).iter().zip(angles(&mean)).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(off < 1e-9, "{off} rad");
}

fn kinds(system: &System) -> Result<Registry, equations::EquationsError> {
    let voltage = Layout {
        name: "test/Voltage".into(),
        leaves: ["voltage", "above", "below"].map(str::to_owned).into(),
    };
    let layout = |node: &str| (node == "motor").then(|| voltage.clone());
    let plant = equations::kind(system, layout)?;
    let source = NodeKind::erased(voltage.clone(), vec![0.0; 3], |_| Ok(Box::new(Source)));
    Ok(Registry::new().with("source", source).with("plant", plant))
}

fn corrected(effects: &str) -> System {
    let text = pendulum::SYSTEM.replace("initial = \"camera.angle\"", "");
    System::parse(&format!("{text}\n{effects}"), "system.corrected.toml").unwrap()
}

/// One effect of every sort that can act without a recording.
const EFFECTS: &str = r#"
[[effect]]
name = "saturation"
place = "input:voltage"
parameters = { low = -1.2, high = 4.5 }
[[effect]]
name = "lag"
place = "input:voltage"
parameters = { time_constant = 0.03, damping = 0.5 }
[[effect]]
name = "backlash"
place = "input:voltage"
parameters = { gap = 0.3 }
[[effect]]
name = "coulomb"
place = "joint:shaft"
parameters = { force = 0.002 }
smoothing = 0.05
[[effect]]
name = "payload"
place = "joint:shaft"
parameters = { mass = 0.004 }
[[effect]]
name = "end_stop"
place = "joint:shaft"
parameters = { limit = 4.5, stiffness = 0.3 }
[[effect]]
name = "parameter"
place = "parameter:R"
parameters = { value = 8.1 }
[[effect]]
name = "saturation"
place = "state:v"
parameters = { low = -30.0, high = 9.0 }
[[effect]]
name = "sensor_lag"
place = "output:angle"
parameters = { time_constant = 0.02 }
[[effect]]
name = "drift"
place = "output:angle"
parameters = { rate = 0.01 }
"#;

fn record(system: &System) -> Recording {
    let graph = GraphSpec::from_toml(GRAPH).unwrap().validate(&kinds(system).unwrap()).unwrap();
    Executor::new(graph, 1).record(4 * SECOND).unwrap()
}

#[test]
fn a_corrected_system_as_a_node_equals_the_diagnosis_own_simulation() {
    for effects in ["", EFFECTS] {
        let system = corrected(effects);
        let recording = record(&system);
        let (equations, experiment) = bind(&system, &recording.log()).unwrap();
        let plant = Plant::new(equations, &[], Vec::new(), vec![0.05]);
        let simulator = EquationsSimulator::new(plant, Vec::new(), &experiment, 0.01);
        let (mut state, _) = simulator.start(&[2.5, 0.0], &[0.0; 2], 0.0);
        let mut run = simulator.run(&[]);
        let (mut prediction, mut transition) = (Prediction::default(), Transition::default());
        let mut readings = 0;
        for index in 0..run.events().len() {
            if let Some(reading) = run.events()[index].reading {
                run.observe(index, &state, &mut prediction);
                let off = (prediction.value - reading.value).abs();
                assert!(off < 1e-9, "{off} rad at {} s", reading.stamp);
                readings += 1;
            }
            if index + 1 < run.events().len() {
                run.advance(index, &mut state, &mut transition);
            }
        }
        assert!(readings >= 400, "{readings} readings");
    }
}

#[test]
fn every_effect_of_a_corrected_system_acts_in_its_node() {
    let angles =
        |effects: &str| record(&corrected(effects)).log().signal("camera.angle").unwrap().values.clone();
    let all = angles(EFFECTS);
    let entries: Vec<&str> = EFFECTS.split("[[effect]]").skip(1).collect();
    for left_out in 0..entries.len() {
        let kept = entries.iter().enumerate().filter(|(k, _)| *k != left_out);
        let kept: String = kept.map(|(_, entry)| format!("[[effect]]{entry}")).collect();
        let change = angles(&kept).iter().zip(&all).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(change > 1e-3, "without{} the angle differs by {change} rad", entries[left_out]);
    }
}

#[test]
fn what_cannot_act_in_a_node_is_named_with_the_reason() {
    let refused = |effect: &str, parts: &[&str]| {
        let system = corrected(&format!("[[effect]]\n{effect}\n"));
        let error = kinds(&system).err().unwrap().to_string();
        for part in parts.iter().chain(&["system.corrected.toml:"]) {
            assert!(error.contains(part), "no `{part}` in: {error}");
        }
    };
    refused(
        "name = \"delay\"\nplace = \"input:voltage\"\nparameters = { delay = 0.02 }",
        &["`delay` at input:voltage", "give the connection this delay"],
    );
    refused(
        "name = \"jitter\"\nplace = \"output:angle\"\nparameters = { spread = 0.01 }",
        &["`jitter` at output:angle", "by chance"],
    );
    refused(
        "name = \"supply_sag\"\nplace = \"input:voltage\"\nparameters = { exponent = 1.0 }",
        &["`supply_sag` at input:voltage", "recorded voltage"],
    );
    refused(
        "name = \"coulomb\"\nplace = \"joint:shaft\"\nparameters = { force = 0.002 }",
        &["`coulomb` at joint:shaft", "`smoothing = 0.001`"],
    );
}
