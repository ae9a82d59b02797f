//! A graph as data: what stands in `graph.toml`, and what is attached to a recording.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::{GraphError, SafeValue};
use crate::delay::Delay;
pub use crate::node::Parameters;

/// Nodes, connections and one supervisor.
///
/// ```
/// use parallax_runtime::graph::GraphSpec;
/// let spec = GraphSpec::from_toml(r#"
///     name = "look and act"
///     supervisor = "agent"
///     [[node]]
///     name = "camera"
///     kind = "example/camera"
///     rate = 60.0
///     computation = { distribution = "constant", seconds = 0.004 }
///     [[node]]
///     name = "agent"
///     kind = "example/agent"
///     rate = 30.0
///     [[connection]]
///     from = "camera"
///     to = "agent"
///     blocking = true
///     window = 2
/// "#)?;
/// assert_eq!(spec.connections[0].port(), "camera");
/// assert_eq!(GraphSpec::from_json(&spec.to_json())?, spec);
/// # Ok::<(), parallax_runtime::graph::GraphError>(())
/// ```
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GraphSpec {
    /// What people call it.
    pub name: String,
    /// The node at whose rate the graph is stepped, normally the agent.
    pub supervisor: String,
    /// The nodes.
    #[serde(rename = "node", default)]
    pub nodes: Vec<NodeSpec>,
    /// The connections.
    #[serde(rename = "connection", default)]
    pub connections: Vec<ConnectionSpec>,
    /// The nominal simulator of the stretch that no node records.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub plant: Option<PlantSpec>,
}

/// The nominal simulator between the actuators and the sensors.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlantSpec {
    /// The text of a `system.toml` whose signals are named `NODE.LEAF`.
    pub system: String,
}

/// One node.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NodeSpec {
    /// Its name, unique in the graph: letters, digits and underscores, starting with a letter.
    pub name: String,
    /// The key of its kind in the registry.
    pub kind: String,
    /// Steps a second.
    pub rate: f64,
    /// The kind's own parameters.
    #[serde(default, skip_serializing_if = "Parameters::is_empty")]
    pub parameters: Parameters,
    /// How long a step takes. Its mean sets the phases of receivers; the simulated clock draws from it.
    #[serde(default)]
    pub computation: Delay,
    /// What an overrun does to later ticks.
    #[serde(default)]
    pub scheduling: Scheduling,
    /// Starts as soon as the blocking inputs are there, without waiting for the tick.
    #[serde(default)]
    pub advance: bool,
    /// The core it is pinned to.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub core: Option<usize>,
    /// What it does when a node it waits for is gone.
    #[serde(default)]
    pub on_dead_sender: OnDeadSender,
    /// What its receivers are given when it is gone, hangs or is too late: a value for each leaf of its output, or
    /// `"hold"` for the last one sent. `"*"` stands for the leaves without a line of their own. Without it, the kind's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub safe: Option<BTreeMap<String, SafeValue>>,
}

impl NodeSpec {
    /// A node with the defaults: no parameters, steps that take no time, the grid kept, no core.
    pub fn new(name: impl Into<String>, kind: impl Into<String>, rate: f64) -> Self {
        Self {
            name: name.into(),
            kind: kind.into(),
            rate,
            parameters: Parameters::new(),
            computation: Delay::ZERO,
            scheduling: Scheduling::default(),
            advance: false,
            core: None,
            on_dead_sender: OnDeadSender::default(),
            safe: None,
        }
    }
}

/// What an overrun (a step that ends after the next one was due) does to later ticks.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Scheduling {
    /// All later ticks shift: the time between two steps is kept.
    Frequency,
    /// Later steps catch up with the grid: the number of steps is kept.
    #[default]
    Phase,
}

/// What a node does when a blocking input's sender is dead and the message it waits for will never come.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum OnDeadSender {
    /// It stops.
    #[default]
    Stop,
    /// It goes on with what is there.
    Continue,
}

/// How the jitter of a connection is treated.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum JitterPolicy {
    /// Whatever has arrived may be used.
    #[default]
    Latest,
    /// A message is held until its expected arrival: jitter becomes a constant delay.
    Buffer,
}

