//! A rotating joint with everything that an effect may need, and predictions of its readings.

use parallax_gap::equations::EquationsSimulator;
use parallax_gap::experiment::{Experiment, Held, Sample, SupplyVoltage};
use parallax_gap::hypothesis::Slot;
use parallax_gap::simulator::{Prediction, Run, Simulator, Transition};
use parallax_model::effect::{Effect, PlaceKind};
use parallax_model::plant::Plant;
use parallax_model::system::{Equations, System};

/// A rotating joint with everything that an effect may need, in air that moves, and a second reading.
pub(crate) const SYSTEM: &str = r#"
format = 1
name = "rotor"

[parameters]
J = { value = 0.0125, unit = "kg m^2" }
k = { value = 0.12, unit = "N m/V" }
m = { value = 0.25, unit = "kg" }
l = { value = 0.2, unit = "m" }
b = { value = 0.004, unit = "N m s/rad" }

[inputs]
u = { signal = "voltage", supply = { signal = "battery", nominal = 12.0 } }

[let]
weight = "-m*9.81*l*sin(q)"
torque = "k*u + weight - b*(v - air)"

[state]
q = { derivative = "v", initial = "angle" }
v = { derivative = "torque/J" }
air = { derivative = "-air/0.5", initial = 0.0 }

[outputs]
angle = { value = "q", unit = "rad" }
speed = { value = "v", unit = "rad/s" }

[joints]
shaft = { position = "q", velocity = "v", inertia = "J", drive = "k*u", load = "weight", lever = "l", air = "air" }
coupled = { position = "q", velocity = "v", force = "torque", drive = "k*u", load = "weight", payload = { J = "J + mass*l^2", m = "m + mass" } }
"#;

pub(crate) const STEP: f64 = 0.005;

pub(crate) fn equations() -> Equations {
    System::parse(SYSTEM, "rotor.toml").expect("valid").equations().expect("complete")
}

/// Half a second: a command that changes every 10 ms, readings of both outputs, a battery that sags.
pub(crate) fn experiment() -> Experiment {
    let mut held = Held::default();
    let mut samples = Vec::new();
    for k in 0..=50 {
        let t = 0.01 * f64::from(k);
        held.times.push(t);
        held.values.push(1.1 * (9.0 * t).sin() + 0.4 * (31.0 * t + 1.0).sin());
        let stamp = t + 0.0013;
        samples.push(Sample { stamp, output: 0, value: 0.0 });
        samples.push(Sample { stamp, output: 1, value: 0.0 });
    }
    let voltage = Held { times: vec![0.0, 0.153, 0.337], values: vec![12.3, 11.6, 10.9] };
    Experiment {
        inputs: vec![held],
        supplies: vec![Some(SupplyVoltage { voltage, nominal: 12.0 })],
        samples,
        wraps: vec![None, None],
        ..Experiment::default()
    }
}

/// A simulator with these effects, each of whose parameters is an entry of θ.
pub(crate) fn simulator<'a>(
    equations: Equations,
    effects: &[(Effect, PlaceKind, usize)],
    experiment: &'a Experiment,
) -> EquationsSimulator<'a> {
    let joints = equations.system().joints.len();
    let mut slots = Vec::new();
    for (effect, (e, _, index)) in effects.iter().enumerate() {
        if *e == Effect::Parameter {
            slots.push(Slot::Nominal(*index));
            continue;
        }
        slots.extend((0..e.parameters().len()).map(|parameter| Slot::Effect { effect, parameter }));
    }
    let bound: Vec<_> = effects.iter().copied().filter(|e| e.0 != Effect::Parameter).collect();
    assert!(bound.len() == effects.len() || effects.len() == 1, "a parameter is tested alone");
    let plant = Plant::new(equations, &bound, Vec::new(), vec![0.3; joints]);
    EquationsSimulator::new(plant, slots, experiment, STEP)
}

/// Predictions in the order of the stamps, from one start of the nominal states, with their derivatives by θ.
pub(crate) fn predictions(simulator: &EquationsSimulator<'_>, theta: &[f64]) -> (Vec<f64>, Vec<Vec<f64>>) {
    let p = simulator.parameters();
    let (mut x, _) = simulator.start(&[0.1, 0.4, 0.2], &[1.0; 3], 0.0);
    let n = x.len();
    let mut run: Box<dyn Run> = simulator.run(theta);
    let mut by = vec![0.0; n * p];
    let mut read: Vec<(f64, usize, f64, Vec<f64>)> = Vec::new();
    let (mut transition, mut prediction) = (Transition::default(), Prediction::default());
    for index in 0..run.events().len() {
        if let Some(reading) = run.events()[index].reading {
            run.observe(index, &x, &mut prediction);
            let through = |j: usize| (0..n).map(|i| prediction.by_state[i] * by[i * p + j]).sum::<f64>();
            let row = (0..p).map(|j| through(j) + prediction.by_parameter[j]).collect();
            read.push((reading.stamp, reading.output, prediction.value, row));
        }
        if index + 1 < run.events().len() {
            run.advance(index, &mut x, &mut transition);
            let before = by.clone();
            for i in 0..n {
                for j in 0..p {
                    let through: f64 =
                        (0..n).map(|k| transition.by_state[i * n + k] * before[k * p + j]).sum();
                    by[i * p + j] = through + transition.by_parameter[i * p + j];
                }
            }
        }
    }
    read.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    read.into_iter().map(|(_, _, value, row)| (value, row)).unzip()
}
