//! What the world hides: at most one effect that the nominal simulator does not know.
//!
//! It is drawn from a seed that reaches the world's process by the environment ([`SEED_VARIABLE`]) or, within one
//! process, by the registry ([`super::kinds`]). It is no parameter of the graph, so no recording holds it; whoever knows
//! the seed can ask for the [`Truth`] afterwards. The formulas here are the world's own, written apart from those of the
//! diagnosis.

use std::env::VarError;
use std::fmt;

use parallax_runtime::node::{NodeContext, NodeError};
use parallax_runtime::random::{Purpose, stream};
use rand::{Rng, RngExt};

use super::view::{Stand, View};

/// The environment variable that holds the seed from which the world draws its effect, a whole number; after the word
/// `machine`, the world is a [`Machine`] instead.
pub const SEED_VARIABLE: &str = "PARALLAX_HIDDEN_SEED";

/// One departure of the world from the nominal simulator.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum HiddenEffect {
    /// There is none.
    #[default]
    None,
    /// A voltage acts this much later than it was sent, s.
    Delay {
        /// The delay, s.
        delay: f64,
    },
    /// The voltage at the motor follows the command as a low-pass of first order.
    Lag {
        /// Its time constant, s.
        time_constant: f64,
    },
    /// A constant is added to the voltage.
    Offset {
        /// The constant, V.
        offset: f64,
    },
    /// The voltage at the motor cannot leave this range.
    Saturation {
        /// The lowest voltage, V.
        low: f64,
        /// The highest voltage, V.
        high: f64,
    },
    /// Voltages smaller than this do nothing, and larger ones lose as much.
    Deadband {
        /// Half of the dead zone, V.
        width: f64,
    },
    /// More viscous friction in the shaft's bearing.
    Viscous {
        /// The additional coefficient, N m s/rad.
        coefficient: f64,
    },
    /// Dry friction in the shaft's bearing.
    Coulomb {
        /// The friction's torque, N m.
        force: f64,
    },
    /// Dry friction that differs by direction.
    AsymmetricFriction {
        /// Its torque when the angle grows, N m.
        forward: f64,
        /// Its torque when the angle falls, N m.
        backward: f64,
    },
    /// The mark that the camera sees is not where it should be.
    Bias {
        /// What the camera reads too much, rad.
        bias: f64,
    },
    /// The weight is not what the nominal simulator believes.
    Weight {
        /// The weight times the distance of its centre from the shaft, N m.
        mgl: f64,
    },
    /// A machine of its own, to be identified before a policy is trained for it: several things are not what the nominal
    /// simulator believes, and a voltage acts late.
    Machine(Machine),
}

/// What is different about a machine.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Machine {
    /// A voltage acts this much later than it was sent, s.
    pub delay: f64,
    /// Moment of inertia about the shaft, kg m².
    pub inertia: f64,
    /// Motor constant, N m/A or V s/rad.
    pub motor: f64,
    /// Viscous friction, N m s/rad.
    pub viscous: f64,
    /// Dry friction, N m.
    pub coulomb: f64,
}

impl Machine {
    /// What the environment's variable begins with when a machine is asked for: `machine 42`.
    pub const WORD: &'static str = "machine";

    /// Draws one; equal seeds draw equal machines.
    pub fn draw(seed: u64) -> Self {
        let mut random = stream(seed, Purpose::Node, "hidden machine");
        Self {
            delay: random.random_range(0.030..0.045),
            inertia: random.random_range(1.4e-4..1.9e-4),
            motor: random.random_range(0.029..0.038),
            viscous: random.random_range(5e-6..5e-5),
            coulomb: random.random_range(2e-4..1e-3),
        }
    }
}

/// What the world hid, in the words of a diagnosis.
#[derive(Clone, Debug, PartialEq)]
pub struct Truth {
    /// The effect's name.
    pub effect: &'static str,
    /// Where it acts.
    pub place: &'static str,
    /// Its parameters: name, value, unit.
    pub parameters: Vec<(&'static str, f64, &'static str)>,
}

impl fmt::Display for Truth {
    /// As in `delay@input:voltage (delay 0.024 s)`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let parameters: Vec<String> = self
            .parameters
            .iter()
            .map(|(name, value, unit)| format!("{name} {} {unit}", rounded(*value)))
            .collect();
        write!(f, "{}@{} ({})", self.effect, self.place, parameters.join(", "))
    }
}

/// Three significant digits.
fn rounded(value: f64) -> f64 {
    format!("{value:.2e}").parse().unwrap_or(value)
}

impl HiddenEffect {
    /// How many sorts there are, "none" included.
    pub const SORTS: usize = 11;

    /// Draws a sort, each as likely as any other, and its size. Equal seeds draw equal effects.
    pub fn draw(seed: u64) -> Self {
        let mut random = stream(seed, Purpose::Node, "hidden effect");
        let sort = random.random_range(0..Self::SORTS);
        Self::draw_sort(sort, &mut random)
    }

    /// Draws the size of the effect of a sort, from 0 (none) to [`Self::SORTS`] − 1. Sizes are such that a mechanic would
    /// find them worth a repair, and no machine would stop working.
    pub fn draw_sort(sort: usize, random: &mut impl Rng) -> Self {
        let sign = if random.random::<bool>() { 1.0 } else { -1.0 };
        match sort {
            1 => Self::Delay { delay: random.random_range(0.010..0.040) },
            2 => Self::Lag { time_constant: random.random_range(0.015..0.050) },
            3 => Self::Offset { offset: sign * random.random_range(0.25..0.6) },
            4 => {
                Self::Saturation { low: -random.random_range(1.8..2.8), high: random.random_range(1.8..2.8) }
            }
            5 => Self::Deadband { width: random.random_range(0.2..0.5) },
            6 => Self::Viscous { coefficient: random.random_range(5e-5..2e-4) },
            7 => Self::Coulomb { force: random.random_range(5e-4..1.5e-3) },
            8 => {
                let (mean, part) = (random.random_range(6e-4..1.2e-3), random.random_range(0.35..0.6));
                Self::AsymmetricFriction {
                    forward: mean * (1.0 + sign * part),
                    backward: mean * (1.0 - sign * part),
                }
            }
            9 => Self::Bias { bias: sign * random.random_range(0.03..0.10) },
            10 => Self::Weight { mgl: super::world::WEIGHT * (1.0 + sign * random.random_range(0.10..0.25)) },
            _ => Self::None,
        }
    }

