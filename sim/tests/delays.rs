//! Measured delays: planted distributions are found again from a thousand samples, and recordings give graphs that behave
//! as the run did.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use parallax_model::tree::Tree;
use parallax_runtime::delay::Delay;
use parallax_runtime::graph::{Graph, GraphBuilder};
use parallax_runtime::node::{Message, Node, NodeError, Port, Step};
use parallax_runtime::random::{Purpose, stream};
use parallax_runtime::registry::{NodeKind, Registry};
use parallax_runtime::time::{Nanos, from_seconds, to_seconds};
use parallax_sim::Executor;
use parallax_sim::delays::{DelayFit, LeftOut, Measured, Place, fit, fitted_graph, measured};

const SEEDS: u64 = 50;

fn draw(delay: &Delay, seed: u64, count: usize) -> Vec<Nanos> {
    let mut random = stream(seed, Purpose::Communication, "a->b");
    let mut sampler = delay.sampler(&[]);
    (0..count).map(|_| sampler.sample(&mut random, &[])).collect()
}

fn of(delays: Vec<Nanos>) -> DelayFit {
    let place = Place::Computation { node: "camera".into() };
    let successive = (0..delays.len()).map(|index| index > 0).collect();
    fit(&Measured { place, delays, successive, left_out: LeftOut::default() }).unwrap()
}

fn mixture(parts: &[(f64, f64, f64)]) -> Delay {
    Delay::Mixture {
        weights: parts.iter().map(|part| part.0).collect(),
        means: parts.iter().map(|part| part.1).collect(),
        stds: parts.iter().map(|part| part.2).collect(),
    }
}

/// The components of a fit, whatever correlates them.
fn parts(delay: &Delay) -> Vec<(f64, f64, f64)> {
    match delay {
        Delay::Correlated { of, .. } => parts(of),
        Delay::Normal { mean, std } => vec![(1.0, *mean, *std)],
        Delay::Constant { seconds } => vec![(1.0, *seconds, 0.0)],
        Delay::Mixture { weights, means, stds } => {
            weights.iter().zip(means).zip(stds).map(|((w, m), s)| (*w, *m, *s)).collect()
        }
        other => panic!("{other:?} is not fitted"),
    }
}

/// Of fifty seeds, how many find the planted number of components; those that do must find the components themselves,
/// within four standard errors and a little.
fn recovered(planted: &[(f64, f64, f64)], disturb: impl Fn(u64, &mut Vec<Nanos>)) -> u64 {
    let delay = mixture(planted);
    let count = 1000;
    let mut right = 0;
    for seed in 0..SEEDS {
        let mut delays = draw(&delay, seed, count);
        disturb(seed, &mut delays);
        let found = parts(&of(delays).fit);
        if found.len() != planted.len() {
            println!("seed {seed}: {found:?}");
            continue;
        }
        right += 1;
        for (&(weight, mean, std), &(w, m, s)) in planted.iter().zip(&found) {
            let samples = count as f64 * weight;
            assert!((w - weight).abs() < 0.06, "seed {seed}: weight {w} is not {weight}");
            assert!(
                (m - mean).abs() < 6.0 * std / samples.sqrt() + 1e-6,
                "seed {seed}: mean {m} is not {mean}"
            );
            assert!((s / std - 1.0).abs() < 6.0 / samples.sqrt(), "seed {seed}: std {s} is not {std}");
        }
    }
    right
}

fn undisturbed(_: u64, _: &mut Vec<Nanos>) {}

const ONE: [(f64, f64, f64); 1] = [(1.0, 2e-3, 0.2e-3)];
/// As in figure 5c of the paper: a camera whose shutter takes one or two of its periods.
const CAMERA: [(f64, f64, f64); 2] = [(0.65, 12e-3, 1.2e-3), (0.35, 21e-3, 1.6e-3)];
const THREE: [(f64, f64, f64); 3] = [(0.5, 1.0e-3, 0.08e-3), (0.3, 1.6e-3, 0.1e-3), (0.2, 2.4e-3, 0.12e-3)];

