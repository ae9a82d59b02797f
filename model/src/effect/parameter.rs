//! What the parameters of effects measure.

/// What a parameter of an effect measures: it decides its unit and its natural size on given data.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Quantity {
    /// Seconds.
    Time,
    /// A factor or a ratio without unit.
    Ratio,
    /// A share of events, 0 to 1.
    Share,
    /// What enters another state, in its unit, for one unit that overflows.
    Overflow,
    /// The damping ratio of a second-order system.
    Damping,
    /// A power.
    Exponent,
    /// The unit of the command it acts on.
    Level,
    /// That unit per second.
    LevelRate,
    /// One over that unit.
    PerLevel,
    /// A level of the command, state or reading: null below the range that was used.
    Low,
    /// As [`Quantity::Low`], above the range.
    High,
    /// The generalised force of the joint.
    Force,
    /// Force per speed of the joint.
    ForcePerSpeed,
    /// Force per speed squared.
    ForcePerSpeedSquared,
    /// Over how far dry friction builds up, in the joint's unit.
    Presliding,
    /// The speed at which dry friction has lost most of its excess.
    StribeckSpeed,
    /// Friction as a share of the transmitted force.
    LoadShare,
    /// Waves per unit of position, times 2π: N in sin(N θ).
    Wavenumber,
    /// A phase in rad.
    Phase,
    /// The joint's inertia (kg m² or kg).
    Inertia,
    /// Kilograms.
    Mass,
    /// An angle of gravity in rad.
    Angle,
    /// Force per position.
    Stiffness,
    /// Force per position cubed.
    CubicStiffness,
    /// A position of the joint.
    Position,
    /// Stiffness of a spring inside the joint.
    FlexibleStiffness,
    /// Damping of a spring inside the joint, force per speed.
    FlexibleDamping,
    /// Share of the joint's inertia on the far side of a spring.
    FarShare,
    /// A position beyond which there is a stop.
    UpperStop,
    /// A position below which there is a stop.
    LowerStop,
    /// Force per position within a stop.
    StopStiffness,
    /// Speed of the air, in the unit of the state that holds it.
    AirSpeed,
    /// Hertz.
    Frequency,
    /// The unit of the output.
    Reading,
    /// That unit per second.
    ReadingRate,
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
    /// The value at which, with the other parameters at theirs, the effect vanishes; an infinity where that lies
    /// beyond every value; not a number where only the system knows it.
    pub null: f64,
    /// Smallest value that physics allows.
    pub low: f64,
    /// Largest value that physics allows.
    pub high: f64,
}
