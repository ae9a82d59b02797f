//! The nodes of the suite.

use std::time::Duration;

use parallax_model::tree::Tree;
use serde::Deserialize;

use crate::node::{Message, Node, NodeContext, NodeError, Port, Step};
use crate::registry::{NodeKind, Registry};

/// The one message of the suite.
#[derive(Tree, Debug, Clone, Default, PartialEq)]
pub struct Number {
    /// A number.
    pub value: f64,
}

impl Message for Number {
    const NAME: &'static str = "conformance/Number";
}

/// The one input of the suite.
pub const IN: Port<Number> = Port::new("in");

/// The initial message of every node.
pub(super) const INITIAL: f64 = -1.0;

/// Sends the number of its step; may sleep now and then, and may give up.
struct Counter {
    dies_at: Option<u64>,
    sleep_every: u64,
    sleep: Duration,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields, default)]
struct CounterParameters {
    dies_at: Option<u64>,
    sleep_every: u64,
    sleep: f64,
}

impl Default for CounterParameters {
    fn default() -> Self {
        Self { dies_at: None, sleep_every: u64::MAX, sleep: 0.0 }
    }
}

impl Counter {
    fn new(context: &NodeContext) -> Result<Self, NodeError> {
        let CounterParameters { dies_at, sleep_every, sleep } = context.parameters()?;
        let sleep = Duration::try_from_secs_f64(sleep)
            .map_err(|error| context.parameter_error(format!("sleep = {sleep}: {error}")))?;
        if sleep_every == 0 {
            return Err(context.parameter_error("sleep_every = 0: has to be at least 1"));
        }
        Ok(Self { dies_at, sleep_every, sleep })
    }

    fn count(&self, step: &Step<'_>) -> Result<(), NodeError> {
        if self.dies_at == Some(step.seq) {
            return Err(NodeError::failed("the end of its life"));
        }
        if step.seq % self.sleep_every == self.sleep_every - 1 {
            std::thread::sleep(self.sleep);
        }
        Ok(())
    }
}

impl Node for Counter {
    type Output = Number;

    fn step(&mut self, step: &Step<'_>) -> Result<Number, NodeError> {
        self.count(step)?;
        Ok(Number { value: step.seq as f64 })
    }
}

/// Sends the sum of its window.
struct Sum(Counter);

impl Node for Sum {
    type Output = Number;

    fn step(&mut self, step: &Step<'_>) -> Result<Number, NodeError> {
        self.0.count(step)?;
        Ok(Number { value: step.window(IN).map(|received| received.message.value).sum() })
    }
}

/// The kinds of node of the suite.
///
/// - `conformance/counter` sends the number of its step;
/// - `conformance/sum` has the input [`IN`] and sends the sum of its window.
///
/// Parameters of both: `dies_at` (the step that fails), `sleep_every` and `sleep` (every so many steps it sleeps so many
/// seconds of real time). The initial message is -1.
pub fn registry() -> Registry {
    let initial = Number { value: INITIAL };
    Registry::new().with("conformance/counter", NodeKind::new(Counter::new).initial(&initial)).with(
        "conformance/sum",
        NodeKind::new(|context| Counter::new(context).map(Sum)).initial(&initial).input(IN),
    )
}