#[test]
fn planted_mixtures_are_found_again() {
    for planted in [&ONE[..], &CAMERA, &THREE] {
        let right = recovered(planted, undisturbed);
        assert!(right >= 48, "{planted:?}: {right} of {SEEDS}");
    }
}

#[test]
fn outliers_are_counted_and_left_out() {
    for planted in [&ONE[..], &CAMERA] {
        let far = |_: u64, delays: &mut Vec<Nanos>| {
            for delay in delays.iter_mut().step_by(50) {
                *delay *= 10;
            }
        };
        let right = recovered(planted, far);
        assert!(right >= 47, "{planted:?}: {right} of {SEEDS}");
        // Spread out, not in one place.
        let spread = |seed: u64, delays: &mut Vec<Nanos>| {
            let stalls = draw(&Delay::Uniform { low: 0.02, high: 0.2 }, seed + 1000, 20);
            for (delay, stall) in delays.iter_mut().step_by(50).zip(stalls) {
                *delay += stall;
            }
        };
        let right = recovered(planted, spread);
        assert!(right >= 47, "spread, {planted:?}: {right} of {SEEDS}");
    }
    let mut delays = draw(&mixture(&CAMERA), 3, 1000);
    for delay in delays.iter_mut().step_by(50) {
        *delay *= 10;
    }
    let found = of(delays);
    assert_eq!(found.outliers, 20);
    assert!(found.max_s > 0.1 && found.fit.quantile(0.9999).unwrap() < 0.03);
    assert!(found.distance < 0.05, "{}", found.distance);
}

#[test]
fn a_small_mode_of_its_own_is_no_outlier_once_it_is_substantial() {
    let planted = [(0.92, 2e-3, 0.1e-3), (0.08, 20e-3, 1e-3)];
    let right = recovered(&planted, undisturbed);
    assert!(right >= 48, "{right} of {SEEDS}");
}

#[test]
fn coarse_clocks_do_not_add_components() {
    // Stamps of a tenth, of half and of a whole standard deviation.
    for step in [20_000, 100_000, 200_000] {
        let right = recovered(&ONE, |_, delays| {
            for delay in delays.iter_mut() {
                *delay = (*delay + step / 2) / step * step;
            }
        });
        assert!(right >= 48, "step {step} ns: {right} of {SEEDS}");
    }
    let right = recovered(&CAMERA, |_, delays| {
        for delay in delays.iter_mut() {
            *delay = (*delay + 500_000) / 1_000_000 * 1_000_000;
        }
    });
    assert!(right >= 47, "{right} of {SEEDS}");
}

#[test]
fn what_never_changes_is_constant() {
    assert_eq!(of(vec![1_500_000; 500]).fit, Delay::constant(1.5e-3));
    assert_eq!(of(vec![0; 500]).fit, Delay::ZERO);
    assert_eq!(of(vec![7]).fit, Delay::constant(7e-9));
    // Nor is it where a few samples are not like the rest.
    let mut delays = vec![1_500_000; 1000];
    for (index, delay) in delays.iter_mut().step_by(60).enumerate() {
        *delay += 3_000_000 + 123_457 * index as Nanos;
    }
    let found = of(delays);
    assert_eq!((found.fit, found.outliers), (Delay::constant(1.5e-3), 17));
    // Two values are two constants.
    let two = of((0..1000).map(|k| if k % 5 == 0 { 3_000_000 } else { 1_000_000 }).collect());
    let found = parts(&two.fit);
    assert_eq!(found.len(), 2);
    for ((w, m, s), (weight, mean)) in found.into_iter().zip([(0.8, 1e-3), (0.2, 3e-3)]) {
        assert!((w - weight).abs() < 1e-3 && (m - mean).abs() < 1e-12 && s == 0.0, "{w} {m} {s}");
    }
}

