//! What is known of each effect without data: its name, its places, its parameters, and one sentence for a reader.

use super::{Effect, EffectParameter, PlaceKind, Quantity};

/// The catalogue's entry of one effect.
pub(super) struct Entry {
    pub(super) name: &'static str,
    pub(super) sentence: &'static str,
    pub(super) places: &'static [PlaceKind],
    pub(super) parameters: &'static [EffectParameter],
}

const INPUT: &[PlaceKind] = &[PlaceKind::Input];
const OUTPUT: &[PlaceKind] = &[PlaceKind::Output];
const JOINT: &[PlaceKind] = &[PlaceKind::Joint];
const OWN: &[PlaceKind] = &[PlaceKind::Joint, PlaceKind::Input, PlaceKind::Output];
const ENDS: &[PlaceKind] = &[PlaceKind::Input, PlaceKind::Output];

const INF: f64 = f64::INFINITY;
const PI: f64 = std::f64::consts::PI;

/// A parameter that vanishes at zero and is not negative.
const fn positive(name: &'static str, quantity: Quantity) -> EffectParameter {
    EffectParameter { name, quantity, null: 0.0, low: 0.0, high: INF }
}

/// A parameter that vanishes at zero and may have either sign.
const fn signed(name: &'static str, quantity: Quantity) -> EffectParameter {
    EffectParameter { name, quantity, null: 0.0, low: -INF, high: INF }
}

/// A parameter with its null value and physical range.
const fn within(name: &'static str, quantity: Quantity, null: f64, low: f64, high: f64) -> EffectParameter {
    EffectParameter { name, quantity, null, low, high }
}

const fn entry(
    name: &'static str,
    sentence: &'static str,
    places: &'static [PlaceKind],
    parameters: &'static [EffectParameter],
) -> Entry {
    Entry { name, sentence, places, parameters }
}

const LEVELS: &[EffectParameter] =
    &[within("low", Quantity::Low, -INF, -INF, INF), within("high", Quantity::High, INF, -INF, INF)];

