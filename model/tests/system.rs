//! A `system.toml` from its text to numbers.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::path::Path;

use parallax_model::program::Workspace;
use parallax_model::system::{EffectEntry, Entry, Initial, Point, System};
use parallax_model::{Dual, Scalar};

/// A pendulum on a cart-like base: coupled joints, an air state, constants left to the recording.
const COUPLED: &str = r#"
format = 1
name = "coupled"

[parameters]
g  = { value = 9.81, unit = "m/s^2" }           # standard gravity
m2 = { value = 2, unit = "kg", calibrate = [1, 3], std = 0.2 }

[inputs]
torque = { signal = "motor.torque", supply = { signal = "battery", nominal = 12.0 } }

[let]
a1 = "(f1 - 0.5*f2)/m1"      # uses what is defined below
f1 = "torque - load"
f2 = "-m2*g*sin(q2)"
load = "m1*g*sin(q1)"

[state]
q1 = { derivative = "v1", initial = "angle" }
v1 = { derivative = "a1", initial = 0.5 }
q2 = { derivative = "v2", initial = { value = 0.1, calibrate = [-1.0, 1.0] } }
v2 = { derivative = "f2/m2" }
wind = { derivative = "-wind/tau" }

[outputs]
angle = { value = "q1", unit = "rad", noise = 0.01, wrap = 6.283185307179586 }
tip = { signal = "camera.tip", value = "q1 + q2" }

[joints]
lower = { position = "q1", velocity = "v1", force = "f1", drive = "torque", load = "load", lever = 0.3, air = "wind" }
upper = { position = "q2 - q1", velocity = "v2 - v1", force = "f2", payload = { m2 = "m2 + mass" } }
twist = { position = "q2", velocity = "v2", inertia = "2*m2" }
bare  = { position = "q2", velocity = "v2" }

[[effect]]
name = "delay"
place = "input:torque"
parameters = { delay = 0.02 }
"#;

fn coupled() -> System {
    let constants = [("m1".to_owned(), 1.5), ("tau".to_owned(), 2.0), ("unrelated".to_owned(), 7.0)];
    System::parse(COUPLED, "coupled.toml").unwrap().with_constants(&constants).unwrap()
}

#[test]
fn every_part_is_read() {
    assert_eq!(System::parse(COUPLED, "coupled.toml").unwrap().open_names(), ["m1", "tau"]);
    let system = coupled();
    assert!(system.open_names().is_empty());
    let names: Vec<_> = system.parameters.iter().map(|p| p.name.as_str()).collect();
    assert_eq!(names, ["g", "m2", "m1", "tau"]);
    assert_eq!(system.parameters[1].calibrate, Some([1.0, 3.0]));
    assert_eq!(system.parameters[1].std, Some(0.2));
    assert_eq!(system.parameters[1].unit, "kg");
    assert_eq!(system.parameters[1].line, 7);
    assert_eq!(system.inputs[0].signal, "motor.torque");
    let supply = system.inputs[0].supply.as_ref().unwrap();
    assert_eq!((supply.signal.as_str(), supply.nominal), ("battery", 12.0));
    let lets: Vec<_> = system.lets.iter().map(|l| l.name.as_str()).collect();
    assert!(lets.iter().position(|l| *l == "load") < lets.iter().position(|l| *l == "f1"));
    assert!(lets.iter().position(|l| *l == "f2") < lets.iter().position(|l| *l == "a1"));
    assert_eq!(system.states[0].initial, Initial::Signal("angle".into()));
    assert_eq!(system.states[1].initial, Initial::Fixed(0.5));
    assert_eq!(system.states[2].initial, Initial::Calibrated { value: 0.1, low: -1.0, high: 1.0 });
    assert_eq!(system.states[3].initial, Initial::Free);
    assert_eq!(system.outputs[0].noise, Some(0.01));
    assert_eq!(system.outputs[0].wrap, Some(std::f64::consts::TAU));
    assert_eq!(system.outputs[1].signal, "camera.tip");
    assert_eq!(system.joints[0].air, system.state("wind"));
    assert_eq!(system.joints[0].entry(), Ok(Entry::Let(system.joints[0].force.unwrap())));
    assert_eq!(system.joints[1].velocity_state, None);
    assert_eq!(system.joints[2].entry(), Ok(Entry::Derivative(3)));
    assert!(system.joints[3].entry().unwrap_err().contains("neither"));
    let effect = EffectEntry {
        name: "delay".into(),
        place: "input:torque".into(),
        parameters: vec![("delay".into(), 0.02)],
        smoothing: None,
        line: 35,
    };
    assert_eq!(system.effects, [effect]);
}

