//! A quadrotor that motion capture sees: the machine of the paper's second task, integrated by what stands in for
//! hardware ([`airframe`](parallax_nodes::quadrotor::airframe)) and by no model.

use std::f64::consts::TAU;

use parallax_nodes::quadrotor::airframe::{Airframe, Flight, hover};
use parallax_nodes::quadrotor::{Command, Motion, Reference, pid};
use parallax_runtime::delay::Delay;
use parallax_runtime::graph::{GraphBuilder, GraphSpec};
use parallax_runtime::node::{Node, NodeError, Port, Step};
use parallax_runtime::recording::Recording;
use parallax_runtime::registry::{NodeKind, Registry};
use parallax_runtime::time::{from_seconds, to_seconds};
use parallax_sim::Executor;
use parallax_sim::identify::{HiddenDelay, Output, Simulated, Specification, Target, Transform, Unknown};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::truth::{Truth, normal, send, starts};

/// The control's rate, Hz, and how long it runs, s: 375 steps.
const RATE: f64 = 25.0;
const DURATION: f64 = 15.0;
/// How often motion capture sees it, Hz.
const MOCAP: f64 = 100.0;
/// Noise of velocities, m/s, and of angles, rad.
const NOISE: [f64; 2] = [0.01, 2e-3];
/// Longest integration step, s.
const STEP: f64 = 2e-4;
/// The height's controller: counts for each metre, for each metre held for a second, for each m/s; and what it adds: the
/// motor signal that carries a Crazyflie of 30 g.
const GAINS: [f64; 3] = [25_000.0, 10_000.0, 15_000.0];

const AGENT: Port<Reference> = pid::AGENT;

/// What is sent is filled in afterwards.
struct Source;
impl Node for Source {
    type Output = Reference;
    fn step(&mut self, _: &Step<'_>) -> Result<Reference, NodeError> {
        Ok(Reference::default())
    }
}

struct Radio;
impl Node for Radio {
    type Output = Command;
    fn step(&mut self, _: &Step<'_>) -> Result<Command, NodeError> {
        Ok(Command::default())
    }
}

struct Driver;
impl Node for Driver {
    type Output = Motion;
    fn step(&mut self, _: &Step<'_>) -> Result<Motion, NodeError> {
        Ok(Motion::default())
    }
}

fn registry() -> Registry {
    parallax_nodes::registry()
        .with("bench/source", NodeKind::new(|_| Ok(Source)))
        .with("bench/radio", NodeKind::new(|_| Ok(Radio)).input(AGENT))
        .with("bench/driver", NodeKind::new(|_| Ok(Driver)))
}

/// What is recorded: references, when the controller stepped, and what motion capture saw.
fn graph() -> GraphSpec {
    let mut graph = GraphBuilder::new("quadrotor-with-mocap");
    let normal = |mean: f64, std: f64| Delay::Normal { mean, std };
    let agent = graph.node::<Source>("agent", "bench/source", RATE).computation(normal(2e-3, 0.4e-3)).add();
    let pid = graph.node::<Radio>("pid", "bench/radio", RATE).computation(normal(1e-3, 0.2e-3)).add();
    graph.node::<Driver>("mocap", "bench/driver", MOCAP).computation(normal(4e-3, 0.5e-3)).add();
    graph.connect(agent, pid, AGENT).blocking().delay(normal(1e-3, 0.3e-3)).add();
    graph.supervisor(agent)
}

/// A flight, from rest at a height of 1 m: the machine's past, and the commands that have been sent.
struct Flown {
    machine: Airframe,
    past: Vec<(f64, Flight)>,
    /// When each acts, and what it says.
    commands: Vec<(f64, [f64; 3])>,
    acting: usize,
}

impl Flown {
    fn fly(&mut self, until: f64) {
        loop {
            let (now, state) = self.past[self.past.len() - 1];
            if now >= until {
                return;
            }
            let next = self.commands.get(self.acting).map_or(f64::INFINITY, |(at, _)| *at);
            if next <= now {
                self.acting += 1;
                continue;
            }
            let command = match self.acting.checked_sub(1) {
                Some(newest) => self.commands[newest].1,
                None => [hover(self.machine.mass), 0.0, 0.0],
            };
            let end = (now + STEP).min(next).min(until);
            self.past.push((end, self.machine.step(state, command, end - now)));
        }
    }

    /// Where it was at a time that it has flown through.
    fn at(&self, time: f64) -> Flight {
        let next = self.past.partition_point(|(at, _)| *at < time.max(0.0)).min(self.past.len() - 1);
        let ((t1, b), (t0, a)) = (self.past[next], self.past[next.saturating_sub(1)]);
        let share = if t1 > t0 { ((time.max(0.0) - t0) / (t1 - t0)).clamp(0.0, 1.0) } else { 1.0 };
        let scaled = |x: Flight, by: f64| Flight::default().along(x, by);
        scaled(a, 1.0 - share).along(b, share)
    }
}

