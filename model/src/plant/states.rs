//! States that effects bring with them, and states that effects hold within bounds.

use super::forces::Forces;
use super::{BoundEffect, Feature, Plant, Residual, Target};
use crate::Scalar;
use crate::effect::{Effect, PlaceKind};
use crate::system::{Point, Values};

/// A state beyond the nominal ones.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ExtraState {
    /// How far what a lagging sensor shows is behind its output, in the output's unit: what the nominal states make of
    /// the output, less what is shown. As a distance it is small however little is known of the states.
    Reading {
        /// Index among the plant's effects.
        effect: usize,
        /// Index of the output.
        output: usize,
    },
    /// How fast what a lagging sensor of second order shows changes, in the output's unit per second; it follows the
    /// [`ExtraState::Reading`] of the same effect.
    ReadingRate {
        /// Index among the plant's effects.
        effect: usize,
        /// Index of the output.
        output: usize,
    },
    /// How far dry friction has built up against the motion, as a share of its whole force: Dahl's model (Dahl 1968, "A
    /// solid friction model"; Armstrong-Hélouvry, Dupont & Canudas de Wit 1994, equation 24), d ζ̇ = v − |v| ζ.
    Bristles {
        /// Index among the plant's effects.
        effect: usize,
        /// Index of the joint.
        joint: usize,
    },
    /// How far the bristles of a residual's [`Feature::Bristles`] are bent, as [`ExtraState::Bristles`] are.
    Slip {
        /// Index among the plant's residuals.
        residual: usize,
        /// Index among its features.
        feature: usize,
        /// Index of the joint.
        joint: usize,
    },
    /// How far the far side of a spring is ahead of its joint, in the joint's unit.
    Deflection {
        /// Index among the plant's effects.
        effect: usize,
        /// Index of the joint.
        joint: usize,
    },
    /// How fast that changes, per second.
    DeflectionRate {
        /// Index among the plant's effects.
        effect: usize,
        /// Index of the joint.
        joint: usize,
    },
}

/// Over how long a time the change of an output along the motion is taken, in central differences (s): exact for what is
/// linear in the states.
const INSTANT: f64 = 1e-4;

/// A deflection that is none, so that nothing is divided by nothing.
const LEAST: f64 = 1e-12;

/// The states that these effects and residuals bring.
pub(super) fn of(effects: &[BoundEffect], residuals: &[Residual]) -> Vec<ExtraState> {
    let mut states = Vec::new();
    for (effect, bound) in effects.iter().enumerate() {
        match bound.effect {
            Effect::SensorLag => states.push(ExtraState::Reading { effect, output: bound.index }),
            Effect::SensorLagSecondOrder => states.extend([
                ExtraState::Reading { effect, output: bound.index },
                ExtraState::ReadingRate { effect, output: bound.index },
            ]),
            Effect::CoulombDahl => states.push(ExtraState::Bristles { effect, joint: bound.index }),
            Effect::Flexibility | Effect::FlexibilityFar => states.extend([
                ExtraState::Deflection { effect, joint: bound.index },
                ExtraState::DeflectionRate { effect, joint: bound.index },
            ]),
            _ => {}
        }
    }
    for (k, residual) in residuals.iter().enumerate() {
        if let Target::Hysteresis(joint) = residual.target {
            let slip = |feature| ExtraState::Slip { residual: k, feature, joint };
            states.extend((0..residual.features.len()).map(slip));
        }
    }
    states
}

impl Plant {
    /// How many states there are, the extra ones included.
    #[must_use]
    pub fn states(&self) -> usize {
        self.equations.system().states.len() + self.extra_states.len()
    }

    /// The states beyond the nominal ones.
    #[must_use]
    pub fn extra_states(&self) -> &[ExtraState] {
        &self.extra_states
    }

    /// A full state from the nominal one, the states of `point`: sensors have settled, springs are at rest.
    #[must_use]
    pub fn start(&self, point: &Point<'_, f64>) -> Vec<f64> {
        let n = self.equations.system().states.len();
        let mut states = point.states[..n].to_vec();
        if self.extra_states.is_empty() {
            return states;
        }
        let values = self.equations.values(&Point { states: &point.states[..n], ..*point }, &[]);
        states.extend(self.extra_states.iter().map(|state| match *state {
            ExtraState::Reading { output, .. } => {
                let plain = Point { states: &point.states[..n], ..*point };
                self.by_states(output, &plain, plain.states) - values.outputs[output]
            }
            ExtraState::ReadingRate { output, .. } => {
                let plain = Point { states: &point.states[..n], ..*point };
                self.along(output, &plain, &values.derivatives)
            }
            ExtraState::Bristles { .. }
            | ExtraState::Slip { .. }
            | ExtraState::Deflection { .. }
            | ExtraState::DeflectionRate { .. } => 0.0,
        }));
        states
    }

    /// Names of all states.
    #[must_use]
    pub fn state_names(&self) -> Vec<String> {
        let system = self.equations.system();
        let mut names: Vec<String> = system.states.iter().map(|s| s.name.clone()).collect();
        names.extend(self.extra_states.iter().enumerate().map(|(k, state)| match *state {
            ExtraState::Reading { output, .. } => format!("{}_behind_{k}", system.outputs[output].name),
            ExtraState::ReadingRate { output, .. } => {
                format!("{}_shown_rate_{k}", system.outputs[output].name)
            }
            ExtraState::Bristles { joint, .. } | ExtraState::Slip { joint, .. } => {
                format!("{}_bristles_{k}", system.joints[joint].name)
            }
            ExtraState::Deflection { joint, .. } => format!("{}_deflection_{k}", system.joints[joint].name),
            ExtraState::DeflectionRate { joint, .. } => {
                format!("{}_deflection_rate_{k}", system.joints[joint].name)
            }
        }));
        names
    }

