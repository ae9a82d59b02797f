//! A plant under a hypothesis: the nominal equations with effects added.
//!
//! Effects on a command act before the equations see it, and those on a reading after; forces enter at their joint;
//! effects with a state of their own (a sensor's lag, a spring inside a joint) add states behind the nominal ones; a
//! flexible [`Residual`] may stand for a cause that no named effect describes. At their null values all of these
//! change nothing. The `[[effect]]` entries of the system itself act in every plant, with their stated values.

mod alone;
mod forces;
mod residual;
mod states;
mod tick;

pub use alone::Unfit;
pub use residual::{Feature, Residual, Target, Variable};
pub use states::ExtraState;

use crate::Scalar;
use crate::effect::{Effect, PlaceKind};
use crate::program::Program;
use crate::system::{Equations, Point, Values};
use crate::trace::{Traced, trace_fn};

/// An effect bound to the index of its place among the system's inputs, joints, outputs or parameters.
#[derive(Clone, Debug, PartialEq)]
pub struct BoundEffect {
    /// The effect.
    pub effect: Effect,
    /// What the index counts.
    pub kind: PlaceKind,
    /// Index of the place.
    pub index: usize,
    /// Where its parameters begin among the plant's effect parameters; meaningless where `fixed` holds them.
    pub first: usize,
    /// The values of an effect that is part of the system itself.
    pub fixed: Option<Vec<f64>>,
    /// The state that takes what overflows, for an effect that lets something overflow.
    pub feeds: Option<usize>,
}

/// Equations with effects.
#[derive(Clone, Debug)]
pub struct Plant {
    equations: Equations,
    effects: Vec<BoundEffect>,
    residuals: Vec<Residual>,
    smoothing: Vec<f64>,
    step: Longest,
    first_weight: usize,
    extra: usize,
    extra_states: Vec<ExtraState>,
}

/// The shortest time that effects with states of their own follow, unless [`Plant::with_step`] says otherwise (s).
const SHORTEST: f64 = 1e-3;

/// The longest step of the integrator.
#[derive(Clone, Copy, Debug)]
enum Longest {
    /// Seconds.
    Fixed(f64),
    /// The extra parameter of this index.
    Extra(usize),
}

impl Plant {
    /// The equations with effects and residuals; `smoothing` is the speed, per joint, within which the direction of
    /// motion is smoothed (rad/s or m/s). The system's own effects are added behind the given ones.
    #[must_use]
    pub fn new(
        equations: Equations,
        effects: &[(Effect, PlaceKind, usize)],
        residuals: Vec<Residual>,
        smoothing: Vec<f64>,
    ) -> Self {
        let mut first = 0;
        let feeds = |effect: Effect, index: usize| {
            (effect == Effect::SaturationOverflow).then(|| equations.system().fed_by(index).ok()).flatten()
        };
        let mut bound: Vec<BoundEffect> = effects
            .iter()
            .map(|&(effect, kind, index)| {
                let feeds = feeds(effect, index);
                let bound = BoundEffect { effect, kind, index, first, fixed: None, feeds };
                first += effect.parameters().len();
                bound
            })
            .collect();
        bound.extend(equations.effects().iter().map(|own| BoundEffect {
            effect: own.effect,
            kind: own.kind,
            index: own.index,
            first: 0,
            fixed: Some(own.values.clone()),
            feeds: feeds(own.effect, own.index),
        }));
        let extra = first + residuals.iter().map(|r| r.features.len()).sum::<usize>();
        let extra_states = states::of(&bound, &residuals);
        Plant {
            equations,
            effects: bound,
            residuals,
            smoothing,
            step: Longest::Fixed(SHORTEST),
            first_weight: first,
            extra,
            extra_states,
        }
    }

    /// The same plant for an integrator whose steps are at most `step` seconds long. What is faster than a step is
    /// followed as far as a step can: no equation becomes stiff, and slow motions are right.
    #[must_use]
    pub fn with_step(mut self, step: f64) -> Self {
        self.step = Longest::Fixed(step);
        self
    }

