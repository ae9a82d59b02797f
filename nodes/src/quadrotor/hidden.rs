//! What a quadrotor that stands in for hardware is, and nobody who identifies it knows.
//!
//! It is drawn from a seed that reaches its processes by the environment ([`SEED_VARIABLE`]); it is no parameter of the
//! graph, so no recording holds it. Whoever knows the seed can ask for it afterwards.

use parallax_runtime::node::{NodeContext, NodeError};
use parallax_runtime::random::{Purpose, stream};
use rand::RngExt;

use super::airframe::Airframe;
use crate::pendulum::hidden::SEED_VARIABLE;

/// A quadrotor with its delays.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Machine {
    /// Mass, kg.
    pub mass: f64,
    /// Gain of its attitude control.
    pub attitude_gain: f64,
    /// Time constant of its attitude control, s.
    pub attitude_time: f64,
    /// Drag across the rotors' axis, N s²/(m rad).
    pub drag_xy: f64,
    /// Drag along it, N s²/(m rad).
    pub drag_z: f64,
    /// A command acts this much later than it was sent, s.
    pub actuator: f64,
    /// What the height's controller hears is as old as this, s.
    pub feedback: f64,
    /// What motion capture tells is as old as this, s.
    pub sensor: f64,
}

impl Default for Machine {
    /// What the nominal simulator believes, without delays.
    fn default() -> Self {
        let [actuator, feedback, sensor] = [0.0; 3];
        Self {
            mass: 0.03,
            attitude_gain: 1.0,
            attitude_time: 0.15,
            drag_xy: 9.18e-7,
            drag_z: 1.03e-6,
            actuator,
            feedback,
            sensor,
        }
    }
}

impl Machine {
    /// Draws one; equal seeds draw equal machines.
    pub fn draw(seed: u64) -> Self {
        let mut random = stream(seed, Purpose::Node, "hidden quadrotor");
        Self {
            mass: random.random_range(0.027..0.036),
            attitude_gain: random.random_range(0.9..1.1),
            attitude_time: random.random_range(0.10..0.16),
            drag_xy: random.random_range(5e-7..2e-6),
            drag_z: random.random_range(5e-7..2e-6),
            actuator: random.random_range(0.025..0.042),
            feedback: random.random_range(0.006..0.014),
            sensor: random.random_range(0.010..0.022),
        }
    }

    /// What the seed in [`SEED_VARIABLE`] draws; without one, the nominal machine.
    ///
    /// # Errors
    ///
    /// When it is set to something else than `machine` and a whole number.
    pub fn from_environment(context: &NodeContext) -> Result<Self, NodeError> {
        Self::of(std::env::var(SEED_VARIABLE).ok().as_deref(), context)
    }

    fn of(variable: Option<&str>, context: &NodeContext) -> Result<Self, NodeError> {
        let Some(text) = variable else { return Ok(Self::default()) };
        let seed = text.trim().strip_prefix("machine").and_then(|seed| seed.trim().parse().ok());
        seed.map(Self::draw).ok_or_else(|| {
            context.parameter_error(format!(
                "the environment's {SEED_VARIABLE} is `{text}`; a quadrotor wants the word `machine` and a whole number"
            ))
        })
    }

    /// Its numbers by name.
    pub fn parameters(&self) -> [(&'static str, f64); 8] {
        [
            ("mass", self.mass),
            ("attitude_gain", self.attitude_gain),
            ("attitude_time", self.attitude_time),
            ("drag_xy", self.drag_xy),
            ("drag_z", self.drag_z),
            ("actuator", self.actuator),
            ("feedback", self.feedback),
            ("sensor", self.sensor),
        ]
    }

    pub(super) fn airframe(&self) -> Airframe {
        Airframe {
            mass: self.mass,
            attitude_rate: self.attitude_gain / self.attitude_time,
            drag: [self.drag_xy, self.drag_z],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_environment_gives_a_machine_or_the_nominal_one() {
        let context =
            NodeContext { name: "world".into(), rate: 200.0, seed: 1, parameters: Default::default() };
        assert_eq!(Machine::of(None, &context), Ok(Machine::default()));
        assert_eq!(Machine::of(Some(" machine 42"), &context), Ok(Machine::draw(42)));
        assert_ne!(Machine::draw(42), Machine::draw(43));
        for wrong in ["42", "machine", "machine x"] {
            let error = Machine::of(Some(wrong), &context).expect_err("no machine").to_string();
            assert!(error.contains(wrong) && error.contains("whole number"), "{error}");
        }
    }
}
