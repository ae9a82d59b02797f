//! The timing of one run: when every step ran, and which messages it saw.
//!
//! An [`Episode`] is a schedule without payloads. It comes from a recording, or is drawn from a graph and its delays
//! ([`generate`](crate::generate)).

use parallax_runtime::graph::Graph;
use parallax_runtime::recording::{NodeTrack, Recording, StepRecord};
use parallax_runtime::time::Nanos;

/// The schedule of one run, nodes and connections in the order of the graph. Times are nanoseconds since the run's
/// start.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Episode {
    /// How long it ran: no step started at or after this time.
    pub duration: Nanos,
    /// When each node's steps ran.
    pub nodes: Vec<NodeSteps>,
    /// What each connection's receiver saw.
    pub connections: Vec<Consumption>,
}

/// When a node's steps ran; step k at place k.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct NodeSteps {
    /// When each was due.
    pub due: Vec<Nanos>,
    /// When each started.
    pub start: Vec<Nanos>,
    /// When each ended and its message was sent.
    pub end: Vec<Nanos>,
}

impl NodeSteps {
    /// How many steps there are.
    pub fn len(&self) -> usize {
        self.start.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.start.is_empty()
    }
}

/// What the receiver of a connection saw: one window a step, oldest first.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Consumption {
    /// Messages in a window.
    pub window: usize,
    /// The sender's step that made each message, −1 for the initial message: `[receiver's step][place in the window]`.
    pub seq: Vec<i64>,
    /// When each arrived, 0 for the initial message; of the same shape.
    pub received: Vec<Nanos>,
}

impl Consumption {
    /// Nothing seen yet, with room for `steps` windows.
    pub fn new(window: usize, steps: usize) -> Self {
        let places = window * steps;
        Self { window, seq: Vec::with_capacity(places), received: Vec::with_capacity(places) }
    }

    /// Numbers of the messages that the receiver's step `step` saw, oldest first.
    ///
    /// # Panics
    ///
    /// When there is no such step.
    pub fn seqs(&self, step: usize) -> &[i64] {
        &self.seq[step * self.window..(step + 1) * self.window]
    }

    /// When those messages arrived.
    ///
    /// # Panics
    ///
    /// When there is no such step.
    pub fn arrivals(&self, step: usize) -> &[Nanos] {
        &self.received[step * self.window..(step + 1) * self.window]
    }
}

/// Why a recording is no whole schedule of its graph.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum EpisodeError {
    /// A node of the graph was not recorded.
    #[error("the recording has no node `{node}` of the graph; drop the node from the graph first")]
    MissingNode {
        /// The node.
        node: String,
    },
    /// Steps are missing.
    #[error(
        "node `{node}`: step {expected} is missing from the recording (step {found} follows); a schedule needs every \
         step from the first on"
    )]
    MissingStep {
        /// The node.
        node: String,
        /// The step that should be there.
        expected: u64,
        /// The step that is there.
        found: u64,
    },
    /// A step's inputs are not those of the graph.
    #[error("node `{node}`, step {step}: the recorded input `{port}` does not fit the graph: {problem}")]
    Input {
        /// The node.
        node: String,
        /// The step.
        step: u64,
        /// The input.
        port: String,
        /// How.
        problem: String,
    },
    /// A step saw a message of which the recording has no step.
    #[error(
        "node `{node}`, step {step} saw message {seq} of `{sender}`, which the recording lacks; it is damaged"
    )]
    MissingMessage {
        /// The receiver.
        node: String,
        /// Its step.
        step: u64,
        /// The sender.
        sender: String,
        /// The message.
        seq: u64,
    },
}

impl Episode {
    /// An episode of `graph` in which nothing has happened yet.
    pub fn empty(graph: &Graph, duration: Nanos) -> Self {
        Self {
            duration,
            nodes: vec![NodeSteps::default(); graph.nodes().len()],
            connections: graph.connections().iter().map(|plan| Consumption::new(plan.window, 0)).collect(),
        }
    }

    /// The schedule of a recording. Nodes that the graph does not have are left out. Of a recording that was cut, whose
    /// tracks end at different times, the steps are left out that saw what lies beyond the cut.
    ///
    /// # Errors
    ///
    /// [`EpisodeError`] when a node or a step is missing, or the recorded windows are not those of `graph`.
    pub fn from_recording(graph: &Graph, recording: &Recording) -> Result<Self, EpisodeError> {
        let mut episode = Self::empty(graph, recording.duration);
        for index in 0..graph.nodes().len() {
            let name = &graph.nodes()[index].name;
            let track =
                recording.node(name).ok_or_else(|| EpisodeError::MissingNode { node: name.clone() })?;
            episode.take(graph, index, track)?;
        }
        if recording.truncated.is_some() {
            episode.drop_beyond_cut(graph);
        }
        episode.check_messages(graph)?;
        Ok(episode)
    }

    /// Adds the steps of one node.
    fn take(&mut self, graph: &Graph, index: usize, track: &NodeTrack) -> Result<(), EpisodeError> {
        let plan = &graph.nodes()[index];
        for (expected, step) in track.steps.iter().enumerate() {
            if step.seq != expected as u64 {
                let (expected, found) = (expected as u64, step.seq);
                return Err(EpisodeError::MissingStep { node: plan.name.clone(), expected, found });
            }
            self.push(graph, index, step)?;
        }
        Ok(())
    }

