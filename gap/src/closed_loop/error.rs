//! Why a closed loop cannot be scored.

use parallax_model::plant::Unfit;
use parallax_model::system::SystemError;
use parallax_runtime::graph::GraphError;
use parallax_runtime::recording::log::UnknownSignal;
use parallax_sim::SimError;

use crate::bind::BindError;

/// Why a closed loop cannot be scored.
#[derive(Debug, thiserror::Error)]
pub enum ClosedLoopError {
    /// The task's expressions are not whole.
    #[error(transparent)]
    Task(Box<SystemError>),
    /// The machine and a recording do not fit together.
    #[error(transparent)]
    Bind(Box<BindError>),
    /// An input of the task file is bound to a signal that a recording lacks.
    #[error(
        "{file}:{line}: `{name}` of [inputs] is bound to a signal that the recording does not have: {source}"
    )]
    Signal {
        /// The task file.
        file: String,
        /// The line.
        line: usize,
        /// The input.
        name: String,
        /// What is missing, and what there is.
        source: Box<UnknownSignal>,
    },
    /// A signal that the task reads has no sample.
    #[error(
        "the recording `{title}` has no sample of `{signal}`, which the task reads as `{name}`; leave that recording out, or choose another part of it"
    )]
    Silent {
        /// The recording.
        title: String,
        /// The signal.
        signal: String,
        /// Its name in the task.
        name: String,
    },
    /// An output of the controller commands nothing.
    #[error(
        "{file}:{line}: the controller's output `{output}` cannot act: {problem}; name it after the input that it commands"
    )]
    Command {
        /// The task file.
        file: String,
        /// The line.
        line: usize,
        /// The output.
        output: String,
        /// Why.
        problem: String,
    },
    /// Nothing says where a state of the controller starts.
    #[error(
        "{file}:{line}: nothing says where the controller's state `{state}` starts; write `initial = 0.0`, or the name \
         of a signal for its first value"
    )]
    State {
        /// The task file.
        file: String,
        /// The line.
        line: usize,
        /// The state.
        state: String,
    },
    /// The controller's equations cannot be stepped.
    #[error(transparent)]
    Controller(#[from] Unfit),
    /// There is no controller.
    #[error(
        "{file}: nothing says which controller closes the loop; describe it in the task file by [outputs] (one for each \
         input that it commands), or diagnose one recording of a Parallax graph, whose nodes then run"
    )]
    NoController {
        /// The task file.
        file: String,
    },
    /// The task reaches beyond a recording.
    #[error(
        "{file}: the task takes {from} to {to} s, but the recording `{title}` ends at {end} s; make `to` or `horizon` smaller"
    )]
    Horizon {
        /// The task file.
        file: String,
        /// The recording.
        title: String,
        /// Where the task begins (s).
        from: f64,
        /// Where its first episode ends (s).
        to: f64,
        /// Where the recording ends (s).
        end: f64,
    },
    /// The recorded cost is no number.
    #[error(
        "{at}: the {what} of the recording `{title}` is {value} at {time} s, with {given}; write it so that it is a number there"
    )]
    NotFinite {
        /// File and line of the expression.
        at: String,
        /// `cost` or `terminal` cost.
        what: &'static str,
        /// The recording.
        title: String,
        /// The value.
        value: f64,
        /// When (s from its first stamp).
        time: f64,
        /// What its names were.
        given: String,
    },
    /// An episode in which nothing was read.
    #[error(
        "the recording `{title}` has no reading from which a state at {from} s could be told; move `from`, or choose another horizon"
    )]
    Start {
        /// The recording.
        title: String,
        /// Where the episode begins (s).
        from: f64,
    },
    /// A node that senses sends what the system does not describe.
    #[error(
        "node `{node}` sends `{leaf}`, of which the system says nothing, so no simulation can take the node's place; add \
         an output with `signal = \"{node}.{leaf}\"`, or describe the controller in the task file"
    )]
    Sensor {
        /// The node.
        node: String,
        /// The leaf.
        leaf: String,
    },
    /// A node reads what stands in for hardware.
    #[error(
        "node `{node}` reads `{hardware}`, which stands in for hardware, and is no output of the system; add its leaves \
         as outputs with `signal = \"{node}.LEAF\"`, or describe the controller in the task file"
    )]
    Hardware {
        /// The node.
        node: String,
        /// What it reads.
        hardware: String,
    },
    /// The machine is not driven by nodes of the graph.
    #[error(
        "{file}: the input `{input}` is driven by `{signal}`, which is no leaf of a node's messages; a graph cannot close this loop"
    )]
    NotDriven {
        /// The system's file.
        file: String,
        /// The input.
        input: String,
        /// The signal.
        signal: String,
    },
    /// The recorded graph with the machine in it is not whole.
    #[error("the recorded graph cannot run around the simulated machine: {0}")]
    Graph(Box<GraphError>),
    /// The graph could not be run.
    #[error("the recorded graph cannot run around the simulated machine: {0}")]
    Run(Box<SimError>),
    /// A node of the graph ended.
    #[error(
        "node `{node}` of the recorded graph gives up at {time} s in closed loop with the simulated machine: {why}"
    )]
    Fault {
        /// The node.
        node: String,
        /// When (s).
        time: f64,
        /// Why.
        why: String,
    },
}

impl From<SystemError> for ClosedLoopError {
    fn from(error: SystemError) -> Self {
        Self::Task(Box::new(error))
    }
}

impl From<BindError> for ClosedLoopError {
    fn from(error: BindError) -> Self {
        Self::Bind(Box::new(error))
    }
}