    /// The effect in the words of a diagnosis, or nothing when there is none.
    pub fn truth(&self) -> Option<Truth> {
        let truth =
            |effect, place, parameters: &[_]| Some(Truth { effect, place, parameters: parameters.to_vec() });
        match *self {
            Self::None => None,
            Self::Delay { delay } => truth("delay", "input:voltage", &[("delay", delay, "s")]),
            Self::Lag { time_constant } => {
                truth("lag", "input:voltage", &[("time_constant", time_constant, "s")])
            }
            Self::Offset { offset } => truth("offset", "input:voltage", &[("offset", offset, "V")]),
            Self::Saturation { low, high } => {
                truth("saturation", "input:voltage", &[("low", low, "V"), ("high", high, "V")])
            }
            Self::Deadband { width } => truth("deadband", "input:voltage", &[("width", width, "V")]),
            Self::Viscous { coefficient } => {
                truth("viscous", "joint:shaft", &[("coefficient", coefficient, "N m s/rad")])
            }
            Self::Coulomb { force } => truth("coulomb", "joint:shaft", &[("force", force, "N m")]),
            Self::AsymmetricFriction { forward, backward } => truth(
                "asymmetric_friction",
                "joint:shaft",
                &[("forward", forward, "N m"), ("backward", backward, "N m")],
            ),
            Self::Bias { bias } => truth("bias", "output:angle", &[("bias", bias, "rad")]),
            Self::Weight { mgl } => truth("parameter", "parameter:mgl", &[("value", mgl, "N m")]),
            Self::Machine(Machine { delay, inertia, motor, viscous, coulomb }) => truth(
                Machine::WORD,
                "joint:shaft",
                &[
                    ("delay", delay, "s"),
                    ("inertia", inertia, "kg m^2"),
                    ("motor", motor, "N m/A"),
                    ("viscous", viscous, "N m s/rad"),
                    ("coulomb", coulomb, "N m"),
                ],
            ),
        }
    }
}

/// What the seed in [`SEED_VARIABLE`] draws; nothing is hidden when it is not set.
///
/// # Errors
///
/// When it is set to something that is no whole number.
pub fn from_environment(context: &NodeContext) -> Result<HiddenEffect, NodeError> {
    effect_of(std::env::var(SEED_VARIABLE), context)
}

/// From where a camera looks: where the seed in [`SEED_VARIABLE`] draws a machine, from somewhere that nobody knows.
///
/// # Errors
///
/// As [`from_environment`].
pub fn view_from_environment(context: &NodeContext, stand: Stand) -> Result<View, NodeError> {
    Ok(match secret(std::env::var(SEED_VARIABLE), context)? {
        Some((true, seed)) => View::draw(seed, stand),
        _ => View::nominal(stand),
    })
}

fn effect_of(variable: Result<String, VarError>, context: &NodeContext) -> Result<HiddenEffect, NodeError> {
    Ok(match secret(variable, context)? {
        None => HiddenEffect::None,
        Some((true, seed)) => HiddenEffect::Machine(Machine::draw(seed)),
        Some((false, seed)) => HiddenEffect::draw(seed),
    })
}

/// The seed, and whether it draws a whole machine.
fn secret(
    variable: Result<String, VarError>,
    context: &NodeContext,
) -> Result<Option<(bool, u64)>, NodeError> {
    match variable {
        Err(VarError::NotPresent) => Ok(None),
        Ok(text) => {
            let (machine, seed) = match text.trim().strip_prefix(Machine::WORD) {
                Some(seed) => (true, seed),
                None => (false, text.as_str()),
            };
            let seed = seed.trim().parse().map_err(|_| {
                context.parameter_error(format!(
                    "the environment's {SEED_VARIABLE} is `{text}`, not a whole number"
                ))
            })?;
            Ok(Some((machine, seed)))
        }
        Err(error) => Err(context.parameter_error(format!("the environment's {SEED_VARIABLE}: {error}"))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_environment_gives_a_seed_or_nothing() {
        let context =
            NodeContext { name: "world".into(), rate: 200.0, seed: 1, parameters: Default::default() };
        let effect = |text: &str| effect_of(Ok(text.to_owned()), &context);
        assert_eq!(effect_of(Err(VarError::NotPresent), &context), Ok(HiddenEffect::None));
        assert_eq!(effect(" 42 "), Ok(HiddenEffect::draw(42)));
        assert_eq!(effect("machine 42"), Ok(HiddenEffect::Machine(Machine::draw(42))));
        let error = effect("friction").expect_err("no number").to_string();
        assert!(error.contains("PARALLAX_HIDDEN_SEED is `friction`"), "{error}");
    }

    #[test]
    fn a_truth_reads_as_a_diagnosis_does() {
        let truth = HiddenEffect::Delay { delay: 0.023_456 }.truth().expect("an effect");
        assert_eq!(truth.to_string(), "delay@input:voltage (delay 0.0235 s)");
        assert_eq!(HiddenEffect::None.truth(), None);
    }
}
