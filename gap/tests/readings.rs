//! Effects on how readings scatter, repeat and are spaced: each is found by itself, and none where there is none.

use crate::rail::SLIDE;
use crate::support::{Hidden, SYSTEM, record};
use parallax_gap::diagnosis::{Options, diagnose_experiment};
use parallax_gap::experiment::{Experiment, Held, Sample};
use parallax_gap::readings::{ReadingEffect, Suspicion, cleaned, examine, is_trace, scatter};
use parallax_gap::report::Report;
use parallax_gap::search;
use parallax_gap::setup::Setup;
use parallax_model::system::{Equations, System};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// The pendulum, with its sensor's noise declared or not.
fn equations(declared: bool) -> Equations {
    let noise = if declared { "unit = \"rad\", noise = 0.0015, wrap" } else { "unit = \"rad\", wrap" };
    let text = SYSTEM.replace("unit = \"rad\", wrap", noise);
    System::parse(&text, "pendulum.toml").expect("valid").equations().expect("complete")
}

fn plain(seed: u64) -> Experiment {
    record(Hidden::default(), seed, 30.0)
}

fn changed(seed: u64, mut change: impl FnMut(&mut ChaCha8Rng, &mut Vec<Sample>)) -> Experiment {
    let mut experiment = plain(seed);
    change(&mut ChaCha8Rng::seed_from_u64(100 + seed), &mut experiment.samples);
    experiment
}

fn significant(effects: &[ReadingEffect]) -> Vec<String> {
    effects.iter().filter(|e| e.significant).map(|e| format!("{}@{}", e.name, e.place)).collect()
}

/// The effect is the only one that is significant, and its parameter is the truth within what it states.
fn is_alone(
    experiment: &Experiment,
    declared: bool,
    label: &str,
    parameter: &str,
    truth: f64,
) -> ReadingEffect {
    let effects = examine(&equations(declared), experiment);
    assert_eq!(significant(&effects), [label], "{effects:#?}");
    let effect = effects.into_iter().find(|e| e.significant).expect("one is significant");
    let found = &effect.parameters[parameter];
    let allowed = 3.0 * found.std + 0.05 * truth;
    assert!((found.value - truth).abs() < allowed, "{} ± {}, not {truth}", found.value, found.std);
    assert!(effect.log_density.with > effect.log_density.without, "{effect:#?}");
    effect
}

#[test]
fn nothing_is_found_where_nothing_is() {
    for seed in 1..6 {
        for declared in [false, true] {
            let effects = examine(&equations(declared), &plain(seed));
            assert!(significant(&effects).is_empty(), "seed {seed}: {effects:#?}");
        }
    }
}

#[test]
fn noise_beyond_the_declared_is_found() {
    let experiment = changed(1, |random, samples| {
        for sample in samples {
            let z: f64 = StandardNormal.sample(random);
            sample.value += 0.004 * z;
        }
    });
    let effect = is_alone(&experiment, true, "noise@output:angle", "std", 0.004);
    assert!(effect.share.is_some_and(|share| share > 0.95), "{effect:#?}");
    // Where none is declared there is nothing to exceed.
    assert!(significant(&examine(&equations(false), &experiment)).is_empty());
}

#[test]
fn a_lattice_of_values_is_found() {
    let step = std::f64::consts::TAU / 1024.0;
    let experiment = changed(2, |_, samples| {
        for sample in samples {
            sample.value = (sample.value / step).round() * step;
        }
    });
    for declared in [false, true] {
        let effect = is_alone(&experiment, declared, "quantization@output:angle", "step", step);
        assert!(effect.share.is_some_and(|share| share > 0.5), "{effect:#?}");
    }
}

#[test]
fn a_coarse_lattice_tells_most_of_what_its_readings_are() {
    // So coarse that neighbours predict a reading hardly better than to its cell.
    let step = std::f64::consts::TAU / 128.0;
    let experiment = changed(2, |_, samples| {
        for sample in samples {
            sample.value = (sample.value / step).round() * step;
        }
    });
    for declared in [false, true] {
        let effects = examine(&equations(declared), &experiment);
        let lattice = effects.iter().find(|e| e.name == "quantization").unwrap();
        assert!(lattice.significant && lattice.share.is_some_and(|share| share > 0.8), "{lattice:#?}");
    }
}

