//! The graphs that are timed: one text each, which the Python package reads too, and the kinds of node that only they need.

use anyhow::Context;
use parallax_model::Scalar;
use parallax_model::Tree;
use parallax_model::node_model::{NodeModel, NodeStep};
use parallax_nodes::models::{pendulum, quadrotor as quad};
use parallax_nodes::pendulum::{Estimate, WorldState};
use parallax_nodes::quadrotor::{Command, Motion};
use parallax_runtime::delay::Delay;
use parallax_runtime::graph::{ConnectionSpec, Graph, GraphSpec, NodeSpec};
use parallax_runtime::node::{Message, Port};
use parallax_runtime::registry::{NodeKind, Registry};

use crate::draws::Draws;

/// A system that is timed.
pub(crate) struct Case {
    /// Its name.
    pub(crate) name: &'static str,
    /// The text of its graph.
    pub(crate) text: &'static str,
    /// The parameters of its world and their nominal values.
    pub(crate) nominal: Vec<(&'static str, f64)>,
    /// The leaves of an action and their bounds.
    pub(crate) actions: Vec<(f64, f64)>,
}

impl Case {
    /// Its graph, checked.
    pub(crate) fn graph(&self) -> anyhow::Result<Graph> {
        let spec = GraphSpec::from_toml(self.text).with_context(|| format!("the graph {}", self.name))?;
        Ok(spec.validate(&registry())?)
    }

    /// Distinct parameters for every environment, within 5 % of the nominal ones: `[parameter][environment]`.
    pub(crate) fn parameters(&self, environments: usize) -> Vec<Vec<f64>> {
        let mut draws = Draws::new(1);
        let several = |&(_, value): &(_, f64)| -> Vec<f64> {
            (0..environments).map(|_| value * draws.between(0.95, 1.05)).collect()
        };
        self.nominal.iter().map(several).collect()
    }

    /// Random actions, drawn beforehand: `[environment][step][leaf]`.
    pub(crate) fn actions(&self, environments: usize, steps: usize) -> Vec<f64> {
        let mut draws = Draws::new(2);
        let mut values = Vec::with_capacity(environments * steps * self.actions.len());
        for _ in 0..environments * steps {
            values.extend(self.actions.iter().map(|&(low, high)| draws.between(low, high)));
        }
        values
    }
}

/// The systems that are timed.
pub(crate) fn cases() -> Vec<Case> {
    let pendulum::Params { inertia, mass, length, damping, motor, resistance, friction } =
        pendulum::Params::default();
    let p: quad::Params<f64> = quad::Params::default();
    vec![
        Case {
            name: "pendulum",
            text: include_str!("pendulum.toml"),
            nominal: vec![
                ("pendulum.inertia", inertia),
                ("pendulum.mass", mass),
                ("pendulum.length", length),
                ("pendulum.damping", damping),
                ("pendulum.motor", motor),
                ("pendulum.resistance", resistance),
                ("pendulum.friction", friction),
            ],
            actions: vec![(-2.0, 2.0)],
        },
        Case {
            name: "quadrotor",
            text: include_str!("quadrotor.toml"),
            nominal: vec![
                ("quadrotor.mass", p.mass),
                ("quadrotor.attitude_time", p.attitude_time),
                ("quadrotor.drag_xy", p.drag_xy),
                ("quadrotor.drag_z", p.drag_z),
                ("quadrotor.motor_rate", p.motor_rate),
                ("quadrotor.thrust_state", p.thrust_state),
                ("quadrotor.pwm_linear", p.pwm_linear),
                ("quadrotor.rotor_linear", p.rotor_linear),
            ],
            actions: vec![(3.0e4, 4.0e4), (-0.3, 0.3), (-0.3, 0.3)],
        },
    ]
}

/// All kinds that come with Parallax, and those of this bench.
pub(crate) fn registry() -> Registry {
    parallax_nodes::registry()
        .with("throughput/sensor", NodeKind::model::<Sensor>(|_| Ok(((), ()))).input(WORLD))
        .with("throughput/mocap", NodeKind::model::<Mocap>(|_| Ok(((), ()))).input(MOTION))
        .with("throughput/pilot", NodeKind::model::<Pilot>(|_| Ok(((), ()))).input(SEEN))
        .with("throughput/driver", NodeKind::model::<Driver>(|_| Ok(((), ()))).input(WANTED))
        .with("throughput/mix", PORTS.iter().fold(mix(), |kind, name| kind.input(Port::<Value>::new(name))))
}

const WORLD: Port<WorldState> = Port::new("world");
const MOTION: Port<Motion> = Port::new("world");
const SEEN: Port<Motion> = Port::new("sensor");
const WANTED: Port<Command> = Port::new("agent");

/// Passes the world's state on.
struct Sensor;

impl NodeModel for Sensor {
    const NAME: &'static str = "sensor";
    type Params<T: Scalar> = ();
    type State<T: Scalar> = ();
    type Output<T: Scalar> = Estimate<T>;

