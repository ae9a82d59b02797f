#![allow(missing_docs)]
use parallax_gap::*;
fn main() {
    let a: Vec<String> = std::env::args().collect();
    let t0 = std::time::Instant::now();
    let log = parallax_runtime::import::folder(a[2].as_ref()).unwrap();
    let system = parallax_runtime::import::read_system(a[1].as_ref()).unwrap();
    let d = diagnosis::diagnose(&system, &log, &Default::default(), &|f, l| {
        eprintln!("{f:.2} {l} {:?}", t0.elapsed())
    })
    .unwrap();
    println!("{}", serde_json::to_string_pretty(&d.report).unwrap());
    println!("  time {:?}", t0.elapsed());
}