#[test]
fn equations_give_what_the_file_says() {
    let equations = coupled().equations().unwrap();
    let (g, m1, m2, tau) = (9.81, 1.5, 2.0, 2.0);
    let states = [0.3, 0.5, -0.2, 0.7, 4.0];
    let [q1, v1, q2, v2, wind] = states;
    let torque = 1.25;
    let point = Point { parameters: &equations.nominal(), states: &states, inputs: &[torque], time: 0.0 };
    let f1 = torque - m1 * g * q1.sin();
    let f2 = -m2 * g * q2.sin();

    let free = equations.values(&point, &[]);
    assert_eq!(free.derivatives, [v1, (f1 - 0.5 * f2) / m1, v2, f2 / m2, -wind / tau]);
    assert_eq!(free.outputs, [q1, q1 + q2]);

    // A force on the upper joint enters f2, and through it both accelerations.
    let (lower, upper, twist) = (0, 1, 2);
    let pushed = equations.values(&point, &[(upper, 0.25), (upper, 0.5), (twist, 3.0)]);
    let f2 = f2 + 0.25 + 0.5;
    assert_eq!(pushed.derivatives, [v1, (f1 - 0.5 * f2) / m1, v2, f2 / m2 + 3.0 / (2.0 * m2), -wind / tau]);

    let joint = equations.joint(lower, &point, &free.lets);
    assert_eq!((joint.position, joint.velocity, joint.force), (q1, v1, Some(f1)));
    assert_eq!((joint.drive, joint.load), (Some(torque), Some(m1 * g * q1.sin())));
    assert_eq!((joint.lever, joint.air, joint.inertia), (Some(0.3), Some(wind), None));
    assert_eq!(equations.load_at(lower, &point, 0.1), Some(m1 * g * (q1 + 0.1).sin()));
    assert_eq!(equations.load_at(upper, &point, 0.1), None);

    assert_eq!(equations.loaded(upper, &equations.nominal(), 0.75), [g, m2 + 0.75, m1, tau]);
    assert_eq!(equations.loaded(lower, &equations.nominal(), 0.75), equations.nominal());
}

#[test]
fn equations_are_differentiated_by_dual_numbers() {
    let equations = coupled().equations().unwrap();
    let constant = |values: &[f64]| values.iter().map(|v| Dual::<1>::constant(*v)).collect::<Vec<_>>();
    let (parameters, mut states) = (constant(&equations.nominal()), constant(&[0.3, 0.5, -0.2, 0.7, 4.0]));
    states[0] = Dual::variable(0.3, 0);
    let point = Point {
        parameters: &parameters,
        states: &states,
        inputs: &constant(&[1.25]),
        time: constant(&[0.0])[0],
    };
    let values = equations.values(&point, &[]);
    assert!((values.derivatives[1].gradient[0] + 9.81 * 0.3_f64.cos()).abs() < 1e-12);
}

#[test]
fn a_program_gives_what_the_equations_give() {
    let equations = coupled().equations().unwrap();
    let (states, inputs) = ([0.3, 0.5, -0.2, 0.7, 4.0], [1.25]);
    let point = Point { parameters: &equations.nominal(), states: &states, inputs: &inputs, time: 2.0 };
    let values = equations.values(&point, &[]);

    let program = equations.program();
    assert_eq!(program.inputs().len(), 11);
    assert_eq!(program.inputs()[3..6], ["parameter.tau", "state.q1", "state.v1"]);
    assert_eq!(program.inputs()[9..], ["input.torque", "time"]);
    assert_eq!(program.outputs()[4..], ["derivative.wind", "output.angle", "output.tip"]);
    let flat = [&equations.nominal()[..], &states, &inputs, &[2.0]].concat();
    let mut out = [0.0; 7];
    program.evaluate(&flat, &mut Workspace::new(), &mut out);
    assert_eq!(out[..], [values.derivatives, values.outputs].concat());
}

#[test]
fn a_constant_replaces_a_parameter_and_fixes_it() {
    let system = coupled().with_constants(&[("m2".into(), 5.0)]).unwrap();
    let m2 = &system.parameters[system.parameter("m2").unwrap()];
    assert_eq!((m2.value, m2.calibrate, m2.std, m2.unit.as_str()), (5.0, None, None, "kg"));
}

