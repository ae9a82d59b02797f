//! Runs of a graph from Python: in real time, as processes, or under the simulated clock, in this one.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use parallax_nodes::registry;
use parallax_runtime::data::Data;
use parallax_runtime::graph::GraphSpec;
use parallax_runtime::launch::{self, LaunchSpec, RunAs, RunError, RunOptions};
use parallax_runtime::recording::{
    Change, Description, Fault, FaultKind, Loss, RecordingSink, RecordingWriter, SinkError, StepView,
};
use parallax_runtime::registry::{Registry, Wrap};
use parallax_runtime::time::{Nanos, from_seconds, to_seconds};
use parallax_sim::{Executor, SimError};
use pyo3::prelude::*;
use serde_json::json;

use crate::error::raise;
use crate::gate::{GLANCE, Gate, Gated};
use crate::graph::NativeGraph;
use crate::worker::{PYTHON, python_kind, window};

/// What becomes of a run: its report as JSON, or why it could not be made.
type Reported = Result<String, String>;

/// A run that goes on in a thread of its own.
#[pyclass(frozen, name = "Run", module = "parallax._native")]
pub(crate) struct NativeRun {
    gate: Arc<Gate>,
    stop: Arc<AtomicBool>,
    thread: Mutex<Option<JoinHandle<Reported>>>,
}

#[pymethods]
impl NativeGraph {
    /// Begins a run in real time. The nodes of `programs` are processes of these commands, the others of `node_command`, with
    /// `private` variables; the supervisor is a thread of this process, which `build` makes if it is written in Python, and
    /// waits before each step. `launch` is the text of a `launch.toml`.
    #[allow(clippy::too_many_arguments, reason = "called from one place in Python, by keyword")]
    #[pyo3(signature = (*, path, seed, build, programs, node_command, private, launch, patience))]
    fn launch(
        &self,
        path: PathBuf,
        seed: u64,
        build: Py<PyAny>,
        programs: BTreeMap<String, Vec<String>>,
        node_command: Vec<String>,
        private: BTreeMap<String, BTreeMap<String, String>>,
        launch: &str,
        patience: f64,
    ) -> PyResult<NativeRun> {
        let spec = self.graph.spec().clone();
        let gate = Arc::new(Gate::default());
        let registry = gated(&spec, build, &gate)?;
        let mut launch = LaunchSpec::from_toml("the launch settings", launch).map_err(raise)?;
        let own = launch.nodes.entry(spec.supervisor.clone()).or_default();
        // It gives no sign of life while nobody wants a step of it.
        (own.run_as, own.heartbeat) = (Some(RunAs::Thread), Some(f64::INFINITY));
        let patience = Duration::try_from_secs_f64(patience).map_err(raise)?;
        NativeRun::begin(gate, move |stop| {
            let options = RunOptions {
                seed,
                recording: Some(path),
                launch,
                private,
                programs,
                node_command,
                patience,
                signals: false,
                progress: Some(Box::new(move |_| !stop.load(Ordering::Relaxed))),
                ..RunOptions::default()
            };
            let report = match launch::run(&spec, &registry, options) {
                // Who stops a run has not failed: there is nothing of it yet.
                Err(error @ RunError::Interrupted) => {
                    return Ok(json!({ "graph": spec.name, "failure": error.to_string() }).to_string());
                }
                report => report.map_err(|error| error.to_string())?,
            };
            let failure = report.failure();
            let mut told = serde_json::to_value(&report).map_err(|error| error.to_string())?;
            told["failure"] = json!(failure);
            Ok(told.to_string())
        })
    }