    #[inline(always)]
    fn step<T: Scalar>(_: &(), (): (), step: &NodeStep<'_, T>) -> ((), Estimate<T>) {
        let WorldState { angle, speed, stamp } = step.latest::<WorldState<T>>(WORLD.name()).message;
        ((), Estimate { angle, speed, stamp })
    }
}

/// Passes the quadrotor's motion on.
struct Mocap;

impl NodeModel for Mocap {
    const NAME: &'static str = "mocap";
    type Params<T: Scalar> = ();
    type State<T: Scalar> = ();
    type Output<T: Scalar> = Motion<T>;

    #[inline(always)]
    fn step<T: Scalar>(_: &(), (): (), step: &NodeStep<'_, T>) -> ((), Motion<T>) {
        ((), step.latest::<Motion<T>>(MOTION.name()).message)
    }
}

/// Flies level where nobody gives its outputs.
struct Pilot;

impl NodeModel for Pilot {
    const NAME: &'static str = "pilot";
    type Params<T: Scalar> = ();
    type State<T: Scalar> = ();
    type Output<T: Scalar> = Command<T>;

    #[inline(always)]
    fn step<T: Scalar>(_: &(), (): (), step: &NodeStep<'_, T>) -> ((), Command<T>) {
        let attitude = step.latest::<Motion<T>>(SEEN.name()).message.attitude;
        ((), Command { pwm: T::constant(3.5e4), roll: -attitude.roll, pitch: -attitude.pitch })
    }
}

/// Passes the command on.
struct Driver;

impl NodeModel for Driver {
    const NAME: &'static str = "driver";
    type Params<T: Scalar> = ();
    type State<T: Scalar> = ();
    type Output<T: Scalar> = Command<T>;

    #[inline(always)]
    fn step<T: Scalar>(_: &(), (): (), step: &NodeStep<'_, T>) -> ((), Command<T>) {
        ((), step.latest::<Command<T>>(WANTED.name()).message)
    }
}

/// A number that a node of the large graph sends.
#[derive(Tree, Clone, Copy, Debug, Default, PartialEq)]
struct Value<T = f64> {
    value: T,
}

impl Message for Value {
    const NAME: &'static str = "throughput/Value";
}

const PORTS: [&str; 5] = ["a", "b", "c", "d", "e"];

/// A low pass over what five others send.
struct Mix;

fn mix() -> NodeKind {
    NodeKind::model::<Mix>(|_| Ok(((), Value { value: 1.0 })))
}

impl NodeModel for Mix {
    const NAME: &'static str = "mix";
    type Params<T: Scalar> = ();
    type State<T: Scalar> = Value<T>;
    type Output<T: Scalar> = Value<T>;

    #[inline(always)]
    fn step<T: Scalar>(_: &(), state: Value<T>, step: &NodeStep<'_, T>) -> (Value<T>, Value<T>) {
        let mut sum = state.value * 0.5 + 0.01;
        for name in PORTS {
            sum += step.latest::<Value<T>>(name).message.value * 0.09;
        }
        (Value { value: sum }, Value { value: sum })
    }
}

/// A random graph of `nodes` nodes with five inputs each, at 25 to 100 Hz, with Gaussian delays.
pub(crate) fn large(nodes: usize) -> anyhow::Result<Graph> {
    let mut draws = Draws::new(3);
    let name = |index: usize| format!("n{index}");
    let mut spec = GraphSpec {
        nodes: Vec::with_capacity(nodes),
        connections: Vec::with_capacity(nodes * PORTS.len()),
        supervisor: name(nodes - 1),
        ..GraphSpec::from_toml(cases()[0].text)?
    };
    spec.name = format!("large-{nodes}");
    for index in 0..nodes {
        let rate = [25.0, 50.0, 50.0, 100.0][draws.below(4)];
        let mut node =
            NodeSpec::new(name(index), "throughput/mix", if index + 1 == nodes { 50.0 } else { rate });
        node.computation = Delay::Normal { mean: 1e-3, std: 2e-4 };
        spec.nodes.push(node);
        let mut senders: Vec<usize> = Vec::new();
        while senders.len() < PORTS.len() {
            let sender = draws.below(nodes);
            if sender != index && !senders.contains(&sender) {
                senders.push(sender);
            }
        }
        for (port, sender) in PORTS.iter().zip(senders) {
            let mut connection = ConnectionSpec::new(name(sender), name(index));
            connection.port = Some((*port).to_owned());
            // Whoever stands later in the list is heard one step later: no circle.
            connection.skip = sender > index;
            connection.delay = Delay::Normal { mean: 1e-3, std: 3e-4 };
            spec.connections.push(connection);
        }
    }
    Ok(spec.validate(&registry())?)
}
