//! The generator keeps its promises.

use crate::case::{Case, reading, stream};
use crate::channel::{Channel, show};
use crate::effect::{Cause, INPUT, JOINT, Kind, OUTPUT, Place, draw, label, table};
use crate::mechanics::{H, Machine};
use crate::signature::{detectability, judge};
use crate::system::{ALL, N, State, System};
use crate::{Experiment, Plan, Set, causes, effects, folder, plans, replay, systems, write};
use proptest::prelude::*;
use std::collections::BTreeMap;
use std::path::Path;

type Files = BTreeMap<String, Vec<u8>>;

fn read(folder: &Path) -> Files {
    std::fs::read_dir(folder)
        .unwrap()
        .map(|f| {
            let f = f.unwrap();
            (f.file_name().into_string().unwrap(), std::fs::read(f.path()).unwrap())
        })
        .collect()
}

fn files(plan: &Plan, seed: u64) -> Files {
    let folder = tempfile::tempdir().unwrap();
    write(plan, seed, folder.path()).unwrap();
    read(folder.path())
}

fn of_case(system: usize, causes: Vec<Cause>) -> Files {
    let folder = tempfile::tempdir().unwrap();
    let case = plain(ALL[system], causes, 1.0, 9);
    folder::write(&case, &case.run(), folder.path()).unwrap();
    read(folder.path())
}

/// A case without more than its causes.
fn plain(system: &'static System, causes: Vec<Cause>, duration: f64, seed: u64) -> Case {
    Case { system, causes, duration, poor: false, rough: false, seed, take: 0 }
}

fn cause(kind: Kind, place: Place, p: [f64; 4]) -> Cause {
    Cause { kind, place, p }
}

#[test]
fn same_seed_same_bytes_and_another_seed_others() {
    let plan = Plan { set: Set::Short, system: 0, effect: 3 };
    assert_eq!(files(&plan, 5), files(&plan, 5));
    assert_ne!(files(&plan, 5), files(&plan, 6));
}

#[test]
fn an_effect_of_no_size_changes_no_byte() {
    for system in 0..ALL.len() {
        let null = of_case(system, Vec::new());
        for (kind, place) in table(ALL[system]) {
            let p = match kind {
                Kind::Gain | Kind::Scale => [1.0, 0.0, 0.0, 0.0],
                Kind::Saturation | Kind::SensorSaturation => [f64::NEG_INFINITY, f64::INFINITY, 0.0, 0.0],
                Kind::RateLimit => [f64::INFINITY, 0.0, 0.0, 0.0],
                Kind::EndStop => [1e9, 1.0, 0.0, 0.0],
                Kind::EndStopLow => [-1e9, 1.0, 0.0, 0.0],
                Kind::Parameter => {
                    let Place::Parameter(k) = place else { continue };
                    [ALL[system].parameters[k].value, 0.0, 0.0, 0.0]
                }
                _ => [0.0; 4],
            };
            let mut made = of_case(system, vec![cause(kind, place, p)]);
            if kind == Kind::Noise {
                // It has the noise stated.
                made.insert("system.toml".into(), null["system.toml"].clone());
            }
            assert!(made == null, "{kind:?} at {place:?} of {system}");
        }
    }
}

#[test]
fn a_joint_at_rest_stands_still_below_its_friction_and_moves_above() {
    let machine = |level| {
        let friction = cause(Kind::Coulomb, Place::Joint(0), [level, 0.0, 0.0, 0.0]);
        Machine::new(ALL[0], &[0.02, 0.5, 0.03, 0.5], &[friction])
    };
    for (level, moves) in [(0.11, false), (0.09, true)] {
        let machine = machine(level);
        let (mut s, mut hidden) = (State::default(), machine.hidden());
        for i in 0..10_000 {
            machine.step(&mut s, &mut hidden, &[0.2, 0.0, 0.0], f64::from(i) * H);
        }
        assert_eq!(s.q[0] != 0.0, moves, "friction {level} against 0.1");
    }
}

