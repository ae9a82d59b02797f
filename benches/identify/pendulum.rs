//! A pendulum that a camera sees: the machine of the paper's first task, integrated here and nowhere else.

use std::f64::consts::TAU;

use parallax_nodes::pendulum::{Voltage, motor, sight};
use parallax_runtime::delay::Delay;
use parallax_runtime::graph::{GraphBuilder, GraphSpec};
use parallax_runtime::node::{Node, NodeError, Step};
use parallax_runtime::recording::Recording;
use parallax_runtime::registry::{NodeKind, Registry};
use parallax_runtime::time::from_seconds;
use parallax_sim::Executor;
use parallax_sim::identify::{
    HiddenDelay, Output, Scatter, Simulated, Specification, Target, Term, Transform, Unknown,
};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::truth::{Truth, normal, send, sent, starts};

/// The control's rate, Hz, and how long it runs, s: 1,050 steps.
const RATE: f64 = 50.0;
const DURATION: f64 = 21.0;
/// The camera's noise, px.
const NOISE: f64 = 1.0;
/// Longest integration step, s.
const STEP: f64 = 1e-4;

/// A source of voltages; what it sends is filled in afterwards.
struct Source;
impl Node for Source {
    type Output = Voltage;
    fn step(&mut self, _: &Step<'_>) -> Result<Voltage, NodeError> {
        Ok(Voltage::default())
    }
}

/// A camera's driver: whatever it sees comes from outside of the graph.
struct Driver;
impl Node for Driver {
    type Output = sight::Pixel;
    fn step(&mut self, _: &Step<'_>) -> Result<sight::Pixel, NodeError> {
        Ok(sight::Pixel::default())
    }
}

fn registry() -> Registry {
    parallax_nodes::registry()
        .with("bench/source", NodeKind::new(|_| Ok(Source)))
        .with("bench/driver", NodeKind::new(|_| Ok(Driver)))
}

/// What is recorded: commands and pictures. Nobody records the machine.
fn graph() -> GraphSpec {
    let mut graph = GraphBuilder::new("pendulum-with-camera");
    let normal = |mean: f64, std: f64| Delay::Normal { mean, std };
    let agent = graph.node::<Source>("agent", "bench/source", RATE).computation(normal(1.7e-3, 1e-3)).add();
    let motor =
        graph.model::<motor::Motor>("motor", "pendulum/motor", RATE).computation(normal(5.6e-3, 2e-3)).add();
    graph.node::<Driver>("camera", "bench/driver", 60.0).computation(normal(9.8e-3, 2e-3)).add();
    graph.connect(agent, motor, motor::AGENT).blocking().delay(normal(0.5e-3, 0.1e-3)).add();
    graph.supervisor(agent)
}

/// The machine's constants.
#[derive(Clone, Copy)]
struct Machine {
    inertia: f64,
    weight: f64,
    viscous: f64,
    motor: f64,
    friction: f64,
    offset: f64,
    tilt: f64,
    asymmetry: f64,
    stiction: f64,
    stribeck: f64,
    drag: f64,
}

impl Machine {
    fn torque(&self, angle: f64, speed: f64, volts: f64) -> f64 {
        self.motor * (volts + self.offset) + self.weight * (angle + self.tilt).sin()
            - self.viscous * speed
            - self.drag * speed * speed.abs()
    }

    /// Half a drift, a kick, half a drift; dry friction takes what momentum it can and no more.
    fn step(&self, (angle, speed): (f64, f64), volts: f64, h: f64) -> (f64, f64) {
        let middle = angle + 0.5 * h * speed;
        let guess = speed + 0.5 * h * self.torque(middle, speed, volts) / self.inertia;
        let free = speed + h * self.torque(middle, guess, volts) / self.inertia;
        let way = if free > 0.0 { 1.0 + self.asymmetry } else { 1.0 - self.asymmetry };
        let sticky = 1.0 + self.stiction * (-(speed / self.stribeck).powi(2)).exp();
        let loss = h * self.friction * way * sticky / self.inertia;
        let next = if free.abs() <= loss { 0.0 } else { free - loss.copysign(free) };
        (middle + 0.5 * h * next, next)
    }

    /// The angle at `times` (s, rising) under commands that act from their times on.
    fn angles(&self, first: (f64, f64), commands: &[(f64, f64)], times: &[f64]) -> Vec<f64> {
        let (mut now, mut state, mut volts, mut next) = (0.0, first, 0.0, 0);
        let mut angles = Vec::with_capacity(times.len());
        for &time in times {
            while now < time {
                let switch = commands.get(next).map_or(f64::INFINITY, |(at, _)| *at);
                if switch <= now {
                    volts = commands[next].1;
                    next += 1;
                    continue;
                }
                let until = (now + STEP).min(time).min(switch);
                state = self.step(state, volts, until - now);
                now = until;
            }
            angles.push(state.0);
        }
        angles
    }
}

/// The default question: what enters the picture linearly is solved for.
pub(crate) fn truth(seed: u64) -> anyhow::Result<Truth> {
    machine(seed, false, false)
}

