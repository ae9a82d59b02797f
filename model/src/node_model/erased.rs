//! Models of which only the shape is known.

use super::blocks::{BlockKernel, BlockStep};
use super::{Directions, FlatInputs, FlatModel, NodeStep, PortShape, Scratch};
use crate::lanes::{F32x32, F64x16, Level};
use crate::program::Program;
use crate::scalar::Scalar;
use crate::trace::{Traced, trace_fn};

/// A model of which only the shape is known: what runtimes hold. Every [`FlatModel`] is one.
pub trait ErasedModel: Send + Sync {
    /// The model's name.
    fn name(&self) -> &str;
    /// The names of the parameters' leaves.
    fn params(&self) -> Vec<String>;
    /// The names of the state's leaves.
    fn state(&self) -> Vec<String>;
    /// The names of the message's leaves.
    fn output(&self) -> Vec<String>;
    /// How many standard normal numbers a step draws.
    fn noise(&self) -> usize;
    /// How many numbers the model prepares.
    fn prepared(&self) -> usize;

    /// What follows from the parameters alone, for one environment. Steps are given it.
    ///
    /// # Panics
    ///
    /// When a slice has another length than the model's list.
    fn prepare_f64(&self, params: &[f64], prepared: &mut [f64]);
    /// As [`prepare_f64`](Self::prepare_f64), for sixteen.
    ///
    /// # Panics
    ///
    /// As [`prepare_f64`](Self::prepare_f64).
    fn prepare_f64x16(&self, params: &[F64x16], prepared: &mut [F64x16]);
    /// As [`prepare_f64`](Self::prepare_f64), for thirty-two in single precision.
    ///
    /// # Panics
    ///
    /// As [`prepare_f64`](Self::prepare_f64).
    fn prepare_f32x32(&self, params: &[F32x32], prepared: &mut [F32x32]);
    /// As [`prepare_f64`](Self::prepare_f64), with derivatives.
    ///
    /// # Panics
    ///
    /// As [`prepare_f64`](Self::prepare_f64).
    fn prepare_dual(&self, params: &[Directions], prepared: &mut [Directions]);

    /// The model as a program, in the flat form of the [module](super), for these ports.
    fn program(&self, ports: &[PortShape]) -> Program;

    /// One step on numbers: replaces `state` by the next and writes the message to `output`.
    ///
    /// # Panics
    ///
    /// When a slice has another length than the model's list of leaves.
    fn step_f64(
        &self,
        params: &[f64],
        state: &mut [f64],
        step: &NodeStep<'_, f64>,
        scratch: &mut Scratch<f64>,
        output: &mut [f64],
    );