#[test]
fn heavy_tails_and_skew_are_described_closely() {
    let delays = [
        Delay::LogNormal { mean: 2e-3, std: 1.5e-3 },
        Delay::Gamma { mean: 5e-3, std: 3e-3 },
        Delay::Gamma { mean: 0.3e-3, std: 0.1e-3 },
        Delay::Uniform { low: 1e-3, high: 4e-3 },
    ];
    for delay in delays {
        for seed in 0..10 {
            let found = of(draw(&delay, seed, 1000));
            assert!(found.distance < 0.035, "{delay:?}, seed {seed}: {}", found.distance);
            assert!(found.outliers <= 30, "{delay:?}, seed {seed}: {} outliers", found.outliers);
            let (mean, expected) = (found.fit.expected(), delay.expected());
            assert!((mean / expected - 1.0).abs() < 0.1, "{delay:?}, seed {seed}: {mean}");
        }
    }
}

#[test]
fn clipping_at_zero_is_undone() {
    // A quarter of all is clipped.
    let planted = Delay::Normal { mean: 0.2e-3, std: 0.3e-3 };
    let right = (0..SEEDS)
        .filter(|&seed| match of(draw(&planted, seed, 1000)).fit {
            Delay::Normal { mean, std } => {
                assert!((mean - 0.2e-3).abs() < 0.06e-3 && (std - 0.3e-3).abs() < 0.06e-3, "{mean} {std}");
                true
            }
            _ => false,
        })
        .count();
    assert!(right >= 48, "{right} of {SEEDS}");
}

#[test]
fn successive_delays_that_resemble_each_other_are_told() {
    for correlation in [-0.4, 0.3, 0.8] {
        let planted = Delay::Correlated { correlation, of: Box::new(mixture(&CAMERA)) };
        let mut near = 0;
        for seed in 0..20 {
            let found = of(draw(&planted, seed, 1000));
            let Delay::Correlated { correlation: value, .. } = found.fit else {
                panic!("seed {seed}: {:?}", found.correlation)
            };
            near += usize::from((value - correlation).abs() < 0.1);
        }
        assert!(near >= 19, "{correlation}: {near} of 20");
    }
    let chance = (0..SEEDS).filter(|&seed| of(draw(&mixture(&CAMERA), seed, 1000)).correlation.significant);
    assert!(chance.count() <= 1);
}

#[test]
fn very_many_samples_are_fitted_by_a_choice_of_them() {
    let found = of(draw(&mixture(&CAMERA), 1, 60_000));
    assert_eq!((found.samples, found.components), (60_000, 2));
    assert!(found.distance < 0.03, "{}", found.distance);
}

#[derive(Tree, Clone, Default)]
struct Count {
    objects: f64,
}
impl Message for Count {
    const NAME: &'static str = "test/Count";
}
const DETECTOR: Port<Count> = Port::new("detector");
struct Detector;
impl Node for Detector {
    type Output = Count;
    fn step(&mut self, step: &Step<'_>) -> Result<Count, NodeError> {
        Ok(Count { objects: (step.seq % 4) as f64 })
    }
}
struct Reader;
impl Node for Reader {
    type Output = Count;
    fn step(&mut self, step: &Step<'_>) -> Result<Count, NodeError> {
        Ok(step.latest(DETECTOR).message)
    }
}

fn registry() -> Registry {
    Registry::new()
        .with("detector", NodeKind::new(|_| Ok(Detector)))
        .with("reader", NodeKind::new(|_| Ok(Reader)).input(DETECTOR))
}

fn graph(computation: Delay, travel: Delay) -> Graph {
    let mut graph = GraphBuilder::new("g");
    let detector = graph.node::<Detector>("detector", "detector", 100.0).computation(computation).add();
    let reader = graph.node::<Reader>("reader", "reader", 100.0).add();
    graph.connect(detector, reader, DETECTOR).blocking().delay(travel).add();
    graph.supervisor(reader).validate(&registry()).unwrap()
}

