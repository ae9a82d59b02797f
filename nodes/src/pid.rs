//! A PID controller as a node, for any message with a measurement and any with a command.

use std::marker::PhantomData;

use parallax_runtime::node::{Message, Node, NodeError, Port, Step};
use parallax_runtime::registry::NodeKind;
use parallax_runtime::time::{Nanos, to_seconds};
use parallax_runtime::tuning::{Parameter, Tuning};
use serde::Deserialize;

/// A message that carries a measurement to control.
pub trait Measured: Message {
    /// The measurement.
    fn measured(&self) -> f64;
}

/// A message that carries a command.
pub trait Commanded: Message {
    /// The message for a command.
    fn command(value: f64) -> Self;
}

/// Parameters of the controller. Units follow from the measurement's (m) and the command's (c).
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Parameters {
    /// Where the measurement should be, m.
    #[serde(default)]
    pub setpoint: f64,
    /// Proportional gain, c/m.
    pub proportional: f64,
    /// Integral gain, c/(m s).
    #[serde(default)]
    pub integral: f64,
    /// Derivative gain, c s/m, on the measurement, so that a new setpoint gives no kick.
    #[serde(default)]
    pub derivative: f64,
    /// Lowest and highest command, c.
    pub limits: [f64; 2],
    /// The measurement's period when it is circular, m: 6.283185307179586 for an angle.
    #[serde(default)]
    pub wrap: Option<f64>,
}

/// What the controller measures.
pub const fn measurement<M: Message>() -> Port<M> {
    Port::new("measurement")
}

/// The controller, from messages `M` to messages `C`.
#[derive(Clone, Debug)]
pub struct Pid<M, C> {
    parameters: Parameters,
    /// The integral's share of the command, c.
    accumulated: f64,
    last: Option<(Nanos, f64)>,
    messages: PhantomData<fn(M) -> C>,
}

/// A kind of PID controller; its input is called `measurement`.
pub fn kind<M: Measured, C: Commanded>() -> NodeKind {
    NodeKind::new(|context| {
        let parameters: Parameters = context.parameters()?;
        let [low, high] = parameters.limits;
        if low.is_nan() || high.is_nan() || low > high {
            return Err(
                context.parameter_error(format!("`limits` are [{low}, {high}]; the first must be lower"))
            );
        }
        if parameters.wrap.is_some_and(|period| period.is_nan() || period <= 0.0) {
            return Err(context.parameter_error("`wrap` must be a positive period"));
        }
        Ok(Pid::<M, C>::new(parameters))
    })
    .input(measurement::<M>())
}

impl<M, C> Pid<M, C> {
    fn new(parameters: Parameters) -> Self {
        Self { parameters, accumulated: 0.0, last: None, messages: PhantomData }
    }

    fn difference(&self, a: f64, b: f64) -> f64 {
        let difference = a - b;
        match self.parameters.wrap {
            Some(period) => (difference + 0.5 * period).rem_euclid(period) - 0.5 * period,
            None => difference,
        }
    }

    /// The command for a measurement at a time.
    fn control(&mut self, now: Nanos, measured: f64) -> f64 {
        let Parameters { setpoint, proportional, integral, derivative, limits: [low, high], .. } =
            self.parameters;
        let error = self.difference(setpoint, measured);
        let (dt, rate) = match self.last {
            Some((before, last)) if now > before => {
                let dt = to_seconds(now - before);
                (dt, self.difference(measured, last) / dt)
            }
            _ => (0.0, 0.0),
        };
        self.last = Some((now, measured));
        let direct = proportional * error - derivative * rate;
        let accumulated = self.accumulated + integral * error * dt;
        let wanted = direct + accumulated;
        // Anti-windup: at a limit the integral may only move away from it.
        let deeper = (wanted > high && accumulated > self.accumulated)
            || (wanted < low && accumulated < self.accumulated);
        if !deeper {
            self.accumulated = accumulated;
        }
        (direct + self.accumulated).clamp(low, high)
    }
}

impl<M: Measured, C: Commanded> Node for Pid<M, C> {
    type Output = C;

    fn step(&mut self, step: &Step<'_>) -> Result<C, NodeError> {
        let received = step.latest(measurement::<M>());
        Ok(C::command(self.control(step.start, received.message.measured())))
    }

    fn tuning(&mut self) -> Option<&mut dyn Tuning> {
        Some(self)
    }
}

/// The limits are called `low` and `high`. The state is the integral's share of the command.
impl<M, C> Tuning for Pid<M, C> {
    fn parameters(&self) -> Vec<Parameter> {
        // Their units follow from the messages, which are not known here.
        ["setpoint", "proportional", "integral", "derivative", "low", "high"]
            .map(|name| Parameter::new(name, ""))
            .into()
    }

    fn value(&self, parameter: usize) -> f64 {
        let Parameters { setpoint, proportional, integral, derivative, limits: [low, high], .. } =
            self.parameters;
        [setpoint, proportional, integral, derivative, low, high][parameter]
    }

    fn set(&mut self, parameter: usize, value: f64) {
        let Parameters { setpoint, proportional, integral, derivative, limits: [low, high], .. } =
            &mut self.parameters;
        *[setpoint, proportional, integral, derivative, low, high][parameter] = value;
    }

    fn settle(&mut self) -> Result<(), String> {
        let [low, high] = self.parameters.limits;
        if low <= high { Ok(()) } else { Err(format!("`low` would be {low} and `high` {high}")) }
    }

    fn state(&self) -> Vec<String> {
        vec!["accumulated".into()]
    }

    fn read_state(&self, values: &mut [f64]) {
        values[0] = self.accumulated;
    }

    fn reset(&mut self) {
        (self.accumulated, self.last) = (0.0, None);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pid(parameters: Parameters) -> Pid<(), ()> {
        Pid::new(parameters)
    }

    const PLAIN: Parameters = Parameters {
        setpoint: 1.0,
        proportional: 2.0,
        integral: 0.0,
        derivative: 0.0,
        limits: [-10.0, 10.0],
        wrap: None,
    };

    #[test]
    fn each_part_acts_as_its_name_says() {
        assert_eq!(pid(PLAIN).control(0, 0.25), 1.5);
        let mut damped = pid(Parameters { derivative: 0.1, proportional: 0.0, ..PLAIN });
        assert_eq!(damped.control(0, 0.0), 0.0, "the first measurement has no rate");
        assert!((damped.control(100_000_000, 0.5) + 0.5).abs() < 1e-12);
        let mut patient = pid(Parameters { integral: 3.0, proportional: 0.0, ..PLAIN });
        patient.control(0, 0.0);
        assert!((patient.control(500_000_000, 0.0) - 1.5).abs() < 1e-12);
    }

    #[test]
    fn a_limited_command_does_not_wind_up() {
        let mut pid = pid(Parameters { integral: 5.0, limits: [-1.0, 1.0], ..PLAIN });
        for step in 0..1000 {
            assert_eq!(pid.control(step * 10_000_000, -5.0), 1.0);
        }
        // A measurement beyond the setpoint is answered at once, not after the integral has emptied.
        assert!(pid.control(10_000_000_000, 1.6) < 0.0);
    }

    #[test]
    fn an_angle_goes_the_short_way() {
        let mut pid = pid(Parameters { setpoint: 3.0, wrap: Some(std::f64::consts::TAU), ..PLAIN });
        assert!(pid.control(0, -3.0) < 0.0, "from −3 to 3 rad it is nearer backwards");
    }
}
