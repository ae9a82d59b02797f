//! The pendulum's graph: it is valid, its loop does what the agent wants, its world hides its effect well.

use std::collections::{BTreeSet, VecDeque};

use parallax_model::system::System;
use parallax_nodes::pendulum::hidden::HiddenEffect;
use parallax_nodes::pendulum::{Angle, Estimate, SYSTEM, Voltage, WorldState, graph, kinds};
use parallax_nodes::registry;
use parallax_runtime::graph::GraphSpec;
use parallax_runtime::node::{Consumed, ErasedNode, InputWindow, Message, NodeContext, Step};
use parallax_runtime::registry::Registry;
use parallax_runtime::time::{Nanos, SECOND, to_seconds};

const MS: Nanos = SECOND / 1000;

/// A node with its inputs, stepped by hand.
struct Bench {
    node: Box<dyn ErasedNode>,
    inputs: Vec<InputWindow>,
    output: Vec<f64>,
    steps: u64,
}

impl Bench {
    fn new(registry: &Registry, name: &str, parameters: serde_json::Value) -> Self {
        let kind = registry.get(&format!("pendulum/{name}")).expect("registered");
        let parameters = parameters.as_object().cloned().unwrap_or_default();
        let context = NodeContext { name: name.into(), rate: 100.0, seed: 7, parameters };
        Self {
            node: kind.build(&context).expect("the parameters are right"),
            inputs: kind
                .inputs()
                .iter()
                .map(|port| InputWindow::new(&port.name, port.layout.leaves.len(), 16))
                .collect(),
            output: vec![0.0; kind.output().leaves.len()],
            steps: 0,
        }
    }

    /// Messages for an input: number, sent, payload; the newest last.
    fn feed<'a, M: Message>(&mut self, port: &str, messages: impl Iterator<Item = &'a (u64, Nanos, M)>) {
        let input = self.inputs.iter_mut().find(|input| input.port() == port).expect("an input of this name");
        input.clear(0);
        input.push(Consumed::INITIAL, &M::default().to_vec());
        for (seq, sent, message) in messages {
            input.push(Consumed { seq: Some(*seq), sent: *sent, received: *sent }, &message.to_vec());
        }
    }

    fn step<M: Message>(&mut self, start: Nanos) -> M {
        self.node
            .step_into(&Step::new(self.steps, start, start, &self.inputs), &mut self.output)
            .expect("a step");
        self.steps += 1;
        M::read_from(&self.output)
    }
}

/// One row every 10 ms: true angle, estimate, voltage.
struct Row {
    time: f64,
    truth: WorldState,
    estimate: Estimate,
    voltage: f64,
}

/// The loop at the nodes' rates, with the camera's picture 3 ms old when the estimator sees it.
fn run(effect: HiddenEffect, agent: serde_json::Value, seconds: Nanos) -> Vec<Row> {
    let registry = kinds(Registry::new(), effect);
    let bench = |name: &str| Bench::new(&registry, name, serde_json::json!({}));
    let (mut world, mut camera, mut estimator, mut motor) =
        (bench("world"), bench("camera"), bench("estimator"), bench("motor"));
    let mut agent = Bench::new(&registry, "agent", agent);
    let mut commands: VecDeque<(u64, Nanos, Voltage)> = VecDeque::new();
    let mut wanted = Voltage::default();
    let mut rows = Vec::new();
    for tick in 0..(seconds * 100) as u64 {
        let time = tick as Nanos * 10 * MS;
        world.feed("motor", commands.iter());
        let truth: WorldState = world.step(time);
        camera.feed("world", [(tick, time, truth)].iter());
        let picture: Angle = camera.step(time + MS);
        estimator.feed("camera", [(tick, time + 3 * MS, picture)].iter());
        estimator.feed("motor", commands.iter());
        let estimate: Estimate = estimator.step(time + 3 * MS);
        if tick % 2 == 0 {
            agent.feed("estimator", [(tick, time + 3 * MS, estimate)].iter());
            wanted = agent.step(time + 4 * MS);
        }
        motor.feed("agent", [(tick, time + 5 * MS, wanted)].iter());
        let voltage: Voltage = motor.step(time + 5 * MS);
        commands.push_back((tick, time + 5 * MS, voltage));
        if commands.len() > 15 {
            commands.pop_front();
        }
        rows.push(Row { time: to_seconds(time), truth, estimate, voltage: voltage.voltage });
    }
    rows
}

fn apart(a: f64, b: f64) -> f64 {
    (a - b + std::f64::consts::PI).rem_euclid(std::f64::consts::TAU) - std::f64::consts::PI
}

