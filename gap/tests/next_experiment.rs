//! The next experiment, from end to end: a log that cannot tell two effects apart, the experiment that is proposed, the
//! machine under it, and the diagnosis of what it then shows. The machine is simulated by code of its own.

use parallax_gap::diagnosis::{Options, diagnose_experiment};
use parallax_gap::excitation::{Design, Limit, ProposeError, Wishes, propose};
use parallax_gap::experiment::{Experiment, Held, Sample};
use parallax_gap::options::Pattern;
use parallax_model::system::{Equations, System};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::f64::consts::TAU;

/// What is believed of an axis: a mass with viscous friction on a weak spring.
const SYSTEM: &str = r#"
format = 1
name = "axis"
[parameters]
M = { value = 2.0, unit = "kg" }
k = { value = 3.0, unit = "N/V", calibrate = [1.0, 9.0] }
b = { value = 4.0, unit = "N s/m", calibrate = [0.5, 20.0] }
s = { value = 30.0, unit = "N/m" }
[inputs]
u = { signal = "voltage" }
[state]
q = { derivative = "v", initial = "position" }
v = { derivative = "(k*u - b*v - s*q)/M" }
[outputs]
position = { value = "q", unit = "m" }
[joints]
axis = { position = "q", velocity = "v", inertia = "M", drive = "k*u", load = "-s*q" }
"#;

fn equations(system: &str) -> Equations {
    System::parse(system, "axis.toml").expect("valid").equations().expect("complete")
}

/// What the machine does that is not believed.
#[derive(Clone, Copy, Default)]
struct Hidden {
    command_late: f64,
    lag: f64,
    reading_late: f64,
    /// Dry friction against motion forwards and backwards (N).
    friction: (f64, f64),
}

/// The machine under a command, in steps of a tenth of a millisecond; one reading every 10 ms.
fn machine(hidden: Hidden, command: &Held, duration: f64, seed: u64) -> Experiment {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let h = 1e-4;
    let (mut q, mut v, mut smooth) = (0.0_f64, 0.0_f64, command.at(0.0));
    let mut past: Vec<f64> = Vec::new();
    let mut experiment = Experiment {
        inputs: vec![command.clone()],
        input_units: vec!["V".into()],
        wraps: vec![None],
        ..Experiment::default()
    };
    for step in 0..=(duration / h).round() as usize {
        let t = step as f64 * h;
        past.push(q);
        if step % 100 == 0 {
            let late = (hidden.reading_late / h).round() as usize;
            let noise: f64 = (0..12).map(|_| random.random::<f64>()).sum::<f64>() - 6.0;
            let value = past[step.saturating_sub(late)] + 2e-4 * noise;
            experiment.samples.push(Sample { stamp: t, output: 0, value });
        }
        let asked = command.at(t - hidden.command_late + 1e-9);
        smooth = if hidden.lag > 0.0 { smooth + h * (asked - smooth) / hidden.lag } else { asked };
        v = stuck_or_slipping(v, h * (3.1 * smooth - 4.2 * v - 30.0 * q) / 2.0, hidden.friction, h / 2.0);
        q += h * v;
    }
    experiment
}

/// The velocity after a step in which a force changes it by `push`, and dry friction takes `share` of its force from it, to rest at most.
fn stuck_or_slipping(v: f64, push: f64, (forward, backward): (f64, f64), share: f64) -> f64 {
    let pushed = v + push;
    (pushed - share * forward).max(0.0) + (pushed + share * backward).min(0.0)
}

/// One slow sine: of all excitations the poorest.
fn sine(duration: f64) -> Held {
    let times: Vec<f64> = (0..(duration / 0.01) as usize).map(|k| k as f64 * 0.01).collect();
    let values = times.iter().map(|t| 4.0 * (TAU * 0.5 * t).sin()).collect();
    Held { times, values }
}

fn effects(labels: &[&str]) -> Vec<String> {
    labels.iter().map(|l| (*l).to_owned()).collect()
}

fn proposed(hidden: Hidden, labels: &[&str], wishes: &Wishes) -> Result<Design, ProposeError> {
    let log = machine(hidden, &sine(12.0), 12.0, 1);
    propose(equations(SYSTEM), log, "a sine", &effects(labels), &Options::default(), wishes)
}