#[test]
fn outliers_are_found_and_left_out() {
    let mut spoiled = Vec::new();
    let experiment = changed(3, |random, samples| {
        for (index, sample) in samples.iter_mut().enumerate() {
            if random.random_bool(0.02) {
                sample.value += if random.random_bool(0.5) { 0.3 } else { -0.2 };
                spoiled.push(index);
            }
        }
    });
    for declared in [false, true] {
        is_alone(&experiment, declared, "outliers@output:angle", "rate", 0.02);
    }
    let (kept, left_out) = cleaned(&equations(true), &experiment);
    assert!(left_out.iter().all(|s| s.why == Suspicion::Outlier));
    let caught = spoiled.iter().filter(|k| left_out.iter().any(|s| s.sample == **k)).count();
    assert!(caught as f64 > 0.9 * spoiled.len() as f64, "{caught} of {}", spoiled.len());
    assert!(left_out.len() < spoiled.len() + 5);
    assert_eq!(kept.samples.len() + left_out.len(), experiment.samples.len());
}

#[test]
fn stuck_readings_are_found_and_left_out() {
    for step in [0.0, 0.001] {
        let experiment = changed(4, |random, samples| {
            if step > 0.0 {
                for sample in samples.iter_mut() {
                    sample.value = (sample.value / step).round() * step;
                }
            }
            for k in 1..samples.len() {
                if random.random_bool(0.06) {
                    samples[k].value = samples[k - 1].value;
                }
            }
            // At the end nothing comes after it.
            let last = samples.len() - 5;
            let value = samples[last].value;
            samples[last..].iter_mut().for_each(|sample| sample.value = value);
        });
        is_alone(&experiment, true, "stuck@output:angle", "rate", 0.06);
        let (_, left_out) = cleaned(&equations(true), &experiment);
        assert!(left_out.iter().all(|s| s.why == Suspicion::Stuck));
        let last = left_out.iter().map(|s| s.sample).max();
        assert!(step > 0.0 || last == Some(experiment.samples.len() - 1), "{last:?}");
        // In slow motion a repeat on a lattice proves nothing, and harms nothing.
        let least = if step > 0.0 { 60 } else { 150 };
        assert!(left_out.len() > least, "{}", left_out.len());
    }
}

#[test]
fn missing_readings_are_found() {
    let experiment = changed(5, |random, samples| samples.retain(|_| !random.random_bool(0.04)));
    is_alone(&experiment, true, "drops@output:angle", "rate", 0.04);
}

#[test]
fn an_experiment_without_suspicion_is_left_as_it_is() {
    let experiment = plain(6);
    let (kept, left_out) = cleaned(&equations(true), &experiment);
    assert!(left_out.is_empty());
    assert_eq!(kept.samples, experiment.samples);
}

fn scattered(experiment: Experiment) -> Vec<ReadingEffect> {
    let setup = Setup::new(equations(true), experiment, None);
    let null = search::null(&setup);
    scatter(&setup, &null)
}

/// Readings taken up to `most` seconds after their stamp, or at it.
fn jittered(seed: u64, most: f64) -> Experiment {
    changed(seed, |random, samples| {
        let before = samples.clone();
        for k in 0..samples.len() - 1 {
            let part = random.random_range(0.0..most) / 0.01;
            samples[k].value += part * (before[k + 1].value - before[k].value);
        }
    })
}

#[test]
fn times_of_readings_that_scatter_are_found() {
    let effects = scattered(jittered(7, 0.008));
    let found =
        effects.iter().find(|e| e.name == "jitter" && e.place == "output:angle").expect("it is judged");
    assert!(found.significant, "{found:#?}");
    // The standard deviation of an even spread.
    let truth = 0.008 / 12.0_f64.sqrt();
    let spread = &found.parameters["spread"];
    assert!((spread.value / truth - 1.0).abs() < 0.3, "{spread:?}, not {truth}");
    assert!(found.log_density.with > found.log_density.without);
}

/// A first-order plant that is told a new level every tenth of a second.
const FOLLOWER: &str = r#"
format = 1
name = "follower"
[parameters]
T = { value = 0.05, unit = "s", calibrate = [0.02, 0.1], std = 0.005 }
[inputs]
u = { signal = "level" }
[state]
y = { derivative = "(u - y)/T", initial = "reading" }
[outputs]
reading = { value = "y", unit = "m", noise = 0.002 }
"#;

