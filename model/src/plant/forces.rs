//! What effects do to the equations of motion: forces, masses, and what moves with a joint.
//!
//! An added mass resists a joint's acceleration, which depends on all forces: F = −m a, a = a₀ + B F, where B is what a
//! unit of force does to the accelerations. Solving these few linear equations is right for coupled joints as well
//! (Featherstone, "Rigid Body Dynamics Algorithms", section 6.1: B is the inverse of the joint-space inertia).

use super::{BoundEffect, ExtraState, Plant, Residual, Target};
use crate::Scalar;
use crate::effect::{Effect, JointMotion, PlaceKind};
use crate::system::{Entry, JointValues, Point};

/// Standard gravity (m/s²), for the weight of an added mass.
const GRAVITY: f64 = 9.806_65;

/// Parameters and states that effects have moved before the equations see them.
pub(super) struct Moved<T> {
    parameters: Vec<T>,
    states: Vec<T>,
    /// States to which a speed of the air was added.
    pub(super) air: Vec<usize>,
}

impl<T: Scalar> Moved<T> {
    /// The point at which the nominal equations are evaluated.
    pub(super) fn point<'a>(&'a self, point: &Point<'a, T>, states: usize) -> Point<'a, T> {
        Point { parameters: &self.parameters, states: &self.states[..states], ..*point }
    }
}

/// Forces on joints, and what the springs inside joints do.
pub(super) struct Forces<T> {
    /// Pairs of a joint's index and a force.
    pub(super) forces: Vec<(usize, T)>,
    /// Per deflection among the extra states: its acceleration.
    pub(super) deflections: Vec<(usize, T)>,
}

/// A mass on a joint, or a spring inside it.
struct Body<T> {
    joint: usize,
    state: usize,
    mass: T,
    /// The force that a spring leaves of the drive: subtracted from the joint.
    lost: T,
}

impl Plant {
    /// Parameters with payloads and stated values, states with the air's speed.
    pub(super) fn moved<T: Scalar>(&self, point: &Point<'_, T>, extra: &[T]) -> Moved<T> {
        let mut moved =
            Moved { parameters: point.parameters.to_vec(), states: point.states.to_vec(), air: Vec::new() };
        for bound in &self.effects {
            let index = bound.index;
            match bound.effect {
                // A free one is an entry of the system's parameters itself.
                Effect::Parameter if bound.fixed.is_some() => {
                    moved.parameters[index] = self.own(bound, extra)[0];
                }
                Effect::Payload if !self.equations.system().joints[index].payload.is_empty() => {
                    let mass = self.own(bound, extra)[0];
                    moved.parameters = self.equations.loaded(index, &moved.parameters, mass);
                }
                Effect::WindSpeed => {
                    if let Some(state) = self.equations.system().joints[index].air {
                        moved.states[state] += self.own(bound, extra)[0];
                        moved.air.push(state);
                    }
                }
                _ => {}
            }
        }
        moved
    }

