//! Identification of machines that it cannot look into, a few of those of `benches/identify`.

#[allow(dead_code, reason = "the benchmark uses all of it")]
#[path = "../../benches/identify/pendulum.rs"]
mod pendulum;
#[allow(dead_code, reason = "the benchmark uses all of it")]
#[path = "../../benches/identify/quadrotor.rs"]
mod quadrotor;
#[allow(dead_code, reason = "the benchmark uses all of it")]
#[path = "../../benches/identify/truth.rs"]
mod truth;

use std::ops::ControlFlow;

use parallax_runtime::delay::Delay;
use parallax_sim::identify::{Identified, Method, Problem, identified_graph, search};
use truth::{Truth, delay, share};

fn found(truth: &Truth) -> Identified {
    let recordings = std::slice::from_ref(&truth.recording);
    let problem = Problem::new(recordings, &truth.registry, &truth.specification).expect("a problem");
    search(&problem, &Method::default(), None, &mut |_| ControlFlow::Continue(())).expect("a result")
}

#[test]
fn a_pendulum_with_seventeen_unknowns_is_predicted_to_its_noise_and_the_sum_of_its_delays_is_found() {
    for seed in [5, 77] {
        let truth = pendulum::truth(seed).unwrap();
        let found = found(&truth);
        let of_floor = share(&found, &truth.floor);
        assert!(of_floor < 1.05, "seed {seed}: {of_floor} of the noise floor");
        let (names, value) = &truth.delays[0];
        let (sum, std) = delay(&found, names);
        assert!(
            (sum - value).abs() < 1e-3 && std.unwrap() < 1e-3,
            "seed {seed}: {sum} ± {std:?}, truly {value}"
        );
    }
}

#[test]
fn a_quadrotor_with_a_controller_on_board_is_predicted_to_its_noise() {
    let truth = quadrotor::truth(5).unwrap();
    let found = found(&truth);
    let of_floor = share(&found, &truth.floor);
    assert!(of_floor < 1.05, "{of_floor} of the noise floor");
    for (names, value) in &truth.delays {
        let (sum, _) = delay(&found, names);
        assert!((sum - value).abs() < 2e-3, "{names:?}: {sum}, truly {value}");
    }
}

#[test]
fn the_mean_and_the_spread_are_found_of_a_delay_that_is_another_one_for_every_picture() {
    let truth = pendulum::truth_with_a_camera_that_jitters(5).unwrap();
    let found = found(&truth);
    let (names, value) = &truth.delays[0];
    let (sum, _) = delay(&found, names);
    assert!((sum - value).abs() < 1e-3, "{sum}, truly {value}");
    let (name, value) = truth.spreads[0];
    let spread = found.estimate(name).unwrap();
    assert!((spread.value - value).abs() < 0.15 * value, "{spread:?}, truly {value}");
    assert!(spread.std.unwrap() < 0.1 * value);
}

#[test]
fn two_humps_of_a_delay_are_told_and_go_into_the_graph_that_is_simulated() {
    let truth = pendulum::truth_with_a_camera_that_jitters(6).unwrap();
    let recordings = std::slice::from_ref(&truth.recording);
    let problem = Problem::new(recordings, &truth.registry, &truth.specification).unwrap();
    let found = search(&problem, &Method::default(), None, &mut |_| ControlFlow::Continue(())).unwrap();
    let (apart, share) = truth.humps.expect("a seed of two humps");
    let [told] = &found.humps[..] else { panic!("one delay that scatters: {:?}", found.humps) };
    let late = told.humps[1].share;
    assert!((told.apart.value - apart).abs() < 3.0 * told.apart.std, "{told:?}, truly {apart} s apart");
    assert!((late.value - share).abs() < 3.0 * late.std, "{told:?}, truly {share} in the later one");
    assert!(told.apart.std < 0.1 * apart && late.std < 0.05, "{told:?}");
    let (graph, _) = identified_graph(&problem, &found, &truth.registry);
    let edge = graph.connections.iter().find(|edge| edge.from == "world" && edge.to == "camera").unwrap();
    let Delay::Mixture { weights, means, stds } = &edge.delay else { panic!("{:?}", edge.delay) };
    assert_eq!((weights.len(), means.len(), stds.len()), (2, 2, 2));
    assert!((means[1] - means[0] - told.apart.value).abs() < 1e-12);
}

#[test]
fn one_hump_stays_one() {
    let truth = pendulum::truth_with_a_camera_that_jitters(7).unwrap();
    assert!(truth.humps.is_none(), "a seed of one hump");
    assert!(found(&truth).humps.is_empty());
}
