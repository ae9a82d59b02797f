//! The generator keeps its promises.

use crate::case::{Case, reading};
use crate::effect::{Cause, Kind, Place, table};
use crate::mechanics::{H, Machine};
use crate::system::{ALL, N, State};
use crate::{Plan, Set, causes, effects, folder, plans, systems, write};
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
    let case = Case { system: ALL[system], causes, duration: 1.0, poor: false, seed: 9 };
    folder::write(&case, &case.run(), folder.path()).unwrap();
    read(folder.path())
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
                _ => [0.0; 4],
            };
            assert!(
                of_case(system, vec![cause(kind, place, p)]) == null,
                "{kind:?} at {place:?} of {system}"
            );
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
    let case = Case { system: ALL[0], causes: vec![late], duration: 2.0, poor: false, seed: 3 };
    let run = case.run();
    let plain = case.shown(0, &run.states, &[]);
    let shown = case.shown(0, &run.states, &case.causes);
    for k in 3..plain.len() {
        assert!((shown[k].1 - plain[k - 3].1).abs() < 1e-9, "sample {k}");
    }
    assert_eq!(plain[7].1, reading(ALL[0], 0, &run.states[700]));
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

proptest! {
    #[test]
    fn plans_exist_and_are_spread(count in 0usize..200, seed: u64) {
        for set in [Set::Single, Set::OtherForm, Set::Pair, Set::Outside, Set::PoorExcitation, Set::Short] {
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