/// The follower's log; commands act late by up to `most` seconds, and a share of them is `lost`.
fn follow(seed: u64, most: f64, lost: f64) -> (Equations, Experiment) {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let (mut level, mut acted, mut samples) = (Held::default(), Held::default(), Vec::new());
    for k in 0..400 {
        let value = random.random_range(-1.0..1.0);
        level.times.push(0.1 * f64::from(k));
        level.values.push(value);
        if !random.random_bool(lost) {
            acted.times.push(0.1 * f64::from(k) + most * random.random_range(0.0..1.0));
            acted.values.push(value);
        }
    }
    let (mut y, mut at) = (0.0, 0);
    for k in 0..40_000 {
        let t = 1e-3 * f64::from(k);
        while at + 1 < acted.times.len() && acted.times[at + 1] <= t + 1e-9 {
            at += 1;
        }
        if k % 10 == 0 {
            let z: f64 = StandardNormal.sample(&mut random);
            samples.push(Sample { stamp: t, output: 0, value: y + 0.002 * z });
        }
        y += (acted.values[at] - y) * (1.0 - (-1e-3_f64 / 0.05).exp());
    }
    let experiment = Experiment {
        inputs: vec![level],
        input_units: vec![String::new()],
        samples,
        wraps: vec![None],
        ..Experiment::default()
    };
    let system = System::parse(FOLLOWER, "follower.toml").expect("valid");
    (system.equations().expect("complete"), experiment)
}

/// What scatters in the follower's log.
fn followed(seed: u64, most: f64, lost: f64) -> Vec<ReadingEffect> {
    let (equations, experiment) = follow(seed, most, lost);
    let setup = Setup::new(equations, experiment, None);
    scatter(&setup, &search::null(&setup))
}

#[test]
fn corners_of_the_motion_are_neither_noise_nor_outliers() {
    let (equations, experiment) = follow(6, 0.0, 0.0);
    assert!(significant(&examine(&equations, &experiment)).contains(&"outliers@output:reading".to_owned()));
    let found = diagnose_experiment(equations, experiment, "follower", &Options::default(), &|_, _| {})
        .expect("a diagnosis")
        .report;
    assert!(!found.gap.detected, "{}", found.summary);
}

/// The report of a diagnosis that names this effect and no other.
fn named(equations: Equations, experiment: Experiment, effect: &str) -> Report {
    let found = diagnose_experiment(equations, experiment, "log", &Options::default(), &|_, _| {})
        .expect("a diagnosis")
        .report;
    let names: Vec<&str> = found.which[0].effects.iter().map(|e| e.name.as_str()).collect();
    assert_eq!(names, [effect], "{}", found.summary);
    found
}

#[test]
fn lost_commands_are_named_and_the_rest_is_explained_by_what_arrived() {
    let (equations, experiment) = follow(6, 0.0, 0.08);
    let found = named(equations, experiment, "drops");
    let rate = &found.which[0].effects[0].parameters["rate"];
    assert!((rate.value - 0.08).abs() < 2.0 * rate.std, "{rate:?}");
    assert!(found.how_far.closed_by_effect.value > 0.95, "{:?}", found.how_far);
}

/// The log of a mass on that rail to which commands were sent and others acted, 30 s of it.
fn slid(sent: Held, acted: &Held, mut random: ChaCha8Rng) -> (Equations, Experiment) {
    const STEP: f64 = 1e-4;
    let mut samples = Vec::new();
    let (mut q, mut v, mut at) = (0.0, 0.0, 0);
    for k in 0..300_000 {
        let t = STEP * f64::from(k);
        while at + 1 < acted.times.len() && acted.times[at + 1] <= t + 1e-9 {
            at += 1;
        }
        if k % 100 == 0 {
            let z: f64 = StandardNormal.sample(&mut random);
            samples.push(Sample { stamp: t, output: 0, value: q + 0.0005 * z });
        }
        // Velocity first, in the middle of the step.
        q += 0.5 * STEP * v;
        v += STEP * (acted.values[at] - 3.0 * v);
        q += 0.5 * STEP * v;
    }
    let inputs = vec![sent];
    let input_units = vec![String::new()];
    let experiment = Experiment { inputs, input_units, samples, wraps: vec![None], ..Experiment::default() };
    let equations = System::parse(SLIDE, "slide.toml").expect("valid").equations().expect("complete");
    (equations, experiment)
}

