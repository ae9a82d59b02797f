//! Effects: optional departures of reality from the nominal model, each with a value at which it vanishes.
//!
//! [`Effect`] names them, [`Place`] says where one may act, and the equations stand in one file per family,
//! generic over the scalar: the same line serves the filter, its derivatives and the exported program.
//!
//! # Forms
//!
//! Reality does not share our formulas. Where a family has several, each form is a variant of its own with the same
//! [`Effect::name`] and other parameters; in an `[[effect]]` entry the parameters that are given decide the form
//! ([`Effect::with_parameters`]).
//!
//! # Order
//!
//! Several effects at one place act in a fixed, physical order ([`Effect::stage`]). A command: gain, offset, supply
//! sag, saturation, deadband, rate limit, lag, backlash; delays and skews shift the result in time. A reading: sensor
//! lag, scale, bias, drift, sensor saturation. Forces add up.

mod actuation;
mod body;
mod catalogue;
mod friction;
mod own;
mod parameter;
mod place;
mod sensing;

pub use actuation::{lag_second_order_step, lag_step, play_step, rate_limit_step, sag};
pub use friction::JointMotion;
pub use own::Own;
pub use parameter::{EffectParameter, Quantity};
pub use place::{Place, PlaceError, PlaceKind};

use crate::Scalar;

/// A named effect, in one functional form. Names are those of reports and of `[[effect]]` entries in a `system.toml`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Effect {
    /// A command acts, or an output shows, `delay` late. A command that was smooth before it was sampled, or that is stamped when
    /// it is logged, acts early: its delay is negative.
    Delay,
    /// A first-order low-pass on a command.
    Lag,
    /// A second-order low-pass on a command: a form of `lag`.
    LagSecondOrder,
    /// A command multiplied by a factor.
    Gain,
    /// A constant added to a command.
    Offset,
    /// A command clipped to `[low, high]`, or a state that cannot leave them.
    Saturation,
    /// A command that bends smoothly towards `low` and `high`: a form of `saturation`.
    SaturationSoft,
    /// A state that overflows: a share of what it cannot hold enters the state that it feeds
    /// ([`System::fed_by`](crate::system::System::fed_by)). A form of `saturation`.
    SaturationOverflow,
    /// A command of less than `width` does nothing.
    Deadband,
    /// A command that is followed at a limited rate.
    RateLimit,
    /// Play between a command and what it moves.
    Backlash,
    /// A command that weakens with a power of the recorded supply voltage.
    SupplySag,
    /// A command that weakens in proportion to its own size: the form of `supply_sag` without a voltage signal.
    SupplySagLoad,
    /// A command or a reading whose clock runs at another rate: its delay grows in time.
    ClockSkew,
    /// Friction proportional to speed, beyond what the nominal model has.
    Viscous,
    /// Dry friction of constant force against the motion.
    Coulomb,
    /// Dry friction that builds up over a deflection.
    CoulombDahl,
    /// Dry friction that is larger near standstill.
    Stribeck,
    /// Dry friction in proportion to the transmitted force.
    LoadFriction,
    /// Dry friction with a force of its own in each direction.
    AsymmetricFriction,
    /// Viscous friction with a coefficient of its own in each direction: a form of `asymmetric_friction`.
    AsymmetricViscous,
    /// Drag with the square of speed.
    QuadraticDrag,
    /// A force that repeats with position.
    Cogging,
    /// Inertia added at a joint.
    Inertia,
    /// A mass added at a joint, with its inertia and weight.
    Payload,
    /// Gravity from another direction.
    GravityTilt,
    /// A spring between the joint and the world.
    Spring,
    /// A spring that hardens with the cube of its deflection.
    SpringCubic,
    /// A spring between the drive and the measured side of a joint: a two-mass resonance.
    Flexibility,
    /// A mass that hangs on the measured side of a joint by a spring: a form of `flexibility`.
    FlexibilityFar,
    /// A constant force on a joint.
    ConstantForce,
    /// A stop above a position.
    EndStop,
    /// A stop below a position: a form of `end_stop`.
    EndStopLower,
    /// Stops on both sides of the way, alike in stiffness: a form of `end_stop`.
    EndStopBoth,
    /// A constant force of the surrounding air.
    Wind,
    /// Surrounding air that moves, where a joint names its state: a form of `wind`.
    WindSpeed,
    /// A sinusoidal force of time.
    PeriodicDisturbance,
    /// A constant added to a reading.
    Bias,
    /// A reading multiplied by a factor.
    Scale,
    /// An error of a reading that grows in time.
    Drift,
    /// A first-order low-pass on a reading.
    SensorLag,
    /// A second-order low-pass on a reading.
    SensorLagSecondOrder,
    /// A reading clipped to `[low, high]`.
    SensorSaturation,
    /// A parameter of the nominal model that has another value.
    Parameter,
    /// Delays that scatter.
    Jitter,
    /// Messages that are lost.
    Drops,
    /// Noise of a reading beyond what is stated.
    Noise,
    /// A reading in steps.
    Quantization,
    /// Readings that are wrong at times.
    Outliers,
    /// Readings that repeat an earlier one at times.
    Stuck,
    /// An effect that a system's file adds: its equation and its parameters are the system's.
    Own(Own),
}