/// The leading class of a diagnosis that is told to try these effects only.
fn class(log: Experiment, only: &[&str]) -> (Vec<String>, f64) {
    let only = only.iter().map(|o| o.parse::<Pattern>().expect("a pattern")).collect();
    let options = Options { only, ..Options::default() };
    let found = diagnose_experiment(equations(SYSTEM), log, "axis", &options, &|_, _| ()).expect("diagnosed");
    let first = &found.report.which[0];
    (first.class.clone(), first.probability)
}

const PAIR: [&str; 2] = ["delay@input:u", "lag@input:u"];

#[test]
fn a_proposed_experiment_separates_what_a_sine_cannot() {
    for (hidden, truth) in [
        (Hidden { command_late: 0.030, ..Hidden::default() }, "delay@input:u"),
        (Hidden { lag: 0.030, ..Hidden::default() }, "lag@input:u"),
    ] {
        let (alike, _) = class(machine(hidden, &sine(12.0), 12.0, 1), &["delay@input", "lag"]);
        assert_eq!(alike.len(), 2, "a sine leaves both: {alike:?}");
        let design = proposed(hidden, &PAIR, &Wishes::default()).expect("there is one");
        assert!(design.separates() && design.sensor.is_none(), "{design}");
        assert!(design.probability() > 0.95, "{design}");
        let command = &design.commands[0];
        assert_eq!((command.signal.as_str(), command.unit.as_str()), ("voltage", "V"));
        assert!(command.held.values.iter().all(|u| u.abs() <= 4.0 + 1e-9), "within the log's range");

        let second = machine(hidden, &command.held, design.duration, 2);
        let (low, high) = (design.reach[0].1, design.reach[0].2);
        let off = 0.2 * (high - low);
        let inside = second.samples.iter().all(|s| s.value > low - off && s.value < high + off);
        assert!(inside, "the machine goes about where it was foreseen");
        let (found, probability) = class(second, &["delay@input", "lag"]);
        assert_eq!(found, [truth]);
        assert!(probability > 0.95, "{probability}");
    }
}

#[test]
fn a_late_command_and_a_late_reading_need_a_sensor_more() {
    let hidden = Hidden { command_late: 0.030, ..Hidden::default() };
    let design = proposed(hidden, &["delay@input:u", "delay@output:position"], &Wishes::default())
        .expect("there is one");
    let sensor = design.sensor.clone().expect("one sensor cannot tell them apart");
    assert!(sensor.contains("`v`") || sensor.contains("`u`"), "{sensor}");
    assert!(design.separates(), "{design}");
    assert!(design.to_string().contains("impossible with these sensors; add a sensor of"), "{design}");
}

/// The axis with a bias that is free.
fn biased() -> String {
    let bias = "f = { value = 0.0, unit = \"N\", calibrate = [-5.0, 5.0] }\n[inputs]";
    SYSTEM.replace("s*q)/M", "s*q - f)/M").replace("[inputs]", bias)
}

/// What tells these effects apart on the machine with friction that differs by direction.
fn rubbing(system: &str, labels: &[&str]) -> Design {
    let log = machine(Hidden { friction: (2.5, 1.0), ..Hidden::default() }, &sine(12.0), 12.0, 1);
    let (options, wishes) = (Options::default(), Wishes::default());
    propose(equations(system), log, "a sine", &effects(labels), &options, &wishes).expect("there is one")
}

#[test]
fn friction_by_direction_is_not_told_from_a_bias_by_how_a_model_creeps() {
    // Where the machine stands, smoothed friction creeps, of either kind otherwise: there is no other difference.
    let frictions = ["coulomb@joint:axis", "asymmetric_friction@joint:axis"];
    let design = rubbing(&biased(), &frictions);
    assert!(!design.separates() && !design.narrows(), "{design}");
    assert!(design.to_string().contains("impossible"), "{design}");
    let without = rubbing(SYSTEM, &frictions);
    assert!(without.separates() && without.sensor.is_none(), "without a bias: {without}");
}

