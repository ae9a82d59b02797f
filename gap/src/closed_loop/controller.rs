//! A controller that is described by equations, stepped.

use parallax_model::plant::Plant;
use parallax_model::program::{Program, Workspace};
use parallax_model::system::{BoundTask, Initial, State};

use super::ClosedLoopError;

/// A controller with its states. Between two steps its inputs are held, as those of a node are.
#[derive(Clone, Debug)]
pub(super) struct Controller {
    /// See [`Plant::tick_program`].
    program: Program,
    parameters: Vec<f64>,
    states: Vec<f64>,
    /// What it keeps from one step to the next.
    memory: Vec<f64>,
    /// How many commands it gives.
    commands: usize,
    /// When it stepped last (s), and its inputs then.
    last: Option<(f64, Vec<f64>)>,
    workspace: Workspace<f64>,
}

impl Controller {
    /// A controller before its first step; `first` gives the first value of a signal, where a state starts at one.
    pub(super) fn new(
        task: &BoundTask,
        first: impl Fn(&str) -> Option<f64>,
    ) -> Result<Self, ClosedLoopError> {
        let system = task.controller.system();
        let start = |state: &State| {
            let value = match &state.initial {
                Initial::Fixed(value) | Initial::Calibrated { value, .. } => Some(*value),
                Initial::Signal(signal) => first(signal),
                Initial::Free => None,
            };
            value.ok_or_else(|| ClosedLoopError::State {
                file: system.file.clone(),
                line: state.line,
                state: state.name.clone(),
            })
        };
        Ok(Self {
            program: Plant::alone(task.controller.clone())?.tick_program(),
            parameters: task.controller.nominal(),
            states: system.states.iter().map(start).collect::<Result<_, _>>()?,
            memory: task.memory.iter().map(start).collect::<Result<_, _>>()?,
            commands: system.outputs.len() - task.memory.len(),
            last: None,
            workspace: Workspace::new(),
        })
    }

    /// The commands at `time` (s), in the order of the controller's outputs, from the signals that it reads then.
    pub(super) fn step(&mut self, time: f64, signals: &[f64]) -> Vec<f64> {
        if let Some((last, before)) = self.last.take() {
            let (next, _) = self.tick(last, time - last, &before);
            self.states = next;
        }
        let inputs: Vec<f64> = signals.iter().chain(&self.memory).copied().collect();
        let (_, mut commands) = self.tick(time, 0.0, &inputs);
        self.memory = commands.split_off(self.commands);
        self.last = Some((time, inputs));
        commands
    }

    /// The states `period` seconds later, and the outputs now.
    fn tick(&mut self, time: f64, period: f64, inputs: &[f64]) -> (Vec<f64>, Vec<f64>) {
        let mut given = self.parameters.clone();
        given.extend(&self.states);
        given.extend(inputs);
        given.extend([time, period, 0.0]);
        let mut results = vec![0.0; self.program.outputs().len()];
        self.program.evaluate(&given, &mut self.workspace, &mut results);
        let outputs = results.split_off(self.states.len());
        (results, outputs)
    }
}
