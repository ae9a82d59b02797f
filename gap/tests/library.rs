//! Every effect of the library: at its null value nothing changes, its derivatives are right, several act together, and
//! a system that states it predicts the same as a hypothesis that adds it.

use crate::rotor::{SYSTEM, equations, experiment, predictions, simulator};
use parallax_gap::equations::EquationsSimulator;
use parallax_gap::simulator::{At, Event, Gradient, LANES, Motion, Simulator};
use parallax_model::effect::{Effect, Place, PlaceKind};
use parallax_model::lanes::F64x16;
use parallax_model::system::{EffectEntry, System};
use proptest::prelude::*;

/// Each effect at a place, with values well inside its range.
const CASES: &[(Effect, PlaceKind, usize, &[f64])] = &[
    (Effect::Delay, PlaceKind::Input, 0, &[0.0137]),
    (Effect::Delay, PlaceKind::Output, 0, &[0.0071]),
    (Effect::ClockSkew, PlaceKind::Input, 0, &[0.0083]),
    (Effect::ClockSkew, PlaceKind::Output, 0, &[-0.0061]),
    (Effect::Lag, PlaceKind::Input, 0, &[0.043]),
    (Effect::LagSecondOrder, PlaceKind::Input, 0, &[0.031, 0.4]),
    (Effect::Gain, PlaceKind::Input, 0, &[1.2]),
    (Effect::Offset, PlaceKind::Input, 0, &[0.2]),
    (Effect::Saturation, PlaceKind::Input, 0, &[-0.83, 0.91]),
    (Effect::SaturationSoft, PlaceKind::Input, 0, &[-0.83, 0.91, 0.17]),
    (Effect::Deadband, PlaceKind::Input, 0, &[0.15]),
    (Effect::RateLimit, PlaceKind::Input, 0, &[9.7]),
    (Effect::Backlash, PlaceKind::Input, 0, &[0.31]),
    (Effect::SupplySag, PlaceKind::Input, 0, &[1.4]),
    (Effect::SupplySagLoad, PlaceKind::Input, 0, &[0.11]),
    (Effect::Viscous, PlaceKind::Joint, 0, &[0.01]),
    (Effect::Coulomb, PlaceKind::Joint, 0, &[0.02]),
    (Effect::Stribeck, PlaceKind::Joint, 0, &[0.015, 0.02, 0.9]),
    (Effect::LoadFriction, PlaceKind::Joint, 0, &[0.11]),
    (Effect::AsymmetricFriction, PlaceKind::Joint, 0, &[0.015, 0.01]),
    (Effect::AsymmetricViscous, PlaceKind::Joint, 0, &[0.015, 0.004]),
    (Effect::QuadraticDrag, PlaceKind::Joint, 0, &[0.006]),
    (Effect::Cogging, PlaceKind::Joint, 0, &[0.03, 5.0, 0.7]),
    (Effect::Inertia, PlaceKind::Joint, 0, &[0.004]),
    (Effect::Inertia, PlaceKind::Joint, 1, &[0.004]),
    (Effect::Payload, PlaceKind::Joint, 0, &[0.1]),
    (Effect::Payload, PlaceKind::Joint, 1, &[0.1]),
    (Effect::GravityTilt, PlaceKind::Joint, 0, &[0.09]),
    (Effect::SpringCubic, PlaceKind::Joint, 0, &[0.3, 0.1]),
    (Effect::CoulombDahl, PlaceKind::Joint, 0, &[0.1, 0.02]),
    (Effect::Spring, PlaceKind::Joint, 0, &[0.2, 0.3]),
    (Effect::Flexibility, PlaceKind::Joint, 0, &[9.0, 0.03, 0.35]),
    (Effect::FlexibilityFar, PlaceKind::Joint, 1, &[9.0, 0.03, 0.35]),
    (Effect::ConstantForce, PlaceKind::Joint, 0, &[0.05]),
    (Effect::EndStop, PlaceKind::Joint, 0, &[0.13, 3.0]),
    (Effect::EndStopLower, PlaceKind::Joint, 0, &[0.137, 3.0]),
    (Effect::EndStopBoth, PlaceKind::Joint, 0, &[0.13, 0.137, 3.0]),
    (Effect::Wind, PlaceKind::Joint, 1, &[0.05]),
    (Effect::WindSpeed, PlaceKind::Joint, 0, &[0.9]),
    (Effect::PeriodicDisturbance, PlaceKind::Joint, 0, &[0.06, 3.1, 0.4]),
    (Effect::Parameter, PlaceKind::Parameter, 2, &[0.31]),
    (Effect::Bias, PlaceKind::Output, 0, &[0.05]),
    (Effect::Scale, PlaceKind::Output, 0, &[1.1]),
    (Effect::Drift, PlaceKind::Output, 0, &[0.2]),
    (Effect::SensorLag, PlaceKind::Output, 0, &[0.023]),
    (Effect::SensorLagSecondOrder, PlaceKind::Output, 0, &[0.023, 0.8]),
    (Effect::SensorSaturation, PlaceKind::Output, 0, &[0.03, 0.21]),
    (Effect::Saturation, PlaceKind::State, 1, &[-0.5, 1.1]),
];