#[test]
fn a_system_without_states_is_static() {
    let text = "format = 1\nname = \"s\"\n[inputs]\nu = {}\n[outputs]\ny = { value = \"2*u + time\" }";
    let equations = System::parse(text, "s.toml").unwrap().equations().unwrap();
    assert_eq!(equations.system().inputs[0].signal, "u");
    let values = equations.values(&Point { parameters: &[], states: &[], inputs: &[3.0], time: 0.5 }, &[]);
    assert_eq!((values.outputs, values.derivatives), (vec![6.5], vec![]));
}

#[test]
fn a_corrected_file_keeps_everything_else() {
    let system = coupled();
    let effect = EffectEntry {
        name: "coulomb".into(),
        place: "joint:lower".into(),
        parameters: vec![("force".into(), 0.125)],
        smoothing: Some(0.02),
        line: 0,
    };
    let text = system.corrected(COUPLED, &[("m2".into(), 2.5)], std::slice::from_ref(&effect)).unwrap();

    assert!(text.starts_with(&COUPLED.replace("m2 = { value = 2,", "m2 = { value = 2.5,")), "{text}");
    let again = System::parse(&text, "coupled.toml").unwrap();
    assert_eq!(again.parameters[1].value, 2.5);
    assert_eq!(again.effects.len(), 2);
    assert_eq!(again.effects[1], EffectEntry { line: again.effects[1].line, ..effect });

    let outside = system.corrected(COUPLED, &[("m2".into(), 9.0)], &[]).unwrap_err().to_string();
    assert!(outside.contains("do not hold the value 9"), "{outside}");
    let absent = system.corrected(COUPLED, &[("m1".into(), 9.0)], &[]).unwrap_err().to_string();
    assert!(absent.contains("`m1`, which does not exist"), "{absent}");
}

#[test]
fn effects_in_an_inline_array_are_continued_inline() {
    let text = "format = 1\nname = \"s\"\neffect = [{ name = \"bias\", place = \"output:y\", parameters = { bias = 1 } }]\n\
                [outputs]\ny = { value = \"time\" }\n";
    let system = System::parse(text, "s.toml").unwrap();
    let text = system.corrected(text, &[], &system.effects).unwrap();
    assert_eq!(System::parse(&text, "s.toml").unwrap().effects.len(), 2);
}

#[test]
fn signals_are_held_against_a_recording() {
    let system = coupled();
    let mut recorded =
        vec![("motor.torque", "N m"), ("battery", "V"), ("angle", "rad"), ("camera.tip", "rad")];
    assert_eq!(system.check_signals(&recorded), Ok(()));
    recorded[3].0 = "camera.top";
    let message = system.check_signals(&recorded).unwrap_err().to_string();
    assert!(message.starts_with("coupled.toml:27: output `tip` names the signal `camera.tip`"), "{message}");
    assert!(message.contains("did you mean `camera.top`?"), "{message}");
    recorded[3].0 = "camera.tip";
    recorded[2].1 = "deg";
    let message = system.check_signals(&recorded).unwrap_err().to_string();
    assert!(
        message.contains("output `angle` is in `rad` but its signal `angle` is recorded in `deg`"),
        "{message}"
    );
}

#[test]
fn the_systems_of_real_recordings_load() {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data");
    let Ok(folders) = std::fs::read_dir(&data) else {
        println!("not run: {} does not exist", data.display());
        return;
    };
    let mut loaded = 0;
    for folder in folders {
        let path = folder.unwrap().path().join("system.toml");
        let Ok(text) = std::fs::read_to_string(&path) else { continue };
        let system = System::parse(&text, &path.display().to_string()).unwrap();
        // What the recordings of the servo supply.
        let constants = ["mass", "length", "kp", "vin"].map(|name| (name.to_owned(), 1.0));
        let equations = system.with_constants(&constants).unwrap().equations().unwrap();
        let point = Point {
            parameters: &equations.nominal(),
            states: &vec![0.5; system.states.len()],
            inputs: &vec![0.25; system.inputs.len()],
            time: 1.0,
        };
        let values = equations.values(&point, &[]);
        assert!(
            values.derivatives.iter().chain(&values.outputs).all(|v| v.is_finite()),
            "{}",
            path.display()
        );
        loaded += 1;
    }
    assert!(loaded >= 5, "only {loaded} systems in {}", data.display());
}