    /// All forces of the effects at a point of the nominal states; `states` are the extra ones.
    pub(super) fn forces<T: Scalar>(&self, point: &Point<'_, T>, states: &[T], extra: &[T]) -> Forces<T> {
        let mut out = Forces { forces: Vec::new(), deflections: Vec::new() };
        let at_joints: Vec<(usize, &BoundEffect)> =
            self.effects.iter().enumerate().filter(|(_, b)| b.kind == PlaceKind::Joint).collect();
        if at_joints.is_empty() && !self.residuals.iter().any(Residual::is_force) {
            return out;
        }
        let lets = self.equations.lets(point, &[]);
        let mut first = self.first_weight;
        for (k, residual) in self.residuals.iter().enumerate() {
            let weights = &extra[first..first + residual.features.len()];
            first += residual.features.len();
            let force = match residual.target {
                Target::Friction(joint) => {
                    let velocity = self.equations.joint(joint, point, &lets).velocity;
                    let direction = (velocity / self.smoothing[joint]).tanh();
                    (joint, -(residual.value(weights, point) * direction))
                }
                Target::Hysteresis(joint) => {
                    let bent = self.extra_states.iter().zip(states).filter(
                        |(state, _)| matches!(state, ExtraState::Slip { residual, .. } if *residual == k),
                    );
                    let force = weights.iter().zip(bent);
                    (joint, force.fold(T::constant(0.0), |sum, (weight, (_, bent))| sum - *weight * *bent))
                }
                Target::State(_) | Target::Output(_) => continue,
            };
            out.forces.push(force);
        }
        let mut masses: Vec<(usize, T)> = Vec::new();
        let mut springs: Vec<(usize, &BoundEffect, JointValues<T>)> = Vec::new();
        for (k, b) in at_joints {
            let joint = self.equations.joint(b.index, point, &lets);
            let own = self.own(b, extra);
            match b.effect {
                Effect::Inertia => masses.push((b.index, own[0])),
                Effect::Payload => {
                    if let (true, Some(lever)) =
                        (self.equations.system().joints[b.index].payload.is_empty(), joint.lever)
                    {
                        masses.push((b.index, own[0] * lever * lever));
                        let weight = self.weight(b.index, point, own[0] * lever);
                        out.forces.extend(weight.map(|force| (b.index, force)));
                    }
                }
                Effect::GravityTilt => {
                    let load = |angle| self.equations.load_at(b.index, point, angle);
                    if let (Some(tilted), Some(upright)) = (load(own[0]), load(T::constant(0.0))) {
                        out.forces.push((b.index, tilted - upright));
                    }
                }
                Effect::CoulombDahl => {
                    let bristles =
                        |s: &ExtraState| matches!(s, ExtraState::Bristles { effect, .. } if *effect == k);
                    if let Some(built_up) = self.extra_states.iter().position(bristles) {
                        out.forces.push((b.index, -(own[0] * states[built_up])));
                    }
                }
                Effect::Flexibility | Effect::FlexibilityFar => springs.push((k, b, joint)),
                _ => {
                    let motion = JointMotion {
                        position: joint.position,
                        velocity: joint.velocity,
                        drive: joint.drive,
                        load: joint.load,
                        time: point.time,
                        smoothing: self.smoothing[b.index],
                    };
                    out.forces.extend(b.effect.force(&own, &motion).map(|force| (b.index, force)));
                }
            }
        }
        if !masses.is_empty() || !springs.is_empty() {
            self.add_bodies(point, states, extra, &masses, &springs, &mut out);
        }
        out
    }

    /// The weight of a mass times lever: along the joint's load, of which only the direction counts. A load that turns
    /// with the joint as gravity's does is A sin(q + φ), whose amplitude shows a quarter turn apart.
    fn weight<T: Scalar>(&self, joint: usize, point: &Point<'_, T>, moment: T) -> Option<T> {
        let here = self.equations.load_at(joint, point, T::constant(0.0))?;
        let quarter = self.equations.load_at(joint, point, T::constant(std::f64::consts::FRAC_PI_2))?;
        Some(moment * GRAVITY * here / (here * here + quarter * quarter + 1e-30).sqrt())
    }

    fn add_bodies<T: Scalar>(
        &self,
        point: &Point<'_, T>,
        states: &[T],
        extra: &[T],
        masses: &[(usize, T)],
        springs: &[(usize, &BoundEffect, JointValues<T>)],
        out: &mut Forces<T>,
    ) {
        let system = self.equations.system();
        let mut bodies: Vec<Body<T>> = Vec::new();
        let zero = T::constant(0.0);
        for &(joint, mass) in masses {
            // Without a velocity that is a state there is no acceleration to resist.
            let Some(state) = system.joints[joint].velocity_state else { continue };
            match bodies.iter_mut().find(|b| b.joint == joint) {
                Some(body) => body.mass += mass,
                None => bodies.push(Body { joint, state, mass, lost: zero }),
            }
        }
        for (_, b, _) in springs {
            let Some(state) = system.joints[b.index].velocity_state else { continue };
            if !bodies.iter().any(|body| body.joint == b.index) {
                bodies.push(Body { joint: b.index, state, mass: zero, lost: zero });
            }
        }
        let unit = self.response(point, &bodies, &out.forces);
        let mut pulls: Vec<(usize, usize, T)> = Vec::new();
        for (effect, b, joint) in springs {
            let Some(at) = bodies.iter().position(|body| body.joint == b.index) else { continue };
            let Some(first) = self.deflection(*effect) else { continue };
            let own = self.own(b, extra);
            let (stiffness, damping, ratio) = (own[0], own[1], own[2]);
            // The far side must move no faster than a step can follow; see `Plant::with_step`.
            let mobility = unit[at][at];
            let step = self.step(extra);
            let slowest = mobility * (stiffness * (step * step * 0.25) + damping * (step * 0.5)) + 1e-9;
            let followed = ratio.max(slowest);
            let source = match (b.effect, joint.drive) {
                (Effect::Flexibility, Some(drive)) => drive,
                _ => zero,
            };
            let pull = source - stiffness * states[first] - damping * states[first + 1];
            bodies[at].mass -= ratio / mobility;
            bodies[at].lost += ratio / followed * pull;
            pulls.push((first, at, pull * mobility / followed));
        }
        let accelerations = self.accelerations(point, &bodies, &unit, &out.forces);
        for (body, a) in bodies.iter().zip(&accelerations) {
            out.forces.push((body.joint, -(body.mass * *a) - body.lost));
        }
        out.deflections =
            pulls.into_iter().map(|(first, at, own)| (first, own - accelerations[at])).collect();
    }