    /// The longest step (s), one of the extra parameters where it is not known yet.
    fn step<T: Scalar>(&self, extra: &[T]) -> T {
        match self.step {
            Longest::Fixed(step) => T::constant(step),
            Longest::Extra(index) => extra[index],
        }
    }

    /// The nominal equations.
    #[must_use]
    pub fn equations(&self) -> &Equations {
        &self.equations
    }

    /// The effects, in the order of their parameters; the system's own ones follow.
    #[must_use]
    pub fn effects(&self) -> &[BoundEffect] {
        &self.effects
    }

    /// The effects at one place, in the order in which they act.
    #[must_use]
    pub fn effects_at(&self, kind: PlaceKind, index: usize) -> Vec<&BoundEffect> {
        let here = |b: &&BoundEffect| b.kind == kind && b.index == index;
        let mut found: Vec<&BoundEffect> = self.effects.iter().filter(here).collect();
        found.sort_by_key(|b| b.effect.stage());
        found
    }

    /// How many parameters effects and residuals have together.
    #[must_use]
    pub fn extra_parameters(&self) -> usize {
        self.extra
    }

    /// The extra parameters at which nothing is added: null values, and weights of zero.
    #[must_use]
    pub fn extra_values(&self) -> Vec<f64> {
        let free = self.effects.iter().filter(|b| b.fixed.is_none());
        let null = |null: f64| if null.is_nan() { 0.0 } else { null };
        let mut values: Vec<f64> =
            free.flat_map(|b| b.effect.parameters().iter().map(|p| null(p.null))).collect();
        values.resize(self.extra, 0.0);
        values
    }

    /// Index of the first weight of a residual among the extra parameters.
    #[must_use]
    pub fn first_weight(&self) -> usize {
        self.first_weight
    }

    /// Parameters of one effect, from the plant's extra ones.
    #[must_use]
    pub fn own<T: Scalar>(&self, bound: &BoundEffect, extra: &[T]) -> Vec<T> {
        match &bound.fixed {
            Some(values) => values.iter().map(|v| T::constant(*v)).collect(),
            None => extra[bound.first..bound.first + bound.effect.parameters().len()].to_vec(),
        }
    }

    /// Rates of change of the states, per second, the extra ones last; `point` holds the commands as they reach the
    /// equations, and all states.
    #[must_use]
    pub fn derivatives<T: Scalar>(&self, point: &Point<'_, T>, extra: &[T]) -> Vec<T> {
        let n = self.equations.system().states.len();
        let moved = self.moved(point, extra);
        let nominal = moved.point(point, n);
        let forces = self.forces(&nominal, &point.states[n..], extra);
        let values = self.equations.values(&nominal, &forces.forces);
        let mut derivatives = values.derivatives.clone();
        if !moved.air.is_empty() {
            // The air's speed relaxes as the equations say; what is added to it stays.
            let still = Point { states: &point.states[..n], ..nominal };
            let calm = self.equations.values(&still, &forces.forces).derivatives;
            for &state in &moved.air {
                derivatives[state] = calm[state];
            }
        }
        let mut first = self.first_weight;
        for residual in &self.residuals {
            let weights = &extra[first..first + residual.features.len()];
            first += residual.features.len();
            if let residual::Target::State(state) = residual.target {
                derivatives[state] += residual.value(weights, point);
            }
        }
        self.hold_within(point, extra, &mut derivatives);
        self.extra_rates(point, extra, &values, &forces, &mut derivatives);
        derivatives
    }

    /// One reading, effects of sensing included.
    #[must_use]
    pub fn output<T: Scalar>(&self, output: usize, point: &Point<'_, T>, extra: &[T]) -> T {
        self.output_with(output, point, extra, |_| true)
    }

