//! What the pendulum's nodes tell each other.

use parallax_model::Tree;
use parallax_runtime::node::Message;

use crate::pid::{Commanded, Measured};

/// What the world is like; known only because the world is simulated.
#[derive(Tree, Clone, Copy, Debug, Default, PartialEq)]
pub struct WorldState<T = f64> {
    /// Angle of the sensor's mark from upright, rad, not wrapped.
    pub angle: T,
    /// Angular speed, rad/s.
    pub speed: T,
    /// When this was true, seconds since the run's start.
    pub stamp: T,
}

impl Message for WorldState {
    const NAME: &'static str = "pendulum/WorldState";
}

/// What the camera sees.
#[derive(Tree, Clone, Copy, Debug, Default, PartialEq)]
pub struct Angle<T = f64> {
    /// Angle from upright, rad, within [−π, π).
    pub angle: T,
    /// When the picture was taken, seconds since the run's start.
    pub stamp: T,
}

impl Message for Angle {
    const NAME: &'static str = "pendulum/Angle";
}

impl Measured for Angle {
    fn measured(&self) -> f64 {
        self.angle
    }
}

/// What the estimator believes of the present.
#[derive(Tree, Clone, Copy, Debug, Default, PartialEq)]
pub struct Estimate<T = f64> {
    /// Angle from upright, rad, within [−π, π).
    pub angle: T,
    /// Angular speed, rad/s.
    pub speed: T,
    /// The time for which this holds, seconds since the run's start.
    pub stamp: T,
}

impl Message for Estimate {
    const NAME: &'static str = "pendulum/Estimate";
}

/// A voltage for the motor.
#[derive(Tree, Clone, Copy, Debug, Default, PartialEq)]
pub struct Voltage<T = f64> {
    /// Voltage, V; positive drives the angle up.
    pub voltage: T,
}

impl Message for Voltage {
    const NAME: &'static str = "pendulum/Voltage";
}

impl Commanded for Voltage {
    fn command(value: f64) -> Self {
        Self { voltage: value }
    }
}