    /// What a unit of force at each body does to the acceleration of each.
    fn response<T: Scalar>(
        &self,
        point: &Point<'_, T>,
        bodies: &[Body<T>],
        forces: &[(usize, T)],
    ) -> Vec<Vec<T>> {
        let system = self.equations.system();
        let plain = |joint: usize| matches!(system.joints[joint].entry(), Ok(Entry::Derivative(_)));
        let mut unit = vec![vec![T::constant(0.0); bodies.len()]; bodies.len()];
        let at_rest = if bodies.iter().all(|b| plain(b.joint)) {
            Vec::new()
        } else {
            self.equations.values(point, forces).derivatives
        };
        for (j, body) in bodies.iter().enumerate() {
            if plain(body.joint) {
                let lets = self.equations.lets(point, forces);
                if let Some(inertia) = self.equations.joint(body.joint, point, &lets).inertia {
                    unit[j][j] = T::constant(1.0) / inertia;
                }
                continue;
            }
            let mut pushed = forces.to_vec();
            pushed.push((body.joint, T::constant(1.0)));
            let moved = self.equations.values(point, &pushed).derivatives;
            for (i, other) in bodies.iter().enumerate() {
                unit[i][j] = moved[other.state] - at_rest[other.state];
            }
        }
        unit
    }

    /// (I + B M) a = a₀ − B P: the accelerations of the bodies.
    fn accelerations<T: Scalar>(
        &self,
        point: &Point<'_, T>,
        bodies: &[Body<T>],
        unit: &[Vec<T>],
        forces: &[(usize, T)],
    ) -> Vec<T> {
        let free = self.equations.values(point, forces).derivatives;
        let k = bodies.len();
        let mut matrix = vec![vec![T::constant(0.0); k]; k];
        let mut right: Vec<T> = bodies.iter().map(|b| free[b.state]).collect();
        for i in 0..k {
            for j in 0..k {
                matrix[i][j] = unit[i][j] * bodies[j].mass;
                right[i] -= unit[i][j] * bodies[j].lost;
            }
            matrix[i][i] += T::constant(1.0);
        }
        // Gauss's elimination without pivots: the matrix is near the identity, and a pivot would be a branch.
        for i in 0..k {
            let (done, below) = matrix.split_at_mut(i + 1);
            let pivot = &done[i];
            for (row, line) in below.iter_mut().enumerate() {
                let factor = line[i] / pivot[i];
                for (entry, above) in line.iter_mut().zip(pivot).skip(i) {
                    *entry -= factor * *above;
                }
                let above = right[i];
                right[i + 1 + row] -= factor * above;
            }
        }
        for i in (0..k).rev() {
            for column in i + 1..k {
                let known = right[column];
                right[i] -= matrix[i][column] * known;
            }
            right[i] /= matrix[i][i];
        }
        right
    }

    /// Index among the extra states of the deflection of an effect.
    fn deflection(&self, of: usize) -> Option<usize> {
        self.extra_states
            .iter()
            .position(|state| matches!(state, ExtraState::Deflection { effect, .. } if *effect == of))
    }
}
