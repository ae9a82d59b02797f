//! Time that is held out: what happens in it alone, and what an exact model's predictions of it are off by.

use crate::rail::SLIDE;
use parallax_gap::diagnosis::{Options, diagnose_experiment};
use parallax_gap::experiment::{Experiment, Held, Sample};
use parallax_gap::report::Report;
use parallax_gap::setup::Setup;
use parallax_gap::{floor, library, quantify, search};
use parallax_model::system::{Equations, System};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// Sensors of the mass on the rail beside the first one.
const MORE: &str = r#"
left = { value = "q", unit = "m", noise = 0.0005 }
right = { value = "q", unit = "m", noise = 0.0005 }
speed = { value = "v", unit = "m/s", noise = 0.01 }
"#;

/// A log of 20 s; the sensor of the speed is off by `bump` there.
fn logged(seed: u64, bump: impl Fn(f64) -> f64) -> (Equations, Experiment) {
    const PERIOD: f64 = 0.02;
    let friction = 2.8;
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut normal = || -> f64 { StandardNormal.sample(&mut random) };
    let (mut held, mut samples) = (Held::default(), Vec::new());
    let (mut q, mut v) = (0.0, 0.0);
    for k in 0..1000 {
        let t = PERIOD * f64::from(k);
        for output in 0..3 {
            samples.push(Sample { stamp: t, output, value: q + 0.0005 * normal() });
        }
        samples.push(Sample { stamp: t, output: 3, value: v + bump(t) + 0.01 * normal() });
        let push = 1.5 * (1.9 * t).sin() + 1.2 * (5.3 * t + 1.0).sin() + 0.8 * (11.0 * t).cos();
        held.times.push(t);
        held.values.push(push);
        // Exact while the push is held.
        let (decay, rest) = ((-friction * PERIOD).exp(), push / friction);
        q += rest * PERIOD + (v - rest) * (1.0 - decay) / friction;
        v = rest + (v - rest) * decay;
    }
    let experiment = Experiment {
        inputs: vec![held],
        input_units: vec![String::new()],
        samples,
        wraps: vec![None; 4],
        ..Experiment::default()
    };
    let equations =
        System::parse(&format!("{SLIDE}{MORE}"), "rail.toml").expect("valid").equations().expect("complete");
    (equations, experiment)
}

fn diagnosed(seed: u64, bump: impl Fn(f64) -> f64) -> Report {
    let (equations, experiment) = logged(seed, bump);
    diagnose_experiment(equations, experiment, "log", &Options::default(), &|_, _| {})
        .expect("a diagnosis")
        .report
}

#[test]
fn what_happens_once_in_one_sensor_is_no_secret_of_the_time_held_out() {
    let nothing = diagnosed(3, |_| 0.0);
    assert!(!nothing.gap.detected && nothing.summary.starts_with("No gap"), "{}", nothing.summary);
    for from in [4.5, 16.5] {
        let bump = |t: f64| 0.06 * (std::f64::consts::PI * (t - from)).sin().max(0.0);
        let once = |t: f64| if (from..from + 1.0).contains(&t) { bump(t) } else { 0.0 };
        let found = diagnosed(3, once);
        assert!(found.gap.detected, "{from}: {}", found.summary);
    }
}

#[test]
fn predictions_of_an_exact_model_are_off_by_what_is_expected() {
    let mut ratios = Vec::new();
    for seed in 0..12 {
        let (equations, experiment) = logged(seed, |_| 0.0);
        let setup = Setup::new(equations, experiment, Some(0.06));
        let null = search::null(&setup);
        let simulator = library::simulator(&setup, &null.hypothesis, Vec::new());
        let (theta, noise) = (null.theta(), &null.innovation.noise);
        let expected = floor::expected(&setup, &simulator, theta, noise);
        let found = quantify::predict(&setup, &simulator, theta, noise).mean_square();
        assert!(expected > 1.01, "what is not known of the state counts: {expected}, {found}");
        ratios.push(found / expected);
    }
    let mean = ratios.iter().sum::<f64>() / ratios.len() as f64;
    assert!((0.97..1.03).contains(&mean), "{ratios:?}");
}