#[test]
fn a_pendulum_without_friction_keeps_its_energy() {
    let machine = Machine::new(ALL[0], &[0.02, 0.5, 0.0, 0.5], &[]);
    let mut s = State { q: [1.0, 0.0, 0.0], ..State::default() };
    let energy = |s: &State| 0.01 * s.v[0] * s.v[0] + 0.5 * (1.0 - s.q[0].cos());
    let before = energy(&s);
    for i in 0..100_000 {
        machine.step(&mut s, &mut Vec::new(), &[0.0; N], f64::from(i) * H);
        assert!((energy(&s) / before - 1.0).abs() < 1e-6, "step {i}");
    }
}

#[test]
fn a_late_sensor_shows_earlier_samples() {
    let late = cause(Kind::DelayOut, Place::Output(0), [0.03, 0.0, 0.0, 0.0]);
    let case = plain(ALL[0], vec![late], 2.0, 3);
    let run = case.run();
    let plain = case.shown(0, &run.states, &[]);
    let shown = case.shown(0, &run.states, &case.causes);
    for k in 3..plain.len() {
        assert!((shown[k].1 - plain[k - 3].1).abs() < 1e-9, "sample {k}");
    }
    assert_eq!(plain[7].1, reading(ALL[0], 0, &run.states[700]));
}

#[test]
fn a_sensor_with_a_fast_clock_shows_nothing_from_after_the_end() {
    let fast = cause(Kind::SkewOut, Place::Output(0), [-0.005, 0.0, 0.0, 0.0]);
    let case = plain(ALL[0], vec![fast], 2.0, 3);
    let run = case.run();
    let noise = run.noise[0];
    // 10 ms too far at the end, which is one reading.
    assert!(run.readings[0].len() < case.shown(0, &run.states, &[]).len());
    for (stamp, y) in &run.readings[0] {
        let at = (stamp * 1.005 / H).round() as usize;
        let (truth, speed) = (run.states[at].q[0], run.states[at].v[0]);
        assert!((y - truth).abs() < 5.0 * noise + speed.abs() * H, "{stamp} s");
    }
}

/// What lags follows a ramp late by the area above its step response: the time constant of a first order, twice the damping of it of
/// a second.
#[test]
fn what_lags_follows_a_ramp_as_late_as_its_constants_say() {
    const SPEED: f64 = 3.0;
    /// A thousandth of a step (s).
    const EXACT: f64 = 1e-3 * H;
    let ramp: Vec<f64> = (0..20_000).map(|k| SPEED * k as f64 * H).collect();
    let last = ramp.len() - 1;
    for (sensor, actuator, p, late) in [
        (Kind::SensorLag, Kind::Lag, [0.02, 0.0, 0.0, 0.0], 0.02),
        (Kind::SensorLagSecond, Kind::LagSecond, [0.02, 0.4, 0.0, 0.0], 0.016),
    ] {
        let slow = [cause(sensor, Place::Output(0), p)];
        let shown = show(&slow, 0, &ramp, 1, &mut stream(1, 50));
        assert!((ramp[last] - shown[last].1 - SPEED * late).abs() < EXACT * SPEED, "{:?}", shown[last]);
        let sluggish = [cause(actuator, Place::Input(0), p)];
        let mut channel = Channel::new(&sluggish, 0, 0.0, stream(1, 20));
        let mut acting = 0.0;
        for (k, middle) in ramp.iter().map(|u| u + 0.5 * SPEED * H).enumerate() {
            channel.send(k as f64 * H, middle);
            acting = channel.act(k as f64 * H);
        }
        let now = ramp[last] + 0.5 * SPEED * H;
        assert!((now - acting - SPEED * late).abs() < EXACT * SPEED, "{acting}");
    }
}

