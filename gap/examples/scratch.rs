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
        if which != "all" && which != name { continue; }
        let t0 = std::time::Instant::now();
        let experiment = record(hidden, seed, 20.0);
        let system = parallax_model::system::System::parse(SYSTEM, "s.toml").unwrap();
        let setup = setup::Setup::new(system.equations().unwrap(), experiment, None);
        let null = search::null(&setup);
        println!("== {name}: noise {:?} joints {:?} null cost {:.1} ev {:.1} shoot {:.1} theta {:?} noise {:?}", setup.output_noise, setup.joints, null.innovation.pass.cost(), null.innovation.evidence_cost, null.shooting_cost, null.theta(), null.innovation.noise);
        let (c, _) = library::candidates(&setup);
        let mut fits = search::singles(&setup, &null, &c);
        fits.sort_by(|a, b| a.innovation.evidence_cost.total_cmp(&b.innovation.evidence_cost));
        for f in &fits {
            println!("  {:32} dev {:9.1} dshoot {:9.1}  lq {:.1} lr {:.2}  theta {:?} (shoot {:?})", f.hypothesis.label(), f.innovation.evidence_cost - null.innovation.evidence_cost, f.shooting_cost - null.shooting_cost, f.innovation.noise.log_process, f.innovation.noise.log_output[0], f.theta().iter().map(|v| (v*1e5).round()/1e5).collect::<Vec<_>>(), f.shooting.theta.iter().map(|v| (v*1e5).round()/1e5).collect::<Vec<_>>());
        }
        println!("  time {:?}", t0.elapsed());
    }
}