    /// One step of many environments, number by number: the bits of [`step_f64`](Self::step_f64).
    ///
    /// # Panics
    ///
    /// When a list of the step has another length than the model's list of leaves for each block.
    fn step_blocks_f64(&self, step: &mut BlockStep<'_, f64>, scratch: &mut Scratch<f64>);

    /// One step of many environments, sixteen at once, on the widest instructions of this machine.
    ///
    /// # Panics
    ///
    /// As [`step_blocks_f64`](Self::step_blocks_f64).
    fn step_blocks_f64x16(&self, step: &mut BlockStep<'_, F64x16>, scratch: &mut Scratch<F64x16>);

    /// As [`step_blocks_f64x16`](Self::step_blocks_f64x16), thirty-two in single precision.
    ///
    /// # Panics
    ///
    /// As [`step_blocks_f64`](Self::step_blocks_f64).
    fn step_blocks_f32x32(&self, step: &mut BlockStep<'_, F32x32>, scratch: &mut Scratch<F32x32>);

    /// As [`step_blocks_f64`](Self::step_blocks_f64), with exact derivatives in eight directions.
    ///
    /// # Panics
    ///
    /// As [`step_blocks_f64`](Self::step_blocks_f64).
    fn step_blocks_dual(&self, step: &mut BlockStep<'_, Directions>, scratch: &mut Scratch<Directions>);
}

impl<M: FlatModel> ErasedModel for M {
    fn name(&self) -> &str {
        FlatModel::name(self)
    }
    fn params(&self) -> Vec<String> {
        FlatModel::params(self)
    }
    fn state(&self) -> Vec<String> {
        FlatModel::state(self)
    }
    fn output(&self) -> Vec<String> {
        FlatModel::output(self)
    }
    fn noise(&self) -> usize {
        FlatModel::noise(self)
    }
    fn prepared(&self) -> usize {
        FlatModel::prepared(self)
    }
    fn prepare_f64(&self, params: &[f64], prepared: &mut [f64]) {
        FlatModel::prepare(self, params, prepared);
    }
    fn prepare_f64x16(&self, params: &[F64x16], prepared: &mut [F64x16]) {
        FlatModel::prepare(self, params, prepared);
    }
    fn prepare_f32x32(&self, params: &[F32x32], prepared: &mut [F32x32]) {
        FlatModel::prepare(self, params, prepared);
    }
    fn prepare_dual(&self, params: &[Directions], prepared: &mut [Directions]) {
        FlatModel::prepare(self, params, prepared);
    }

    fn program(&self, ports: &[PortShape]) -> Program {
        let (params, state, output) =
            (FlatModel::params(self), FlatModel::state(self), FlatModel::output(self));
        let (parameters, states, noise) = (params.len(), state.len(), FlatModel::noise(self));
        let inputs = program_inputs(&params, &state, noise, ports);
        let outputs: Vec<String> = state
            .iter()
            .map(|leaf| below("state", leaf))
            .chain(output.iter().map(|leaf| below("output", leaf)))
            .collect();
        trace_fn(FlatModel::name(self), &inputs, &outputs, |all| {
            let (params, rest) = all.split_at(parameters);
            let (state, rest) = rest.split_at(states);
            let (times, rest) = rest.split_at(3);
            let (noise, messages) = rest.split_at(noise);
            let messages = FlatInputs { ports, values: messages };
            let mut prepared = vec![Traced::constant(0.0); FlatModel::prepared(self)];
            FlatModel::prepare(self, params, &mut prepared);
            let step =
                NodeStep::new([times[0], times[1], times[2]], noise, &messages).with_prepared(&prepared);
            let mut next = state.to_vec();
            let mut message = vec![Traced::constant(0.0); output.len()];
            FlatModel::step(self, params, &mut next, &step, &mut Scratch::default(), &mut message);
            next.extend(message);
            next
        })
    }

    fn step_f64(
        &self,
        params: &[f64],
        state: &mut [f64],
        step: &NodeStep<'_, f64>,
        scratch: &mut Scratch<f64>,
        output: &mut [f64],
    ) {
        FlatModel::step(self, params, state, step, scratch, output);
    }

    fn step_blocks_f64(&self, step: &mut BlockStep<'_, f64>, scratch: &mut Scratch<f64>) {
        Level::Baseline.run(BlockKernel { model: self, step, scratch });
    }

    fn step_blocks_f64x16(&self, step: &mut BlockStep<'_, F64x16>, scratch: &mut Scratch<F64x16>) {
        Level::widest().run(BlockKernel { model: self, step, scratch });
    }

    fn step_blocks_f32x32(&self, step: &mut BlockStep<'_, F32x32>, scratch: &mut Scratch<F32x32>) {
        Level::widest().run(BlockKernel { model: self, step, scratch });
    }

    fn step_blocks_dual(&self, step: &mut BlockStep<'_, Directions>, scratch: &mut Scratch<Directions>) {
        Level::widest().run(BlockKernel { model: self, step, scratch });
    }
}

/// The names of a program's inputs, in the order of the flat form.
fn program_inputs(params: &[String], state: &[String], noise: usize, ports: &[PortShape]) -> Vec<String> {
    let mut names: Vec<String> = params.iter().map(|leaf| below("params", leaf)).collect();
    names.extend(state.iter().map(|leaf| below("state", leaf)));
    names.extend(["step.seq", "step.due", "step.start"].map(str::to_owned));
    names.extend((0..noise).map(|index| format!("noise_{index}")));
    for port in ports {
        for index in 0..port.window {
            let message = format!("inputs.{}_{index}", port.name);
            names.extend(["seq", "sent", "received"].map(|stamp| format!("{message}.{stamp}")));
            names.extend(port.leaves.iter().map(|leaf| below(&format!("{message}.message"), leaf)));
        }
    }
    names
}

/// `prefix.leaf`; a tree that is a single scalar has a leaf without a name.
fn below(prefix: &str, leaf: &str) -> String {
    if leaf.is_empty() { prefix.to_owned() } else { format!("{prefix}.{leaf}") }
}
