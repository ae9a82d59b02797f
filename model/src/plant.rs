//! A plant under a hypothesis: the nominal equations with effects added.
//!
//! Effects on a command act before the equations see it, and those on a reading after; forces enter at their joint;
//! a flexible [`Residual`] may stand for a cause that no named effect describes. At their null values all of these
//! change nothing.

mod residual;

pub use residual::{Feature, Residual, Target, Variable};

use crate::Scalar;
use crate::effect::{Effect, JointMotion, PlaceKind};
use crate::program::Program;
use crate::system::{Equations, Point};
use crate::trace::{Traced, trace_fn};

/// An effect bound to the index of its place among the system's inputs, joints, outputs or parameters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BoundEffect {
    /// The effect.
    pub effect: Effect,
    /// What the index counts.
    pub kind: PlaceKind,
    /// Index of the place.
    pub index: usize,
    /// Where its parameters begin among the plant's effect parameters.
    pub first: usize,
}

/// Equations with effects.
#[derive(Clone, Debug)]
pub struct Plant {
    equations: Equations,
    effects: Vec<BoundEffect>,
    residuals: Vec<Residual>,
    smoothing: Vec<f64>,
    extra: usize,
}

impl Plant {
    /// The equations with effects and residuals; `smoothing` is the speed, per joint, within which the direction of
    /// motion is smoothed (rad/s or m/s).
    #[must_use]
    pub fn new(
        equations: Equations,
        effects: &[(Effect, PlaceKind, usize)],
        residuals: Vec<Residual>,
        smoothing: Vec<f64>,
    ) -> Self {
        let mut first = 0;
        let effects = effects
            .iter()
            .map(|&(effect, kind, index)| {
                let bound = BoundEffect { effect, kind, index, first };
                first += effect.parameters().len();
                bound
            })
            .collect();
        let extra = first + residuals.iter().map(|r| r.features.len()).sum::<usize>();
        Plant { equations, effects, residuals, smoothing, extra }
    }

    /// The nominal equations.
    #[must_use]
    pub fn equations(&self) -> &Equations {
        &self.equations
    }

    /// The effects, in the order of their parameters.
    #[must_use]
    pub fn effects(&self) -> &[BoundEffect] {
        &self.effects
    }

    /// How many parameters effects and residuals have together.
    #[must_use]
    pub fn extra_parameters(&self) -> usize {
        self.extra
    }

    /// Parameters of one effect among the plant's.
    fn own<'a, T>(&self, bound: &BoundEffect, extra: &'a [T]) -> &'a [T] {
        &extra[bound.first..bound.first + bound.effect.parameters().len()]
    }

    /// The command that reaches the equations, from the one that was sent. Effects in time (delay, lag) are not
    /// applied here: they need the command's history.
    #[must_use]
    pub fn command<T: Scalar>(&self, input: usize, extra: &[T], command: T) -> T {
        self.effects
            .iter()
            .filter(|b| b.kind == PlaceKind::Input && b.index == input)
            .fold(command, |u, b| b.effect.input(self.own(b, extra), u))
    }

    /// Rates of change of the states, per second; `inputs` as [`Plant::command`] gave them.
    #[must_use]
    pub fn derivatives<T: Scalar>(&self, point: &Point<'_, T>, extra: &[T]) -> Vec<T> {
        let values = self.equations.values(point, &self.forces(point, extra));
        let mut derivatives = values.derivatives;
        let mut first = self.residuals_begin();
        for residual in &self.residuals {
            let weights = &extra[first..first + residual.features.len()];
            first += residual.features.len();
            if let residual::Target::State(state) = residual.target {
                derivatives[state] += residual.value(weights, point);
            }
        }
        derivatives
    }

    /// One reading, effects of sensing included.
    #[must_use]
    pub fn output<T: Scalar>(&self, output: usize, point: &Point<'_, T>, extra: &[T]) -> T {
        let mut value = self.equations.values(point, &self.forces(point, extra)).outputs[output];
        let mut first = self.residuals_begin();
        for residual in &self.residuals {
            let weights = &extra[first..first + residual.features.len()];
            first += residual.features.len();
            if residual.target == residual::Target::Output(output) {
                value += residual.value(weights, point);
            }
        }
        self.effects
            .iter()
            .filter(|b| b.kind == PlaceKind::Output && b.index == output)
            .fold(value, |y, b| b.effect.output(self.own(b, extra), y))
    }

    /// The rates of change as a program. Its inputs are, in order, the system's parameters, the plant's extra
    /// parameters, the states, the commands as they reach the equations, and the time; its outputs one per state.
    #[must_use]
    pub fn derivative_program(&self) -> Program {
        let system = self.equations.system();
        let outputs: Vec<String> = system.states.iter().map(|s| format!("d_{}", s.name)).collect();
        trace_fn(&system.name, &self.program_inputs(), &outputs, |all| {
            let (point, extra) = self.split(all);
            self.derivatives(&point, extra)
        })
    }

    /// One reading as a program, with the inputs of [`Plant::derivative_program`].
    #[must_use]
    pub fn output_program(&self, output: usize) -> Program {
        let system = self.equations.system();
        let name = &system.outputs[output].name;
        trace_fn(name, &self.program_inputs(), &[format!("y_{name}")], |all| {
            let (point, extra) = self.split(all);
            vec![self.output(output, &point, extra)]
        })
    }

    fn program_inputs(&self) -> Vec<String> {
        let system = self.equations.system();
        let mut names: Vec<String> = system.parameters.iter().map(|p| format!("p_{}", p.name)).collect();
        names.extend((0..self.extra).map(|i| format!("e_{i}")));
        names.extend(system.states.iter().map(|s| format!("x_{}", s.name)));
        names.extend(system.inputs.iter().map(|i| format!("u_{}", i.name)));
        names.push("time".into());
        names
    }

    fn split<'a>(&self, all: &'a [Traced]) -> (Point<'a, Traced>, &'a [Traced]) {
        let system = self.equations.system();
        let (parameters, rest) = all.split_at(system.parameters.len());
        let (extra, rest) = rest.split_at(self.extra);
        let (states, rest) = rest.split_at(system.states.len());
        let (inputs, time) = rest.split_at(system.inputs.len());
        (Point { parameters, states, inputs, time: time[0] }, extra)
    }

    fn residuals_begin(&self) -> usize {
        self.effects.iter().map(|b| b.effect.parameters().len()).sum()
    }

    fn forces<T: Scalar>(&self, point: &Point<'_, T>, extra: &[T]) -> Vec<(usize, T)> {
        let joints: Vec<&BoundEffect> = self.effects.iter().filter(|b| b.kind == PlaceKind::Joint).collect();
        if joints.is_empty() {
            return Vec::new();
        }
        let lets = self.equations.lets(point, &[]);
        joints
            .into_iter()
            .filter_map(|b| {
                let joint = self.equations.joint(b.index, point, &lets);
                let motion = JointMotion {
                    position: joint.position,
                    velocity: joint.velocity,
                    smoothing: self.smoothing[b.index],
                };
                b.effect.force(self.own(b, extra), &motion).map(|force| (b.index, force))
            })
            .collect()
    }
}
