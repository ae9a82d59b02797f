//! Properties of delays: what is drawn has the stated distribution, whatever correlates it, and never leaves its bounds.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use parallax_model::tree::Tree;
use parallax_runtime::delay::Delay;
use parallax_runtime::graph::{GraphError, GraphSpec, NodeSpec};
use parallax_runtime::node::{Message, Node, NodeError, Port, Step};
use parallax_runtime::random::{Purpose, stream};
use parallax_runtime::registry::{NodeKind, Registry};
use parallax_runtime::time::to_seconds;
use proptest::prelude::*;

fn draws(delay: &Delay, seed: u64, count: usize) -> Vec<f64> {
    let mut random = stream(seed, Purpose::Communication, "a->b");
    let mut sampler = delay.sampler(&[]);
    (0..count).map(|_| to_seconds(sampler.sample(&mut random, &[]))).collect()
}

/// The largest difference between the share of draws up to some delay and its probability.
fn distance(delay: &Delay, mut draws: Vec<f64>) -> f64 {
    draws.sort_by(f64::total_cmp);
    let count = draws.len() as f64;
    // Draws are rounded to whole nanoseconds.
    let below = |x: f64| draws.partition_point(|draw| *draw <= x + 0.6e-9) as f64 / count;
    let under = |x: f64| draws.partition_point(|draw| *draw < x - 0.6e-9) as f64 / count;
    let mut places = draws.clone();
    places.dedup();
    places
        .iter()
        .map(|&x| {
            // Exceeded on one side only: what lies exactly at a step of the distribution belongs to it.
            let (low, high) = (delay.cdf(x - 0.6e-9).unwrap(), delay.cdf(x + 0.6e-9).unwrap());
            (below(x) - high).max(low - under(x)).max(0.0)
        })
        .fold(0.0, f64::max)
}

