//! What the quadrotor's nodes tell each other.

use parallax_model::Tree;
use parallax_runtime::node::Message;

use crate::models::quadrotor::{Attitude, Vector};

/// How the quadrotor moves.
#[derive(Tree, Clone, Copy, Debug, Default, PartialEq)]
pub struct Motion<T = f64> {
    /// Position in the world's frame, m.
    pub position: Vector<T>,
    /// Velocity in the world's frame, m/s.
    pub velocity: Vector<T>,
    /// Attitude.
    pub attitude: Attitude<T>,
    /// When this was true, seconds since the run's start.
    pub stamp: T,
}

impl Message for Motion {
    const NAME: &'static str = "quadrotor/Motion";
}

/// Where the agent wants it to go.
#[derive(Tree, Clone, Copy, Debug, Default, PartialEq)]
pub struct Reference<T = f64> {
    /// Reference of the roll angle, rad.
    pub roll: T,
    /// Reference of the pitch angle, rad.
    pub pitch: T,
    /// Height to keep, m.
    pub height: T,
}

impl Message for Reference {
    const NAME: &'static str = "quadrotor/Reference";
}

/// What is sent to the quadrotor.
#[derive(Tree, Clone, Copy, Debug, Default, PartialEq)]
pub struct Command<T = f64> {
    /// Motor signal of all rotors, counts from 0 to 65535.
    pub pwm: T,
    /// Reference of the roll angle, rad.
    pub roll: T,
    /// Reference of the pitch angle, rad.
    pub pitch: T,
}

impl Message for Command {
    const NAME: &'static str = "quadrotor/Command";
}