#[test]
fn late_commands_are_named_and_the_rest_is_explained_by_when_they_acted() {
    let most = 0.03;
    let mut random = ChaCha8Rng::seed_from_u64(5);
    let (mut push, mut acted) = (Held::default(), Held::default());
    for k in 0..375 {
        let at = 0.08 * f64::from(k);
        push.times.push(at);
        push.values.push(random.random_range(-5.0..5.0));
        acted.times.push(at + most * random.random_range(0.0..1.0));
    }
    acted.values.clone_from(&push.values);
    let (equations, experiment) = slid(push, &acted, random);
    let found = named(equations, experiment, "jitter");
    let (spread, truth) = (&found.which[0].effects[0].parameters["spread"], most / 12.0_f64.sqrt());
    assert!((spread.value / truth - 1.0).abs() < 0.15, "{spread:?}, not {truth}");
    assert!(found.how_far.closed_by_effect.value > 0.9, "{:?}", found.how_far);
}

#[test]
fn lost_commands_are_named_that_hide_in_what_all_of_them_leave() {
    let mut random = ChaCha8Rng::seed_from_u64(8);
    let (mut push, mut acted) = (Held::default(), Held::default());
    let mut last = 0.0;
    let mut lost = 0;
    for k in 0..1500 {
        let value = random.random_range(-3.0..3.0);
        if k > 0 && random.random_bool(0.08) {
            lost += 1;
        } else {
            last = value;
        }
        for (held, value) in [(&mut push, value), (&mut acted, last)] {
            held.times.push(0.02 * f64::from(k));
            held.values.push(value);
        }
    }
    let (equations, experiment) = slid(push, &acted, random);
    let found = named(equations, experiment, "drops");
    let (rate, truth) = (&found.which[0].effects[0].parameters["rate"], f64::from(lost) / 1500.0);
    // Commands that change little leave it open whether they are lost.
    assert!((0.7 * truth..truth + 2.0 * rate.std).contains(&rate.value), "{rate:?}, not {truth}");
    assert!(found.how_far.closed_by_effect.value > 0.7, "{:?}", found.how_far);
}

#[test]
fn commands_that_scatter_or_are_lost_leave_evidence() {
    for (most, lost) in [(0.02, 0.0), (0.0, 0.15)] {
        let effects = followed(3, most, lost);
        // A mean delay goes with times that scatter, so the nominal mean is wrong here: evidence, but no verdict.
        let at_input = effects.iter().filter(|e| e.place == "input:u").map(|e| e.evidence);
        let best = at_input.fold(f64::INFINITY, f64::min);
        assert!(best < -100.0, "{most} {lost}: {effects:#?}");
    }
    // Little scatter leaves the mean right, and is named.
    let effects = followed(4, 0.002, 0.0);
    assert!(significant(&effects).contains(&"jitter@input:u".to_owned()), "{effects:#?}");
    let effects = followed(4, 0.0, 0.0);
    assert!(significant(&effects).is_empty(), "{effects:#?}");
}

#[test]
fn even_times_do_not_scatter() {
    for seed in 8..10 {
        let effects = scattered(plain(seed));
        assert!(!effects.is_empty());
        assert!(significant(&effects).is_empty(), "seed {seed}: {effects:#?}");
    }
}

#[test]
fn bad_readings_beside_times_that_scatter_are_their_traces() {
    let found = |name: &str, place: &str, evidence: f64| ReadingEffect {
        name: name.into(),
        place: place.into(),
        parameters: Default::default(),
        evidence,
        significant: true,
        log_density: Default::default(),
        share: None,
    };
    let jitter = found("jitter", "output:angle", -1000.0);
    let weak = found("outliers", "output:angle", -60.0);
    assert!(is_trace(&weak, &[weak.clone(), jitter.clone()]));
    // Elsewhere, and where they are as plain as the times, they are there.
    let elsewhere = found("outliers", "output:other", -60.0);
    assert!(!is_trace(&elsewhere, &[elsewhere.clone(), jitter.clone()]));
    let strong = found("outliers", "output:angle", -900.0);
    assert!(!is_trace(&strong, &[strong.clone(), jitter]));
}
