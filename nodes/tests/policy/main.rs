//! Policies from files: the numbers are numpy's, and files that are none are named with what is wrong.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::collections::HashMap;
use std::path::Path;

use parallax_nodes::pendulum::{Estimate, Voltage};
use parallax_nodes::policy::Policy;
use parallax_nodes::{pendulum, registry};
use safetensors::tensor::{Dtype, TensorView, serialize};

type Pendulum = Policy<Estimate, Voltage>;

/// Made by `fixture.py`, with what numpy computes.
const FIXTURE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/policy/policy.safetensors");
const EXPECTED: &str = include_str!("expected.csv");

#[test]
fn numbers_are_those_of_numpy() {
    let mut policy = Pendulum::read(Path::new(FIXTURE)).unwrap();
    let (mut rows, mut least, mut most) = (0, f64::INFINITY, f64::NEG_INFINITY);
    for line in EXPECTED.lines().skip(1) {
        let row: Vec<f64> = line.split(',').map(|cell| cell.parse().unwrap()).collect();
        let got = policy.act(&[row[0], row[1], 0.0]).unwrap().voltage;
        assert!((got - row[2]).abs() < 1e-12, "{got} for {line}");
        (rows, least, most) = (rows + 1, least.min(got), most.max(got));
    }
    assert!(rows == 50 && most - least > 1.0, "the policy must not be a constant");
}

#[test]
fn it_takes_the_agents_place_in_the_graph() {
    let mut graph = pendulum::graph();
    let agent = graph.node_mut("agent").unwrap();
    agent.kind = "pendulum/policy".into();
    agent.parameters = serde_json::from_value(serde_json::json!({ "file": FIXTURE })).unwrap();
    for connection in graph.connections.iter_mut().filter(|connection| connection.to == "agent") {
        connection.port = Some("observation".into());
    }
    let graph = graph.validate(&registry()).unwrap();
    graph.build(graph.index("agent").unwrap(), 1).unwrap();
}

#[test]
fn what_is_no_number_is_an_error() {
    let mut policy = Pendulum::read(Path::new(FIXTURE)).unwrap();
    let error = policy.act(&[0.0, f64::NAN, 0.0]).unwrap_err().to_string();
    assert!(error.contains("speed") && error.contains("NaN"), "{error}");
    assert!(policy.act(&[0.0, 1.0, f64::NAN]).is_ok(), "the stamp is no observation here");
}

struct File {
    tensors: Vec<(String, Vec<usize>, Vec<f64>)>,
    metadata: HashMap<String, String>,
}

/// Two inputs, three in the middle, one output.
fn file() -> File {
    let tensor = |name: &str, shape: &[usize]| {
        let count = shape.iter().product();
        (name.to_owned(), shape.to_vec(), (0..count).map(|i| 0.1 * i as f64).collect())
    };
    let tensors = vec![
        tensor("layers.0.weight", &[3, 2]),
        tensor("layers.0.bias", &[3]),
        tensor("layers.1.weight", &[1, 3]),
    ];
    let metadata = [("format", "parallax-policy-1"), ("activation", "relu")];
    File { tensors, metadata: metadata.map(|(key, value)| (key.into(), value.into())).into() }
}

impl File {
    fn with(mut self, key: &str, value: &str) -> Self {
        self.metadata.insert(key.into(), value.into());
        self
    }

    fn without(mut self, name: &str) -> Self {
        self.metadata.remove(name);
        self.tensors.retain(|(tensor, ..)| tensor != name);
        self
    }

    fn shaped(mut self, name: &str, shape: &[usize]) -> Self {
        let values = vec![0.5; shape.iter().product()];
        self.tensors.retain(|(tensor, ..)| tensor != name);
        self.tensors.push((name.into(), shape.to_vec(), values));
        self
    }

    fn write(&self, path: &Path) {
        let bytes: Vec<Vec<u8>> = self
            .tensors
            .iter()
            .map(|(.., values)| values.iter().flat_map(|v| v.to_le_bytes()).collect())
            .collect();
        let views = self.tensors.iter().zip(&bytes).map(|((name, shape, _), bytes)| {
            (name.clone(), TensorView::new(Dtype::F64, shape.clone(), bytes).unwrap())
        });
        std::fs::write(path, serialize(views, Some(self.metadata.clone())).unwrap()).unwrap();
    }

    fn read(&self) -> Result<Pendulum, String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("policy.safetensors");
        self.write(&path);
        Pendulum::read(&path).map_err(|error| error.to_string())
    }
}

#[test]
fn a_file_without_names_takes_the_leaves_as_they_come() {
    let mut policy = file().read().unwrap();
    // relu(W0 [angle, speed] + b0), then W1: by hand.
    let got = policy.act(&[1.0, 2.0, 99.0]).unwrap().voltage;
    let hidden = [0.0 * 1.0 + 0.1 * 2.0, 0.2 + 0.3 * 2.0 + 0.1, 0.4 + 0.5 * 2.0 + 0.2];
    assert!((got - (0.1 * hidden[1] + 0.2 * hidden[2])).abs() < 1e-15, "{got}");
}

