//! The estimator: where the pendulum is now, from pictures of the past and commands in flight.
//!
//! An extended Kalman filter on the pendulum's model. It keeps the estimate at the stamp of the last picture, corrects
//! it there, and predicts from it to the start of the step with the commands sent in between, so that the camera's
//! delay does not reach the agent.

use parallax_model::integrate::rk4;
use parallax_model::{Dual, Scalar, Tree};
use parallax_runtime::node::{Node, NodeError, Port, Step};
use parallax_runtime::registry::NodeKind;
use parallax_runtime::time::{from_seconds, to_seconds};
use serde::Deserialize;

use super::messages::{Angle, Estimate, Voltage};
use super::wrapped;
use crate::models::pendulum::{Input, Params, STEP, State, derivative};

/// The pictures.
pub const CAMERA: Port<Angle> = Port::new("camera");
/// The commands in flight.
pub const MOTOR: Port<Voltage> = Port::new("motor");
/// How many commands it looks back on: more than the camera's delay holds.
pub const COMMANDS: usize = 16;

/// Parameters of the estimator.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Parameters {
    /// Standard deviation of the camera's noise, rad.
    pub noise: f64,
    /// Density of the unknown acceleration, rad/s² √s: how much the model is distrusted.
    pub disturbance: f64,
}

impl Default for Parameters {
    fn default() -> Self {
        Self { noise: 1.5e-3, disturbance: 2.0 }
    }
}

/// The filter.
#[derive(Clone, Debug)]
pub struct Estimator {
    parameters: Parameters,
    model: Params<f64>,
    /// The estimate after the last picture; nothing before the first.
    believed: Option<Believed>,
}

#[derive(Clone, Copy, Debug)]
struct Believed {
    /// Seconds since the run's start.
    stamp: f64,
    state: [f64; 2],
    covariance: [[f64; 2]; 2],
}

/// The kind `pendulum/estimator`.
pub fn kind() -> NodeKind {
    NodeKind::new(|context| {
        let parameters: Parameters = context.parameters()?;
        if !(parameters.noise > 0.0 && parameters.disturbance > 0.0) {
            return Err(context.parameter_error("`noise` and `disturbance` must be positive"));
        }
        // The nominal simulator knows of no dry friction.
        let model = Params { friction: 0.0, ..Params::default() };
        Ok(Estimator { parameters, model, believed: None })
    })
    .input(CAMERA)
    .input(MOTOR)
    .initial(&Estimate { angle: -std::f64::consts::PI, speed: 0.0, stamp: 0.0 })
}

impl Node for Estimator {
    type Output = Estimate;

    fn step(&mut self, step: &Step<'_>) -> Result<Estimate, NodeError> {
        let now = to_seconds(step.start);
        for seen in step.window(CAMERA).filter(|seen| seen.seq.is_some()) {
            self.see(&seen.message, step);
        }
        let Some(mut believed) = self.believed else {
            return Ok(Estimate { angle: -std::f64::consts::PI, speed: 0.0, stamp: now });
        };
        self.predict(&mut believed, now, step);
        Ok(Estimate { angle: wrapped(believed.state[0]), speed: believed.state[1], stamp: now })
    }
}

impl Estimator {
    fn see(&mut self, seen: &Angle, step: &Step<'_>) {
        let noise = self.parameters.noise * self.parameters.noise;
        let Some(mut believed) = self.believed else {
            // At rest within a few turns a second, for all that one picture tells.
            let covariance = [[noise, 0.0], [0.0, 25.0]];
            self.believed = Some(Believed { stamp: seen.stamp, state: [seen.angle, 0.0], covariance });
            return;
        };
        if seen.stamp <= believed.stamp {
            return;
        }
        self.predict(&mut believed, seen.stamp, step);
        let p = believed.covariance;
        let innovation = wrapped(seen.angle - believed.state[0]);
        let gain = [p[0][0] / (p[0][0] + noise), p[1][0] / (p[0][0] + noise)];
        believed.state = [0, 1].map(|row| believed.state[row] + gain[row] * innovation);
        believed.covariance =
            [0, 1].map(|row| [0, 1].map(|column: usize| p[row][column] - gain[row] * p[0][column]));
        believed.state[0] = wrapped(believed.state[0]);
        self.believed = Some(believed);
    }

    /// Moves the estimate to the time `until`, holding each command from when it was sent until the next.
    fn predict(&self, believed: &mut Believed, until: f64, step: &Step<'_>) {
        let mut voltage = 0.0;
        for command in step.window(MOTOR).filter(|command| command.seq.is_some()) {
            let sent = to_seconds(command.sent);
            if sent >= until {
                break;
            }
            self.hold(believed, sent, voltage);
            voltage = command.message.voltage;
        }
        self.hold(believed, until, voltage);
    }

    /// Moves the estimate under one command; a time that is already past changes nothing.
    fn hold(&self, believed: &mut Believed, until: f64, voltage: f64) {
        while from_seconds(until) > from_seconds(believed.stamp) {
            let dt = (until - believed.stamp).min(STEP);
            let x = [Dual::<2>::variable(believed.state[0], 0), Dual::variable(believed.state[1], 1)];
            let next = advance(&self.model, x, voltage, dt);
            believed.state = next.map(|x| x.value);
            let f = next.map(|x| x.gradient);
            let p = believed.covariance;
            let fp = f.map(|row| [0, 1].map(|column| row[0] * p[0][column] + row[1] * p[1][column]));
            // White acceleration of density q: its effect on speed and angle over dt.
            let q = self.parameters.disturbance * self.parameters.disturbance;
            let noise = [[q * dt.powi(3) / 3.0, q * dt * dt / 2.0], [q * dt * dt / 2.0, q * dt]];
            believed.covariance = [0, 1].map(|row: usize| {
                [0, 1].map(|column: usize| {
                    fp[row][0] * f[column][0] + fp[row][1] * f[column][1] + noise[row][column]
                })
            });
            believed.stamp += dt;
        }
    }
}

/// The model's state after `dt` seconds, with its derivatives.
fn advance<T: Scalar>(model: &Params<f64>, state: [T; 2], voltage: f64, dt: f64) -> [T; 2] {
    let mut constants = [0.0; 7];
    model.write_to(&mut constants);
    let params = Params::<T>::read_from(&constants.map(T::constant));
    let input = Input { voltage: T::constant(voltage) };
    let x = State { angle: state[0], speed: state[1] };
    let x = rk4(|x: &State<T>| derivative(&params, x, &input), x, T::constant(dt));
    [x.angle, x.speed]
}
