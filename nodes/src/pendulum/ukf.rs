//! The estimator as the paper has it: an unscented Kalman filter on the pendulum's model, with delays compensated.
//!
//! It takes the place of [`super::estimator`], an extended Kalman filter that knows of no hidden delays. Its model is written
//! out, so that a step takes a microsecond or two; [`crate::estimator`] does the same for any system.

use std::f64::consts::{PI, TAU};

use parallax_model::filter::{Compensation, Compensator, Process, Scaling, Source, Work};
use parallax_model::integrate::Length;
use parallax_model::tree::leaf_names;
use parallax_model::{Scalar, Tree};
use parallax_runtime::node::Layout;
use parallax_runtime::registry::NodeKind;
use serde::Deserialize;

use super::estimator::{CAMERA, MOTOR};
use super::messages::Estimate;
use crate::estimator::{Estimator, EstimatorError, Listened, Shown, bands, check};
use crate::models::pendulum::{Constants, Input, Params, STEP, State};

/// What may stand in a graph.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Standard deviation of the camera's noise, rad.
    pub noise: f64,
    /// Density of the unknown acceleration, rad/s² √s: how much the model is distrusted.
    pub disturbance: f64,
    /// From when the camera sees to the stamp of its picture, s.
    pub camera_delay: f64,
    /// From the stamp of a command to when it acts, s.
    pub motor_delay: f64,
    /// From the start of a step to when what follows from its estimate acts, s.
    pub ahead: f64,
    /// Whether it predicts, or tells the filtered state at the time of the newest picture.
    pub predict: bool,
    /// What is believed before the first picture: the angle, rad,
    pub angle: f64,
    /// the speed, rad/s,
    pub speed: f64,
    /// and their standard deviations.
    pub angle_std: f64,
    /// As `angle_std`, rad/s.
    pub speed_std: f64,
    /// The most steps of the integrator between two pictures, and after the last one.
    pub steps: usize,
    /// How many later pictures may arrive before one.
    pub reorder: usize,
    /// Moment of inertia J, kg m².
    pub inertia: f64,
    /// Mass m, kg.
    pub mass: f64,
    /// Distance l of its centre from the shaft, m.
    pub length: f64,
    /// Viscous friction b, N m s/rad.
    pub damping: f64,
    /// Motor constant K, N m/A.
    pub motor: f64,
    /// Resistance R, Ω.
    pub resistance: f64,
    /// Coulomb friction c, N m.
    pub friction: f64,
}

impl Default for Settings {
    /// The nominal simulator, which knows of no dry friction, and no hidden delays.
    fn default() -> Self {
        let Params { inertia, mass, length, damping, motor, resistance, .. } = Params::default();
        Self {
            noise: 1.5e-3,
            disturbance: 2.0,
            camera_delay: 0.0,
            motor_delay: 0.0,
            ahead: 0.0,
            predict: true,
            angle: PI,
            speed: 0.0,
            angle_std: 2.0,
            speed_std: 5.0,
            steps: 24,
            reorder: 0,
            inertia,
            mass,
            length,
            damping,
            motor,
            resistance,
            friction: 0.0,
        }
    }
}

/// The pendulum as a filter sees it: angle and speed under a voltage, of which the angle is read.
#[derive(Clone, Copy, Debug)]
pub struct Pendulum;

impl Process for Pendulum {
    fn params(&self) -> usize {
        <Params<f64> as Tree<f64>>::LEAVES
    }
    fn states(&self) -> usize {
        2
    }
    fn outputs(&self) -> usize {
        1
    }
    fn prepared(&self) -> usize {
        <Constants<f64> as Tree<f64>>::LEAVES
    }
    fn prepare<T: Scalar>(&self, params: &[T], prepared: &mut [T]) {
        Constants::new(&Params::read_from(params)).write_to(prepared);
    }
    #[inline(always)]
    fn advance<T: Scalar>(
        &self,
        params: &[T],
        state: &[T],
        inputs: &[T],
        [_, dt]: [T; 2],
        _: &mut Work<'_, T>,
        next: &mut [T],
    ) {
        let constants = Constants::<T>::read_from(params);
        let (state, input) = (State::read_from(state), Input { voltage: inputs[0] });
        constants.step(state, input, &Length::new(dt)).write_to(next);
    }
    #[inline(always)]
    fn observe<T: Scalar>(
        &self,
        _: &[T],
        state: &[T],
        _: &[T],
        _: T,
        _: &mut Work<'_, T>,
        readings: &mut [T],
    ) {
        readings[0] = state[0];
    }
}

/// The kind `pendulum/ukf`. Its model's parameters, which may be set while it runs, are those of the pendulum, `noise.angle`,
/// `disturbance.speed`, `delay.camera`, `delay.motor` and `ahead`.
pub fn kind() -> NodeKind {
    NodeKind::by_graph(|_, node, _| {
        let parameters = serde_json::Value::Object(node.parameters.clone());
        let settings: Settings = serde_json::from_value(parameters).map_err(|error| error.to_string())?;
        make(&settings).map_err(|error| error.to_string())
    })
}

fn make(settings: &Settings) -> Result<NodeKind, EstimatorError> {
    let Settings { noise, disturbance, camera_delay, motor_delay, ahead, .. } = *settings;
    let Settings { inertia, mass, length, damping, motor, resistance, friction, .. } = *settings;
    check("inertia".into(), inertia, false)?;
    check("resistance".into(), resistance, false)?;
    let mut params = Params { inertia, mass, length, damping, motor, resistance, friction }.to_vec();
    params.push(check("noise".into(), noise, false)?);
    params.push(check("disturbance".into(), disturbance, false)?);
    params.push(check("camera_delay".into(), camera_delay, true)?);
    params.push(check("motor_delay".into(), motor_delay, true)?);
    params.push(check("ahead".into(), ahead, true)?);
    let estimator = Estimator {
        name: "pendulum_ukf".into(),
        compensator: Compensator::new(Pendulum, compensation(settings))?,
        parameters: leaf_names::<f64, Params<f64>>(),
        states: leaf_names::<f64, State<f64>>(),
        readings: vec!["angle".into()],
        sensors: vec![Listened { port: CAMERA.name().into(), stamp: Some(1), leaves: vec![0] }],
        actuators: vec![Listened { port: MOTOR.name().into(), stamp: None, leaves: vec![0] }],
        predicts: settings.predict,
        message: vec![
            ("angle".into(), Shown::State(0)),
            ("speed".into(), Shown::State(1)),
            ("stamp".into(), Shown::Stamp),
        ],
    };
    Ok(estimator.kind(Layout::of::<Estimate>(), params).input(CAMERA).input(MOTOR))
}

/// How the filter is used.
pub fn compensation(settings: &Settings) -> Compensation {
    Compensation {
        scaling: Scaling::default(),
        disturbed: vec![1],
        wraps: vec![Some(TAU)],
        circular: vec![Some(TAU), None],
        sensors: vec![vec![0]],
        actuators: vec![1],
        inputs: vec![vec![Source { actuator: 0, leaf: 0 }]],
        step: STEP,
        steps: settings.steps,
        reorder: settings.reorder,
        mean: vec![settings.angle, settings.speed],
        std: vec![settings.angle_std, settings.speed_std],
        bands: bands(1),
    }
}