impl Effect {
    /// Every effect there is, in every form.
    pub const ALL: [Effect; 50] = [
        Effect::Delay,
        Effect::Lag,
        Effect::LagSecondOrder,
        Effect::Gain,
        Effect::Offset,
        Effect::Saturation,
        Effect::SaturationSoft,
        Effect::SaturationOverflow,
        Effect::Deadband,
        Effect::RateLimit,
        Effect::Backlash,
        Effect::SupplySag,
        Effect::SupplySagLoad,
        Effect::ClockSkew,
        Effect::Viscous,
        Effect::Coulomb,
        Effect::CoulombDahl,
        Effect::Stribeck,
        Effect::LoadFriction,
        Effect::AsymmetricFriction,
        Effect::AsymmetricViscous,
        Effect::QuadraticDrag,
        Effect::Cogging,
        Effect::Inertia,
        Effect::Payload,
        Effect::GravityTilt,
        Effect::Spring,
        Effect::SpringCubic,
        Effect::Flexibility,
        Effect::FlexibilityFar,
        Effect::ConstantForce,
        Effect::EndStop,
        Effect::EndStopLower,
        Effect::EndStopBoth,
        Effect::Wind,
        Effect::WindSpeed,
        Effect::PeriodicDisturbance,
        Effect::Bias,
        Effect::Scale,
        Effect::Drift,
        Effect::SensorLag,
        Effect::SensorLagSecondOrder,
        Effect::SensorSaturation,
        Effect::Parameter,
        Effect::Jitter,
        Effect::Drops,
        Effect::Noise,
        Effect::Quantization,
        Effect::Outliers,
        Effect::Stuck,
    ];

