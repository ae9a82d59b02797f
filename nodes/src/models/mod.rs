//! Mathematics of robots, pure and generic over the scalar.

pub mod pendulum;
pub mod quadrotor;
