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

use parallax_sim::identify::{Identified, Method, Problem, search};
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