/// A flight and what is asked of it.
pub(crate) fn truth(seed: u64) -> anyhow::Result<Truth> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut within = |low: f64, high: f64| random.random_range(low..high);
    let machine = Airframe {
        mass: within(0.027, 0.036),
        attitude_rate: within(0.8, 1.2) / within(0.1, 0.2),
        drag: [within(5e-7, 2e-6), within(5e-7, 2e-6)],
    };
    let [actuator, feedback, sensor] = [within(0.0, 0.05), within(0.0, 0.05), within(0.0, 0.05)];
    let phases: Vec<f64> = (0..9).map(|_| within(0.0, TAU)).collect();
    let graph = graph().validate(&registry())?;
    let mut recording: Recording = Executor::new(graph, seed).record(from_seconds(DURATION))?;
    let reference = |k: usize| {
        let t = k as f64 / RATE;
        let sum = |first: usize, frequencies: [f64; 3]| -> f64 {
            frequencies.iter().zip(&phases[first..]).map(|(f, phase)| (TAU * f * t + phase).sin()).sum()
        };
        let height = 1.0 + 0.15 * if sum(6, [0.11, 0.23, 0.31]) > 0.0 { 1.0 } else { -1.0 };
        vec![0.12 * sum(0, [0.21, 0.63, 1.7]), 0.12 * sum(3, [0.17, 0.71, 1.9]), height]
    };
    send(&mut recording, "agent", reference);

    // The controller on board sees the machine some time ago, and its commands act some time later.
    let start = Flight::hovering([0.0, 0.0, 1.0]);
    let mut flight = Flown { machine, past: vec![(0.0, start)], commands: Vec::new(), acting: 0 };
    let radio = recording.node("pid").expect("a node of the graph");
    let consumed: Vec<(f64, f64)> =
        radio.steps.iter().map(|step| (to_seconds(step.start), to_seconds(step.end))).collect();
    let mut held = 0.0f64;
    let mut sent = Vec::with_capacity(consumed.len());
    for (k, (begin, end)) in consumed.into_iter().enumerate() {
        flight.fly(begin);
        let seen = flight.at(begin - feedback);
        let wanted = reference(k);
        // Nothing has been seen before the first message is there.
        let known = begin >= feedback;
        let distance = if known { wanted[2] - seen.position[2] } else { 0.0 };
        held = (held + distance / RATE).clamp(-0.5, 0.5);
        let speed = if known { seen.velocity[2] } else { 0.0 };
        let pwm = hover(0.03) + GAINS[0] * distance + GAINS[1] * held - GAINS[2] * speed;
        let command = [pwm.clamp(0.0, 65535.0), wanted[0], wanted[1]];
        flight.commands.push((end + actuator, command));
        sent.push(command.to_vec());
    }
    flight.fly(DURATION + 0.1);
    send(&mut recording, "pid", |k| sent[k].clone());

    let times = starts(&recording, "mocap");
    let mut floor = [0.0f64; 5];
    let seen: Vec<Vec<f64>> = times
        .iter()
        .map(|time| {
            let now = flight.at(time - sensor);
            let [x, y, z] = now.velocity;
            let mut values = [x, y, z, now.roll, now.pitch];
            for (k, value) in values.iter_mut().enumerate() {
                let noise = NOISE[usize::from(k > 2)] * normal(&mut random);
                floor[k] += noise * noise;
                *value += noise;
            }
            let [x, y, z, roll, pitch] = values;
            vec![0.0, 0.0, 0.0, x, y, z, roll, pitch, 0.0, 0.0]
        })
        .collect();
    send(&mut recording, "mocap", |k| seen[k].clone());
    Ok(Truth {
        recording,
        registry: registry(),
        specification: specification(),
        floor: floor.map(|square| (square / times.len() as f64).sqrt()).to_vec(),
        // A command is seen to act after the way there and back; the loop on board closes after its own.
        delays: vec![
            (vec!["actuator", "sensor"], actuator + sensor),
            (vec!["actuator", "feedback"], actuator + feedback),
        ],
        spreads: Vec::new(),
        humps: None,
    })
}

/// The paper's eight: mass, gain and time constant of the attitude, two drags, three delays.
fn specification() -> Specification {
    let parameter = |leaf: &str, low: f64, high: f64| Unknown {
        name: leaf.to_owned(),
        targets: vec![Target::Parameter { node: "world".into(), leaf: format!("quadrotor.{leaf}") }],
        low,
        high,
        start: None,
        transform: Some(Transform::Log),
        prior: None,
        unit: String::new(),
    };
    let delay = |name: &str, from: &str, to: &str, port: Option<&str>| HiddenDelay {
        name: name.into(),
        from: from.into(),
        to: to.into(),
        port: port.map(str::to_owned),
        min: 0.0,
        max: Some(0.05),
        start: None,
        prior: None,
        interpolation: None,
        scatter: None,
        window: None,
    };
    let simulated = |node: &str, kind: &str, rate: Option<f64>| Simulated {
        node: node.into(),
        kind: Some(kind.into()),
        parameters: None,
        rate,
    };
    let leaves = ["velocity.x", "velocity.y", "velocity.z", "attitude.roll", "attitude.pitch"];
    let outputs = leaves.iter().enumerate().map(|(k, leaf)| Output {
        node: "mocap".into(),
        leaf: (*leaf).into(),
        noise: Some(NOISE[usize::from(k > 2)]),
        wrap: None,
        linear: Vec::new(),
    });
    Specification {
        nodes: vec![
            simulated("world", "quadrotor/simulator", Some(100.0)),
            simulated("pid", "quadrotor/pid", None),
            simulated("mocap", "quadrotor/mocap", None),
        ],
        unknowns: vec![
            parameter("mass", 0.02, 0.05),
            parameter("attitude_gain", 0.5, 2.0),
            parameter("attitude_time", 0.05, 0.4),
            parameter("drag_xy", 2e-7, 4e-6),
            parameter("drag_z", 2e-7, 4e-6),
        ],
        delays: vec![
            delay("actuator", "pid", "world", None),
            delay("feedback", "world", "pid", Some("mocap")),
            delay("sensor", "world", "mocap", None),
        ],
        outputs: outputs.collect(),
        hold_out: 0.0,
        ..Specification::default()
    }
}