#[test]
fn a_command_that_arrives_within_a_step_acts_for_the_rest_of_it() {
    let late = cause(Kind::DelayIn, Place::Input(0), [0.25 * H, 0.0, 0.0, 0.0]);
    let case = plain(ALL[0], vec![late], 1.0, 3);
    let commands = [[1.0, 0.0, 0.0], [3.0, 0.0, 0.0]];
    let every = (1.0 / ALL[0].command_rate / H).round() as usize;
    let acting = case.acting(&commands, 2 * every, &case.causes);
    assert_eq!(acting[every - 1][0], 1.0);
    assert!((acting[every][0] - 2.5).abs() < 1e-9, "{}", acting[every][0]);
    assert_eq!(acting[every + 1][0], 3.0);
}

#[test]
fn every_folder_is_well_formed() {
    for system in 0..systems().len() {
        let made = files(&Plan { set: Set::Null, system, effect: 0 }, 8);
        let text = |name: &str| String::from_utf8(made[name].clone()).unwrap();
        assert!(!text("system.toml").contains('@'), "an unfilled place in system.toml");
        for line in text("recording.toml").lines().filter_map(|l| l.strip_prefix("file = ")) {
            let table = text(line.trim_matches('"'));
            let mut rows = table.lines();
            let columns = rows.next().unwrap().split(',').count();
            let mut last = -1.0;
            for row in rows {
                let values: Vec<f64> = row.split(',').map(|x| x.parse().unwrap()).collect();
                assert!(values.len() == columns && values.iter().all(|x| x.is_finite()) && values[0] > last);
                last = values[0];
            }
            assert!(last > 19.9);
        }
    }
}

fn of_draw(system: usize, kind: Kind, place: Place, seed: u64) -> (Case, crate::case::Run) {
    let system = ALL[system];
    let noise = if let Place::Output(o) = place { crate::case::noises(system, seed)[o] } else { 0.0 };
    let cause = draw(system, kind, place, 20.0, noise, &mut stream(seed, 4));
    let case = plain(system, vec![cause], 20.0, seed);
    let run = case.run();
    (case, run)
}

/// The cause of this label, a tenth of what is drawn.
fn small(system: &'static System, name: &str) -> Cause {
    let kinds = INPUT.iter().chain(JOINT).chain(OUTPUT).chain(&[Kind::Parameter]);
    let places = (0..N).flat_map(|i| [Place::Input(i), Place::Joint(i), Place::Output(i)]);
    let places: Vec<Place> = places.chain((0..system.parameters.len()).map(Place::Parameter)).collect();
    let exists = |place: &Place| match *place {
        Place::Input(i) => i < system.inputs.len(),
        Place::Joint(i) => i < system.joints.len(),
        Place::Output(i) => i < system.outputs.len(),
        Place::Parameter(_) => true,
    };
    let all = kinds.flat_map(|kind| places.iter().filter(|p| exists(p)).map(move |place| (*kind, *place)));
    let (kind, place) = all.into_iter().find(|(kind, place)| label(system, *kind, *place) == name).unwrap();
    let mut cause = draw(system, kind, place, 6.0, 0.0, &mut stream(1, 4));
    let null = match (kind, place) {
        (Kind::Gain | Kind::Scale, _) => 1.0,
        (Kind::Parameter, Place::Parameter(k)) => system.parameters[k].value,
        _ => 0.0,
    };
    cause.p[0] = null + 0.1 * (cause.p[0] - null);
    cause
}

#[test]
fn what_is_left_out_as_absorbed_leaves_no_trace_after_the_refit() {
    for system in ALL {
        for name in system.absorbed {
            let causes = vec![small(system, name)];
            let case = plain(system, causes, 6.0, 2);
            let run = case.run();
            let healthy = Case { causes: Vec::new(), ..case }.run();
            let readings = run.readings.iter().zip(&healthy.readings).zip(&run.noise);
            let before: f64 = readings
                .flat_map(|((a, b), noise)| a.iter().zip(b).map(move |(a, b)| ((a.1 - b.1) / noise).powi(2)))
                .sum();
            let after = detectability(&case, &run);
            assert!(before > 1.0 && after < 0.1, "{} {name}: {before} before, {after} after", system.name);
        }
    }
}