/// The default question where every picture is late by another time: around one mean, or around two.
pub(crate) fn truth_with_a_camera_that_jitters(seed: u64) -> anyhow::Result<Truth> {
    machine(seed, false, true)
}

/// The paper's question: every one of the 27 parameters is searched.
pub(crate) fn truth_with_every_parameter_searched(seed: u64) -> anyhow::Result<Truth> {
    machine(seed, true, false)
}

fn machine(seed: u64, search_everything: bool, jitters: bool) -> anyhow::Result<Truth> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut around =
        |value: f64, factor: f64| value * (random.random_range(-1.0..1.0f64) * factor.ln()).exp();
    let (inertia, mass, length) = (around(1.6e-4, 1.5), around(0.0509, 1.3), around(0.0415, 1.3));
    let (motor, resistance) = (around(0.0333, 1.3), around(7.73, 1.3));
    let (damping, friction) = (around(1.43e-5, 1.8), around(9.75e-4, 1.8));
    let stribeck = around(1.0, 1.5);
    let mut within = |low: f64, high: f64| random.random_range(low..high);
    let machine = Machine {
        inertia,
        weight: mass * length * 9.81,
        viscous: damping + motor * motor / resistance,
        motor: motor / resistance,
        friction,
        offset: within(-0.2, 0.2),
        tilt: within(-0.1, 0.1),
        asymmetry: within(-0.2, 0.2),
        stiction: within(0.0, 0.4),
        stribeck,
        drag: within(0.0, 3e-7),
    };
    let (actuator, sensor) = (within(0.0, 0.05), within(0.0, 0.05));
    let first = (within(-4.5, 4.5), within(-2.0, 2.0));
    let (size, squash, turn) = (within(50.0, 90.0), within(0.6, 1.0), within(-0.5, 0.5));
    let (column, row, bend) = (within(180.0, 240.0), within(100.0, 140.0), within(-0.05, 0.05));
    let phases: Vec<f64> = (0..8).map(|_| within(0.0, TAU)).collect();
    let slow = within(0.0, TAU);
    let dispersion: Vec<f64> = (0..4000).map(|_| NOISE * normal(&mut random)).collect();

    let graph = graph().validate(&registry())?;
    let mut recording: Recording = Executor::new(graph, seed).record(from_seconds(DURATION))?;
    let volts = |k: usize| {
        let t = k as f64 / RATE;
        let sines = [0.31, 0.57, 0.97, 1.61, 2.43, 3.37, 4.61, 5.93].iter().zip(&phases);
        let sum: f64 = sines.map(|(f, phase)| (TAU * f * t + phase).sin()).sum();
        (1.2 * sum * (0.7 + 0.3 * (TAU * t / 7.0 + slow).sin())).clamp(-4.0, 4.0)
    };
    send(&mut recording, "agent", |k| vec![volts(k)]);
    send(&mut recording, "motor", |k| vec![volts(k)]);
    let commands: Vec<(f64, f64)> =
        sent(&recording, "motor").into_iter().map(|(sent, payload)| (sent + actuator, payload[0])).collect();
    let (seen, sensor, spread, humps) = match jitters {
        true => late(&mut random, starts(&recording, "camera").len()),
        false => (Vec::new(), sensor, 0.0, None),
    };
    let starts = starts(&recording, "camera").into_iter().enumerate();
    let times = starts.map(|(k, start)| (start - seen.get(k).unwrap_or(&sensor)).max(0.0));
    let times: Vec<f64> = times.collect();
    // A picture may show an earlier moment than the one before it.
    let mut order: Vec<usize> = (0..times.len()).collect();
    order.sort_by(|&a, &b| times[a].total_cmp(&times[b]));
    let rising: Vec<f64> = order.iter().map(|&k| times[k]).collect();
    let mut angles = vec![0.0; times.len()];
    for (k, angle) in order.into_iter().zip(machine.angles(first, &commands, &rising)) {
        angles[k] = angle;
    }
    let mut square = [0.0, 0.0];
    let pixels: Vec<Vec<f64>> = angles
        .iter()
        .enumerate()
        .map(|(k, angle)| {
            // The mark on a circle, seen from the side, and a little larger where it is nearer.
            let (x, y) = (-size * angle.sin(), -size * squash * angle.cos());
            let near = 1.0 + bend * angle.sin();
            let (x, y) = (near * (x * turn.cos() - y * turn.sin()), near * (x * turn.sin() + y * turn.cos()));
            let noise = [dispersion[2 * k % 4000], dispersion[(2 * k + 1) % 4000]];
            square[0] += noise[0] * noise[0];
            square[1] += noise[1] * noise[1];
            vec![column + x + noise[0], row + y + noise[1], 0.0, 0.0, 0.0, 0.0]
        })
        .collect();
    send(&mut recording, "camera", |k| pixels[k].clone());
    let floor = square.map(|square| (square / pixels.len() as f64).sqrt()).to_vec();
    Ok(Truth {
        recording,
        registry: registry(),
        specification: specification(search_everything, jitters),
        floor,
        // Open loop, a constant delay before the machine and one after it are seen as their sum.
        delays: vec![(vec!["actuator", "sensor"], actuator + sensor)],
        spreads: if jitters { vec![("sensor.spread", spread)] } else { Vec::new() },
        humps,
    })
}

