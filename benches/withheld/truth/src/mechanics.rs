//! One small step of a machine: kick and drift, with dry friction as an impulse that may stop a joint but not push it.

use crate::effect::{Cause, Kind, Place};
use crate::system::{Forces, N, Payload, State, System};
use std::f64::consts::PI;

/// Length of a step, s.
pub(crate) const H: f64 = 1e-4;

/// A machine with its real parameters and what is wrong with it.
pub(crate) struct Machine<'a> {
    pub(crate) system: &'a System,
    pub(crate) parameters: Vec<f64>,
    pub(crate) causes: Vec<Cause>,
}

/// States of causes: a rotor's position and speed relative to its link, or a bristle's deflection.
pub(crate) type Hidden = Vec<[f64; 2]>;

impl<'a> Machine<'a> {
    pub(crate) fn new(system: &'a System, parameters: &[f64], causes: &[Cause]) -> Self {
        let mut parameters = parameters.to_vec();
        for cause in causes {
            if let Place::Parameter(k) = cause.place {
                parameters[k] = cause.p[0];
            }
        }
        for cause in causes {
            if let (Kind::Payload, Place::Joint(j)) = (cause.kind, cause.place)
                && let Payload::Parameter(k) = system.joints[j].payload
            {
                parameters[k] += cause.p[0];
            }
        }
        let causes = causes.iter().filter(|c| matches!(c.place, Place::Joint(_))).copied().collect();
        Self { system, parameters, causes }
    }

    pub(crate) fn hidden(&self) -> Hidden {
        vec![[0.0; 2]; self.causes.len()]
    }

    /// Moves the state from `t` to `t + H` under constant commands.
    pub(crate) fn step(&self, s: &mut State, hidden: &mut Hidden, u: &[f64; N], t: f64) {
        self.pushed(s, hidden, u, &[0.0; N], t);
    }

    /// The same with a force more on each joint.
    pub(crate) fn pushed(&self, s: &mut State, hidden: &mut Hidden, u: &[f64; N], push: &[f64; N], t: f64) {
        let n = self.system.joints.len();
        for i in 0..n {
            s.q[i] += 0.5 * H * s.v[i];
        }
        let mut tilt = [0.0; N];
        for c in &self.causes {
            if let (Kind::Tilt, Place::Joint(j)) = (c.kind, c.place) {
                tilt[j] += c.p[0];
            }
        }
        let f = (self.system.body)(&self.parameters, s, &tilt, u);
        let mut force = [0.0; N];
        for i in 0..n {
            force[i] = f.drive[i] + f.load[i] + f.other[i] + push[i];
        }
        let mut mass = f.mass;
        let mut dry: Vec<(usize, f64, f64)> = Vec::new();
        for (c, z) in self.causes.iter().zip(hidden) {
            let Place::Joint(j) = c.place else { continue };
            self.act(c, j, s, z, &f, t, &mut force, &mut mass, &mut dry);
        }
        let inverse = invert(&mass, n);
        for i in 0..n {
            s.v[i] += H * (0..n).map(|k| inverse[i][k] * force[k]).sum::<f64>();
        }
        // Projected Gauss-Seidel: the sum of a joint's impulses stays within its friction.
        let mut spent = vec![0.0; dry.len()];
        for _ in 0..if dry.len() > 1 { 8 } else { 1 } {
            for (&(j, forward, backward), spent) in dry.iter().zip(&mut spent) {
                let sum = (*spent - s.v[j] / inverse[j][j]).clamp(-forward * H, backward * H);
                let impulse = sum - *spent;
                *spent = sum;
                let stopped = sum > -forward * H && sum < backward * H;
                for i in 0..n {
                    s.v[i] += inverse[i][j] * impulse;
                }
                if stopped {
                    s.v[j] = 0.0;
                }
            }
        }
        for i in 0..self.system.extras {
            s.x[i] += H * f.dx[i];
        }
        for i in 0..n {
            s.q[i] += 0.5 * H * s.v[i];
        }
    }