    /// What the nominal states alone make of an output, the commands and the time being zero.
    pub(super) fn by_states<T: Scalar>(&self, output: usize, point: &Point<'_, T>, states: &[T]) -> T {
        let inputs = vec![T::constant(0.0); point.inputs.len()];
        let still = Point { states, inputs: &inputs, time: T::constant(0.0), ..*point };
        self.equations.values(&still, &[]).outputs[output]
    }

    /// How fast what the nominal states make of an output changes along the motion.
    fn along<T: Scalar>(&self, output: usize, point: &Point<'_, T>, derivatives: &[T]) -> T {
        let beside = |seconds: f64| {
            let moved = point.states.iter().zip(derivatives).map(|(x, d)| *x + *d * seconds);
            self.by_states(output, point, &moved.collect::<Vec<T>>())
        };
        (beside(INSTANT) - beside(-INSTANT)) / (2.0 * INSTANT)
    }

    /// Keeps saturated states within their bounds: a derivative that points outside vanishes there, and what is
    /// beyond a bound returns to it within a step, so that a state's rest depends on its bound. Of what a state that
    /// overflows cannot hold, a share enters the state that it feeds.
    pub(super) fn hold_within<T: Scalar>(&self, point: &Point<'_, T>, extra: &[T], derivatives: &mut [T]) {
        let zero = T::constant(0.0);
        for bound in self.effects.iter().filter(|b| b.kind == PlaceKind::State) {
            let own = self.own(bound, extra);
            let (x, d) = (point.states[bound.index], derivatives[bound.index]);
            let step = self.step(extra);
            let overflows = bound.effect == Effect::SaturationOverflow;
            let (low, high) = if overflows { (None, own[0]) } else { (Some(own[0]), own[1]) };
            let above = d.min(zero) - (x - high) / step;
            let held = match low {
                Some(low) => T::select(x.lt(low), d.max(zero) + (low - x) / step, d),
                None => d,
            };
            let held = T::select(high.lt(x), above, held);
            derivatives[bound.index] = held;
            if let Some(fed) = bound.feeds {
                derivatives[fed] += own[1] * (d - held);
            }
        }
    }

    /// Appends the rates of the extra states to those of the nominal ones.
    pub(super) fn extra_rates<T: Scalar>(
        &self,
        point: &Point<'_, T>,
        extra: &[T],
        values: &Values<T>,
        forces: &Forces<T>,
        derivatives: &mut Vec<T>,
    ) {
        let n = derivatives.len();
        let mut lags = vec![0; values.outputs.len()];
        // What the last lag of second order does to its rate.
        let mut bent = T::constant(0.0);
        for (k, state) in self.extra_states.iter().enumerate() {
            let rate = match *state {
                ExtraState::Reading { effect, output } => {
                    // A lag shorter than a step is followed as one of a step, and shown in proportion (see `lagged`):
                    // y − τ ẏ to first order in both. The state is g − s, with ġ along the motion and τ ṡ = y − s, or
                    // τ² s̈ = y − s − 2ζ τ ṡ for a lag of second order.
                    let own = self.own(&self.effects[effect], extra);
                    let tau = own[0].max(self.step(extra));
                    let source = self.lagged(output, point, extra, values, lags[output]);
                    lags[output] += 1;
                    let nominal = Point { states: &point.states[..n], ..*point };
                    let ahead = source - self.by_states(output, point, nominal.states) + point.states[n + k];
                    let shown_rate = match own[..] {
                        [_, damping] => {
                            let rate = point.states[n + k + 1];
                            bent = (ahead - damping * tau * rate * 2.0) / (tau * tau);
                            rate
                        }
                        _ => ahead / tau,
                    };
                    self.along(output, &nominal, &derivatives[..n]) - shown_rate
                }
                ExtraState::ReadingRate { .. } => bent,
                ExtraState::Bristles { effect, joint } => {
                    let deflection = self.own(&self.effects[effect], extra)[1];
                    self.bending(joint, (deflection, point.states[n + k]), point, extra, values)
                }
                ExtraState::Slip { residual, feature, joint } => {
                    let Feature::Bristles { deflection } = self.residuals[residual].features[feature] else {
                        derivatives.push(T::constant(0.0));
                        continue;
                    };
                    let bristles = (T::constant(deflection), point.states[n + k]);
                    self.bending(joint, bristles, point, extra, values)
                }
                ExtraState::Deflection { .. } => point.states[n + k + 1],
                ExtraState::DeflectionRate { .. } => {
                    let own = forces.deflections.iter().find(|(first, _)| first + 1 == k);
                    own.map_or(T::constant(0.0), |(_, rate)| *rate)
                }
            };
            derivatives.push(rate);
        }
    }

    /// How fast bristles bend that are `bent` so far, over a way of `deflection`.
    fn bending<T: Scalar>(
        &self,
        joint: usize,
        (deflection, bent): (T, T),
        point: &Point<'_, T>,
        extra: &[T],
        values: &Values<T>,
    ) -> T {
        let n = self.equations.system().states.len();
        let nominal = Point { states: &point.states[..n], ..*point };
        let velocity = self.equations.joint(joint, &nominal, &values.lets).velocity;
        // Over a deflection that is passed within a step the force turns within a step.
        let passed = velocity.abs() * self.step(extra);
        (velocity - velocity.abs() * bent) / deflection.max(passed).max(T::constant(LEAST))
    }
}
