//! The models: every reading agrees, and they move as physics says.

use parallax_model::program::Workspace;
use parallax_model::trace::trace_model;
use parallax_model::{Dual, Model, Program, Scalar, Tree};
use parallax_nodes::models::{pendulum, quadrotor};
use pendulum::Pendulum;
use proptest::prelude::*;
use quadrotor::Quadrotor;

/// A step of a model on the flat list of its program's inputs.
fn direct<M: Model, T: Scalar>(inputs: &[T]) -> Vec<T> {
    let mut inputs = inputs.iter().copied();
    let params = M::Params::<T>::read(&mut inputs);
    let state = M::State::<T>::read(&mut inputs);
    let input = M::Input::<T>::read(&mut inputs);
    let dt = T::read(&mut inputs);
    let (state, output) = M::step(&params, state, input, dt);
    [state.to_vec(), output.to_vec()].concat()
}

fn run<T: Scalar>(program: &Program, inputs: &[T]) -> Vec<T> {
    let mut outputs = vec![T::constant(0.0); program.outputs().len()];
    program.evaluate(inputs, &mut Workspace::new(), &mut outputs);
    outputs
}

fn close(a: f64, b: f64, tolerance: f64) -> bool {
    (a - b).abs() <= tolerance * (1.0 + a.abs().max(b.abs()))
}

/// All three readings of a model at one point, and derivatives against differences with steps of that relative size.
fn readings_agree<M: Model>(inputs: &[f64], step: f64) -> Result<(), TestCaseError> {
    let program = trace_model::<M>();
    let values = direct::<M, f64>(inputs);
    for (a, b) in run(&program, inputs).iter().zip(&values) {
        prop_assert!((a - b).abs() <= 1e-12 * a.abs().max(b.abs()), "program {} model {}", a, b);
    }
    let wrt: Vec<usize> = (0..inputs.len()).collect();
    let jacobian = program.jacobian(inputs, &wrt);
    for column in wrt {
        let mut duals: Vec<Dual<1>> = inputs.iter().map(|value| Dual::constant(*value)).collect();
        duals[column] = Dual::variable(inputs[column], 0);
        // Differences in units of the input, so that constants of 1e-11 and counts of 1e4 are judged alike.
        let unit = inputs[column].abs().max(1e-3 * f64::from(inputs[column] == 0.0));
        let moved = |sign: f64| {
            let mut moved = inputs.to_vec();
            moved[column] += sign * step * unit;
            direct::<M, f64>(&moved)
        };
        let (high, low) = (moved(1.0), moved(-1.0));
        for (row, dual) in direct::<M, Dual<1>>(&duals).iter().enumerate() {
            let slope = jacobian[(row, column)];
            prop_assert!(close(slope * unit, dual.gradient[0] * unit, 1e-12));
            let difference = (high[row] - low[row]) / (2.0 * step);
            prop_assert!(
                close(slope * unit, difference, 1e-6),
                "d{}/d{}: {} differences {}",
                program.outputs()[row],
                program.inputs()[column],
                slope * unit,
                difference
            );
        }
    }
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(1000))]

    #[test]
    fn readings_of_the_pendulum_agree(
        angle in -7.0..7.0f64,
        speed in 1.0..20.0f64,
        forward in any::<bool>(),
        voltage in -3.0..3.0f64,
        factors in proptest::collection::vec(0.7..1.3f64, 7),
    ) {
        let mut inputs: Vec<f64> =
            pendulum::Params::default().to_vec().iter().zip(&factors).map(|(a, b)| a * b).collect();
        // A reversal within the step is a kink, which no difference sees rightly.
        let speed = if forward { speed + 2.0 } else { -speed - 2.0 };
        inputs.extend([angle, speed, voltage, pendulum::STEP]);
        readings_agree::<Pendulum>(&inputs, 1e-5)?;
    }

    #[test]
    fn readings_of_the_quadrotor_agree(
        state in proptest::collection::vec(-0.5..0.5f64, 9),
        thrust in 500.0..3500.0f64,
        pwm in 10_000.0..60_000.0f64,
        references in proptest::array::uniform2(-0.5..0.5f64),
        factors in proptest::collection::vec(0.9..1.1f64, 14),
    ) {
        let mut inputs: Vec<f64> =
            quadrotor::Params::default().to_vec().iter().zip(&factors).map(|(a, b)| a * b).collect();
        inputs.extend(state);
        inputs.extend([thrust, pwm, references[0], references[1], quadrotor::STEP]);
        readings_agree::<Quadrotor>(&inputs, 1e-4)?;
    }
}