#[test]
fn the_graph_is_valid_and_says_nothing_of_what_is_hidden() {
    let spec = graph();
    let plain = spec.validate(&registry()).expect("valid");
    assert!(plain.warnings().is_empty());
    assert_eq!(plain.nodes().iter().filter(|node| node.kind.is_stand_in()).count(), 1);
    let hiding = kinds(Registry::new(), HiddenEffect::draw(3));
    assert_eq!(spec.validate(&hiding).expect("valid").spec().to_json(), spec.to_json());
    assert_eq!(GraphSpec::from_toml(&spec.to_toml().expect("TOML")).expect("back"), spec);
}

#[test]
fn the_nominal_system_binds_signals_that_the_graph_records() {
    let system = System::parse(SYSTEM, "system.toml").expect("it parses");
    assert_eq!(system.inputs[0].signal, "motor.voltage");
    assert_eq!(system.outputs[0].signal, "camera.angle");
    let graph = graph().validate(&registry()).expect("valid");
    for signal in ["motor.voltage", "camera.angle"] {
        let (node, leaf) = signal.split_once('.').expect("NODE.LEAF");
        let node = graph.index(node).expect("a node of the graph");
        assert!(graph.nodes()[node].kind.output().leaf(leaf).is_some(), "{signal}");
    }
    // Hanging still without voltage is an equilibrium, and gravity brings it back there.
    let equations = system.equations().expect("every name is known");
    let acceleration = |angle: f64| {
        let point = parallax_model::system::Point {
            parameters: &equations.nominal(),
            states: &[angle, 0.0],
            inputs: &[0.0],
            time: 0.0,
        };
        equations.values(&point, &[]).derivatives[1]
    };
    assert!(acceleration(std::f64::consts::PI).abs() < 1e-9);
    assert!(acceleration(std::f64::consts::PI + 0.1) < -5.0);
    // Effects that the world may hide are placed where the system has such a place.
    for seed in 0..200 {
        if let Some(truth) = HiddenEffect::draw(seed).truth() {
            let (kind, key) = truth.place.split_once(':').expect("KIND:KEY");
            let names: Vec<&String> = match kind {
                "input" => system.inputs.iter().map(|input| &input.name).collect(),
                "output" => system.outputs.iter().map(|output| &output.name).collect(),
                "joint" => system.joints.iter().map(|joint| &joint.name).collect(),
                "parameter" => system.parameters.iter().map(|parameter| &parameter.name).collect(),
                other => panic!("no places of kind {other}"),
            };
            assert!(names.iter().any(|name| *name == key), "{truth}");
        }
    }
}

#[test]
fn every_sort_of_effect_is_drawn_and_one_seed_always_draws_the_same() {
    let sorts: BTreeSet<_> = (0..300)
        .map(|seed| HiddenEffect::draw(seed).truth().map(|truth| (truth.effect, truth.place)))
        .collect();
    assert_eq!(sorts.len(), HiddenEffect::SORTS);
    assert_eq!(HiddenEffect::draw(42), HiddenEffect::draw(42));
}

#[test]
fn the_agent_swings_it_up_and_balances_it() {
    let rows = run(HiddenEffect::None, serde_json::json!({"balance_only": true, "excitation": 0.0}), 10);
    let last = &rows[rows.len() - 300..];
    let worst = last.iter().map(|row| apart(row.truth.angle, 0.0).abs()).fold(0.0, f64::max);
    assert!(worst < 0.05, "balances within {worst} rad in the last three seconds");
}

#[test]
fn twenty_seconds_cover_what_tells_causes_apart() {
    let rows = run(HiddenEffect::None, serde_json::json!({}), 20);
    let share =
        |keep: &dyn Fn(&Row) -> bool| rows.iter().filter(|row| keep(row)).count() as f64 / rows.len() as f64;
    for (what, part) in [
        ("hangs", share(&|row| row.truth.angle.cos() < -0.7)),
        ("is level", share(&|row| row.truth.angle.cos().abs() < 0.7)),
        ("is up", share(&|row| row.truth.angle.cos() > 0.7)),
        ("slow", share(&|row| row.truth.speed.abs() < 2.0)),
        ("fast forward", share(&|row| row.truth.speed > 8.0)),
        ("fast backward", share(&|row| row.truth.speed < -8.0)),
        ("small voltage", share(&|row| row.voltage.abs() < 0.5)),
        ("large positive voltage", share(&|row| row.voltage > 2.8)),
        ("large negative voltage", share(&|row| row.voltage < -2.8)),
    ] {
        assert!(part > 0.03, "{what}: {:.1} % of the time", 100.0 * part);
    }
    let reversals = rows.windows(2).filter(|pair| pair[0].truth.speed * pair[1].truth.speed < 0.0).count();
    assert!(reversals > 40, "{reversals} reversals");
}