    /// The effect's name, the same for all its forms.
    #[must_use]
    pub const fn name(self) -> &'static str {
        catalogue::of(self).name
    }

    /// The first form of the effect of that name.
    #[must_use]
    pub fn from_name(name: &str) -> Option<Effect> {
        Effect::forms(name).next()
    }

    /// All forms of the effect of that name.
    pub fn forms(name: &str) -> impl Iterator<Item = Effect> {
        Effect::ALL.into_iter().filter(move |effect| effect.name() == name)
    }

    /// The form of the effect of that name that has just these parameters, in any order.
    #[must_use]
    pub fn with_parameters(name: &str, parameters: &[&str]) -> Option<Effect> {
        Effect::forms(name).find(|form| {
            let own = form.parameters();
            own.len() == parameters.len() && own.iter().all(|p| parameters.contains(&p.name))
        })
    }

    /// One sentence for a reader of the report: what reality does that the model does not.
    #[must_use]
    pub const fn sentence(self) -> &'static str {
        catalogue::of(self).sentence
    }

    /// The kinds of places where it can act.
    #[must_use]
    pub const fn places(self) -> &'static [PlaceKind] {
        catalogue::of(self).places
    }

    /// Its parameters, in the order in which the equations take them.
    #[must_use]
    pub const fn parameters(self) -> &'static [EffectParameter] {
        catalogue::of(self).parameters
    }

    /// The effects that it contains: with some of its parameters at their null value, or equal to each other, it is one
    /// of these. Where the data do not ask for more, the simpler one is the answer.
    #[must_use]
    pub const fn simpler(self) -> &'static [Effect] {
        match self {
            Effect::LagSecondOrder => &[Effect::Lag],
            Effect::SensorLagSecondOrder => &[Effect::SensorLag],
            Effect::SaturationSoft | Effect::SaturationOverflow => &[Effect::Saturation],
            Effect::CoulombDahl | Effect::Stribeck | Effect::AsymmetricFriction => &[Effect::Coulomb],
            Effect::AsymmetricViscous => &[Effect::Viscous],
            // A wave longer than the way is a stiffness that changes along it.
            Effect::Cogging => &[Effect::SpringCubic],
            // Two stops that meet are a spring.
            Effect::EndStopBoth => &[Effect::EndStop, Effect::EndStopLower, Effect::Spring],
            // A soft spring that rests far away.
            Effect::Spring => &[Effect::ConstantForce],
            _ => &[],
        }
    }

    /// Whether it leaves the mean of every prediction as it is: such an effect shows in the distribution of the
    /// residuals and in the stamps, and no fit of predictions can find it.
    #[must_use]
    pub const fn statistical(self) -> bool {
        matches!(
            self,
            Effect::Jitter
                | Effect::Drops
                | Effect::Noise
                | Effect::Quantization
                | Effect::Outliers
                | Effect::Stuck
        )
    }

    /// Whether it acts on a command through the command's history: see [`Effect::held`].
    #[must_use]
    pub const fn has_memory(self) -> bool {
        self.memory() > 0
    }

    /// When it acts among several at one place: the smallest stage first.
    #[must_use]
    pub const fn stage(self) -> u8 {
        match self {
            Effect::Gain | Effect::SensorLag | Effect::SensorLagSecondOrder => 0,
            Effect::Offset | Effect::Scale => 1,
            Effect::SupplySag | Effect::SupplySagLoad | Effect::Bias => 2,
            Effect::Saturation | Effect::SaturationSoft | Effect::SaturationOverflow | Effect::Drift => 3,
            Effect::Deadband | Effect::SensorSaturation => 4,
            Effect::RateLimit => 5,
            Effect::Lag | Effect::LagSecondOrder => 6,
            Effect::Backlash => 7,
            _ => 8,
        }
    }

    /// The command that reaches the plant, from the command that was sent, both in the input's unit.
    /// Effects that do not act on a command's value alone return it unchanged.
    #[must_use]
    pub fn input<T: Scalar>(self, parameters: &[T], command: T) -> T {
        match (self, parameters) {
            (Effect::Gain, &[gain]) => command * gain,
            (Effect::Offset, &[offset]) => command + offset,
            (Effect::Saturation, &[low, high]) => command.clamp(low, high),
            (Effect::SaturationSoft, &[low, high, softness]) => {
                actuation::soft_saturation(low, high, softness, command)
            }
            (Effect::Deadband, &[width]) => actuation::deadband(width, command),
            (Effect::SupplySagLoad, &[coefficient]) => actuation::load_sag(coefficient, command),
            _ => command,
        }
    }

    /// The generalised force that the effect adds to a joint, in the joint's unit of force; `None` for effects that
    /// are no force of the joint's motion alone, and where the joint does not state what the force depends on.
    #[must_use]
    pub fn force<T: Scalar>(self, parameters: &[T], motion: &JointMotion<T>) -> Option<T> {
        match (self, parameters) {
            (Effect::Viscous, &[coefficient]) => Some(friction::viscous(coefficient, motion)),
            (Effect::Coulomb, &[force]) => Some(friction::coulomb(force, motion)),
            (Effect::Stribeck, &[coulomb, extra, speed]) => {
                Some(friction::stribeck(coulomb, extra, speed, motion))
            }
            (Effect::LoadFriction, &[ratio]) => friction::load(ratio, motion),
            (Effect::AsymmetricFriction, &[forward, backward]) => {
                Some(friction::asymmetric(forward, backward, motion))
            }
            (Effect::AsymmetricViscous, &[forward, backward]) => {
                Some(friction::asymmetric_viscous(forward, backward, motion))
            }
            (Effect::QuadraticDrag, &[coefficient]) => Some(friction::quadratic(coefficient, motion)),
            (Effect::Cogging, &[amplitude, wavenumber, phase]) => {
                Some(body::cogging(amplitude, wavenumber, phase, motion))
            }
            (Effect::Spring, &[stiffness, rest]) => Some(body::spring(stiffness, rest, motion)),
            (Effect::SpringCubic, &[cubic_stiffness, rest]) => {
                Some(body::cubic_spring(cubic_stiffness, rest, motion))
            }
            (Effect::EndStop, &[limit, stiffness]) => Some(body::upper_stop(limit, stiffness, motion)),
            (Effect::EndStopLower, &[limit, stiffness]) => Some(body::lower_stop(limit, stiffness, motion)),
            (Effect::EndStopBoth, &[upper, lower, stiffness]) => {
                Some(body::upper_stop(upper, stiffness, motion) + body::lower_stop(lower, stiffness, motion))
            }
            (Effect::ConstantForce | Effect::Wind, &[force]) => Some(force),
            (Effect::PeriodicDisturbance, &[amplitude, frequency, phase]) => {
                Some(body::periodic(amplitude, frequency, phase, motion))
            }
            _ => None,
        }
    }

    /// The one among parameters of equal meaning that is reported: a sinusoid of negative amplitude is one of positive
    /// amplitude half a turn on, and phases lie in (−π, π].
    #[must_use]
    pub fn canonical(self, parameters: &[f64]) -> Vec<f64> {
        let mut values = parameters.to_vec();
        if let (Effect::Cogging | Effect::PeriodicDisturbance, [amplitude, _, phase]) =
            (self, &mut values[..])
        {
            if *amplitude < 0.0 {
                (*amplitude, *phase) = (-*amplitude, *phase + std::f64::consts::PI);
            }
            let turns = (0.5 - *phase / std::f64::consts::TAU).floor();
            *phase += turns * std::f64::consts::TAU;
        }
        values
    }

    /// The reading, from the true value of the output, both in the output's unit, `time` seconds after the
    /// recording's start. Effects that do not act on a reading's value alone return it unchanged.
    #[must_use]
    pub fn output<T: Scalar>(self, parameters: &[T], value: T, time: T) -> T {
        match (self, parameters) {
            (Effect::Bias, &[bias]) => value + bias,
            (Effect::Scale, &[scale]) => value * scale,
            (Effect::Drift, &[rate]) => sensing::drift(rate, value, time),
            (Effect::SensorSaturation, &[low, high]) => value.clamp(low, high),
            _ => value,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_list_holds_every_effect_once_and_forms_differ_by_their_parameters() {
        for (k, effect) in Effect::ALL.into_iter().enumerate() {
            assert!(!Effect::ALL[..k].contains(&effect), "{effect:?} is listed twice");
            let names: Vec<&str> = effect.parameters().iter().map(|p| p.name).collect();
            assert_eq!(Effect::with_parameters(effect.name(), &names), Some(effect), "{effect:?}");
            for p in effect.parameters() {
                assert!(p.low <= p.high && !(p.null < p.low || p.null > p.high), "{effect:?}: {}", p.name);
            }
            assert!(!effect.places().is_empty() && !effect.sentence().is_empty());
        }
        assert_eq!(
            Effect::with_parameters("lag", &["damping", "time_constant"]),
            Some(Effect::LagSecondOrder)
        );
        assert_eq!(Effect::with_parameters("lag", &["delay"]), None);
    }

    #[test]
    fn a_sinusoid_has_one_name() {
        let pi = std::f64::consts::PI;
        let [a, n, phase] = Effect::Cogging.canonical(&[-0.5, 3.0, 0.2])[..] else { panic!() };
        assert_eq!((a, n), (0.5, 3.0));
        assert!((phase - (0.2 - pi)).abs() < 1e-12);
        let motion = |x: f64| (x * 3.0 + 0.2).sin() * -0.5;
        assert!((a * (3.0 * 0.7 + phase).sin() - motion(0.7)).abs() < 1e-12);
        assert!((Effect::PeriodicDisturbance.canonical(&[1.0, 2.0, -pi])[2] - pi).abs() < 1e-12);
        assert_eq!(Effect::Bias.canonical(&[-1.0]), [-1.0]);
    }

    /// The names and parameters that reports and files rely on.
    #[test]
    fn names_are_those_of_the_format() {
        let expected = "delay{delay} jitter{spread} drops{rate} clock_skew{skew} gain{gain} offset{offset} \
            lag{time_constant} saturation{low,high} deadband{width} rate_limit{rate} backlash{gap} supply_sag{exponent} \
            viscous{coefficient} coulomb{force} stribeck{coulomb,extra,stribeck_speed} load_friction{ratio} \
            asymmetric_friction{forward,backward} quadratic_drag{coefficient} cogging{amplitude,wavenumber,phase} \
            inertia{added} payload{mass} gravity_tilt{angle} spring{stiffness,rest} \
            flexibility{stiffness,damping,ratio} constant_force{force} end_stop{limit,stiffness} parameter{value} \
            wind{force} periodic_disturbance{amplitude,frequency,phase} bias{bias} scale{scale} noise{std} \
            quantization{step} sensor_lag{time_constant} drift{rate} outliers{rate} sensor_saturation{low,high} \
            stuck{rate}";
        for text in expected.split_whitespace() {
            let (name, rest) = text.split_once('{').unwrap();
            let parameters: Vec<&str> = rest.trim_end_matches('}').split(',').collect();
            let first = Effect::from_name(name).unwrap();
            let own: Vec<&str> = first.parameters().iter().map(|p| p.name).collect();
            assert_eq!(own, parameters, "{name}");
        }
        assert_eq!(
            expected.split_whitespace().count(),
            Effect::ALL.iter().map(|e| e.name()).collect::<std::collections::BTreeSet<_>>().len()
        );
    }
}