/// Largest difference, and how far the second goes.
fn apart(a: &[f64], b: &[f64]) -> (f64, f64) {
    assert_eq!(a.len(), b.len());
    let difference = a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    (difference, b.iter().map(|v| v.abs()).fold(0.0, f64::max))
}

/// A null value that a list of numbers can hold.
fn nulls(effect: Effect, kind: PlaceKind) -> Vec<f64> {
    effect
        .parameters()
        .iter()
        .map(|p| match p.null {
            null if null.is_nan() => 0.25,
            null if kind == PlaceKind::Input && effect == Effect::RateLimit => null.min(1e12),
            null if null.is_infinite() => null.signum() * 1e6,
            // A spring of no stiffness has no frequency; any will do.
            _ if p.name == "stiffness" && effect.name() == "flexibility" => 5.0,
            null => null,
        })
        .collect()
}

/// How closely the null value is met: exactly, but for what divides by a time constant.
fn exactness(effect: Effect) -> f64 {
    match effect {
        Effect::Lag | Effect::LagSecondOrder | Effect::SaturationSoft | Effect::RateLimit => 1e-6,
        _ => 0.0,
    }
}

#[test]
fn null_values_change_nothing() {
    let experiment = experiment();
    let (plain, _) = predictions(&simulator(equations(), &[], &experiment), &[]);
    for &(effect, kind, index, _) in CASES {
        let (with, _) =
            predictions(&simulator(equations(), &[(effect, kind, index)], &experiment), &nulls(effect, kind));
        // More events and other sums round differently.
        let (difference, size) = apart(&with, &plain);
        assert!(difference <= (exactness(effect) + 1e-9) * size, "{effect:?}: {difference}");
    }
}

#[test]
fn every_effect_changes_something() {
    let experiment = experiment();
    let (plain, _) = predictions(&simulator(equations(), &[], &experiment), &[]);
    for &(effect, kind, index, values) in CASES {
        let (with, _) = predictions(&simulator(equations(), &[(effect, kind, index)], &experiment), values);
        let (difference, size) = apart(&with, &plain);
        assert!(difference > 1e-4 * size && difference.is_finite(), "{effect:?}: {difference}");
    }
}

#[test]
fn derivatives_agree_with_central_differences() {
    let experiment = experiment();
    for &(effect, kind, index, values) in CASES {
        let simulator = simulator(equations(), &[(effect, kind, index)], &experiment);
        let (_, rows) = predictions(&simulator, values);
        for j in 0..values.len() {
            let h = 1e-6 * values[j].abs();
            let shifted = |sign: f64| {
                let mut theta = values.to_vec();
                theta[j] += sign * h;
                predictions(&simulator, &theta).0
            };
            let (above, below) = (shifted(1.0), shifted(-1.0));
            let largest = rows.iter().map(|r| r[j].abs()).fold(1e-9, f64::max);
            for (k, row) in rows.iter().enumerate() {
                let difference = (above[k] - below[k]) / (2.0 * h);
                assert!(
                    (row[j] - difference).abs() < 1e-3 * largest,
                    "{effect:?} at {kind:?} {index}, reading {k}, parameter {j}: {} against {difference}",
                    row[j]
                );
            }
        }
    }
}