    /// Adds one step of a node, the next in order.
    fn push(&mut self, graph: &Graph, index: usize, step: &StepRecord) -> Result<(), EpisodeError> {
        let plan = &graph.nodes()[index];
        let wrong = |port: &str, problem: String| EpisodeError::Input {
            node: plan.name.clone(),
            step: step.seq,
            port: port.to_owned(),
            problem,
        };
        let steps = &mut self.nodes[index];
        steps.due.push(step.due);
        steps.start.push(step.start);
        steps.end.push(step.end);
        for &connection in &plan.inputs {
            let ConnectionShape { port, window } = shape(graph, connection);
            let Some(input) = step.inputs.iter().find(|input| input.port == port) else {
                return Err(wrong(port, "it was not recorded".into()));
            };
            if input.consumed.len() != window {
                let problem = format!("{} messages, where the window is {window}", input.consumed.len());
                return Err(wrong(port, problem));
            }
            let consumption = &mut self.connections[connection];
            for message in &input.consumed {
                let seq = message.seq.map_or(Ok(-1), i64::try_from);
                consumption.seq.push(seq.map_err(|_| wrong(port, "an impossible number".into()))?);
                consumption.received.push(message.received);
            }
        }
        Ok(())
    }

    /// Ends every node before its first step that saw a message of which there is no step.
    fn drop_beyond_cut(&mut self, graph: &Graph) {
        let mut changed = true;
        while changed {
            changed = false;
            for (index, plan) in graph.connections().iter().enumerate() {
                let sent = self.nodes[plan.from].len() as i64;
                let consumption = &self.connections[index];
                let Some(place) = consumption.seq.iter().position(|&seq| seq >= sent) else { continue };
                let kept = place / consumption.window;
                let steps = &mut self.nodes[plan.to];
                steps.due.truncate(kept);
                steps.start.truncate(kept);
                steps.end.truncate(kept);
                for &input in &graph.nodes()[plan.to].inputs {
                    let consumption = &mut self.connections[input];
                    consumption.seq.truncate(kept * consumption.window);
                    consumption.received.truncate(kept * consumption.window);
                }
                changed = true;
            }
        }
    }

    /// Every message that was seen has a step that made it.
    fn check_messages(&self, graph: &Graph) -> Result<(), EpisodeError> {
        for (plan, consumption) in graph.connections().iter().zip(&self.connections) {
            let sent = self.nodes[plan.from].len() as i64;
            if let Some(place) = consumption.seq.iter().position(|&seq| seq >= sent) {
                return Err(EpisodeError::MissingMessage {
                    node: graph.nodes()[plan.to].name.clone(),
                    step: (place / consumption.window) as u64,
                    sender: graph.nodes()[plan.from].name.clone(),
                    seq: consumption.seq[place].unsigned_abs(),
                });
            }
        }
        Ok(())
    }

    /// Whether its shape is that of `graph`, as a sentence about what is not.
    ///
    /// # Errors
    ///
    /// The first thing that does not fit.
    pub fn check(&self, graph: &Graph) -> Result<(), String> {
        let (nodes, connections) = (graph.nodes(), graph.connections());
        if self.nodes.len() != nodes.len() || self.connections.len() != connections.len() {
            return Err(format!(
                "it has {} nodes and {} connections, the graph has {} and {}",
                self.nodes.len(),
                self.connections.len(),
                nodes.len(),
                connections.len()
            ));
        }
        for (plan, steps) in nodes.iter().zip(&self.nodes) {
            if steps.due.len() != steps.len() || steps.end.len() != steps.len() {
                return Err(format!("node `{}` has not as many due times and ends as starts", plan.name));
            }
            let orderly = |pair: &[Nanos]| pair[0] <= pair[1];
            if !steps.start.windows(2).all(orderly) || !steps.end.windows(2).all(orderly) {
                return Err(format!("the steps of node `{}` are not in the order of time", plan.name));
            }
        }
        for (index, (plan, consumption)) in connections.iter().zip(&self.connections).enumerate() {
            let name = || graph.connection_name(index);
            let (sent, steps) = (self.nodes[plan.from].len() as i64, self.nodes[plan.to].len());
            if consumption.window != plan.window {
                return Err(format!("{} has window {}, not {}", name(), consumption.window, plan.window));
            }
            if consumption.seq.len() != steps * plan.window
                || consumption.received.len() != steps * plan.window
            {
                return Err(format!("{} has not one window for each of {steps} steps", name()));
            }
            if let Some(seq) = consumption.seq.iter().find(|&&seq| seq < -1 || seq >= sent) {
                return Err(format!("{} saw message {seq}, but {sent} were sent", name()));
            }
        }
        Ok(())
    }

    /// How many steps ran in all.
    pub fn steps(&self) -> usize {
        self.nodes.iter().map(NodeSteps::len).sum()
    }
}

struct ConnectionShape<'a> {
    port: &'a str,
    window: usize,
}

fn shape(graph: &Graph, connection: usize) -> ConnectionShape<'_> {
    let plan = &graph.connections()[connection];
    ConnectionShape { port: &plan.port, window: plan.window }
}