fn marginal() -> impl Strategy<Value = Delay> {
    let mean = || 1e-4..0.05_f64;
    let component = (0.05..1.0_f64, 0.0..0.05_f64, prop_oneof![Just(0.0), 1e-6..0.01_f64]);
    prop_oneof![
        (-0.01..0.05_f64, 1e-5..0.02_f64).prop_map(|(mean, std)| Delay::Normal { mean, std }),
        (mean(), 0.05..2.0_f64).prop_map(|(mean, ratio)| Delay::Gamma { mean, std: mean * ratio }),
        (mean(), 0.05..2.0_f64).prop_map(|(mean, ratio)| Delay::LogNormal { mean, std: mean * ratio }),
        (mean(), 1e-5..0.05_f64).prop_map(|(low, span)| Delay::Uniform { low, high: low + span }),
        prop::collection::vec(0.0..0.05_f64, 1..20).prop_map(|samples| Delay::Empirical { samples }),
        prop::collection::vec(component, 1..5).prop_map(|parts| Delay::Mixture {
            weights: parts.iter().map(|part| part.0).collect(),
            means: parts.iter().map(|part| part.1).collect(),
            stds: parts.iter().map(|part| part.2).collect(),
        }),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    /// Kolmogorov's distance of n independent draws exceeds 3/sqrt(n) once in thirty million times.
    #[test]
    fn draws_follow_the_distribution(delay in marginal(), seed: u64) {
        prop_assert_eq!(delay.problem(), None);
        let found = distance(&delay, draws(&delay, seed, 8000));
        prop_assert!(found < 3.0 / 8000_f64.sqrt(), "{:?}: {}", delay, found);
    }

    /// Correlated draws are worth fewer independent ones, by (1 - r)/(1 + r).
    #[test]
    fn a_correlation_keeps_the_distribution(of in marginal(), correlation in -0.6..0.8_f64, seed: u64) {
        let delay = Delay::Correlated { correlation, of: Box::new(of.clone()) };
        prop_assert_eq!(delay.problem(), None);
        prop_assert_eq!(delay.expected(), of.expected());
        let worth = 8000.0 * (1.0 - correlation.max(0.0)) / (1.0 + correlation.max(0.0));
        let found = distance(&of, draws(&delay, seed, 8000));
        prop_assert!(found < 3.0 / worth.sqrt(), "{:?}: {}", delay, found);
    }

    #[test]
    fn quantiles_invert_the_distribution(delay in marginal(), p in 0.001..0.999_f64) {
        let x = delay.quantile(p).unwrap();
        let (low, high) = delay.bounds();
        prop_assert!(x >= low && x <= high);
        prop_assert!(delay.cdf(x + 1e-9).unwrap() >= p - 1e-6, "{:?} at {}: {}", delay, p, x);
        prop_assert!(x <= 1e-9 || delay.cdf(x - 2e-9).unwrap() <= p + 1e-6, "{:?} at {}: {}", delay, p, x);
    }

    #[test]
    fn densities_integrate_to_the_distribution(delay in marginal(), p in 0.1..0.8_f64) {
        let (low, high) = (delay.quantile(p).unwrap(), delay.quantile(p + 0.1).unwrap());
        // Steps have no density: only stretches without one are integrated.
        let smooth = match &delay {
            Delay::Mixture { stds, .. } => stds.iter().all(|std| *std > 1e-4),
            Delay::Empirical { .. } => false,
            _ => true,
        };
        if low > 1e-6 && high > low && smooth {
            let (count, width) = (4000, high - low);
            let at = |i: i32| delay.density(low + width * (f64::from(i) + 0.5) / f64::from(count)).unwrap();
            let integral: f64 = (0..count).map(at).sum::<f64>() * width / f64::from(count);
            let mass = delay.cdf(high).unwrap() - delay.cdf(low).unwrap();
            prop_assert!((integral - mass).abs() < 1e-4, "{:?}: {} is not {}", delay, integral, mass);
        }
    }

    #[test]
    fn toml_and_json_keep_delays(of in marginal(), correlation in -0.9..0.9_f64) {
        let delay = Delay::Correlated { correlation, of: Box::new(of) };
        let text = toml::to_string(&delay).unwrap();
        prop_assert_eq!(&toml::from_str::<Delay>(&text).unwrap(), &delay);
        let text = serde_json::to_string(&delay).unwrap();
        prop_assert_eq!(&serde_json::from_str::<Delay>(&text).unwrap(), &delay);
    }
}

/// Correlation of each number with the one after it.
fn autocorrelation(values: &[f64]) -> f64 {
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    let variance: f64 = values.iter().map(|x| (x - mean).powi(2)).sum();
    values.windows(2).map(|pair| (pair[0] - mean) * (pair[1] - mean)).sum::<f64>() / variance
}

#[test]
fn successive_delays_have_the_stated_correlation() {
    let of = Box::new(Delay::Normal { mean: 0.1, std: 0.01 });
    for correlation in [-0.5, 0.0, 0.5, 0.95] {
        let delay = Delay::Correlated { correlation, of: of.clone() };
        let found = autocorrelation(&draws(&delay, 3, 20_000));
        assert!((found - correlation).abs() < 0.03, "{correlation}: {found}");
    }
    // Of a gamma the number of the copula is not that of the delays, but it is close.
    let delay = Delay::Correlated { correlation: 0.8, of: Box::new(Delay::Gamma { mean: 0.01, std: 0.008 }) };
    let found = autocorrelation(&draws(&delay, 4, 20_000));
    assert!((0.68..0.82).contains(&found), "{found}");
}

#[test]
fn the_numbers_drawn_for_a_seed_stay_the_same() {
    // Recordings of simulated runs repeat only as long as these do.
    let pinned = |delay: Delay| {
        let mut random = stream(1, Purpose::Computation, "camera");
        let mut sampler = delay.sampler(&[]);
        [0; 3].map(|_| sampler.sample(&mut random, &[]))
    };
    let found = [
        pinned(Delay::Normal { mean: 0.01, std: 0.002 }),
        pinned(Delay::LogNormal { mean: 0.01, std: 0.002 }),
        pinned(Delay::Uniform { low: 0.01, high: 0.02 }),
        pinned(Delay::Empirical { samples: vec![0.001, 0.002, 0.003, 0.004] }),
    ];
    let expected = [
        [11_913_166, 9_977_980, 10_558_574],
        [11_851_075, 9_784_449, 10_363_451],
        [16_861_755, 14_978_916, 15_746_727],
        [3_000_000, 2_000_000, 3_000_000],
    ];
    assert_eq!(found, expected);
}

/// A detector that says how many objects it saw.
#[derive(Tree, Clone, Default)]
struct Objects {
    objects: f64,
    brightness: f64,
}
impl Message for Objects {
    const NAME: &'static str = "test/Objects";
}
const DETECTOR: Port<Objects> = Port::new("detector");
struct Detector;
impl Node for Detector {
    type Output = Objects;
    fn step(&mut self, step: &Step<'_>) -> Result<Objects, NodeError> {
        Ok(Objects { objects: step.seq as f64, brightness: 0.5 })
    }
}
struct Reader;
impl Node for Reader {
    type Output = Objects;
    fn step(&mut self, step: &Step<'_>) -> Result<Objects, NodeError> {
        Ok(step.latest(DETECTOR).message)
    }
}

fn registry() -> Registry {
    Registry::new()
        .with("detector", NodeKind::new(|_| Ok(Detector)))
        .with("reader", NodeKind::new(|_| Ok(Reader)).input(DETECTOR))
}

fn output(leaf: &str) -> Delay {
    Delay::Output { leaf: leaf.into(), offset: 0.002, scale: 0.0005, min: 0.001, max: 0.004, expected: None }
}

fn spec() -> GraphSpec {
    let text = "name = 'g'\nsupervisor = 'reader'\n\
        [[node]]\nname = 'detector'\nkind = 'detector'\nrate = 50.0\n\
        computation = { distribution = 'output', leaf = 'objects', offset = 0.002, scale = 0.0005, min = 0.001, max = 0.004 }\n\
        [[node]]\nname = 'reader'\nkind = 'reader'\nrate = 50.0\n\
        [[connection]]\nfrom = 'detector'\nto = 'reader'\n";
    GraphSpec::from_toml(text).unwrap()
}

#[test]
fn a_delay_follows_from_the_output_within_its_bounds() {
    let spec = spec();
    assert_eq!(spec.nodes[0].computation, output("objects"));
    let graph = spec.validate(&registry()).unwrap();
    // The middle of the bounds is what the schedule expects.
    assert_eq!(graph.nodes()[1].grid.phase(), 2_500_000);
    assert_eq!(graph.nodes()[0].computation.bounds(), (0.001, 0.004));
    let mut random = stream(1, Purpose::Computation, "detector");
    let mut sampler = graph.nodes()[0].computation.sampler(&graph.nodes()[0].kind.output().leaves);
    let mut at = |objects: f64| sampler.sample(&mut random, &[objects, 0.5]);
    assert_eq!(
        [0.0, 2.0, 100.0, -100.0, f64::NAN].map(&mut at),
        [2_000_000, 3_000_000, 4_000_000, 1_000_000, 4_000_000]
    );
}

#[test]
fn an_output_that_lacks_the_leaf_and_a_connection_are_told() {
    let mut wrong = spec();
    wrong.nodes[0].computation = output("object");
    let error = wrong.validate(&registry()).unwrap_err();
    assert!(matches!(error, GraphError::DelayLeaf { .. }));
    let text = error.to_string();
    assert!(text.contains("`detector`") && text.contains("did you mean `objects`"), "{text}");

    let mut wrong = spec();
    wrong.connections[0].delay = output("objects");
    let error = wrong.validate(&registry()).unwrap_err();
    assert!(matches!(error, GraphError::DelayOfOutput { .. }));
    assert!(error.to_string().contains("detector -> reader"), "{error}");
}

#[test]
fn impossible_numbers_of_the_new_distributions_are_named() {
    let mixture = |weights: &[f64], means: &[f64], stds: &[f64]| Delay::Mixture {
        weights: weights.to_vec(),
        means: means.to_vec(),
        stds: stds.to_vec(),
    };
    let normal = Delay::Normal { mean: 0.01, std: 0.001 };
    let correlated = |correlation: f64, of: Delay| Delay::Correlated { correlation, of: Box::new(of) };
    let wrong = [
        mixture(&[], &[], &[]),
        mixture(&[1.0], &[0.1, 0.2], &[0.1]),
        mixture(&[0.0], &[0.1], &[0.1]),
        mixture(&[1.0, -0.5], &[0.1, 0.1], &[0.1, 0.1]),
        mixture(&[1.0], &[f64::NAN], &[0.1]),
        mixture(&[1.0], &[0.1], &[-0.1]),
        Delay::Gamma { mean: 0.0, std: 0.1 },
        correlated(1.0, normal.clone()),
        correlated(f64::NAN, normal.clone()),
        correlated(0.5, correlated(0.5, normal)),
        correlated(0.5, output("objects")),
        correlated(0.5, Delay::constant(-1.0)),
        Delay::Output { leaf: "x".into(), offset: 0.0, scale: 1.0, min: 0.2, max: 0.1, expected: None },
        Delay::Output { leaf: "x".into(), offset: 0.0, scale: 1.0, min: 0.0, max: 0.1, expected: Some(0.2) },
        Delay::Output {
            leaf: "x".into(),
            offset: 0.0,
            scale: f64::INFINITY,
            min: 0.0,
            max: 0.1,
            expected: None,
        },
    ];
    for delay in wrong {
        assert!(delay.problem().is_some(), "{delay:?}");
        assert_eq!((delay.cdf(0.1), delay.quantile(0.5)), (None, None), "{delay:?}");
    }
    let spec = NodeSpec { computation: mixture(&[1.0], &[], &[]), ..NodeSpec::new("a", "detector", 1.0) };
    let graph = GraphSpec {
        name: "g".into(),
        supervisor: "a".into(),
        nodes: vec![spec],
        connections: vec![],
        plant: None,
    };
    let text = graph.validate(&registry()).unwrap_err().to_string();
    assert!(text.contains("computation delay of node `a` needs as many weights"), "{text}");
}