#[test]
fn a_stated_effect_predicts_as_a_fitted_one() {
    let experiment = experiment();
    let nominal = equations();
    for &(effect, kind, index, values) in CASES {
        let (fitted, _) = predictions(&simulator(equations(), &[(effect, kind, index)], &experiment), values);
        let system = nominal.system();
        let key = match kind {
            PlaceKind::Input => &system.inputs[index].name,
            PlaceKind::Output => &system.outputs[index].name,
            PlaceKind::Joint => &system.joints[index].name,
            PlaceKind::State => &system.states[index].name,
            _ => &system.parameters[index].name,
        };
        let entry = EffectEntry {
            name: effect.name().into(),
            place: Place::new(kind, key.clone()).to_string(),
            parameters: effect
                .parameters()
                .iter()
                .map(|p| p.name.to_owned())
                .zip(values.iter().copied())
                .collect(),
            smoothing: None,
            line: 0,
        };
        let text = system.corrected(SYSTEM, &[], std::slice::from_ref(&entry)).expect("it can be written");
        let stated =
            System::parse(&text, "rotor.toml").expect("it can be read").equations().expect("complete");
        assert_eq!(stated.effects().len(), 1);
        assert_eq!(stated.effects()[0].effect, effect);
        let (written, _) = predictions(&simulator(stated, &[], &experiment), &[]);
        let (difference, size) = apart(&written, &fitted);
        assert!(difference <= 1e-12 * size, "{effect:?}: {difference}");
    }
}