    #[allow(clippy::too_many_arguments)]
    fn act(
        &self,
        c: &Cause,
        j: usize,
        s: &State,
        z: &mut [f64; 2],
        f: &Forces,
        t: f64,
        force: &mut [f64; N],
        mass: &mut [[f64; N]; N],
        dry: &mut Vec<(usize, f64, f64)>,
    ) {
        let (q, v) = (s.q[j], s.v[j]);
        let [a, b, g, d] = c.p;
        match c.kind {
            Kind::Viscous => force[j] -= a * v,
            Kind::Drag => force[j] -= a * v * v.abs(),
            Kind::Coulomb => dry.push((j, a, a)),
            Kind::Asymmetric => dry.push((j, a, b)),
            Kind::Stribeck => {
                let level = a + b * (-(v / g.max(1e-12)).powi(2)).exp();
                dry.push((j, level, level));
            }
            Kind::StribeckFirst => {
                let level = a + b * (-(v / g.max(1e-12)).abs()).exp();
                dry.push((j, level, level));
            }
            Kind::LoadFriction => {
                let level = a * (f.drive[j] - f.load[j]).abs();
                dry.push((j, level, level));
            }
            Kind::VaryingFriction => {
                let level = a * (-t / b.max(1e-12)).exp();
                dry.push((j, level, level));
            }
            Kind::Cogging => force[j] += a * (b * q + g).sin(),
            Kind::Inertia => mass[j][j] += a,
            Kind::Payload => {
                if let Payload::Lever(l) = self.system.joints[j].payload {
                    mass[j][j] += a * l * l;
                    force[j] -= a * 9.81 * l * q.sin();
                }
            }
            Kind::Spring => force[j] -= a * (q - b),
            Kind::CubicSpring => force[j] -= a * (q - b).powi(3),
            Kind::ConstantForce | Kind::Wind => force[j] += a,
            Kind::EndStop => force[j] -= b * (q - a).max(0.0),
            Kind::EndStopLow => force[j] -= b * (q - a).min(0.0),
            Kind::QuadraticStop => force[j] -= b * (q - a).max(0.0).powi(2),
            Kind::Wall if t > g && t < d => force[j] -= b * (q - a).max(0.0),
            Kind::Gust => force[j] += a * (-((t - b) / g.max(1e-12)).powi(2)).exp(),
            Kind::Periodic => force[j] += a * (2.0 * PI * b * t + g).sin(),
            Kind::SquarePeriodic => force[j] += a * (2.0 * PI * b * t + g).sin().signum(),
            Kind::Dahl => {
                let width = b.max(1e-9);
                z[0] = (z[0] + H * (v - v.abs() * z[0] / width)).clamp(-width, width);
                force[j] -= a * z[0] / width;
            }
            Kind::LuGre => {
                let stiffness = a / d.max(1e-9);
                let level = (a + b * (-(v / g.max(1e-12)).powi(2)).exp()).max(1e-12);
                let rate = v - v.abs() * stiffness * z[0] / level;
                z[0] += H * rate;
                force[j] -=
                    stiffness * z[0] + 0.5 * (stiffness * self.system.joints[j].inertia).sqrt() * rate;
            }
            Kind::BoucWen => {
                z[0] += H * (v - 0.5 * v.abs() * z[0] - 0.5 * v * z[0].abs()) / b.max(1e-9);
                force[j] -= a * z[0];
            }
            Kind::Flexibility if g > 0.0 => {
                // The rotor is driven; the link carries load, friction and the sensor. z = rotor minus link.
                let twist = a * z[0] + b * z[1];
                let (rotor, link) = (g * mass[j][j], (1.0 - g) * mass[j][j]);
                force[j] += twist - f.drive[j];
                mass[j][j] = link;
                z[1] += H * ((f.drive[j] - twist) / rotor - force[j] / link);
                z[0] += H * z[1];
            }
            _ => {}
        }
    }
}

/// Inverse of the leading n × n block of a symmetric positive matrix.
fn invert(m: &[[f64; N]; N], n: usize) -> [[f64; N]; N] {
    let mut r = [[0.0; N]; N];
    match n {
        1 => r[0][0] = 1.0 / m[0][0],
        2 => {
            let det = m[0][0] * m[1][1] - m[0][1] * m[1][0];
            r = [[m[1][1] / det, -m[0][1] / det, 0.0], [-m[1][0] / det, m[0][0] / det, 0.0], [0.0; N]];
        }
        // Three joints occur only for a body that moves freely: its matrix is diagonal.
        _ => (0..n).for_each(|i| r[i][i] = 1.0 / m[i][i]),
    }
    r
}
