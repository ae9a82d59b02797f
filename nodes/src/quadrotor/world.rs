//! The world: a quadrotor that stands in for the hardware, integrated at 1 kHz to the stamps of its commands.

use parallax_model::Tree;
use parallax_runtime::node::{Node, NodeError, Port, Step};
use parallax_runtime::registry::NodeKind;
use parallax_runtime::time::{Nanos, from_seconds, to_seconds};
use serde::Deserialize;

use super::airframe::{Airframe, Flight, hover};
use super::hidden::Machine;
use super::messages::{Command, Motion};
use crate::models::quadrotor::{Attitude, Vector};
use crate::stand_in::{Machine as StandInMachine, StandIn};

/// The commands.
pub const PID: Port<Command> = Port::new("pid");

/// The longest integration step, s.
const STEP: f64 = 1e-3;

/// What may stand in a graph.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Settings {
    /// Where it hovers at first, m.
    position: [f64; 3],
}

impl Default for Settings {
    fn default() -> Self {
        Self { position: START }
    }
}

/// Where it is at first, unless the graph says otherwise, m.
const START: [f64; 3] = [1.0, 0.0, 1.0];

/// The kind `quadrotor/world`.
pub fn kind() -> NodeKind {
    NodeKind::new(|context| {
        let Settings { position } = context.parameters()?;
        if !(position.iter().all(|x| x.is_finite()) && position[2] > 0.0) {
            return Err(
                context.parameter_error("`position` must be above the floor, at a height greater than 0")
            );
        }
        let machine = Machine::from_environment(context)?;
        Ok(World(StandIn::new(Airborne::new(&machine, position))))
    })
    .input(PID)
    .initial(&Flight::hovering(START).motion(0.0))
    .stand_in()
}

/// The world.
#[derive(Clone, Debug)]
struct World(StandIn<Airborne>);

impl Node for World {
    type Output = Motion;

    fn step(&mut self, step: &Step<'_>) -> Result<Motion, NodeError> {
        Ok(self.0.step(step, PID).flight.motion(to_seconds(step.start)))
    }
}

impl Flight {
    fn motion(&self, stamp: f64) -> Motion {
        let vector = |[x, y, z]: [f64; 3]| Vector { x, y, z };
        Motion {
            position: vector(self.position),
            velocity: vector(self.velocity),
            attitude: Attitude { roll: self.roll, pitch: self.pitch, yaw: 0.0 },
            stamp,
        }
    }
}

/// A quadrotor at a time.
#[derive(Clone, Copy, Debug)]
struct Airborne {
    frame: Airframe,
    delay: Nanos,
    time: Nanos,
    flight: Flight,
    /// What acts at present: motor signal and references.
    command: [f64; 3],
}

impl Airborne {
    fn new(machine: &Machine, position: [f64; 3]) -> Self {
        Self {
            frame: machine.airframe(),
            delay: from_seconds(machine.actuator),
            time: 0,
            flight: Flight::hovering(position),
            // Until it is told something, it carries its weight.
            command: [hover(machine.mass), 0.0, 0.0],
        }
    }
}

impl StandInMachine for Airborne {
    type Command = Command;

    fn delay(&self) -> Nanos {
        self.delay
    }

    fn apply(&mut self, command: Command) {
        let mut leaves = [0.0; 3];
        command.write_to(&mut leaves);
        self.command = leaves;
    }

    fn advance(&mut self, until: Nanos) {
        if until <= self.time {
            return;
        }
        let span = to_seconds(until - self.time);
        let steps = (span / STEP).ceil().max(1.0);
        for _ in 0..steps as u64 {
            self.flight = self.frame.step(self.flight, self.command, span / steps);
            // The floor: it comes to rest there.
            if self.flight.position[2] < 0.0 {
                self.flight.position[2] = 0.0;
                self.flight.velocity = [0.0; 3];
            }
        }
        self.time = until;
    }
}

#[cfg(test)]
mod tests {
    use parallax_runtime::time::SECOND;

    use super::*;

    fn flown(machine: &Machine, commands: &[(Nanos, Command)], until: Nanos) -> Flight {
        let mut world = StandIn::new(Airborne::new(machine, START));
        commands.iter().for_each(|(sent, command)| world.command(*sent, *command));
        world.at(until).flight
    }

    #[test]
    fn it_agrees_with_the_model_that_is_written_apart() {
        use crate::models::quadrotor::{Input, Params, State, hover_pwm, step};
        let command = Command { pwm: 42_000.0, roll: 0.3, pitch: -0.2 };
        let flown = flown(&Machine::default(), &[(0, command)], SECOND);
        let params = Params::default();
        let mut state = State {
            position: Vector { x: 1.0, y: 0.0, z: 1.0 },
            velocity: Vector::default(),
            attitude: Attitude::default(),
            thrust: hover_pwm(&params) * params.motor_gain / -params.motor_rate,
        };
        let Command { pwm, roll, pitch } = command;
        for _ in 0..1000 {
            state = step(&params, state, Input { pwm, roll, pitch }, 1e-3);
        }
        let State { position, velocity, attitude, .. } = state;
        let [x, y, z] = flown.position;
        for (a, b) in [(x, position.x), (y, position.y), (z, position.z), (flown.roll, attitude.roll)] {
            assert!((a - b).abs() < 1e-5, "{a} {b}");
        }
        assert!((flown.velocity[0] - velocity.x).abs() < 1e-5);
        assert!((x - 1.0).abs() > 0.1, "it moves: {x}");
    }

    #[test]
    fn a_delay_shifts_the_response() {
        let late = Machine { actuator: 0.03, ..Machine::default() };
        let command = Command { pwm: 45_000.0, roll: 0.2, pitch: 0.0 };
        let at = SECOND / 10;
        let a = flown(&Machine::default(), &[(at, command)], SECOND);
        let b = flown(&late, &[(at, command)], SECOND + from_seconds(0.03));
        assert!((a.position[1] - b.position[1]).abs() < 1e-6, "{a:?} {b:?}");
        assert!((a.roll - flown(&late, &[(at, command)], SECOND / 4).roll).abs() > 1e-3);
    }

    #[test]
    fn it_comes_to_rest_on_the_floor() {
        let fallen = flown(&Machine::default(), &[(0, Command::default())], 3 * SECOND);
        assert_eq!((fallen.position[2], fallen.velocity), (0.0, [0.0; 3]));
    }
}
