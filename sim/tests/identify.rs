//! Identification of simulated pendulums: derivatives, what is found again, what cannot be.

use std::ops::ControlFlow;

use parallax_model::fit::{HybridOptions, MarquardtOptions, View};
use parallax_nodes::{pendulum, registry};
use parallax_runtime::recording::Recording;
use parallax_sim::Executor;
use parallax_sim::identify::{
    Checkpoint, Evaluator, HiddenDelay, IdentifyError, Method, Output, Problem, Scatter, Simulated,
    Specification, Target, Unknown, identify, search,
};

fn unknown(name: &str, node: &str, leaf: &str, low: f64, high: f64) -> Unknown {
    Unknown {
        name: name.into(),
        targets: vec![Target::Parameter { node: node.into(), leaf: leaf.into() }],
        low,
        high,
        start: None,
        transform: None,
        prior: None,
        unit: String::new(),
    }
}

fn state(leaf: &str, low: f64, high: f64) -> Unknown {
    Unknown {
        targets: vec![Target::State { node: "world".into(), leaf: leaf.into() }],
        ..unknown(leaf, "world", leaf, low, high)
    }
}

fn hidden(name: &str, from: &str, to: &str, max: Option<f64>) -> HiddenDelay {
    HiddenDelay {
        name: name.into(),
        from: from.into(),
        to: to.into(),
        port: None,
        min: 0.0,
        max,
        start: None,
        prior: None,
        interpolation: None,
        scatter: None,
        window: None,
    }
}

/// The demo's graph, run by its own world, which hides a delay of the commands.
fn recording(delay: f64, seconds: i64) -> Recording {
    let effect = pendulum::hidden::HiddenEffect::Delay { delay };
    let registry = pendulum::kinds(parallax_runtime::registry::Registry::new(), effect);
    let graph = pendulum::graph().validate(&registry).expect("the demo's graph");
    Executor::new(graph, 3).record(seconds * 1_000_000_000).expect("a run")
}

fn specification() -> Specification {
    Specification {
        nodes: vec![Simulated {
            node: "world".into(),
            kind: Some("pendulum/simulator".into()),
            parameters: Some([("friction".to_owned(), 0.0.into())].into_iter().collect()),
            rate: Some(100.0),
        }],
        unknowns: vec![
            unknown("J", "world", "pendulum.inertia", 8e-5, 3.2e-4),
            unknown("K", "world", "pendulum.motor", 0.015, 0.06),
            state("angle", 2.0, 4.3),
            state("speed", -3.0, 3.0),
        ],
        delays: vec![
            hidden("actuator", "motor", "world", Some(0.05)),
            // Longer than a tick, so that every picture lies between two of them.
            HiddenDelay { min: 0.01, ..hidden("sensor", "world", "camera", Some(0.03)) },
        ],
        outputs: vec![Output {
            node: "camera".into(),
            leaf: "angle".into(),
            noise: Some(0.0015),
            wrap: Some(std::f64::consts::TAU),
            linear: Vec::new(),
        }],
        // Afterwards it is balanced upright, which no open-loop prediction follows.
        span: (0.0, 2.6),
        ..Specification::default()
    }
}

fn go(_: &parallax_sim::identify::Progress<'_>) -> ControlFlow<()> {
    ControlFlow::Continue(())
}

#[test]
fn exact_derivatives_are_those_of_the_losses_and_differences_agree() {
    let problem = Problem::new(&[recording(0.013, 3)], &registry(), &specification()).unwrap();
    let evaluator = Evaluator::new(&problem).unwrap();
    let point = vec![0.45, 0.55, 0.5, 0.52, 0.31, 0.27];
    let exact = &evaluator.exact_locals(std::slice::from_ref(&point), 1.0).unwrap()[0];
    let near = &evaluator.locals(std::slice::from_ref(&point), View::whole(1.0)).unwrap()[0];
    let loss = evaluator.losses(std::slice::from_ref(&point), View::whole(1.0)).unwrap()[0];
    let rough = evaluator.rough_losses(std::slice::from_ref(&point), View::whole(1.0)).unwrap()[0];
    assert!((rough / loss - 1.0).abs() < 1e-2, "{rough} {loss}");
    assert!((exact.cost / loss - 1.0).abs() < 1e-9, "{} {loss}", exact.cost);
    for i in 0..point.len() {
        let h = 1e-6;
        let moved = |by: f64| {
            let mut moved = point.clone();
            moved[i] += by;
            moved
        };
        let losses = evaluator.losses(&[moved(h), moved(-h)], View::whole(1.0)).unwrap();
        let slope = (losses[0] - losses[1]) / (2.0 * h);
        assert!(
            (2.0 * exact.gradient[i] / slope - 1.0).abs() < 1e-3,
            "{i}: exact {} measured {slope}",
            2.0 * exact.gradient[i]
        );
        let size = exact.information[i * point.len() + i];
        assert!((near.information[i * point.len() + i] / size - 1.0).abs() < 1e-3);
    }
}