#[test]
fn without_an_effect_the_nominal_equations_predict_the_world() {
    let system = System::parse(SYSTEM, "system.toml").expect("it parses");
    let equations = system.equations().expect("every name is known");
    let mut parameters = equations.nominal();
    for (name, true_value) in [("J", 1.62e-4), ("K", 0.0337)] {
        let index =
            system.parameters.iter().position(|parameter| parameter.name == name).expect("a parameter");
        let [low, high] = system.parameters[index].calibrate.expect("the fit may move it");
        assert!((low..high).contains(&true_value));
        parameters[index] = true_value;
    }
    let rows = run(HiddenEffect::None, serde_json::json!({}), 20);
    let mut worst = 0.0f64;
    for start in (1..rows.len() - 25).step_by(25) {
        let mut x = [rows[start].truth.angle, rows[start].truth.speed];
        // A quarter of a second; commands change 5 ms after every row.
        for step in 0..50 {
            let voltage = rows[start + usize::div_ceil(step, 2) - 1].voltage;
            let slope = |x: &[f64; 2]| {
                let point = parallax_model::system::Point {
                    parameters: &parameters,
                    states: x,
                    inputs: &[voltage],
                    time: 0.0,
                };
                let derivatives = equations.values(&point, &[]).derivatives;
                [derivatives[0], derivatives[1]]
            };
            x = parallax_model::integrate::rk4_steps(slope, x, 0.005, 5);
        }
        worst = worst.max((x[0] - rows[start + 25].truth.angle).abs());
    }
    assert!(worst < 1e-4, "off by {worst} rad after 0.25 s, with noise of 1.5e-3 rad");
}

#[test]
fn the_agent_balances_while_it_shakes() {
    let rows = run(HiddenEffect::None, serde_json::json!({}), 5);
    let last = &rows[400..];
    let up = last.iter().filter(|row| apart(row.truth.angle, 0.0).abs() < 0.4).count();
    assert!(up as f64 > 0.9 * last.len() as f64, "upright in {up} of {} rows", last.len());
}

#[test]
fn the_estimator_knows_where_the_pendulum_is_now() {
    let rows = run(HiddenEffect::None, serde_json::json!({}), 20);
    // The estimate is for 3 ms later than the truth of the same row: carry the truth on by its speed.
    let errors = rows.iter().skip(50).map(|row| {
        let later = row.truth.angle + row.truth.speed * (row.estimate.stamp - row.time);
        apart(row.estimate.angle, later)
    });
    let square: f64 = errors.clone().map(|error| error * error).sum::<f64>() / (rows.len() - 50) as f64;
    assert!(square.sqrt() < 2.5e-3, "root mean square error {} rad", square.sqrt());
}

#[test]
fn the_loop_stays_whole_under_every_effect_and_each_shows() {
    use parallax_runtime::random::{Purpose, stream};
    let calm = run(HiddenEffect::None, serde_json::json!({}), 2);
    for sort in 1..HiddenEffect::SORTS {
        let effect = HiddenEffect::draw_sort(sort, &mut stream(5, Purpose::Node, "sizes"));
        let rows = run(effect, serde_json::json!({}), 2);
        let truth = effect.truth().expect("an effect");
        assert!(rows.iter().all(|row| row.truth.speed.abs() < 60.0), "{truth}: it runs away");
        let far = rows
            .iter()
            .zip(&calm)
            .map(|(a, b)| apart(a.truth.angle, b.truth.angle).abs())
            .fold(0.0, f64::max);
        assert!(far > 0.02, "{truth} changes the angle by {far} rad only");
    }
}

#[test]
fn wrong_parameters_are_refused() {
    let registry = registry();
    for (kind, parameters) in [
        ("motor", serde_json::json!({"rated": -1.0})),
        ("camera", serde_json::json!({"noise": -1.0})),
        ("camera", serde_json::json!({"nose": 1.0})),
        ("estimator", serde_json::json!({"noise": 0.0})),
        ("agent", serde_json::json!({"limit": 0.0})),
        ("pid", serde_json::json!({"proportional": 1.0, "limits": [1.0, -1.0]})),
    ] {
        let context = NodeContext {
            name: kind.into(),
            rate: 100.0,
            seed: 0,
            parameters: parameters.as_object().cloned().expect("a table"),
        };
        let error = registry.get(&format!("pendulum/{kind}")).expect("registered").build(&context).err();
        assert!(error.is_some_and(|error| error.to_string().contains(kind)), "{kind} {parameters}");
    }
}