/// Nobody knows when a reading was taken: where it changes slowly beside its noise, times that scatter are their mean.
#[test]
fn of_times_that_scatter_the_mean_and_the_scatter_are_seen() {
    let judged = |kind: Kind, p: f64| {
        let case = plain(ALL[2], vec![cause(kind, Place::Output(0), [p, 0.0, 0.0, 0.0])], 6.0, 9);
        judge(&case, &case.run())
    };
    for (spread, is_its_mean) in [(4e-5, true), (1e-3, false)] {
        let (of_mean, _) = judged(Kind::DelayOut, 1.3236 * spread);
        let (seen, class) = judged(Kind::JitterOut, spread);
        assert!(of_mean > 0.1 && seen > of_mean, "{spread}: {seen} of which {of_mean}");
        assert_eq!(class[0], "jitter@output:angle1");
        assert_eq!(class.contains(&"delay@output:angle1".to_owned()), is_its_mean, "{spread}: {class:?}");
    }
}

#[test]
fn what_the_refit_follows_is_not_seen() {
    // All of these but the last are changes of parameters within their bounds; the last is none.
    let cases = [
        (1, Kind::Inertia, Place::Joint(0), [0.001, 0.0, 0.0, 0.0], false),
        (0, Kind::Gain, Place::Input(0), [1.08, 0.0, 0.0, 0.0], false),
        (4, Kind::Bias, Place::Output(0), [0.01, 0.0, 0.0, 0.0], false),
        (1, Kind::Parameter, Place::Parameter(1), [5.4, 0.0, 0.0, 0.0], false),
        (0, Kind::Coulomb, Place::Joint(0), [0.02, 0.0, 0.0, 0.0], true),
    ];
    for (system, kind, place, p, seen) in cases {
        let case = plain(ALL[system], vec![cause(kind, place, p)], 6.0, 2);
        let found = detectability(&case, &case.run());
        assert!(if seen { found > 100.0 } else { found < 1.0 }, "{kind:?}: {found}");
    }
}

#[test]
fn another_parameter_joins_what_looks_like_it() {
    let (case, run) = of_draw(2, Kind::Parameter, Place::Parameter(2), 1);
    let (_, class) = judge(&case, &run);
    assert_eq!(class[0], "parameter@parameter:b1");
    assert!(class.contains(&"viscous@joint:shoulder".to_owned()), "{class:?}");
}

#[test]
fn of_a_linear_machine_nobody_tells_which_end_is_sluggish() {
    let late = cause(Kind::SensorLagSecond, Place::Output(0), [0.0477, 0.443, 0.0, 0.0]);
    let slow = cause(Kind::Lag, Place::Input(0), [0.0786, 0.0, 0.0, 0.0]);
    for (cause, seed, other) in [
        (late, 10292741319297635324, "lag@input:u"),
        (slow, 10313817977960223181, "sensor_lag@output:position"),
    ] {
        let case = plain(ALL[4], vec![cause], 20.0, seed);
        let (_, class) = judge(&case, &case.run());
        assert!(class.contains(&other.to_owned()), "{class:?}");
    }
}

/// What acts behind a limit acts as a force does, however far another limit would go to make up for either.
#[test]
fn a_force_beside_a_limit_is_an_offset_behind_it() {
    let clipped = cause(Kind::Saturation, Place::Input(0), [-0.562, 1.12, 0.0, 0.0]);
    let pushed = cause(Kind::ConstantForce, Place::Joint(0), [-0.11, 0.0, 0.0, 0.0]);
    let case = plain(ALL[0], vec![clipped, pushed], 20.0, 11382151693535357592);
    let (_, class) = judge(&case, &case.run());
    assert_eq!(class[..2], ["saturation@input:u", "constant_force@joint:shaft"]);
    for other in ["wind@joint:shaft", "offset@input:u"] {
        assert!(class.contains(&other.to_owned()), "{class:?}");
    }
    assert!(!class.contains(&"coulomb@joint:shaft".to_owned()), "{class:?}");
}

