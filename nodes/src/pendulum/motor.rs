//! The motor's driver: passes the agent's voltage on, within what the motor is rated for.

use parallax_runtime::node::{Node, NodeError, Port, Step};
use parallax_runtime::registry::NodeKind;
use serde::Deserialize;

use super::messages::Voltage;

/// What the agent wants.
pub const AGENT: Port<Voltage> = Port::new("agent");

/// Parameters of the driver.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Parameters {
    /// The motor's rated voltage, V: commands beyond it, of either sign, are limited.
    pub rated: f64,
}

impl Default for Parameters {
    fn default() -> Self {
        Self { rated: 4.0 }
    }
}

/// The driver.
#[derive(Clone, Copy, Debug)]
pub struct Motor {
    rated: f64,
}

/// The kind `pendulum/motor`.
pub fn kind() -> NodeKind {
    NodeKind::new(|context| {
        let Parameters { rated } = context.parameters()?;
        if !(rated > 0.0 && rated.is_finite()) {
            return Err(context.parameter_error(format!("`rated` is {rated} V; it must be positive")));
        }
        Ok(Motor { rated })
    })
    .input(AGENT)
}

impl Node for Motor {
    type Output = Voltage;

    fn step(&mut self, step: &Step<'_>) -> Result<Voltage, NodeError> {
        let wanted = step.latest(AGENT).message.voltage;
        // Something that is no number must not reach the motor.
        let voltage = if wanted.is_nan() { 0.0 } else { wanted.clamp(-self.rated, self.rated) };
        Ok(Voltage { voltage })
    }
}