    /// Begins a run under the simulated clock, for `duration` seconds or until it is stopped, `factor` simulated seconds a
    /// second. With `stepped`, the supervisor waits before each step. `build` makes the nodes that are written in Python.
    #[allow(clippy::too_many_arguments, reason = "called from one place in Python, by keyword")]
    #[pyo3(signature = (*, path, seed, build, duration, factor, stepped))]
    fn begin(
        &self,
        path: PathBuf,
        seed: u64,
        build: Py<PyAny>,
        duration: Option<f64>,
        factor: Option<f64>,
        stepped: bool,
    ) -> PyResult<NativeRun> {
        let spec = self.graph.spec().clone();
        let gate = Arc::new(if stepped { Gate::default() } else { Gate::opened() });
        let graph = spec.validate(&gated(&spec, build, &gate)?).map_err(raise)?;
        let mut executor = Executor::new(graph, seed);
        if let Some(factor) = factor {
            executor = executor.real_time_factor(factor);
        }
        let duration = duration.map(from_seconds);
        NativeRun::begin(gate, move |_| {
            let description = Description::new(executor.graph(), executor.clock());
            let writer = RecordingWriter::create(&path, &description).map_err(|error| error.to_string())?;
            let supervisor = executor.graph().spec().supervisor.clone();
            let supervisor = duration.is_none().then_some(supervisor);
            let mut sink = Stepped { writer, supervisor, gone: false, last: 0, failure: None };
            let over = match executor.run(duration.unwrap_or(Nanos::MAX / 2), &mut sink) {
                Ok(outcome) => outcome.over,
                Err(SimError::Sink(_)) if sink.gone => None,
                Err(error) => return Err(error.to_string()),
            };
            let lasted = over.or(duration).unwrap_or(sink.last);
            let Stepped { writer, failure, .. } = sink;
            writer.finish(lasted).map_err(|error| error.to_string())?;
            Ok(json!({
                "graph": executor.graph().spec().name, "duration_s": to_seconds(lasted), "failure": failure,
            })
            .to_string())
        })
    }
}

/// Writes what happens, and ends a run without a duration when its supervisor has ended: nobody steps it any more.
struct Stepped {
    writer: RecordingWriter,
    /// Whose end ends the run.
    supervisor: Option<String>,
    gone: bool,
    /// When something happened last.
    last: Nanos,
    failure: Option<String>,
}

/// Why such a run ended.
#[derive(Debug, thiserror::Error)]
#[error("the supervisor has ended")]
struct SupervisorGone;

impl RecordingSink for Stepped {
    fn message(
        &mut self,
        node: usize,
        seq: u64,
        sent: Nanos,
        payload: &[f64],
        data: &Data,
    ) -> Result<(), SinkError> {
        self.last = sent;
        RecordingSink::message(&mut self.writer, node, seq, sent, payload, data)
    }

    fn step(&mut self, node: usize, step: &StepView<'_>) -> Result<(), SinkError> {
        if self.gone {
            return Err(SinkError(Box::new(SupervisorGone)));
        }
        RecordingSink::step(&mut self.writer, node, step)
    }

    fn loss(&mut self, loss: &Loss) -> Result<(), SinkError> {
        RecordingSink::loss(&mut self.writer, loss)
    }

    fn fault(&mut self, fault: &Fault) -> Result<(), SinkError> {
        self.last = fault.time;
        self.gone |= self.supervisor.as_ref() == Some(&fault.node);
        let how = match &fault.kind {
            FaultKind::Failed { message } | FaultKind::Died { message } => message.clone(),
            FaultKind::DeadSender { sender } => format!("it waited for {sender}, which is dead"),
            other => format!("{other:?}"),
        };
        self.failure.get_or_insert_with(|| format!("node {} failed: {how}", fault.node));
        RecordingSink::fault(&mut self.writer, fault)
    }

    fn change(&mut self, change: &Change) -> Result<(), SinkError> {
        RecordingSink::change(&mut self.writer, change)
    }
}