#[test]
fn a_free_pendulum_keeps_its_energy() {
    let params = pendulum::Params { damping: 0.0, motor: 0.0, friction: 0.0, ..Default::default() };
    let mut state = pendulum::State { angle: 0.3, speed: 0.0 };
    let before = pendulum::energy(&params, &state);
    for _ in 0..1000 {
        (state, _) = Pendulum::step(&params, state, pendulum::Input { voltage: 0.0 }, 0.001);
    }
    let after = pendulum::energy(&params, &state);
    assert!((after - before).abs() < 1e-9 * before.abs().max(1e-3), "{before} {after}");
}

#[test]
fn a_driven_pendulum_settles_where_its_torques_balance() {
    let params = pendulum::Params { friction: 0.0, ..Default::default() };
    let mut state = pendulum::State { angle: std::f64::consts::PI, speed: 0.0 };
    for _ in 0..3000 {
        (state, _) = Pendulum::step(&params, state, pendulum::Input { voltage: 2.0 }, pendulum::STEP);
    }
    let holding = -2.0 * params.motor / params.resistance / (params.mass * params.length * pendulum::GRAVITY);
    assert!((state.angle - (std::f64::consts::PI - holding.asin())).abs() < 1e-6, "{state:?}");
}

#[test]
fn a_quadrotor_hovers_at_the_thrust_of_its_weight() {
    let params = quadrotor::Params::default();
    let weight = params.mass * quadrotor::GRAVITY;
    let pwm = weight / (params.thrust_direct - params.thrust_state * params.motor_gain / params.motor_rate);
    assert!((20_000.0..60_000.0).contains(&pwm), "hovers at {pwm} counts");
    let still = quadrotor::Vector { x: 0.0, y: 0.0, z: 0.0 };
    let level = quadrotor::Attitude { roll: 0.0, pitch: 0.0, yaw: 0.0 };
    let thrust = -params.motor_gain * pwm / params.motor_rate;
    let mut state = quadrotor::State { position: still, velocity: still, attitude: level, thrust };
    for _ in 0..500 {
        let input = quadrotor::Input { pwm, roll: 0.0, pitch: 0.0 };
        (state, _) = Quadrotor::step(&params, state, input, quadrotor::STEP);
    }
    assert!(state.position.z.abs() < 1e-9, "{state:?}");
    // Pitching forward accelerates forward, rolling right (positive about x) accelerates right (negative y).
    for _ in 0..100 {
        let input = quadrotor::Input { pwm, roll: 0.1, pitch: 0.1 };
        (state, _) = Quadrotor::step(&params, state, input, quadrotor::STEP);
    }
    assert!(state.velocity.x > 0.5 && state.velocity.y < -0.5, "{state:?}");
    assert_eq!(state.attitude.yaw, 0.0);
}

#[test]
fn the_effective_pwm_inverts_the_thrust_curve() {
    let params = quadrotor::Params::default();
    for pwm in [0.0, 10_000.0, 40_000.0, 65_535.0] {
        let one = params.pwm_quadratic * pwm * pwm + params.pwm_linear * pwm + params.pwm_constant;
        assert!((quadrotor::effective_pwm(&params, 4.0 * one) - pwm).abs() < 1e-6, "{pwm}");
    }
    assert!(quadrotor::effective_pwm(&params, -1.0).is_finite());
}