/// How late each picture is, with the mean and the standard deviation of that, and where there are two humps how far they lie
/// apart and the later one's share.
fn late(random: &mut ChaCha8Rng, count: usize) -> (Vec<f64>, f64, f64, Option<(f64, f64)>) {
    let (mean, spread) = (random.random_range(0.015..0.035), random.random_range(0.001..0.004));
    let second = if random.random::<bool>() { random.random_range(0.004..0.012) } else { 0.0 };
    let share: f64 = random.random_range(0.2..0.5);
    let mut delays = Vec::with_capacity(count);
    for _ in 0..count {
        let hump = if random.random_range(0.0..1.0) < share { second } else { 0.0 };
        delays.push((mean + hump + spread * normal(random)).max(0.0));
    }
    let variance = spread * spread + share * (1.0 - share) * second * second;
    let humps = (second > 0.0).then_some((second, share));
    (delays, mean + share * second, variance.sqrt(), humps)
}

/// Of nothing more is known than a data sheet says: each constant to a factor of two.
fn specification(search_everything: bool, jitters: bool) -> Specification {
    let parameter = |leaf: &str, low: f64, high: f64| Unknown {
        name: leaf.rsplit('.').next().unwrap_or(leaf).to_owned(),
        targets: vec![Target::Parameter { node: "world".into(), leaf: leaf.into() }],
        low,
        high,
        start: None,
        transform: (low > 0.0).then_some(Transform::Log),
        prior: None,
        unit: String::new(),
    };
    let factor = |leaf: &str, middle: f64| parameter(leaf, 0.4 * middle, 2.5 * middle);
    let state = |leaf: &str, size: f64| Unknown {
        targets: vec![Target::State { node: "world".into(), leaf: leaf.into() }],
        transform: Some(Transform::Linear),
        ..parameter(leaf, -size, size)
    };
    let mut unknowns = vec![
        factor("pendulum.inertia", 1.6e-4),
        factor("pendulum.mass", 0.0509),
        factor("pendulum.length", 0.0415),
        factor("pendulum.damping", 1.43e-5),
        factor("pendulum.motor", 0.0333),
        factor("pendulum.resistance", 7.73),
        factor("pendulum.friction", 9.75e-4),
        parameter("offset", -0.5, 0.5),
        parameter("tilt", -0.3, 0.3),
        parameter("asymmetry", -0.5, 0.5),
        parameter("stiction", 0.0, 1.0),
        factor("stribeck_speed", 1.0),
        parameter("drag", -1e-6, 1e-6),
        state("angle", 5.0),
        state("speed", 4.0),
    ];
    let names = ["one", "sin", "cos", "sin_sin", "sin_cos"];
    let outputs = ["u", "v"].map(|leaf| Output {
        node: "camera".into(),
        leaf: leaf.into(),
        noise: Some(NOISE),
        wrap: None,
        linear: match search_everything {
            true => Vec::new(),
            false => names
                .iter()
                .map(|name| Term {
                    name: format!("camera.{leaf}.{name}"),
                    leaf: (*name != "one").then(|| (*name).to_owned()),
                })
                .collect(),
        },
    });
    if search_everything {
        for (leaf, middle) in [("u", 210.0), ("v", 120.0)] {
            for name in names {
                let (low, high) = match name {
                    "one" => (middle - 40.0, middle + 40.0),
                    "sin" | "cos" => (-100.0, 100.0),
                    _ => (-10.0, 10.0),
                };
                unknowns.push(Unknown {
                    name: format!("{leaf}.{name}"),
                    targets: vec![Target::Parameter {
                        node: "camera".into(),
                        leaf: format!("{leaf}.{name}"),
                    }],
                    transform: Some(Transform::Linear),
                    ..parameter(name, low, high)
                });
            }
        }
    }
    let delay = |name: &str, from: &str, to: &str| HiddenDelay {
        name: name.into(),
        from: from.into(),
        to: to.into(),
        port: None,
        min: 0.0,
        max: Some(0.05),
        start: None,
        prior: None,
        interpolation: None,
        scatter: None,
        window: None,
    };
    Specification {
        nodes: vec![
            Simulated {
                node: "world".into(),
                kind: Some("pendulum/simulator".into()),
                parameters: None,
                rate: Some(100.0),
            },
            Simulated {
                node: "camera".into(),
                kind: Some("pendulum/sight".into()),
                parameters: None,
                rate: None,
            },
        ],
        unknowns,
        delays: vec![
            delay("actuator", "motor", "world"),
            HiddenDelay {
                scatter: jitters.then_some(Scatter::Mixture),
                ..delay("sensor", "world", "camera")
            },
        ],
        outputs: outputs.to_vec(),
        hold_out: 0.0,
        ..Specification::default()
    }
}
