//! A mass on a rail that is driven along it, diagnosed.

use parallax_gap::diagnosis::{Options, diagnose_experiment};
use parallax_gap::experiment::{Experiment, Held, Sample};
use parallax_gap::report::{Report, Which};
use parallax_model::system::System;

use crate::rail;

const JOINT: &str = r#"
[joints]
axis = { position = "q", velocity = "v", inertia = "1", drive = "u", load = "-d*v" }
"#;

/// What the diagnosis says of readings of its position, whose noise has this standard deviation (m), under these pushes.
pub(crate) fn diagnosed(noise: f64, pushes: Held, samples: Vec<Sample>) -> Report {
    let experiment = Experiment {
        inputs: vec![pushes],
        input_units: vec![String::new()],
        samples,
        wraps: vec![None],
        ..Experiment::default()
    };
    let text = format!("{}{JOINT}", rail::SLIDE).replace("noise = 0.0005", &format!("noise = {noise}"));
    let equations = System::parse(&text, "rail.toml").expect("valid").equations().expect("complete");
    diagnose_experiment(equations, experiment, "log", &Options::default(), &|_, _| {})
        .expect("it can be diagnosed")
        .report
}

/// The effects of an answer, in the order of their names.
pub(crate) fn labelled(answer: &Which) -> String {
    let mut effects: Vec<String> = answer.effects.iter().map(|e| e.label()).collect();
    effects.sort();
    effects.join(" + ")
}
