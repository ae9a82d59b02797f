//! The diagnosis against hidden effects: the pendulum graph under the simulated clock, one run a seed.
//!
//! `cargo bench --bench hidden_effects -- [FIRST] [COUNT]` prints what was hidden and what was found, and a summary.
//! The world's effect comes from the seed alone; the diagnosis sees the recording, as on hardware.

use std::time::Instant;

use parallax_gap::diagnosis::{Options, diagnose};
use parallax_model::system::System;
use parallax_nodes::pendulum::{self, hidden::HiddenEffect};
use parallax_runtime::registry::Registry;
use parallax_sim::Executor;

fn main() {
    let numbers: Vec<u64> = std::env::args().skip(1).filter_map(|a| a.parse().ok()).collect();
    let (first, count) = (numbers.first().copied().unwrap_or(1000), numbers.get(1).copied().unwrap_or(20));
    let (mut right, mut null, mut alarms, mut effects) = (0, 0, 0, 0);
    for seed in first..first + count {
        let hidden = HiddenEffect::draw(seed);
        let truth = hidden.truth().map(|t| (format!("{}@{}", t.effect, t.place), t.to_string()));
        let registry = pendulum::kinds(Registry::new(), hidden);
        let graph = pendulum::graph().validate(&registry).expect("the demo's graph is valid");
        let recording = Executor::new(graph, seed).record(20_000_000_000).expect("the demo runs");
        let text = recording.graph.plant.clone().expect("the demo attaches its plant").system;
        let system = System::parse(&text, "attached").expect("the attached system is valid");
        let start = Instant::now();
        let found = diagnose(&system, &recording.log(), &Options::default(), &|_, _| ())
            .expect("it can be diagnosed");
        let seconds = start.elapsed().as_secs_f64();
        let report = &found.report;
        let leader = report.which.first().filter(|_| report.gap.detected);
        let class = leader.map(|w| w.class.clone()).unwrap_or_default();
        let good = match &truth {
            None => !report.gap.detected,
            Some((name, _)) => class.contains(name),
        };
        match truth {
            None => {
                null += 1;
                alarms += u32::from(report.gap.detected);
            }
            Some(_) => {
                effects += 1;
                right += u32::from(good);
            }
        }
        println!(
            "{seed:6} {} {:52} {:70} P {:.3} unexplained {:.3} p {:.0e} closed {:.4} rows {:.2} {:.2} {:.2} {:.2} {seconds:.1} s",
            if good { "right" } else { "WRONG" },
            truth.map_or_else(|| "nothing".into(), |t| t.1),
            if class.is_empty() { "no gap".into() } else { class.join(", ") },
            leader.map_or(0.0, |w| w.probability),
            report.unexplained.probability,
            report.gap.p_value,
            report.how_far.closed_by_effect.value,
            report.how_far.nominal,
            report.how_far.refitted,
            report.how_far.with_effect,
            report.how_far.black_box,
        );
    }
    println!("{right} of {effects} effects right; {alarms} false alarms on {null} runs without an effect");
}