    /// One reading with those of the effects of sensing that are `kept`.
    fn output_with<T: Scalar>(
        &self,
        output: usize,
        point: &Point<'_, T>,
        extra: &[T],
        kept: impl Fn(Effect) -> bool,
    ) -> T {
        let n = self.equations.system().states.len();
        let moved = self.moved(point, extra);
        let nominal = moved.point(point, n);
        let forces = self.forces(&nominal, &point.states[n..], extra);
        let values = self.equations.values(&nominal, &forces.forces);
        let mut value = self.lagged(output, point, extra, &values, usize::MAX);
        let mut first = self.first_weight;
        for residual in &self.residuals {
            let weights = &extra[first..first + residual.features.len()];
            first += residual.features.len();
            if residual.target == residual::Target::Output(output) {
                value += residual.value(weights, point);
            }
        }
        self.effects_at(PlaceKind::Output, output)
            .into_iter()
            .filter(|b| kept(b.effect))
            .fold(value, |y, b| b.effect.output(&self.own(b, extra), y, point.time))
    }

    /// The rates of change as a program. Its inputs are, in order, the system's parameters, the plant's extra
    /// parameters, the states (extra ones last), the commands as they reach the equations, and the time; its outputs
    /// one per state.
    #[must_use]
    pub fn derivative_program(&self) -> Program {
        let outputs: Vec<String> = self.state_names().iter().map(|s| format!("d_{s}")).collect();
        trace_fn(&self.equations.system().name, &self.program_inputs(), &outputs, |all| {
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

    /// The same reading if its sensor had no limits; nothing where it has none.
    #[must_use]
    pub fn unclipped_program(&self, output: usize) -> Option<Program> {
        let limits = |effect| effect == Effect::SensorSaturation;
        if !self.effects_at(PlaceKind::Output, output).into_iter().any(|b| limits(b.effect)) {
            return None;
        }
        let name = format!("y_{}", self.equations.system().outputs[output].name);
        Some(trace_fn(&name, &self.program_inputs(), std::slice::from_ref(&name), |all| {
            let (point, extra) = self.split(all);
            vec![self.output_with(output, &point, extra, |effect| !limits(effect))]
        }))
    }

    fn program_inputs(&self) -> Vec<String> {
        let system = self.equations.system();
        let mut names: Vec<String> = system.parameters.iter().map(|p| format!("p_{}", p.name)).collect();
        names.extend((0..self.extra).map(|i| format!("e_{i}")));
        names.extend(self.state_names().iter().map(|s| format!("x_{s}")));
        names.extend(system.inputs.iter().map(|i| format!("u_{}", i.name)));
        names.push("time".into());
        names
    }

    fn split<'a>(&self, all: &'a [Traced]) -> (Point<'a, Traced>, &'a [Traced]) {
        let system = self.equations.system();
        let (parameters, rest) = all.split_at(system.parameters.len());
        let (extra, rest) = rest.split_at(self.extra);
        let (states, rest) = rest.split_at(self.states());
        let (inputs, time) = rest.split_at(system.inputs.len());
        (Point { parameters, states, inputs, time: time[0] }, extra)
    }

    /// The reading of an output after the first `lags` sensor lags of its place.
    fn lagged<T: Scalar>(
        &self,
        output: usize,
        point: &Point<'_, T>,
        extra: &[T],
        values: &Values<T>,
        lags: usize,
    ) -> T {
        let n = self.equations.system().states.len();
        let mut value = values.outputs[output];
        let own = self.extra_states.iter().enumerate().filter_map(|(k, state)| match *state {
            ExtraState::Reading { effect, output: of } if of == output => Some((k, effect)),
            _ => None,
        });
        for (k, effect) in own.take(lags) {
            let tau = self.own(&self.effects[effect], extra)[0];
            let followed = tau.max(self.step(extra));
            let shown = self.by_states(output, point, &point.states[..n]) - point.states[n + k];
            value -= (tau / followed) * (value - shown);
        }
        value
    }
}