#[test]
fn a_stated_effect_acts_beside_a_fitted_one() {
    let experiment = experiment();
    let entry = |name: &str, place: &str, parameter: &str, value: f64| EffectEntry {
        name: name.into(),
        place: place.into(),
        parameters: vec![(parameter.into(), value)],
        smoothing: None,
        line: 0,
    };
    let stated = [
        entry("delay", "input:u", "delay", 0.013),
        entry("lag", "input:u", "time_constant", 0.02),
        entry("sensor_lag", "output:angle", "time_constant", 0.03),
    ];
    let text = equations().system().corrected(SYSTEM, &[], &stated).expect("it can be written");
    let system = System::parse(&text, "rotor.toml").expect("it can be read").equations().expect("complete");
    let more = [
        (Effect::Delay, PlaceKind::Input, 0),
        (Effect::Lag, PlaceKind::Input, 0),
        (Effect::SensorLag, PlaceKind::Output, 0),
    ];
    let (together, _) = predictions(&simulator(system, &more, &experiment), &[0.004, 0.01, 0.01]);
    let all = [
        (Effect::Delay, PlaceKind::Input, 0),
        (Effect::Lag, PlaceKind::Input, 0),
        (Effect::Lag, PlaceKind::Input, 0),
        (Effect::SensorLag, PlaceKind::Output, 0),
        (Effect::SensorLag, PlaceKind::Output, 0),
    ];
    let (fitted, _) =
        predictions(&simulator(equations(), &all, &experiment), &[0.017, 0.01, 0.02, 0.01, 0.03]);
    let (difference, size) = apart(&together, &fitted);
    assert!(difference < 1e-9 * size, "{difference}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    /// Any effects together, several of them at one place.
    #[test]
    fn compositions_at_null_change_nothing(picked in proptest::collection::vec(0..CASES.len(), 1..6)) {
        let experiment = experiment();
        let (plain, _) = predictions(&simulator(equations(), &[], &experiment), &[]);
        let chosen: Vec<_> = picked
            .into_iter()
            .map(|k| (CASES[k].0, CASES[k].1, CASES[k].2))
            .filter(|c| c.0 != Effect::Parameter)
            .collect();
        let theta: Vec<f64> = chosen.iter().flat_map(|c| nulls(c.0, c.1)).collect();
        let (with, _) = predictions(&simulator(equations(), &chosen, &experiment), &theta);
        let (difference, size) = apart(&with, &plain);
        prop_assert!(difference <= 1e-5 * size, "{chosen:?}: {difference}");
    }
}

#[test]
fn a_reading_off_its_sensors_limit_pulls_a_prediction_back_from_beyond_it() {
    // All readings are zero: at the lower limit, and far from the upper one.
    let experiment = experiment();
    let clipped = [(Effect::SensorSaturation, PlaceKind::Output, 0)];
    let simulator = simulator(equations(), &clipped, &experiment).with_noise(&[1e-3, 1e-3]);
    let mut run = simulator.run(&[0.0, 0.21]);
    let of_angle = |event: &Event| event.reading.is_some_and(|reading| reading.output == 0);
    let index = run.events().iter().position(of_angle).expect("the angle is read");
    let mut at: At = [None; LANES];
    at[0] = Some(index);
    let mut predicted = |angle: f64, compared: bool| {
        let mut motion = Motion::new(3, 3, 2);
        motion.x[0] = F64x16::splat(angle);
        motion.seed();
        let mut by = Gradient::default();
        let value = match compared {
            true => run.compare_lanes(&at, &motion, &mut by),
            false => run.observe_lanes(&at, &motion, &mut by),
        };
        (value[0], by.by[0][0])
    };
    assert_eq!(predicted(0.8, false), (0.21, 0.0));
    assert_eq!(predicted(0.8, true), (0.8, 1.0));
    assert_eq!(predicted(-0.8, true), (0.0, 0.0));
    assert_eq!(predicted(0.1, true), (0.1, 1.0));
}

#[test]
fn a_late_reading_of_before_the_recording_began_tells_nothing() {
    // All readings are zero; they and the commands begin at zero.
    const LATE: f64 = 0.0171;
    let experiment = experiment();
    let noise = 1e-3;
    let told = |simulator: EquationsSimulator<'_>, theta: &[f64]| {
        let simulator = simulator.with_noise(&[noise, noise]);
        let mut run = simulator.run(theta);
        let of_angle = |event: &Event| event.reading.is_some_and(|reading| reading.output == 0);
        let read: Vec<usize> = (0..run.events().len()).filter(|k| of_angle(&run.events()[*k])).collect();
        let compared = |index: usize| {
            let mut at: At = [None; LANES];
            at[0] = Some(index);
            let mut motion = Motion::new(3, 3, theta.len());
            motion.x[0] = F64x16::splat(0.8);
            motion.seed();
            let mut by = Gradient::default();
            let value = run.compare_lanes(&at, &motion, &mut by)[0];
            let stamp = run.events()[index].reading.map_or(f64::NAN, |reading| reading.stamp);
            (stamp, value, by.by[0][0])
        };
        read.into_iter().map(compared).collect::<Vec<_>>()
    };
    for kind in [PlaceKind::Output, PlaceKind::Input] {
        let delay = [(Effect::Delay, kind, 0)];
        let seen = told(simulator(equations(), &delay, &experiment), &[LATE]);
        let before = seen.iter().filter(|(stamp, ..)| *stamp < LATE).count();
        assert!(before >= 2 && before < seen.len() / 2, "{before} of {}", seen.len());
        for (stamp, value, by_state) in seen {
            let expected = if stamp < LATE { (-noise, 0.0) } else { (0.8, 1.0) };
            assert_eq!((value, by_state), expected, "{kind:?} at {stamp}");
        }
    }
    // In time, all tell something.
    let in_time = told(simulator(equations(), &[], &experiment), &[]);
    assert!(in_time.iter().all(|(_, value, _)| *value == 0.8));
}