#[test]
fn a_history_is_what_it_saw_and_did_newest_first() {
    // One input a unit wide for each number of the history, so that the action tells what stood where.
    let places: Vec<f64> = (0..6).map(|place| 10_f64.powi(place)).collect();
    let mut file = file().without("layers.0.weight").without("layers.0.bias").without("layers.1.weight");
    file.tensors.push(("layers.0.weight".into(), vec![1, 6], places));
    let mut policy = file
        .with("activation", "none")
        .with("observations", "[\"angle\"]")
        .with("past_observations", "3")
        .with("past_actions", "2")
        .with("action_scale", "[1e-6]")
        .read()
        .unwrap();
    let mut seen: Vec<f64> = Vec::new();
    let mut sent: Vec<f64> = Vec::new();
    for angle in [3.0, 1.0, 4.0, 1.5, 9.0] {
        let got = policy.act(&[angle, 0.0, 0.0]).unwrap().voltage;
        let observation = |age: usize| match age {
            0 => angle,
            _ => seen.iter().rev().nth(age - 1).copied().unwrap_or(*seen.first().unwrap_or(&angle)),
        };
        let action = |age: usize| sent.iter().rev().nth(age - 1).copied().unwrap_or(0.0);
        let expected: f64 = (0..4).map(|age| 10_f64.powi(age as i32) * observation(age)).sum::<f64>()
            + 1e4 * action(1)
            + 1e5 * action(2);
        assert!((got - expected * 1e-6).abs() < 1e-12, "{got} instead of {}", expected * 1e-6);
        seen.push(angle);
        sent.push(got);
    }
}

#[test]
fn what_is_wrong_with_a_file_is_said() {
    let cases = [
        (file().without("format"), "`format` is missing"),
        (file().with("format", "onnx"), "`onnx`"),
        (file().without("activation"), "`activation` is missing; it is one of: none"),
        (file().with("activation", "sine"), "`sine`; it is one of"),
        (file().with("observation_men", "[0]"), "`observation_men`"),
        (file().with("observations", "angle"), "no JSON list of names"),
        (file().with("observations", "[\"angle\", \"sped\"]"), "`sped`, which is no leaf"),
        (file().with("observations", "[\"angle\"]"), "2 inputs, and there are 1 observations: angle"),
        (file().with("observations", "[]").with("past_actions", "2"), "has to see something"),
        (file().with("past_actions", "two"), "`two`; it should be a whole number"),
        (file().with("past_observations", "1").with("past_actions", "2"), "past actions that makes 6"),
        (file().with("past_observations", "18446744073709551615"), "2 inputs, and there are 2 observations"),
        (file().with("actions", "[\"torque\"]"), "`torque`"),
        (file().with("actions", "[\"voltage\", \"voltage\"]"), "twice"),
        (file().with("observation_mean", "[0.0]"), "1 numbers, and the network 2"),
        (file().with("observation_std", "[1.0, 0.0]"), "positive"),
        (file().with("observation_clip", "-1"), "positive number"),
        (file().with("action_low", "[2]").with("action_high", "[1]"), "above the 1"),
        (file().without("layers.0.weight"), "`layers.0.weight` is missing; the file has: layers.0.bias"),
        (file().shaped("layers.1.weight", &[1, 4]), "4 inputs, and the layer before it 3 outputs"),
        (file().shaped("layers.0.bias", &[2]), "[2]; its layer has 3 outputs"),
        (file().shaped("layers.0.weight", &[3]), "outputs × inputs"),
        (file().shaped("layers.1.weight", &[2, 3]), "2 outputs, and there are 1 actions: voltage"),
        (file().shaped("layers.3.weight", &[1, 1]), "`layers.3.weight` belongs to none of the 2 layers"),
        (file().shaped("value.weight", &[1, 1]), "`value.weight`"),
    ];
    for (file, expected) in cases {
        let error = file.read().err().unwrap_or_else(|| panic!("accepted instead of: {expected}"));
        assert!(
            error.contains(expected) && error.contains("policy.safetensors"),
            "{error}\nwants: {expected}"
        );
    }
    let mut broken = file();
    broken.tensors[0].2[3] = f64::INFINITY;
    assert!(broken.read().unwrap_err().contains("inf at place 3"));

    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("policy.safetensors");
    assert!(Pendulum::read(&path).unwrap_err().to_string().contains("cannot be read"));
    file().write(&path);
    let bytes = std::fs::read(&path).unwrap();
    for cut in [0, 4, 8, 60, bytes.len() - 1] {
        std::fs::write(&path, &bytes[..cut]).unwrap();
        let error = Pendulum::read(&path).unwrap_err().to_string();
        assert!(error.contains("no safetensors file"), "{error}");
    }
}
