#![allow(missing_docs)]
#[path = "../tests/support/mod.rs"]
mod support;
use parallax_gap::*;
use support::{Hidden, SYSTEM, record};
fn main() {
    let which = std::env::args().nth(1).unwrap_or("all".into());
    let seed: u64 = std::env::args().nth(2).and_then(|s| s.parse().ok()).unwrap_or(1);
    let d = Hidden::default();
    let cases = [
        ("none", d),
        ("delay", Hidden { input_delay: 0.02, ..d }),
        ("lag", Hidden { lag: 0.03, ..d }),
        ("offset", Hidden { offset: 0.2, ..d }),
        ("saturation", Hidden { limit: Some(2.0), ..d }),
        ("deadband", Hidden { deadband: 0.25, ..d }),
        ("viscous", Hidden { viscous: 0.006, ..d }),
        ("coulomb", Hidden { forward: 0.02, backward: 0.02, ..d }),
        ("asym", Hidden { forward: 0.03, backward: 0.01, ..d }),
        ("bias", Hidden { bias: 0.05, ..d }),
        ("mass", Hidden { mass: 0.04, ..d }),
        ("wall", Hidden { wall: 0.3, ..d }),
    ];
    for (name, hidden) in cases {
        if which != "all" && which != name {
            continue;
        }
        let t0 = std::time::Instant::now();
        let experiment = record(hidden, seed, 20.0);
        let system = parallax_model::system::System::parse(SYSTEM, "s.toml").unwrap();
        let d = diagnosis::diagnose_experiment(
            system.equations().unwrap(),
            experiment,
            name,
            &Default::default(),
            &|_, _| (),
        )
        .unwrap();
        let r = &d.report;
        println!("== {name}: {}", r.summary);
        println!(
            "   p {:.1e} score {:.2} no-gap.. unexplained {:.3} {:.3}  far {:?}",
            r.gap.p_value, r.gap.score, r.unexplained.probability, r.unexplained.share, r.how_far
        );
        for w in r.which.iter().take(4) {
            println!(
                "   {:.4} {:?} {:?}",
                w.probability,
                w.class,
                w.effects
                    .iter()
                    .map(|e| format!(
                        "{:?}",
                        e.parameters
                            .iter()
                            .map(|(n, v)| format!("{n} {:.4}±{:.4}", v.value, v.std))
                            .collect::<Vec<_>>()
                    ))
                    .collect::<Vec<_>>()
            );
        }
        println!("  time {:?}", t0.elapsed());
    }
}
