//! The noise of a walk: exact slopes of its likelihood, and where they lead.

use crate::support::{Hidden, SYSTEM, record};
use parallax_gap::filter::{Noise, Pass};
use parallax_gap::search;
use parallax_gap::setup::Setup;
use parallax_model::system::System;

/// The pendulum again, its angle held as a rotation, which is no number where all states are zero.
const ROTATION: &str = r#"
format = 1
name = "pendulum"

[parameters]
J = { value = 0.0125, unit = "kg m^2" }
k = { value = 0.12, unit = "N m/V" }
b = { value = 0.004, unit = "N m s/rad" }

[inputs]
u = { signal = "voltage" }

[state]
c = { derivative = "-w*s", initial = 0.995 }
s = { derivative = "w*c", initial = 0.0998 }
w = { derivative = "(k*u - 0.4905*s/sqrt(c*c + s*s) - b*w)/J" }

[outputs]
angle = { value = "atan2(s, c)", unit = "rad", wrap = 6.283185307179586 }
"#;

/// A walk of the pendulum whose friction the model lacks, and the noise that makes it likeliest.
fn walked(system: &str) -> (Setup, Pass, Noise) {
    let system = System::parse(system, "pendulum.toml").expect("the system is valid");
    let equations = system.equations().expect("the equations are complete");
    let setup = Setup::new(
        equations,
        record(Hidden { forward: 0.02, backward: 0.02, ..Hidden::default() }, 5, 8.0),
        Some(0.25),
    );
    let (pass, noise) = search::nominal(&setup);
    (setup, pass, noise)
}

fn moved(noise: &Noise, process: f64, outputs: f64) -> Noise {
    let log_output = noise.log_output.iter().map(|log| log + outputs).collect();
    Noise { log_process: noise.log_process + process, log_output }
}

#[test]
fn slopes_by_the_noise_are_those_of_the_likelihood() {
    // A short log leaves lanes idle, at states of zero.
    for system in [SYSTEM, ROTATION] {
        slopes_are_those_of_the_likelihood(system);
    }
}

fn slopes_are_those_of_the_likelihood(system: &str) {
    let (setup, pass, noise) = walked(system);
    let scale = &setup.noise.scale;
    let there = moved(&noise, 0.7, -0.4);
    let slope = pass.slope(scale, &there, &[None, Some(0)]);
    assert!((slope.cost - pass.cost_at(scale, &there)).abs() < 1e-6 * slope.cost.abs(), "{slope:?}");
    let step = 1e-4;
    for (k, (process, output)) in [(step, 0.0), (0.0, step)].into_iter().enumerate() {
        let at = |sign: f64| pass.cost_at(scale, &moved(&there, sign * process, sign * output));
        let by_differences = (at(1.0) - at(-1.0)) / (2.0 * step);
        let exact = 2.0 * slope.gradient[k];
        assert!(
            (by_differences - exact).abs() < 1e-4 * exact.abs().max(1.0),
            "{k}: {by_differences} and {exact}"
        );
    }
    assert!(slope.gradient.iter().all(|g| g.abs() > 1.0), "the likelihood is not flat here: {slope:?}");
}

#[test]
fn the_likeliest_noise_is_found_from_near_as_from_afar() {
    let (setup, pass, noise) = walked(SYSTEM);
    let (scale, limits, floor) = (&setup.noise.scale, &setup.noise.limits, setup.noise.process_floor);
    let cost = |noise: &Noise| pass.cost_at(scale, noise);
    let afar = pass.refit_noise(scale, &noise, limits, floor);
    let mended = pass.mend_noise(scale, &moved(&noise, 1.0, -0.5), limits, floor, &[]);
    assert!(cost(&mended) < cost(&afar) + 0.1, "{mended:?} and {afar:?}");
    // It stays within the limits, and where it is.
    for (log, (low, high)) in mended.log_output.iter().zip(limits) {
        assert!((*low..=*high).contains(log), "{log} within {low} to {high}");
    }
    assert_eq!(pass.mend_noise(scale, &mended, limits, floor, &[]), mended);
    assert_eq!(pass.mend_noise(scale, &mended, limits, floor, &pass.excess(limits.len())), mended);
}