/// The kinds that a run here may build, with the supervisor of the graph behind the gate.
fn gated(spec: &GraphSpec, build: Py<PyAny>, gate: &Arc<Gate>) -> PyResult<Registry> {
    let registry = registry().with(PYTHON, python_kind(build));
    let Some(supervisor) = spec.node(&spec.supervisor) else { return Ok(registry) };
    let Some(kind) = registry.get(&supervisor.kind).cloned() else {
        return Err(raise(format!(
            "node `{}` is of the kind `{}`, which is in no run: a run takes the kinds that come with Parallax and `python`",
            supervisor.name, supervisor.kind
        )));
    };
    let (name, gate) = (supervisor.name.clone(), gate.clone());
    let wrap: Arc<Wrap> =
        Arc::new(
            move |context, node| {
                if context.name == name { Box::new(Gated { node, gate: gate.clone() }) } else { node }
            },
        );
    let kind = kind.around(wrap);
    Ok(registry.with(supervisor.kind.clone(), kind))
}

impl NativeRun {
    fn begin(
        gate: Arc<Gate>,
        run: impl FnOnce(Arc<AtomicBool>) -> Reported + Send + 'static,
    ) -> PyResult<Self> {
        let stop = Arc::new(AtomicBool::new(false));
        let (closing, flag) = (Close(gate.clone()), stop.clone());
        let body = move || {
            // However it ends, nobody waits for a further step.
            let _closing = closing;
            run(flag)
        };
        let thread = std::thread::Builder::new().name("parallax".into()).spawn(body).map_err(raise)?;
        Ok(Self { gate, stop, thread: Mutex::new(Some(thread)) })
    }
}

/// Closes a gate when it goes out of scope.
struct Close(Arc<Gate>);

impl Drop for Close {
    fn drop(&mut self) {
        self.0.close();
    }
}

#[pymethods]
impl NativeRun {
    /// Waits until the supervisor is about to step: `(seq, due, start, inputs)`, times in ns, the inputs as a node in Python
    /// is shown them. `None` when the run has ended.
    fn due<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyAny>>> {
        loop {
            let due = py.detach(|| self.gate.due());
            // Before anything is made for Python: the garbage collector, which that may start, drops what is raised in its callbacks.
            py.check_signals()?;
            match due {
                Err(_) => return Ok(None),
                Ok(None) => {}
                Ok(Some(view)) => {
                    let inputs =
                        view.inputs.iter().map(|input| window(py, input)).collect::<PyResult<Vec<_>>>()?;
                    let seen = (view.seq, view.due, view.start, inputs);
                    return Ok(Some(seen.into_pyobject(py)?.into_any()));
                }
            }
        }
    }

    /// Lets the supervisor make the step that is due, and send these leaves in place of its own. Gives what it sends; `None`
    /// when the run has ended.
    #[pyo3(signature = (output=None))]
    fn make(&self, py: Python<'_>, output: Option<Vec<f64>>) -> PyResult<Option<Vec<f64>>> {
        self.gate.make(output);
        loop {
            let made = py.detach(|| self.gate.made());
            py.check_signals()?;
            match made {
                Err(_) => return Ok(None),
                Ok(None) => {}
                Ok(Some(made)) => return made.map(Some).map_err(raise),
            }
        }
    }

    /// Asks the run to end.
    fn stop(&self) {
        self.stop.store(true, Ordering::Relaxed);
        self.gate.close();
    }

    /// Waits for the end of the run; gives its report as JSON, or `None` if that was given before.
    fn finish(&self, py: Python<'_>) -> PyResult<Option<String>> {
        loop {
            {
                let mut thread = self.thread.lock().unwrap_or_else(PoisonError::into_inner);
                if thread.as_ref().is_none_or(JoinHandle::is_finished) {
                    let Some(thread) = thread.take() else { return Ok(None) };
                    let reported =
                        thread.join().map_err(|_| raise("the run panicked; please report this"))?;
                    return reported.map(Some).map_err(raise);
                }
            }
            py.check_signals()?;
            py.detach(|| std::thread::sleep(GLANCE / 10));
        }
    }
}