/// One connection: the output of `from` feeds an input of `to`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ConnectionSpec {
    /// The sending node.
    pub from: String,
    /// The receiving node.
    pub to: String,
    /// The input of `to`; if absent, the one named like `from`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub port: Option<String>,
    /// Whether a step waits for the messages that belong to it.
    #[serde(default)]
    pub blocking: bool,
    /// How many messages a step sees.
    #[serde(default = "one")]
    pub window: usize,
    /// Whether a message that arrives exactly at the start is left for the next step. Breaks cycles.
    #[serde(default)]
    pub skip: bool,
    /// How jitter is treated.
    #[serde(default)]
    pub jitter: JitterPolicy,
    /// How long a message travels. Its mean sets the receiver's phase; the simulated clock draws from it.
    #[serde(default)]
    pub delay: Delay,
}

fn one() -> usize {
    1
}

impl ConnectionSpec {
    /// A connection with the defaults: not blocking, a window of one, no delay.
    pub fn new(from: impl Into<String>, to: impl Into<String>) -> Self {
        Self {
            from: from.into(),
            to: to.into(),
            port: None,
            blocking: false,
            window: 1,
            skip: false,
            jitter: JitterPolicy::default(),
            delay: Delay::ZERO,
        }
    }

    /// The input of `to` that it feeds.
    pub fn port(&self) -> &str {
        self.port.as_deref().unwrap_or(&self.from)
    }
}

impl GraphSpec {
    /// Reads the text of a `graph.toml`.
    ///
    /// # Errors
    ///
    /// [`GraphError::Text`] with line and column when it is no such text.
    pub fn from_toml(text: &str) -> Result<Self, GraphError> {
        toml::from_str(text).map_err(|error| GraphError::Text { format: "TOML", problem: error.to_string() })
    }

    /// The graph as a `graph.toml`.
    ///
    /// # Errors
    ///
    /// [`GraphError::Text`] when a parameter is `null`, which TOML cannot say.
    pub fn to_toml(&self) -> Result<String, GraphError> {
        toml::to_string(self).map_err(|error| GraphError::Text { format: "TOML", problem: error.to_string() })
    }

    /// Reads the JSON that is attached to a recording.
    ///
    /// # Errors
    ///
    /// [`GraphError::Text`] with line and column when it is no such text.
    pub fn from_json(text: &str) -> Result<Self, GraphError> {
        serde_json::from_str(text)
            .map_err(|error| GraphError::Text { format: "JSON", problem: error.to_string() })
    }

    /// The graph as JSON, the same text for the same graph.
    pub fn to_json(&self) -> String {
        serde_json::to_string_pretty(self).expect("a graph holds nothing that JSON cannot say")
    }

    /// The node called `name`.
    pub fn node(&self, name: &str) -> Option<&NodeSpec> {
        self.nodes.iter().find(|node| node.name == name)
    }

    /// The node called `name`, to be changed.
    pub fn node_mut(&mut self, name: &str) -> Option<&mut NodeSpec> {
        self.nodes.iter_mut().find(|node| node.name == name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spec() -> GraphSpec {
        let mut camera = NodeSpec::new("camera", "test/camera", 59.94);
        camera.computation = Delay::Empirical { samples: vec![0.1 + 0.2, 1e-9] };
        camera.parameters.insert("gain".into(), serde_json::json!(0.1));
        camera.parameters.insert("nested".into(), serde_json::json!({"list": [1, 2], "on": true}));
        camera.core = Some(1);
        camera.safe =
            Some(BTreeMap::from([("angle".into(), SafeValue::Number(0.5)), ("*".into(), SafeValue::Hold)]));
        camera.scheduling = Scheduling::Frequency;
        let mut connection = ConnectionSpec::new("camera", "agent");
        connection.delay = Delay::LogNormal { mean: 0.01, std: 0.003 };
        connection.jitter = JitterPolicy::Buffer;
        GraphSpec {
            name: "a".into(),
            supervisor: "agent".into(),
            nodes: vec![camera, NodeSpec::new("agent", "test/agent", 30.0)],
            connections: vec![connection],
            plant: Some(PlantSpec { system: "name = \"x\"\n".into() }),
        }
    }

    #[test]
    fn toml_and_json_keep_everything() {
        let spec = spec();
        assert_eq!(GraphSpec::from_toml(&spec.to_toml().unwrap()).unwrap(), spec);
        assert_eq!(GraphSpec::from_json(&spec.to_json()).unwrap(), spec);
    }

    #[test]
    fn misspelt_keys_are_named_with_their_line() {
        let text = spec().to_toml().unwrap().replace("window", "windows");
        let error = GraphSpec::from_toml(&text).unwrap_err().to_string();
        assert!(error.contains("windows") && error.contains("line"), "{error}");
    }
}