#[test]
fn what_a_log_tells_apart_already_an_experiment_does_too() {
    // The worse one is followed by a filter that believes in more noise: how far the other's model is off weighs no more.
    let design = rubbing(SYSTEM, &["coulomb@joint:axis", "delay@input:u"]);
    assert!(design.separates() && design.sensor.is_none(), "{design}");
}

#[test]
fn an_experiment_may_tell_one_of_three() {
    let design =
        rubbing(&biased(), &["coulomb@joint:axis", "backlash@input:u", "asymmetric_friction@joint:axis"]);
    assert!(design.narrows() && !design.separates(), "{design}");
    assert_eq!(design.alike, [["coulomb@joint:axis", "asymmetric_friction@joint:axis"]]);
    assert!(design.pair.0 == "backlash@input:u" || design.pair.1 == "backlash@input:u", "{:?}", design.pair);
    let text = design.to_string();
    assert!(text.contains("leaves coulomb@joint:axis and asymmetric_friction@joint:axis alike"), "{text}");
    assert!(design.probability() > 0.95 && design.promise().alike == design.alike);
}

#[test]
fn what_a_sensor_more_would_tell_is_said_beside_what_can_be_told() {
    let hidden = Hidden { command_late: 0.030, ..Hidden::default() };
    let labels = ["delay@input:u", "lag@input:u", "delay@output:position"];
    let design = proposed(hidden, &labels, &Wishes::default()).expect("there is one");
    assert_eq!(design.alike, [["delay@input:u", "delay@output:position"]], "{design}");
    let sensor = design.sensor.clone().expect("one that tells them apart");
    assert!(
        design.to_string().ends_with(&format!("; with {sensor} one would tell all of them apart")),
        "{design}"
    );
}

#[test]
fn limits_bind_commands_and_outputs() {
    let hidden = Hidden { command_late: 0.030, ..Hidden::default() };
    let limit = |text: &str| text.parse::<Limit>().expect("a limit");
    let wishes = Wishes {
        duration: Some(8.0),
        limits: vec![limit("voltage=-1:2"), limit("position=-0.1:0.12")],
        ..Wishes::default()
    };
    let design = proposed(hidden, &PAIR, &wishes).expect("there is one");
    assert_eq!(design.duration, 8.0);
    let held = &design.commands[0].held;
    assert!(held.times.iter().all(|t| *t < 8.0));
    assert!(held.values.iter().all(|u| (-1.0..=2.0).contains(u)));
    assert!(design.reach[0].1 >= -0.1 && design.reach[0].2 <= 0.12, "{:?}", design.reach);

    let refuse = |limits: Vec<Limit>| {
        let wishes = Wishes { limits, ..Wishes::default() };
        proposed(hidden, &PAIR, &wishes).expect_err("it is refused").to_string()
    };
    let error = refuse(vec![limit("voltag=-1:1")]);
    assert!(error.contains("`voltage`") && error.contains("--limit voltag"), "{error}");
    let error = refuse(vec![limit("position=3:4")]);
    assert!(error.contains("position") && error.contains("--limit"), "{error}");
    for text in ["voltage", "voltage=3", "voltage=2:1", "=1:2", "voltage=a:b"] {
        assert!(text.parse::<Limit>().is_err(), "{text}");
    }
}

#[test]
fn unknown_effects_and_single_ones_are_refused() {
    let refuse = |labels: &[&str]| {
        proposed(Hidden::default(), labels, &Wishes::default()).expect_err("it is refused").to_string()
    };
    let error = refuse(&["delay@input:u", "lagg@input:u"]);
    assert!(error.contains("did you mean `lag@input:u`"), "{error}");
    assert!(refuse(&["delay@input:u"]).contains("two candidates"));
}

#[test]
fn one_seed_gives_one_experiment_on_any_number_of_threads() {
    let hidden = Hidden { lag: 0.030, ..Hidden::default() };
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        pool.install(|| proposed(hidden, &PAIR, &Wishes { seed: 7, ..Wishes::default() }))
            .expect("there is one")
    };
    assert_eq!(on(1), on(4));
}
