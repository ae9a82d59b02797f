//! Effects: optional departures of reality from the nominal model, each with a value at which it vanishes.
//!
//! [`Effect`] names them, [`Place`] says where one may act, and the equations stand in one file per family,
//! generic over the scalar: the same line serves the filter, its derivatives and the exported program.

mod actuation;
mod friction;
mod place;
mod sensing;

pub use friction::JointMotion;
pub use place::{Place, PlaceError, PlaceKind};

use crate::Scalar;
use serde::{Deserialize, Serialize};

/// A named effect. Names are those of reports and of `[[effect]]` entries in a `system.toml`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Effect {
    /// A command acts, or an output shows, `delay` late.
    Delay,
    /// A first-order low-pass on a command.
    Lag,
    /// A constant added to a command.
    Offset,
    /// A command clipped to `[low, high]`.
    Saturation,
    /// A command of less than `width` does nothing.
    Deadband,
    /// Friction proportional to speed, beyond what the nominal model has.
    Viscous,
    /// Dry friction of constant force against the motion.
    Coulomb,
    /// Dry friction with a force of its own in each direction.
    AsymmetricFriction,
    /// A constant added to a reading.
    Bias,
    /// A parameter of the nominal model that has another value.
    Parameter,
}

/// What a parameter of an effect measures: it decides its unit and its natural size on given data.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Quantity {
    /// Seconds.
    Time,
    /// The unit of the command it acts on.
    Input,
    /// A level of the command: null at the edge of the range that was used.
    InputLow,
    /// As [`Quantity::InputLow`], for the upper edge.
    InputHigh,
    /// The generalised force of the joint.
    Force,
    /// Force per speed of the joint.
    ForcePerSpeed,
    /// The unit of the output.
    Output,
    /// The unit of the parameter itself.
    Parameter,
}

/// One parameter of an effect.
#[derive(Clone, Copy, Debug)]
pub struct EffectParameter {
    /// Its name in reports and `[[effect]]` entries.
    pub name: &'static str,
    /// What it measures.
    pub quantity: Quantity,
    /// Whether it may be negative.
    pub signed: bool,
}

const fn parameter(name: &'static str, quantity: Quantity, signed: bool) -> EffectParameter {
    EffectParameter { name, quantity, signed }
}

impl Effect {
    /// Every effect there is.
    pub const ALL: [Effect; 10] = [
        Effect::Delay,
        Effect::Lag,
        Effect::Offset,
        Effect::Saturation,
        Effect::Deadband,
        Effect::Viscous,
        Effect::Coulomb,
        Effect::AsymmetricFriction,
        Effect::Bias,
        Effect::Parameter,
    ];

    /// The effect's name.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Effect::Delay => "delay",
            Effect::Lag => "lag",
            Effect::Offset => "offset",
            Effect::Saturation => "saturation",
            Effect::Deadband => "deadband",
            Effect::Viscous => "viscous",
            Effect::Coulomb => "coulomb",
            Effect::AsymmetricFriction => "asymmetric_friction",
            Effect::Bias => "bias",
            Effect::Parameter => "parameter",
        }
    }

    /// The effect of that name.
    #[must_use]
    pub fn from_name(name: &str) -> Option<Effect> {
        Effect::ALL.into_iter().find(|effect| effect.name() == name)
    }

    /// One sentence for a reader of the report: what reality does that the model does not.
    #[must_use]
    pub fn sentence(self) -> &'static str {
        match self {
            Effect::Delay => "acts late",
            Effect::Lag => "follows sluggishly",
            Effect::Offset => "has a constant added",
            Effect::Saturation => "is clipped",
            Effect::Deadband => "does nothing while small",
            Effect::Viscous => "loses force in proportion to speed",
            Effect::Coulomb => "loses a constant force against the motion",
            Effect::AsymmetricFriction => "loses a constant force that differs by direction",
            Effect::Bias => "reads with a constant error",
            Effect::Parameter => "has another value",
        }
    }

    /// The kinds of places where it can act.
    #[must_use]
    pub fn places(self) -> &'static [PlaceKind] {
        match self {
            Effect::Delay => &[PlaceKind::Input, PlaceKind::Output],
            Effect::Lag | Effect::Offset | Effect::Saturation | Effect::Deadband => &[PlaceKind::Input],
            Effect::Viscous | Effect::Coulomb | Effect::AsymmetricFriction => &[PlaceKind::Joint],
            Effect::Bias => &[PlaceKind::Output],
            Effect::Parameter => &[PlaceKind::Parameter],
        }
    }

    /// Its parameters, in the order in which the equations take them.
    #[must_use]
    pub fn parameters(self) -> &'static [EffectParameter] {
        use Quantity::{Force, ForcePerSpeed, Input, InputHigh, InputLow, Output, Time};
        match self {
            Effect::Delay => const { &[parameter("delay", Time, false)] },
            Effect::Lag => const { &[parameter("time_constant", Time, false)] },
            Effect::Offset => const { &[parameter("offset", Input, true)] },
            Effect::Saturation => {
                const { &[parameter("low", InputLow, true), parameter("high", InputHigh, true)] }
            }
            Effect::Deadband => const { &[parameter("width", Input, false)] },
            Effect::Viscous => const { &[parameter("coefficient", ForcePerSpeed, true)] },
            Effect::Coulomb => const { &[parameter("force", Force, false)] },
            Effect::AsymmetricFriction => {
                const { &[parameter("forward", Force, false), parameter("backward", Force, false)] }
            }
            Effect::Bias => const { &[parameter("bias", Output, true)] },
            Effect::Parameter => const { &[parameter("value", Quantity::Parameter, true)] },
        }
    }

    /// The command that reaches the plant, from the command that was sent, both in the input's unit.
    /// Effects that do not act on a command's value return it unchanged.
    #[must_use]
    pub fn input<T: Scalar>(self, parameters: &[T], command: T) -> T {
        match (self, parameters) {
            (Effect::Offset, &[offset]) => actuation::offset(offset, command),
            (Effect::Saturation, &[low, high]) => actuation::saturation(low, high, command),
            (Effect::Deadband, &[width]) => actuation::deadband(width, command),
            _ => command,
        }
    }

    /// The generalised force that the effect adds to a joint, in the joint's unit of force;
    /// `None` for effects that are no force.
    #[must_use]
    pub fn force<T: Scalar>(self, parameters: &[T], motion: &JointMotion<T>) -> Option<T> {
        match (self, parameters) {
            (Effect::Viscous, &[coefficient]) => Some(friction::viscous(coefficient, motion)),
            (Effect::Coulomb, &[force]) => Some(friction::coulomb(force, motion)),
            (Effect::AsymmetricFriction, &[forward, backward]) => {
                Some(friction::asymmetric(forward, backward, motion))
            }
            _ => None,
        }
    }

    /// The reading, from the true value of the output, both in the output's unit.
    /// Effects that do not act on a reading's value return it unchanged.
    #[must_use]
    pub fn output<T: Scalar>(self, parameters: &[T], value: T) -> T {
        match (self, parameters) {
            (Effect::Bias, &[bias]) => sensing::bias(bias, value),
            _ => value,
        }
    }
}

/// The mean of a first-order lag's output over a step with a held command, and its value at the end.
///
/// `state` is the lag's output at the start and `dt` the step in seconds. Exact for a held command
/// (the solution of τ v̇ = u − v), smooth in τ down to zero, where the lag vanishes: no stiff equation is left.
#[must_use]
pub fn lag_step<T: Scalar>(time_constant: T, state: T, command: T, dt: T) -> (T, T) {
    actuation::lag_step(time_constant, state, command, dt)
}
