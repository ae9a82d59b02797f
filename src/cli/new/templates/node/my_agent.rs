//! A node: it swings a pendulum up and balances it.
//!
//! What goes in and out are messages of the graph it plugs into. For messages of your own, derive `Tree` for a struct of numbers
//! and give it a name by `impl Message` (examples/own_nodes.rs of Parallax has both ends). A driver also has `Node::stop`, to leave
//! its hardware safe; `Node::tuning` lets parameters be set while it runs.

use parallax::nodes::pendulum::{Estimate, Voltage};
use parallax::runtime::node::{Node, NodeError, Port, Step};
use parallax::runtime::registry::NodeKind;
use serde::Deserialize;

/// What it sees: the connection in the graph that ends in this port. To connect another message is an error.
const ESTIMATOR: Port<Estimate> = Port::new("estimator");

/// What may stand under `parameters` in the graph; a misspelt name is an error.
#[derive(Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Settings {
    /// The largest voltage that it asks for, V.
    limit: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { limit: 4.0 }
    }
}

/// The node. What it remembers from step to step are its fields.
struct MyAgent {
    settings: Settings,
}

/// The kind, by whose name a graph asks for the node.
pub(crate) fn kind() -> NodeKind {
    NodeKind::new(|context| {
        let settings: Settings = context.parameters()?;
        if settings.limit <= 0.0 {
            return Err(context.parameter_error("`limit` must be above zero"));
        }
        Ok(MyAgent { settings })
    })
    .input(ESTIMATOR)
}

impl Node for MyAgent {
    type Output = Voltage;

    /// One step. It should neither allocate nor wait: others are on time only if it is.
    fn step(&mut self, step: &Step<'_>) -> Result<Voltage, NodeError> {
        let Estimate { angle, speed, .. } = step.latest(ESTIMATOR).message;
        let voltage = if angle.abs() < 0.4 && speed.abs() < 5.0 {
            -(16.0 * angle + 1.4 * speed)
        } else {
            // The energy, 1 when it rests upright; what is missing is pumped in, what is too much taken out.
            let energy = 0.00387 * speed * speed + angle.cos();
            let push = (6.0 * (1.0 - energy)).clamp(-3.0, 3.0);
            if speed.abs() < 0.05 { 0.1 * push } else { push * (speed / 2.0).tanh() }
        };
        Ok(Voltage { voltage: voltage.clamp(-self.settings.limit, self.settings.limit) })
    }
}
