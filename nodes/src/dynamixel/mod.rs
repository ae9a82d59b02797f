//! Servos on a serial bus: the Dynamixel Protocol 2.0, a driver node, and the same node simulated.
//!
//! [`packet`] puts packets together and takes them apart, [`Bus`] asks and waits, [`Servo`] is the node `servo/dynamixel`.
//! The kind `servo/simulated` takes and sends the same messages, so that one line of a graph changes between them:
//!
//! ```toml
//! [[node]]
//! name = "servo"
//! kind = "servo/dynamixel"        # or "servo/simulated"
//! rate = 200.0
//! parameters = { port = "/dev/ttyUSB0", id = 1, mode = "position" }
//! ```
//!
//! The node asks the servo at each step and sends what it answered, then writes the newest goal. Without a command, at the
//! end of a run, and when the process dies, torque is off: the servo's own watchdog sees to the last case.

pub mod bus;
mod driver;
pub mod packet;
pub mod port;
mod simulated;
pub mod table;

use parallax_model::Tree;
use parallax_runtime::node::{Message, Port};
use parallax_runtime::registry::Registry;

pub use bus::{Bus, BusError, Refusal};
pub use driver::{Parameters, Servo};
pub use simulated::{SimulatedServo, Simulation};

/// What a servo is to do.
#[derive(Tree, Clone, Copy, Debug, Default, PartialEq)]
pub struct Command<T = f64> {
    /// The goal, in the unit of the servo's mode: rad, A, or a share of the supply's voltage from −1 to 1.
    pub goal: T,
    /// Above a half: the motor is driven. The default is that it is not.
    pub torque: T,
}

impl Message for Command {
    const NAME: &'static str = "servo/Command";
}

/// What a servo says of itself.
#[derive(Tree, Clone, Copy, Debug, Default, PartialEq)]
pub struct State<T = f64> {
    /// Position, rad from the middle of a turn.
    pub position: T,
    /// Velocity, rad/s.
    pub velocity: T,
    /// Current, A.
    pub current: T,
    /// 1 when the motor is driven, else 0.
    pub torque: T,
    /// How many questions were not answered well so far.
    pub errors: T,
    /// When the values were true, seconds since the run's start: it stands still while the servo does not answer.
    pub stamp: T,
}

impl Message for State {
    const NAME: &'static str = "servo/State";
}

/// The commands.
pub const COMMAND: Port<Command> = Port::new("command");

/// Adds the kinds `servo/dynamixel` and `servo/simulated`.
pub fn kinds(registry: Registry) -> Registry {
    registry.with("servo/dynamixel", driver::kind()).with("servo/simulated", simulated::kind())
}