/// An inertia that is added to another one is another inertia, however much the motor constant, which may not go on, would like
/// to stand in for either.
#[test]
fn another_inertia_is_an_added_one() {
    for value in [0.0262, 0.028] {
        let heavier = cause(Kind::Parameter, Place::Parameter(0), [value, 0.0, 0.0, 0.0]);
        let case = plain(ALL[0], vec![heavier], 20.0, 13333572978654078852);
        let (_, class) = judge(&case, &case.run());
        assert_eq!(class[0], "parameter@parameter:J");
        assert!(class.contains(&"inertia@joint:shaft".to_owned()), "{value}: {class:?}");
    }
}

/// Friction of one direction is friction of both and a constant force, which this machine may have.
#[test]
fn what_needs_other_parameters_to_look_like_it_joins_as_well() {
    let uneven = cause(Kind::Asymmetric, Place::Joint(0), [11.0, 0.5, 0.0, 0.0]);
    let case = plain(ALL[4], vec![uneven], 6.0, 7);
    let (_, class) = judge(&case, &case.run());
    assert!(class.contains(&"coulomb@joint:axis".to_owned()), "{class:?}");
}

/// A servo that reads too much goes to other goals, and its spring rests elsewhere.
#[test]
fn classes_of_a_pair_are_those_beside_the_other_one() {
    let bias = cause(Kind::Bias, Place::Output(0), [0.03, 0.0, 0.0, 0.0]);
    let spring = cause(Kind::Spring, Place::Joint(0), [0.2, 0.1, 0.0, 0.0]);
    let case = plain(ALL[1], vec![bias, spring], 6.0, 7);
    let (_, class) = judge(&case, &case.run());
    assert_eq!(class[..2], ["bias@output:position", "spring@joint:shaft"]);
    assert!(class.contains(&"offset@input:goal".to_owned()), "{class:?}");
    assert!(!class.contains(&"coulomb@joint:shaft".to_owned()), "{class:?}");
}

#[test]
fn noise_is_stated_where_more_of_it_is_the_cause() {
    let noisy = cause(Kind::Noise, Place::Output(0), [0.01, 0.0, 0.0, 0.0]);
    for seed in 0..8 {
        let case = plain(ALL[0], vec![noisy], 1.0, seed);
        assert!(case.run().declared);
    }
}

#[test]
fn a_command_never_acts_before_it_is_sent() {
    for seed in 0..20 {
        let late = draw(ALL[0], Kind::SkewIn, Place::Input(0), 20.0, 0.0, &mut stream(seed, 4));
        assert!(late.p[0] > 0.0);
    }
}

#[test]
fn a_cause_that_never_acts_is_drawn_again() {
    let index = table(ALL[0]).iter().position(|(kind, _)| *kind == Kind::EndStop).unwrap();
    let plan = Plan { set: Set::Single, system: 0, effect: index };
    let (silent, run) = of_draw(0, Kind::EndStop, Place::Joint(0), 3);
    assert!(detectability(&silent, &run) < 0.1, "the first draw of this seed never acts");
    let folder = tempfile::tempdir().unwrap();
    let answer = write(&plan, 3, folder.path()).unwrap();
    assert!(answer.detectability >= 0.1, "{answer:?}");
    assert_ne!(answer.effects[0].parameters["limit"], silent.causes[0].p[0]);
}

#[test]
fn each_of_a_pair_acts_beside_the_other() {
    // Friction keeps this pendulum from where its sensor would clip.
    let plan = Plan { set: Set::Pair, system: 0, effect: 14 };
    let case = crate::case(&plan, 16336837335011046638).unwrap();
    let worth = crate::signature::least_beside(&case, &case.run());
    assert!(worth >= 0.1, "{worth} of {:?}", case.causes);
}

