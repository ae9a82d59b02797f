//! A node whose steps wait until somebody in Python wants them: the supervisor of a graph that is stepped from there.

use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use parallax_runtime::data::DataSpace;
use parallax_runtime::node::{ErasedNode, InputWindow, NodeError, Step, Stopping};
use parallax_runtime::tuning::Tuning;

/// How long Python waits before it looks whether a signal has come.
pub(crate) const GLANCE: Duration = Duration::from_millis(50);

/// What the node and whoever steps it know of each other.
#[derive(Debug, Default)]
struct State {
    /// The node is before a step, which nobody has asked for yet.
    waiting: Option<View>,
    /// It is told to make that step: to send these leaves, or what its own step gives.
    wanted: Option<Option<Vec<f64>>>,
    /// What came of the step that was wanted last, until somebody takes it; the node may be before its next step then.
    made: Option<Result<Vec<f64>, NodeError>>,
    /// Nobody waits: every step is made as it comes.
    open: bool,
    /// No further step is wanted, or none can come: the run has ended.
    over: bool,
    /// The node has been told that.
    told: bool,
}

/// What a step sees, copied: the node that is stepped keeps nobody from looking at it in peace.
#[derive(Debug, Clone, Default)]
pub(crate) struct View {
    pub(crate) seq: u64,
    pub(crate) due: i64,
    pub(crate) start: i64,
    pub(crate) inputs: Vec<InputWindow>,
}

/// The two sides of the gate.
#[derive(Debug, Default)]
pub(crate) struct Gate {
    state: Mutex<State>,
    changed: Condvar,
}

impl Gate {
    /// A gate through which every step goes as it comes, until it is closed.
    pub(crate) fn opened() -> Self {
        let gate = Self::default();
        gate.state().open = true;
        gate
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether the node waits before a step: what it sees. Waits for that at most a [`GLANCE`]; the error says that none
    /// will come.
    pub(crate) fn due(&self) -> Result<Option<View>, Ended> {
        let wait = |state: &mut State| !state.over && state.waiting.is_none();
        let (state, _) = self
            .changed
            .wait_timeout_while(self.state(), GLANCE, wait)
            .unwrap_or_else(PoisonError::into_inner);
        if state.over { Err(Ended) } else { Ok(state.waiting.clone()) }
    }

    /// Lets the node make the step before which it waits.
    pub(crate) fn make(&self, output: Option<Vec<f64>>) {
        let mut state = self.state();
        if state.waiting.is_some() {
            (state.made, state.wanted) = (None, Some(output));
            self.changed.notify_all();
        }
    }

    /// What the step gave that [`make`](Self::make) asked for. Waits as [`due`](Self::due).
    pub(crate) fn made(&self) -> Result<Option<Result<Vec<f64>, NodeError>>, Ended> {
        let wait = |state: &mut State| !state.over && state.made.is_none();
        let (mut state, _) = self
            .changed
            .wait_timeout_while(self.state(), GLANCE, wait)
            .unwrap_or_else(PoisonError::into_inner);
        match state.made.take() {
            None if state.over => Err(Ended),
            made => Ok(made),
        }
    }

    /// No further step is wanted, or can come.
    pub(crate) fn close(&self) {
        self.state().over = true;
        self.changed.notify_all();
    }

    /// The node's side: waits until a step is wanted. Gives what it has to send in place of its own output.
    fn ask(&self, step: &Step<'_>) -> Result<Asked, NodeError> {
        let mut state = self.state();
        // Its last step, on the safe outputs of its senders, comes when the run is over.
        if state.open && !state.over || state.told {
            return Ok(Asked::Freely);
        }
        let (seq, due, start) = (step.seq, step.due, step.start);
        state.waiting = Some(View { seq, due, start, inputs: step.inputs().to_vec() });
        self.changed.notify_all();
        let wait = |state: &mut State| !state.over && state.wanted.is_none();
        state = self.changed.wait_while(state, wait).unwrap_or_else(PoisonError::into_inner);
        state.waiting = None;
        match state.wanted.take() {
            Some(output) => Ok(Asked::To(output)),
            None => {
                state.told = true;
                Err(NodeError::Over)
            }
        }
    }

    fn tell(&self, made: Result<Vec<f64>, NodeError>) {
        self.state().made = Some(made);
        self.changed.notify_all();
    }
}

/// No further step comes.
#[derive(Debug)]
pub(crate) struct Ended;

/// What the node's side is to do.
enum Asked {
    /// Its step, which nobody waits for.
    Freely,
    /// To send these leaves, or to make its step.
    To(Option<Vec<f64>>),
}

/// A node behind a gate. It takes locks and allocates where other nodes must not: whoever steps it is an interpreter.
pub(crate) struct Gated {
    pub(crate) node: Box<dyn ErasedNode>,
    pub(crate) gate: Arc<Gate>,
}

impl ErasedNode for Gated {
    fn step_into(&mut self, step: &Step<'_>, output: &mut [f64]) -> Result<(), NodeError> {
        self.step_with_data(step, output, &mut DataSpace::new(&mut []))
    }

    fn step_with_data(
        &mut self,
        step: &Step<'_>,
        output: &mut [f64],
        data: &mut DataSpace<'_>,
    ) -> Result<(), NodeError> {
        let made = match self.gate.ask(step)? {
            Asked::Freely => return self.node.step_with_data(step, output, data),
            Asked::To(None) => self.node.step_with_data(step, output, data),
            Asked::To(Some(given)) if given.len() == output.len() => {
                output.copy_from_slice(&given);
                Ok(())
            }
            Asked::To(Some(given)) => Err(NodeError::failed(format!(
                "the output that it is given has {} leaves in place of {}",
                given.len(),
                output.len()
            ))),
        };
        self.gate.tell(made.clone().map(|()| output.to_vec()));
        made
    }

    fn stop(&mut self, why: Stopping) {
        self.node.stop(why);
    }

    fn tuning(&mut self) -> Option<&mut dyn Tuning> {
        self.node.tuning()
    }
}