/// The entry of an effect.
#[rustfmt::skip]
pub(super) const fn of(effect: Effect) -> Entry {
    use Quantity as Q;
    match effect {
        Effect::Own(own) => entry(own.name(), "does what the file says", OWN, &[]),
        // Timing.
        Effect::Delay => entry("delay", "acts late", ENDS, const { &[signed("delay", Q::Time)] }),
        Effect::Jitter => entry("jitter", "acts at times that scatter", ENDS, const { &[positive("spread", Q::Time)] }),
        Effect::Drops => entry("drops", "loses messages", ENDS, const { &[within("rate", Q::Share, 0.0, 0.0, 1.0)] }),
        Effect::ClockSkew => entry("clock_skew", "runs on a clock of another rate, so that its delay grows", ENDS,
            const { &[within("skew", Q::Ratio, 0.0, -0.02, 0.02)] }),
        // Actuation.
        Effect::Gain => entry("gain", "acts with another gain", INPUT, const { &[within("gain", Q::Ratio, 1.0, -10.0, 10.0)] }),
        Effect::Lag => entry("lag", "follows sluggishly", INPUT, const { &[positive("time_constant", Q::Time)] }),
        Effect::LagSecondOrder => entry("lag", "follows sluggishly, as a second-order system", INPUT,
            const { &[positive("time_constant", Q::Time), within("damping", Q::Damping, 1.0, 0.05, 3.0)] }),
        Effect::Offset => entry("offset", "has a constant added", INPUT, const { &[signed("offset", Q::Level)] }),
        Effect::Saturation => entry("saturation", "is clipped", const { &[PlaceKind::Input, PlaceKind::State] }, LEVELS),
        Effect::SaturationSoft => entry("saturation", "bends towards its limits", INPUT, const { &[
            within("low", Q::Low, -INF, -INF, INF), within("high", Q::High, INF, -INF, INF), positive("softness", Q::Level)] }),
        Effect::SaturationOverflow => entry("saturation", "overflows into what it feeds", const { &[PlaceKind::State] }, const { &[
            within("high", Q::High, INF, -INF, INF), within("share", Q::Overflow, 0.0, 0.0, INF)] }),
        Effect::Deadband => entry("deadband", "does nothing while small", INPUT, const { &[positive("width", Q::Level)] }),
        Effect::RateLimit => entry("rate_limit", "follows no faster than a limit", INPUT,
            const { &[within("rate", Q::LevelRate, INF, 0.0, INF)] }),
        Effect::Backlash => entry("backlash", "has play at reversals", INPUT, const { &[positive("gap", Q::Level)] }),
        Effect::SupplySag => entry("supply_sag", "weakens with the supply voltage", INPUT,
            const { &[within("exponent", Q::Exponent, 0.0, -5.0, 5.0)] }),
        Effect::SupplySagLoad => entry("supply_sag", "weakens under its own load", INPUT,
            const { &[positive("coefficient", Q::PerLevel)] }),
        // Friction.
        Effect::Viscous => entry("viscous", "loses force in proportion to speed", JOINT, const { &[signed("coefficient", Q::ForcePerSpeed)] }),
        Effect::Coulomb => entry("coulomb", "loses a constant force against the motion", JOINT, const { &[positive("force", Q::Force)] }),
        Effect::CoulombDahl => entry("coulomb", "loses a constant force against the motion, which builds up over a deflection", JOINT,
            const { &[positive("force", Q::Force), positive("deflection", Q::Presliding)] }),
        Effect::Stribeck => entry("stribeck", "loses a force against the motion that is larger near standstill", JOINT, const { &[
            positive("coulomb", Q::Force), positive("extra", Q::Force),
            within("stribeck_speed", Q::StribeckSpeed, INF, 0.0, INF)] }),
        Effect::LoadFriction => entry("load_friction", "loses a share of the transmitted force against the motion", JOINT,
            const { &[within("ratio", Q::LoadShare, 0.0, 0.0, 2.0)] }),
        Effect::AsymmetricFriction => entry("asymmetric_friction", "loses a constant force that differs by direction", JOINT,
            const { &[positive("forward", Q::Force), positive("backward", Q::Force)] }),
        Effect::AsymmetricViscous => entry("asymmetric_friction", "loses force in proportion to speed, differing by direction", JOINT,
            const { &[signed("forward_viscous", Q::ForcePerSpeed), signed("backward_viscous", Q::ForcePerSpeed)] }),
        Effect::QuadraticDrag => entry("quadratic_drag", "loses force with the square of speed", JOINT,
            const { &[positive("coefficient", Q::ForcePerSpeedSquared)] }),
        Effect::Cogging => entry("cogging", "feels a force that repeats with position", JOINT, const { &[
            signed("amplitude", Q::Force), within("wavenumber", Q::Wavenumber, 1.0, 0.0, INF),
            within("phase", Q::Phase, 0.0, -2.0 * PI, 2.0 * PI)] }),
        // Body.
        Effect::Inertia => entry("inertia", "has another inertia", JOINT, const { &[positive("added", Q::Inertia)] }),
        Effect::Payload => entry("payload", "carries another mass", JOINT, const { &[signed("mass", Q::Mass)] }),
        Effect::GravityTilt => entry("gravity_tilt", "is tilted against gravity", JOINT,
            const { &[within("angle", Q::Angle, 0.0, -PI, PI)] }),
        Effect::Spring => entry("spring", "is pulled towards a position", JOINT,
            const { &[signed("stiffness", Q::Stiffness), signed("rest", Q::Position)] }),
        Effect::SpringCubic => entry("spring", "is pulled towards a position, the harder the further away", JOINT,
            const { &[positive("cubic_stiffness", Q::CubicStiffness), signed("rest", Q::Position)] }),
        Effect::Flexibility => entry("flexibility", "is driven through a spring", JOINT, const { &[
            positive("stiffness", Q::FlexibleStiffness), positive("damping", Q::FlexibleDamping),
            within("ratio", Q::FarShare, 0.0, 0.0, 0.998)] }),
        Effect::FlexibilityFar => entry("flexibility", "moves a mass that hangs on a spring", JOINT, const { &[
            positive("stiffness", Q::FlexibleStiffness), positive("damping", Q::FlexibleDamping),
            within("far_ratio", Q::FarShare, 0.0, 0.0, 0.998)] }),
        Effect::ConstantForce => entry("constant_force", "feels a constant force", JOINT, const { &[signed("force", Q::Force)] }),
        Effect::EndStop => entry("end_stop", "runs into a stop", JOINT,
            const { &[within("limit", Q::UpperStop, INF, -INF, INF), positive("stiffness", Q::StopStiffness)] }),
        Effect::EndStopLower => entry("end_stop", "runs into a stop on its lower side", JOINT,
            const { &[within("lower_limit", Q::LowerStop, -INF, -INF, INF), positive("stiffness", Q::StopStiffness)] }),
        Effect::EndStopBoth => entry("end_stop", "runs into stops on both sides", JOINT, const { &[
            within("limit", Q::UpperStop, INF, -INF, INF), within("lower_limit", Q::LowerStop, -INF, -INF, INF),
            positive("stiffness", Q::StopStiffness)] }),
        Effect::Parameter => entry("parameter", "has another value", const { &[PlaceKind::Parameter] },
            const { &[within("value", Q::Parameter, f64::NAN, -INF, INF)] }),
        // Environment.
        Effect::Wind => entry("wind", "is pushed by wind", JOINT, const { &[signed("force", Q::Force)] }),
        Effect::WindSpeed => entry("wind", "moves through air that moves", JOINT, const { &[signed("speed", Q::AirSpeed)] }),
        Effect::PeriodicDisturbance => entry("periodic_disturbance", "is shaken by a periodic force", JOINT, const { &[
            signed("amplitude", Q::Force), within("frequency", Q::Frequency, 1.0, 0.0, INF),
            within("phase", Q::Phase, 0.0, -2.0 * PI, 2.0 * PI)] }),
        // Sensing.
        Effect::Bias => entry("bias", "reads with a constant error", OUTPUT, const { &[signed("bias", Q::Reading)] }),
        Effect::Scale => entry("scale", "reads with another scale", OUTPUT, const { &[within("scale", Q::Ratio, 1.0, -10.0, 10.0)] }),
        Effect::Drift => entry("drift", "reads with an error that grows in time", OUTPUT, const { &[signed("rate", Q::ReadingRate)] }),
        Effect::SensorLag => entry("sensor_lag", "shows the truth sluggishly", OUTPUT, const { &[positive("time_constant", Q::Time)] }),
        Effect::SensorLagSecondOrder => entry("sensor_lag", "shows the truth sluggishly, as a second-order system", OUTPUT,
            const { &[positive("time_constant", Q::Time), within("damping", Q::Damping, 1.0, 0.05, 3.0)] }),
        Effect::SensorSaturation => entry("sensor_saturation", "cannot read beyond its limits", OUTPUT, LEVELS),
        Effect::Noise => entry("noise", "is noisier than stated", OUTPUT, const { &[positive("std", Q::Reading)] }),
        Effect::Quantization => entry("quantization", "reads in steps", OUTPUT, const { &[positive("step", Q::Reading)] }),
        Effect::Outliers => entry("outliers", "is wrong at times", OUTPUT, const { &[within("rate", Q::Share, 0.0, 0.0, 1.0)] }),
        Effect::Stuck => entry("stuck", "repeats old readings at times", OUTPUT, const { &[within("rate", Q::Share, 0.0, 0.0, 1.0)] }),
    }
}