#[test]
fn a_computation_takes_as_long_as_its_output_says() {
    let delay = Delay::Output {
        leaf: "objects".into(),
        offset: 1e-3,
        scale: 1e-3,
        min: 0.0,
        max: 3e-3,
        expected: Some(2e-3),
    };
    let recording = Executor::new(graph(delay, Delay::ZERO), 1).record(1_000_000_000).unwrap();
    let steps = &recording.node("detector").unwrap().steps;
    let took: Vec<Nanos> = steps.iter().take(5).map(|step| step.end - step.start).collect();
    assert_eq!(took, [1_000_000, 2_000_000, 3_000_000, 3_000_000, 1_000_000]);
    // The receiver is due when the message is expected, and waits for one that comes later.
    let reader = &recording.node("reader").unwrap().steps;
    assert_eq!((reader[0].due, reader[2].start), (2_000_000, 23_000_000));
}

#[test]
fn a_recording_gives_its_graph_with_the_delays_that_it_showed() {
    let declared = graph(mixture(&CAMERA[..1]), Delay::Normal { mean: 0.4e-3, std: 0.05e-3 });
    let recording = Executor::new(declared, 5).record(20_000_000_000).unwrap();
    let found = measured(&recording);
    let names: Vec<String> = found.iter().map(|measured| measured.place.to_string()).collect();
    assert_eq!(names, ["detector", "reader", "detector->reader"]);
    assert!(found[2].delays.len() > 1600 && found[2].left_out.unseen < 3, "{}", found[2].delays.len());

    let fitted = fitted_graph(&recording, &registry()).unwrap();
    assert!(fitted.missing.is_empty());
    let node = fitted.graph.node("detector").unwrap();
    assert!((node.computation.expected() - 12e-3).abs() < 0.2e-3, "{:?}", node.computation);
    assert_eq!(fitted.graph.node("reader").unwrap().computation, Delay::ZERO);
    let travel = &fitted.graph.connections[0].delay;
    assert!((travel.expected() - 0.4e-3).abs() < 0.01e-3, "{travel:?}");

    // The fitted graph runs, and its delays are those that were measured.
    let again = fitted.graph.validate(&registry()).unwrap();
    let again = measured(&Executor::new(again, 6).record(20_000_000_000).unwrap());
    let mean = |measured: &Measured| {
        measured.delays.iter().map(|&delay| to_seconds(delay)).sum::<f64>() / measured.delays.len() as f64
    };
    for (first, second) in found.iter().zip(&again) {
        assert!((mean(first) - mean(second)).abs() < 0.2e-3, "{}", first.place);
    }
    assert_eq!(from_seconds(mean(&again[1])), 0);
}

#[test]
fn what_a_recording_does_not_show_is_told() {
    let declared = graph(Delay::ZERO, Delay::constant(1e-3));
    let mut recording = Executor::new(declared, 5).record(200_000_000).unwrap();
    let steps = &mut recording.nodes[1].steps;
    // One message came before it was sent, and the last ten were never seen.
    steps.truncate(10);
    steps[4].inputs[0].consumed[0].received -= 2_000_000;
    let found = measured(&recording);
    assert_eq!(found[2].left_out, LeftOut { unseen: 10, negative: 1 });
    assert_eq!(found[2].delays, [1_000_000; 9]);
    assert_eq!(found[2].successive.iter().filter(|successive| !**successive).count(), 2);

    recording.nodes[1].steps.clear();
    let fitted = fitted_graph(&recording, &registry()).unwrap();
    let missing: Vec<String> = fitted.missing.iter().map(ToString::to_string).collect();
    assert_eq!(missing, ["reader", "detector->reader"]);
    assert_eq!(fitted.graph.connections[0].delay, Delay::constant(1e-3));
}
