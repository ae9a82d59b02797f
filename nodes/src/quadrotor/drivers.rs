//! Drivers of a quadrotor that stands in for hardware. What they hear of it is late by a time that nobody knows
//! ([`super::hidden`]), and noisy:
//!
//! - `quadrotor/tracker` asks motion capture;
//! - `quadrotor/onboard` is the height's controller with what it hears on board.

use parallax_runtime::node::{Node, NodeError, Port, Step};
use parallax_runtime::registry::NodeKind;
use parallax_runtime::time::to_seconds;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::hidden::Machine;
use super::messages::{Command, Motion};
use super::{mocap, pid};
use crate::models::quadrotor::{Attitude, Vector};

/// How many of the world's messages a driver looks back on: 75 ms at 200 Hz.
pub const PAST: usize = 16;

/// What has not been heard yet is extrapolated for at most this long, s.
const AHEAD: f64 = 0.02;

/// The world as it was at a time, between its messages.
fn seen(step: &Step<'_>, port: Port<Motion>, time: f64) -> Motion {
    let mut newest: Option<Motion> = None;
    let mut before = None;
    for received in step.window(port).filter(|received| received.seq.is_some()) {
        (before, newest) = (newest, Some(received.message));
        if received.message.stamp >= time {
            break;
        }
    }
    let Some(b) = newest else { return step.latest(port).message };
    // Older than all that it has: the oldest.
    let Some(a) = before else { return b };
    let share = (time.clamp(0.0, b.stamp + AHEAD) - a.stamp) / (b.stamp - a.stamp);
    let between = |a: f64, b: f64| a + share * (b - a);
    let vector = |a: Vector<f64>, b: Vector<f64>| Vector {
        x: between(a.x, b.x),
        y: between(a.y, b.y),
        z: between(a.z, b.z),
    };
    Motion {
        position: vector(a.position, b.position),
        velocity: vector(a.velocity, b.velocity),
        attitude: Attitude {
            roll: between(a.attitude.roll, b.attitude.roll),
            pitch: between(a.attitude.pitch, b.attitude.pitch),
            yaw: between(a.attitude.yaw, b.attitude.yaw),
        },
        stamp: time,
    }
}

/// Motion capture.
struct Tracker {
    delay: f64,
    noise: mocap::Parameters,
    random: ChaCha8Rng,
}

/// The kind `quadrotor/tracker`.
pub fn tracker() -> NodeKind {
    NodeKind::new(|context| {
        let delay = Machine::from_environment(context)?.sensor;
        Ok(Tracker { delay, noise: mocap::settings(context)?, random: context.random() })
    })
    .input(mocap::WORLD)
}

impl Node for Tracker {
    type Output = Motion;

    fn step(&mut self, step: &Step<'_>) -> Result<Motion, NodeError> {
        let now = to_seconds(step.start);
        let motion = seen(step, mocap::WORLD, now - self.delay);
        let noise: [f64; mocap::NOISES] = std::array::from_fn(|_| StandardNormal.sample(&mut self.random));
        // It does not know how late it is.
        Ok(mocap::noisy(&self.noise, Motion { stamp: now, ..motion }, &noise))
    }
}

/// The height's controller.
struct Onboard {
    delay: f64,
    parameters: pid::Parameters,
    state: pid::State,
}

/// The kind `quadrotor/onboard`; its parameters are those of `quadrotor/pid`.
pub fn onboard() -> NodeKind {
    NodeKind::new(|context| {
        let (parameters, state) = pid::start(context)?;
        Ok(Onboard { delay: Machine::from_environment(context)?.feedback, parameters, state })
    })
    .input(pid::MOCAP)
    .input(pid::AGENT)
}

impl Node for Onboard {
    type Output = Command;

    fn step(&mut self, step: &Step<'_>) -> Result<Command, NodeError> {
        let now = to_seconds(step.start);
        // What is heard at first is what was there at the start.
        let known = step.latest(pid::MOCAP).seq.is_some().then(|| seen(step, pid::MOCAP, now - self.delay));
        let wanted = step.latest(pid::AGENT).message;
        let (state, command) =
            pid::control(&self.parameters, self.state, known.is_some(), known.unwrap_or_default(), wanted);
        self.state = state;
        Ok(command)
    }
}

#[cfg(test)]
mod tests {
    use parallax_model::Tree as _;
    use parallax_runtime::node::{Consumed, InputWindow};
    use parallax_runtime::time::from_seconds;

    use super::*;

    fn at(stamp: f64) -> Motion {
        Motion { position: Vector { x: 2.0 * stamp, y: 0.0, z: 1.0 }, stamp, ..Motion::default() }
    }

    /// What a driver sees of times after messages with these stamps.
    fn looks(stamps: &[f64], times: &[f64]) -> Vec<f64> {
        let mut input =
            InputWindow::new(mocap::WORLD.name(), Motion::<f64>::default().to_vec().len(), stamps.len() + 1);
        input.push(Consumed::INITIAL, &at(0.0).to_vec());
        for (seq, &stamp) in stamps.iter().enumerate() {
            let sent = from_seconds(stamp);
            input.push(Consumed { seq: Some(seq as u64), sent, received: sent }, &at(stamp).to_vec());
        }
        let inputs = [input];
        let step = Step::new(0, 0, 0, &inputs);
        times.iter().map(|&time| seen(&step, mocap::WORLD, time).position.x).collect()
    }

    #[test]
    fn the_past_is_seen_between_messages_and_a_little_of_the_future() {
        let seen = looks(&[0.1, 0.105, 0.11], &[0.1025, 0.107, 0.112]);
        for (x, time) in seen.iter().zip([0.1025, 0.107, 0.112]) {
            assert!((x - 2.0 * time).abs() < 1e-12, "{x} at {time}");
        }
        // Not far: what a process that hangs shows is old.
        assert!((looks(&[0.1, 0.105], &[1.0])[0] - 2.0 * (0.105 + AHEAD)).abs() < 1e-12);
        // Older than all that is known, and nothing known yet.
        assert_eq!(looks(&[0.1, 0.105], &[0.01]), [0.2]);
        assert_eq!(looks(&[0.1], &[0.2]), [0.2]);
        assert_eq!(looks(&[], &[0.2]), [0.0]);
    }
}
