//! The generator keeps its promises.

use crate::effect::Kind;
use crate::{Plan, Set, effect, plans, write};

fn bytes(plan: &Plan, seed: u64) -> Vec<(String, Vec<u8>)> {
    let folder = tempfile::tempdir().unwrap();
    write(plan, seed, folder.path()).unwrap();
    let mut files: Vec<_> = std::fs::read_dir(folder.path())
        .unwrap()
        .map(|f| {
            let f = f.unwrap();
            (f.file_name().into_string().unwrap(), std::fs::read(f.path()).unwrap())
        })
        .collect();
    files.sort();
    files
}

#[test]
fn same_seed_same_bytes_and_another_seed_others() {
    let plan = Plan { set: Set::Short, system: 0, effect: 3 };
    assert_eq!(bytes(&plan, 5), bytes(&plan, 5));
    assert_ne!(bytes(&plan, 5), bytes(&plan, 6));
}

#[test]
fn every_kind_of_cause_has_a_plan() {
    for set in [Set::Single, Set::OtherForm, Set::Outside] {
        for plan in plans(set, 600, 1) {
            assert!(plan.effect < crate::causes(set, crate::system::ALL[plan.system]).len());
        }
    }
    assert!(effect::table(crate::system::ALL[0]).iter().any(|c| c.0 == Kind::Coulomb));
}