#[test]
fn pieces_that_hold_together_are_the_whole_and_their_derivatives_are_those_of_the_losses() {
    let problem = Problem::new(&[recording(0.013, 3)], &registry(), &specification()).unwrap();
    let evaluator = Evaluator::new(&problem).unwrap();
    let pieces = evaluator.pieces();
    assert!(pieces >= 3, "{pieces}");
    let method = Method::Hybrid(HybridOptions { pieces: Some(1), ..HybridOptions::default() });
    let found = search(&problem, &method, None, &mut go).unwrap();
    let view = View { share: 1.0, pieces, tightness: 100.0 };
    let whole = evaluator.losses(std::slice::from_ref(&found.point), View::whole(1.0)).unwrap()[0];
    let cut = evaluator.states(std::slice::from_ref(&found.point), view).unwrap().remove(0);
    assert_eq!(cut.len(), found.point.len() + 2 * (pieces - 1));
    let local = &evaluator.locals(std::slice::from_ref(&cut), view).unwrap()[0];
    let loss = evaluator.losses(std::slice::from_ref(&cut), view).unwrap()[0];
    assert!((local.cost / loss - 1.0).abs() < 1e-9, "{} {loss}", local.cost);
    // With states of their own, pieces fit at least about as well as the whole.
    assert!(loss < 1.2 * whole, "{loss} {whole}");
    for i in 0..cut.len() {
        let h = 1e-5;
        let moved = |by: f64| {
            let mut moved = cut.clone();
            moved[i] += by;
            moved
        };
        let losses = evaluator.losses(&[moved(h), moved(-h)], view).unwrap();
        let slope = (losses[0] - losses[1]) / (2.0 * h);
        let size = local.information[i * cut.len() + i].sqrt();
        assert!((2.0 * local.gradient[i] - slope).abs() < 1e-2 * (slope.abs() + size), "{i}: {slope}");
    }
}

#[test]
fn a_hidden_delay_and_constants_are_found_again_and_only_the_sum_of_delays_is() {
    let (_, found) =
        identify(&[recording(0.013, 3)], &registry(), &specification(), &Method::default(), &mut go).unwrap();
    let estimate = |name: &str| found.estimate(name).unwrap();
    // The world's own constants, written nowhere in the graph.
    assert!((estimate("J").value / 1.62e-4 - 1.0).abs() < 0.01, "{:?}", estimate("J"));
    assert!((estimate("K").value / 0.0337 - 1.0).abs() < 0.01, "{:?}", estimate("K"));
    // From the commands to the pictures: what was hidden, the world's step and the wire.
    let (delay, std) = found.sum(&["actuator", "sensor"]).unwrap();
    assert!((delay - 0.01335).abs() < 1e-3 && std < 1e-3, "{delay} ± {std}");
    // Each by itself lies where its bounds (the sensor's begin at 10 ms) and the sum allow, and nothing says more.
    let [actuator, sensor] = ["actuator", "sensor"].map(|name| estimate(name).clone());
    assert!(actuator.std.is_none() && sensor.std.is_none(), "{found:?}");
    assert!(actuator.interval[0] == 0.0 && sensor.interval[0] == 0.01, "{found:?}");
    for (one, other) in [(&actuator, &sensor), (&sensor, &actuator)] {
        let longest = one.interval[1] + other.interval[0];
        assert!((longest - delay - 1.96 * std).abs() < 1e-6, "{longest} {delay} ± {std}");
    }
    // Every estimate says where in the graph it stands.
    let places = |name: &str| serde_json::to_value(&estimate(name).places).unwrap();
    assert_eq!(places("J"), serde_json::json!([{ "node": "world", "parameter": "pendulum.inertia" }]));
    assert_eq!(places("angle"), serde_json::json!([{ "node": "world", "state": "angle" }]));
    let connection = serde_json::json!([{ "from": "motor", "to": "world", "port": "motor", "of": "mean" }]);
    assert_eq!(places("actuator"), connection);
    let sum = found.combinations.iter().find(|c| !c.product).unwrap();
    assert_eq!(sum.text, "actuator + sensor");
    assert!(found.remarks.iter().any(|remark| remark.contains("actuator + sensor")), "{:?}", found.remarks);
    let score = &found.outputs[0];
    assert!(score.fitted < 1.1 * 0.0015 && score.held_out.unwrap() < 3.0 * 0.0015, "{score:?}");
}

