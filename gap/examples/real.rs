#![allow(missing_docs)]
use parallax_gap::*;
fn main() {
    let a: Vec<String> = std::env::args().collect();
    let t0 = std::time::Instant::now();
    let log = parallax_runtime::import::folder(a[2].as_ref()).unwrap();
    let system = parallax_runtime::import::read_system(a[1].as_ref()).unwrap();
    let (equations, mut experiment) = bind::bind(&system, &log).unwrap();
    let thin: usize = a.get(3).and_then(|s| s.parse().ok()).unwrap_or(1);
    let mut k = 0; experiment.samples.retain(|_| { k += 1; k % thin == 0 });
    let setup = setup::Setup::new(equations, experiment, None);
    println!("noise {:?} joints {:?} scale {:?} {:?}", setup.output_noise, setup.joints, setup.noise.scale, t0.elapsed());
    let null = search::null(&setup);
    println!("null cost {:.1} ev {:.1} shoot {:.1} theta {:?} noise {:?} {:?}", null.innovation.pass.cost(), null.innovation.evidence_cost, null.shooting_cost, null.theta(), null.innovation.noise, t0.elapsed());
    let (c, _) = library::candidates(&setup);
    let mut fits = search::singles(&setup, &null, &c);
    fits.sort_by(|a, b| a.innovation.evidence_cost.total_cmp(&b.innovation.evidence_cost));
    for f in &fits {
        println!("  {:32} dev {:9.1} dshoot {:9.1}  lq {:.1} lr {:.2?}  theta {:?} (shoot {:?})", f.hypothesis.label(), f.innovation.evidence_cost - null.innovation.evidence_cost, f.shooting_cost - null.shooting_cost, f.innovation.noise.log_process, f.innovation.noise.log_output, f.theta().iter().map(|v| (v*1e5).round()/1e5).collect::<Vec<_>>(), f.shooting.theta.iter().map(|v| (v*1e5).round()/1e5).collect::<Vec<_>>());
    }
    println!("  time {:?}", t0.elapsed());
}