#[test]
fn no_supply_gives_less_to_who_asks_for_more() {
    let (system, sag) =
        (ALL.iter().position(|system| system.name == "linear-axis").unwrap(), Kind::SupplySag);
    let index = table(ALL[system]).iter().position(|(kind, _)| *kind == sag).unwrap();
    let plan = Plan { set: Set::Single, system, effect: index };
    for seed in 0..4 {
        let case = crate::case(&plan, seed).unwrap();
        let largest = case.run().commands.iter().fold(0.0_f64, |most, u| most.max(u[0].abs()));
        assert!(case.causes[0].p[0] * largest <= 0.5, "seed {seed}: {} of {largest}", case.causes[0].p[0]);
    }
    let (drawn, run) = of_draw(system, sag, Place::Input(0), 0);
    assert!(!crate::is_supply(&drawn, &run), "the first draw of this seed takes more: {:?}", drawn.causes);
}

#[test]
fn an_experiment_is_played_on_the_same_machine() {
    let plan = Plan { set: Set::Single, system: 0, effect: 3 };
    let folder = tempfile::tempdir().unwrap();
    let times: Vec<f64> = (0..100).map(|k| f64::from(k) * 0.02).collect();
    let values: Vec<f64> = times.iter().map(|t| if *t < 1.0 { 0.5 } else { -0.5 }).collect();
    let commands = BTreeMap::from([("voltage".to_owned(), values)]);
    let experiment = Experiment { times, duration: 2.0, commands };
    replay(&plan, 5, &experiment, folder.path()).unwrap();
    let (first, second) = (files(&plan, 5), read(folder.path()));
    assert_eq!(first["system.toml"], second["system.toml"], "the same machine and the same noise level");
    let table = String::from_utf8(second["commands.csv"].clone()).unwrap();
    assert_eq!(table.lines().count(), 101);
    assert!(table.lines().nth(51).unwrap().ends_with(",-0.5000000"), "{table}");
    let unknown = Experiment { commands: BTreeMap::from([("ghost".into(), Vec::new())]), ..experiment };
    assert!(replay(&plan, 5, &unknown, folder.path()).is_err());
}

/// The forces that scatter are no cause: the answer is that of the machine without them, and what moves under them moves otherwise.
#[test]
fn forces_that_scatter_move_a_machine_and_are_no_cause() {
    let of = |set: Set| {
        let folder = tempfile::tempdir().unwrap();
        let answer = write(&Plan { set, system: 0, effect: 2 }, 5, folder.path()).unwrap();
        (answer, read(folder.path()))
    };
    let ((calm, still), (rough, moved)) = (of(Set::Single), of(Set::Rough));
    assert_eq!(
        (calm.effects, calm.class, calm.detectability),
        (rough.effects, rough.class, rough.detectability)
    );
    assert_eq!(still["commands.csv"], moved["commands.csv"], "this machine is driven open loop");
    assert_ne!(still["angle.csv"], moved["angle.csv"]);
    assert!(of(Set::RoughNull).0.effects.is_empty());
}

proptest! {
    #[test]
    fn plans_exist_and_are_spread(count in 0usize..200, seed: u64) {
        let sets = [Set::Single, Set::OtherForm, Set::Pair, Set::Outside, Set::PoorExcitation, Set::Short, Set::Rough];
        for set in sets {
            let all = plans(set, count, seed);
            prop_assert_eq!(all.len(), count);
            for (i, plan) in all.iter().enumerate() {
                prop_assert_eq!(plan.system, i % systems().len());
                prop_assert!(plan.effect < causes(set, ALL[plan.system]).len());
            }
        }
        prop_assert!((0..systems().len()).all(|s| !effects(s).is_empty()));
    }
}