#[test]
fn a_delay_without_bounds_is_looked_for_further_and_further() {
    let mut specification = specification();
    specification.delays = vec![hidden("actuator", "motor", "world", None)];
    specification.connections = vec![parallax_runtime::graph::ConnectionSpec::new("world", "camera")];
    let recordings = [recording(0.060, 3)];
    let (_, found) = identify(&recordings, &registry(), &specification, &Method::default(), &mut go).unwrap();
    let delay = found.estimate("actuator").unwrap();
    assert!((delay.value - 0.06035).abs() < 1e-3, "{delay:?}");
    assert!(delay.bounds.unwrap()[1] > 0.05, "{delay:?}");
}

#[test]
fn a_search_is_stopped_and_taken_up_again_on_one_thread_or_many() {
    let problem = Problem::new(&[recording(0.013, 3)], &registry(), &specification()).unwrap();
    let method = Method::Hybrid(HybridOptions { generations: 6, restarts: 1, ..HybridOptions::default() });
    let whole = search(&problem, &method, None, &mut go).unwrap();

    let mut kept: Option<Checkpoint> = None;
    let mut questions = 0;
    let stopped = search(&problem, &method, None, &mut |progress| {
        questions += 1;
        kept = Some(progress.checkpoint.clone());
        if questions == 8 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    })
    .unwrap();
    assert_eq!(stopped.stop, None);
    let text = serde_json::to_string(&kept.unwrap()).unwrap();
    let again: Checkpoint = serde_json::from_str(&text).unwrap();
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let resumed = one.install(|| search(&problem, &method, Some(again.clone()), &mut go).unwrap());
    assert_eq!(resumed, whole);

    let mut other = specification();
    other.unknowns[0].high = 4e-4;
    let other = Problem::new(&[recording(0.013, 3)], &registry(), &other).unwrap();
    assert!(matches!(search(&other, &method, Some(again), &mut go), Err(IdentifyError::Checkpoint { .. })));
}

#[test]
fn several_recordings_have_first_states_of_their_own_and_marquardt_alone_finds_the_way_from_near() {
    let mut specification = specification();
    specification.delays.truncate(1);
    specification.connections = vec![parallax_runtime::graph::ConnectionSpec::new("world", "camera")];
    specification.unknowns[0].start = Some(1.6e-4);
    specification.unknowns[1].start = Some(0.033);
    specification.unknowns[2].start = Some(std::f64::consts::PI);
    specification.delays[0].start = Some(0.01);
    let recordings = [recording(0.013, 3), recording(0.013, 3)];
    let method = Method::LevenbergMarquardt(MarquardtOptions::default());
    let (_, found) = identify(&recordings, &registry(), &specification, &method, &mut go).unwrap();
    assert!(found.estimate("angle[2]").is_some() && found.estimate("angle").is_none());
    let delay = found.estimate("actuator").unwrap();
    assert!((delay.value - 0.01335).abs() < 1e-3, "{delay:?}");
}

#[test]
fn what_is_not_there_is_named_with_what_is() {
    let recordings = [recording(0.0, 2)];
    let fails = |change: &dyn Fn(&mut Specification), parts: &[&str]| {
        let mut specification = specification();
        change(&mut specification);
        let error = Problem::new(&recordings, &registry(), &specification).unwrap_err().to_string();
        for part in parts {
            assert!(error.contains(part), "no `{part}` in: {error}");
        }
    };
    fails(&|s| s.unknowns[0] = unknown("J", "world", "inertia", 1.0, 2.0), &["`J`", "pendulum.inertia"]);
    fails(&|s| s.unknowns[0] = unknown("n", "estimator", "noise", 1.0, 2.0), &["estimator", "plain Rust"]);
    fails(&|s| s.unknowns[0].high = 1e-9, &["`J`", "bounds"]);
    fails(&|s| s.unknowns[1] = s.unknowns[0].clone(), &["sets already"]);
    fails(&|s| s.outputs[0].leaf = "pixel".into(), &["camera.pixel", "angle, stamp"]);
    fails(&|s| s.delays[0].to = "wrld".into(), &["wrld", "world"]);
    fails(
        &|s| s.delays[0].scatter = Some(Scatter::Normal),
        &["actuator", "world", "not compared", "scatter"],
    );
    fails(&|s| s.span = (5.0, 6.0), &["camera.angle", "no recorded value"]);
    fails(&|s| s.outputs.clear(), &["nothing is compared"]);
    fails(
        &|s| (s.nodes[0].node, s.nodes[0].rate) = ("plant".into(), None),
        &["nodes.plant", "`kind`", "agent"],
    );
}
