//! What may be wrong with a machine, and how much of it a real one has.

use crate::system::{Control, Payload, System};
use rand::{Rng, RngExt};
use rand_chacha::ChaCha8Rng;
use std::collections::BTreeMap;
use std::f64::consts::PI;

/// Every cause that the generator knows: those of the table, other forms of them, and those of no table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[rustfmt::skip]
pub(crate) enum Kind {
    // At an input.
    DelayIn, JitterIn, DropsIn, SkewIn, Gain, Lag, Offset, Saturation, Deadband, RateLimit, Backlash, SupplySag,
    // At a joint.
    Viscous, Coulomb, Stribeck, LoadFriction, Asymmetric, Drag, Cogging, Inertia, Payload, Tilt, Spring, Flexibility,
    ConstantForce, EndStop, EndStopLow, Wind, Periodic,
    // At a parameter that the diagnosis may not calibrate.
    Parameter,
    // At an output.
    DelayOut, JitterOut, DropsOut, SkewOut, Bias, Scale, Noise, Quantization, SensorLag, Drift, Outliers,
    SensorSaturation, Stuck,
    // Other forms of the above.
    LagSecond, TanhSaturation, SmoothDeadband, StribeckFirst, Dahl, LuGre, QuadraticStop, CubicSpring, SquarePeriodic,
    SensorLagSecond,
    // Outside every table.
    Wall, Gust, BoucWen, VaryingFriction, EventDelay,
}

/// Where a cause acts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Place {
    Input(usize),
    Joint(usize),
    Output(usize),
    Parameter(usize),
}

/// A cause at a place with its parameters, in the order of `names`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Cause {
    pub(crate) kind: Kind,
    pub(crate) place: Place,
    pub(crate) p: [f64; 4],
}

/// Share by which each draw brings a limit closer, or makes a supply stiffer, than the one before.
const CLOSER: f64 = 0.1;

impl Cause {
    /// The same, a limit so many times closer to the middle, or a supply so many times stiffer: a motion may be smaller than the
    /// machine's range, and a command, or its rate, than the typical one.
    pub(crate) fn closer(mut self, system: &System, times: u64) -> Self {
        use Kind::*;
        let (limits, middle) = match (self.kind, self.place) {
            (Saturation, Place::Input(i)) => (2, system.inputs[i].rest),
            (EndStop | EndStopLow | QuadraticStop | SupplySag | RateLimit, _) => (1, 0.0),
            (SensorSaturation, _) => (2, 0.0),
            _ => (0, 0.0),
        };
        let share = (1.0 - CLOSER).powi(times as i32);
        self.p.iter_mut().take(limits).for_each(|p| *p = middle + share * (*p - middle));
        self
    }
}

pub(crate) const INPUT: &[Kind] = {
    use Kind::*;
    &[
        DelayIn, JitterIn, DropsIn, SkewIn, Gain, Lag, Offset, Saturation, Deadband, RateLimit, Backlash,
        SupplySag,
    ]
};
pub(crate) const OUTPUT: &[Kind] = {
    use Kind::*;
    &[
        DelayOut,
        JitterOut,
        DropsOut,
        SkewOut,
        Bias,
        Scale,
        Noise,
        Quantization,
        SensorLag,
        Drift,
        Outliers,
        SensorSaturation,
        Stuck,
    ]
};
pub(crate) const JOINT: &[Kind] = {
    use Kind::*;
    &[
        Viscous,
        Coulomb,
        Stribeck,
        LoadFriction,
        Asymmetric,
        Drag,
        Cogging,
        Inertia,
        Payload,
        Tilt,
        Spring,
        Flexibility,
        ConstantForce,
        EndStop,
        EndStopLow,
        Wind,
        Periodic,
    ]
};

impl Kind {
    /// The family's name in the table of effects, the form, and the names of the parameters.
    #[rustfmt::skip]
    pub(crate) fn names(self) -> (&'static str, &'static str, &'static [&'static str]) {
        use Kind::*;
        match self {
            DelayIn | DelayOut => ("delay", "constant", &["delay"]),
            JitterIn | JitterOut => ("jitter", "half-normal", &["spread"]),
            DropsIn | DropsOut => ("drops", "independent", &["rate"]),
            SkewIn | SkewOut => ("clock_skew", "constant", &["skew"]),
            Gain => ("gain", "linear", &["gain"]),
            Lag => ("lag", "first order", &["time_constant"]),
            Offset => ("offset", "constant", &["offset"]),
            Saturation => ("saturation", "hard", &["low", "high"]),
            Deadband => ("deadband", "hard", &["width"]),
            RateLimit => ("rate_limit", "hard", &["rate"]),
            Backlash => ("backlash", "play", &["gap"]),
            SupplySag => ("supply_sag", "by load", &["coefficient"]),
            Viscous => ("viscous", "linear", &["coefficient"]),
            Coulomb => ("coulomb", "stick-slip", &["force"]),
            Stribeck => ("stribeck", "gaussian stick-slip", &["coulomb", "extra", "stribeck_speed"]),
            LoadFriction => ("load_friction", "stick-slip", &["ratio"]),
            Asymmetric => ("asymmetric_friction", "stick-slip", &["forward", "backward"]),
            Drag => ("quadratic_drag", "quadratic", &["coefficient"]),
            Cogging => ("cogging", "sine", &["amplitude", "wavenumber", "phase"]),
            Inertia => ("inertia", "added", &["added"]),
            Payload => ("payload", "added", &["mass"]),
            Tilt => ("gravity_tilt", "constant", &["angle"]),
            Spring => ("spring", "linear", &["stiffness", "rest"]),
            Flexibility => ("flexibility", "two masses", &["stiffness", "damping", "ratio"]),
            ConstantForce => ("constant_force", "constant", &["force"]),
            EndStop => ("end_stop", "linear", &["limit", "stiffness"]),
            EndStopLow => ("end_stop", "linear", &["lower_limit", "stiffness"]),
            Parameter => ("parameter", "constant", &["value"]),
            Wind => ("wind", "constant force", &["force"]),
            Periodic => ("periodic_disturbance", "sine", &["amplitude", "frequency", "phase"]),
            Bias => ("bias", "constant", &["bias"]),
            Scale => ("scale", "linear", &["scale"]),
            Noise => ("noise", "gaussian", &["std"]),
            Quantization => ("quantization", "rounding", &["step"]),
            SensorLag => ("sensor_lag", "first order", &["time_constant"]),
            Drift => ("drift", "linear", &["rate"]),
            Outliers => ("outliers", "gaussian", &["rate"]),
            SensorSaturation => ("sensor_saturation", "hard", &["low", "high"]),
            Stuck => ("stuck", "runs", &["rate"]),
            LagSecond => ("lag", "second order", &["time_constant", "damping"]),
            TanhSaturation => ("saturation", "tanh", &["level"]),
            SmoothDeadband => ("deadband", "smooth", &["width"]),
            StribeckFirst => ("stribeck", "exponent 1", &["coulomb", "extra", "stribeck_speed"]),
            Dahl => ("coulomb", "dahl", &["force", "deflection"]),
            LuGre => ("stribeck", "lugre", &["coulomb", "extra", "stribeck_speed", "deflection"]),
            QuadraticStop => ("end_stop", "quadratic", &["limit", "stiffness"]),
            CubicSpring => ("spring", "cubic", &["stiffness", "rest"]),
            SquarePeriodic => ("periodic_disturbance", "square", &["amplitude", "frequency", "phase"]),
            SensorLagSecond => ("sensor_lag", "second order", &["time_constant", "damping"]),
            Wall => ("wall", "mid-range", &["position", "stiffness", "from", "to"]),
            Gust => ("gust", "pulses", &["force", "at", "width"]),
            BoucWen => ("hysteresis", "bouc-wen", &["force", "deflection"]),
            VaryingFriction => ("time_varying_friction", "warming", &["force", "time"]),
            EventDelay => ("event_delay", "by size", &["delay", "threshold"]),
        }
    }

    /// Whether the opposite of the cause is one of the same kind. Friction that pushes is none.
    pub(crate) fn two_sided(self) -> bool {
        use Kind::*;
        matches!(
            self,
            SkewOut
                | Gain
                | Offset
                | Viscous
                | Cogging
                | Inertia
                | Payload
                | Tilt
                | Spring
                | ConstantForce
                | Wind
                | Periodic
                | Bias
                | Scale
                | Drift
                | Parameter
        )
    }

    /// Causes that change how readings or stamps scatter, not what they are on average.
    pub(crate) fn statistical(self) -> bool {
        use Kind::*;
        matches!(self, Noise | Quantization | Outliers | Stuck | JitterIn | JitterOut | DropsIn | DropsOut)
    }
}

fn places(system: &System, kinds: &[(&[Kind], usize)]) -> Vec<(Kind, Place)> {
    let mut all = Vec::new();
    for &(kinds, at) in kinds {
        let count =
            [system.inputs.len(), system.joints.len(), system.outputs.len(), system.parameters.len()][at];
        for i in 0..count {
            for &kind in kinds {
                let place = [Place::Input(i), Place::Joint(i), Place::Output(i), Place::Parameter(i)][at];
                let known = match place {
                    Place::Joint(i) => fits(system, kind, i),
                    // One that is calibrated may take any value.
                    Place::Parameter(i) => system.parameters[i].bounds.is_none(),
                    _ => true,
                };
                let label = label(system, kind, place);
                if known && !system.absorbed.contains(&label.as_str()) {
                    all.push((kind, place));
                }
            }
        }
    }
    all
}

fn fits(system: &System, kind: Kind, joint: usize) -> bool {
    let j = &system.joints[joint];
    match kind {
        Kind::LoadFriction => j.geared,
        Kind::Tilt => j.tilts,
        Kind::Payload => !matches!(j.payload, Payload::None),
        Kind::Flexibility | Kind::Inertia => j.solid,
        Kind::Cogging => j.rotates,
        _ => true,
    }
}

/// Every effect of the table at every place, except those in the span of a calibrated parameter.
pub(crate) fn table(system: &System) -> Vec<(Kind, Place)> {
    places(system, &[(INPUT, 0), (JOINT, 1), (OUTPUT, 2), (&[Kind::Parameter], 3)])
}

/// Other forms of the table's effects.
pub(crate) fn other_forms(system: &System) -> Vec<(Kind, Place)> {
    use Kind::*;
    places(
        system,
        &[
            (&[LagSecond, TanhSaturation, SmoothDeadband], 0),
            (&[StribeckFirst, Dahl, LuGre, QuadraticStop, CubicSpring, SquarePeriodic], 1),
            (&[SensorLagSecond], 2),
        ],
    )
}

/// Causes of no table.
pub(crate) fn outside(system: &System) -> Vec<(Kind, Place)> {
    use Kind::*;
    places(system, &[(&[EventDelay], 0), (&[Wall, Gust, BoucWen, VaryingFriction], 1)])
}

/// The place as reports write it.
pub(crate) fn place_name(system: &System, place: Place) -> String {
    match place {
        Place::Input(i) => format!("input:{}", system.inputs[i].key),
        Place::Joint(i) => format!("joint:{}", system.joints[i].name),
        Place::Output(i) => format!("output:{}", system.outputs[i].name),
        Place::Parameter(i) => format!("parameter:{}", system.parameters[i].name),
    }
}

/// `name@place`.
pub(crate) fn label(system: &System, kind: Kind, place: Place) -> String {
    format!("{}@{}", kind.names().0, place_name(system, place))
}

/// The size of a typical command.
pub(crate) fn command_size(system: &System, input: usize) -> f64 {
    if system.control == Control::Axis { system.joints[0].force } else { system.inputs[input].amplitude }
}

/// The size of a typical excursion of a reading.
pub(crate) fn reading_size(system: &System, output: usize) -> f64 {
    let of = system.outputs[output].of;
    system.joints.get(of).map_or(0.08, |j| j.range)
}

/// Parameters from physical ranges; sizes are relative to what the machine's commands, forces and speeds are.
#[rustfmt::skip]
pub(crate) fn draw(system: &System, kind: Kind, place: Place, duration: f64, noise: f64, rng: &mut ChaCha8Rng) -> Cause {
    use Kind::*;
    let mut u = |low: f64, high: f64| low + (high - low) * rng.random::<f64>();
    let (a, b, c, d, sign) = (u(0.0, 1.0), u(0.0, 1.0), u(0.0, 1.0), u(0.0, 1.0), if u(0.0, 1.0) < 0.5 { -1.0 } else { 1.0 });
    let lin = |t: f64, low: f64, high: f64| low + (high - low) * t;
    let log = |t: f64, low: f64, high: f64| (low.ln() + (high / low).ln() * t).exp();
    let (size, rest) = match place {
        Place::Input(i) => (command_size(system, i), system.inputs[i].rest),
        Place::Joint(i) => (system.joints[i].force, 0.0),
        Place::Output(i) => (reading_size(system, i), 0.0),
        Place::Parameter(i) => (system.parameters[i].value, 0.0),
    };
    let (speed, range, inertia) = match place {
        Place::Joint(i) => (system.joints[i].speed, system.joints[i].range, system.joints[i].inertia),
        _ => (1.0, size, 1.0),
    };
    let p = match kind {
        DelayIn | DelayOut => [(log(a, 0.005, 0.08) * 1e4).round() / 1e4, 0.0, 0.0, 0.0],
        JitterIn | JitterOut => [log(a, 0.002, 0.012), 0.0, 0.0, 0.0],
        DropsIn | DropsOut => [log(a, 0.02, 0.2), 0.0, 0.0, 0.0],
        // A command cannot act before it was sent.
        SkewIn => [log(a, 0.0005, 0.006), 0.0, 0.0, 0.0],
        SkewOut => [sign * log(a, 0.0005, 0.006), 0.0, 0.0, 0.0],
        Gain => [if sign < 0.0 { lin(a, 0.6, 0.85) } else { lin(a, 1.15, 1.5) }, 0.0, 0.0, 0.0],
        Lag => [log(a, 0.01, 0.12), 0.0, 0.0, 0.0],
        LagSecond | SensorLagSecond => [log(a, 0.01, 0.06), lin(b, 0.3, 1.0), 0.0, 0.0],
        Offset => [sign * size * lin(a, 0.07, 0.5), 0.0, 0.0, 0.0],
        Saturation => [rest - size * lin(a, 0.7, 1.7), rest + size * lin(b, 0.7, 1.7), 0.0, 0.0],
        TanhSaturation => [size * lin(a, 1.0, 2.5), 0.0, 0.0, 0.0],
        Deadband | SmoothDeadband => [size * lin(a, 0.07, 0.5), 0.0, 0.0, 0.0],
        RateLimit => [size * log(a, 3.0, 30.0), 0.0, 0.0, 0.0],
        Backlash => [size * lin(a, 0.1, 0.8), 0.0, 0.0, 0.0],
        SupplySag => [lin(a, 0.08, 0.3) / (size + rest.abs()), 0.0, 0.0, 0.0],
        Viscous => [size / speed * log(a, 0.1, 0.8), 0.0, 0.0, 0.0],
        Coulomb => [size * log(a, 0.05, 0.5), 0.0, 0.0, 0.0],
        Stribeck | StribeckFirst => [size * lin(a, 0.05, 0.25), size * lin(b, 0.1, 0.4), speed * log(c, 0.02, 0.16), 0.0],
        LoadFriction => [lin(a, 0.05, 0.3), 0.0, 0.0, 0.0],
        Asymmetric => {
            let (large, small) = (size * lin(a, 0.12, 0.5), size * lin(b, 0.0, 0.1));
            if sign > 0.0 { [large, small, 0.0, 0.0] } else { [small, large, 0.0, 0.0] }
        }
        Drag => [size / (speed * speed) * log(a, 0.2, 2.0), 0.0, 0.0, 0.0],
        Cogging => [size * lin(a, 0.07, 0.4), lin(b, 4.0, 13.0).floor(), lin(c, -PI, PI), 0.0],
        Inertia => [inertia * lin(a, 0.2, 1.5), 0.0, 0.0, 0.0],
        Payload => match place {
            Place::Joint(i) => match system.joints[i].payload {
                crate::system::Payload::Lever(l) => [inertia / (l * l) * lin(a, 0.15, 0.6), 0.0, 0.0, 0.0],
                crate::system::Payload::Parameter(k) => [system.parameters[k].value * lin(a, 0.1, 0.5), 0.0, 0.0, 0.0],
                crate::system::Payload::None => [0.0; 4],
            },
            _ => [0.0; 4],
        },
        Tilt => [sign * lin(a, 0.03, 0.2), 0.0, 0.0, 0.0],
        Spring => [size / range * lin(a, 0.3, 1.2), range * lin(b, -0.3, 0.3), 0.0, 0.0],
        CubicSpring => [size / range.powi(3) * lin(a, 0.4, 1.6), range * lin(b, -0.3, 0.3), 0.0, 0.0],
        Flexibility => {
            let stiffness = inertia * log(a, 15.0, 55.0).powi(2);
            [stiffness, 2.0 * lin(b, 0.01, 0.08) * (stiffness * inertia).sqrt(), lin(c, 0.2, 0.6), 0.0]
        }
        ConstantForce | Wind => [sign * size * lin(a, 0.06, 0.4), 0.0, 0.0, 0.0],
        EndStop => [range * lin(a, 0.3, 0.9), size / range * log(b, 30.0, 300.0), 0.0, 0.0],
        EndStopLow => [-range * lin(a, 0.3, 0.9), size / range * log(b, 30.0, 300.0), 0.0, 0.0],
        Parameter => [size * (1.0 + sign * lin(a, 0.15, 0.4)), 0.0, 0.0, 0.0],
        QuadraticStop => [range * lin(a, 0.3, 0.8), size / (range * range) * log(b, 100.0, 1000.0), 0.0, 0.0],
        Periodic | SquarePeriodic => [size * lin(a, 0.06, 0.4), lin(b, 0.5, 6.0), lin(c, -PI, PI), 0.0],
        Bias => [sign * size * lin(a, 0.02, 0.12), 0.0, 0.0, 0.0],
        Scale => [if sign < 0.0 { lin(a, 0.8, 0.96) } else { lin(a, 1.04, 1.2) }, 0.0, 0.0, 0.0],
        Noise => [noise * lin(a, 1.5, 4.0), 0.0, 0.0, 0.0],
        Quantization => [noise * log(a, 3.0, 15.0), 0.0, 0.0, 0.0],
        SensorLag => [log(a, 0.01, 0.1), 0.0, 0.0, 0.0],
        Drift => [sign * size * lin(a, 0.002, 0.02), 0.0, 0.0, 0.0],
        Outliers => [log(a, 0.005, 0.05), 0.0, 0.0, 0.0],
        SensorSaturation => [-size * lin(a, 0.3, 0.9), size * lin(b, 0.3, 0.9), 0.0, 0.0],
        Stuck => [log(a, 0.02, 0.2), 0.0, 0.0, 0.0],
        Dahl => [size * log(a, 0.05, 0.5), range * log(b, 0.003, 0.05), 0.0, 0.0],
        LuGre => [size * lin(a, 0.05, 0.25), size * lin(b, 0.1, 0.4), speed * log(c, 0.02, 0.16), range * log(d, 0.002, 0.02)],
        Wall => [range * lin(a, -0.2, 0.4), size / range * log(b, 10.0, 60.0), duration * lin(c, 0.2, 0.4), duration * lin(d, 0.6, 0.9)],
        Gust => [sign * size * lin(a, 0.4, 1.5), duration * lin(b, 0.2, 0.8), lin(c, 0.2, 1.0), 0.0],
        BoucWen => [size * lin(a, 0.15, 0.6), range * log(b, 0.05, 0.4), 0.0, 0.0],
        VaryingFriction => [size * lin(a, 0.2, 0.7), duration * lin(b, 0.2, 0.6), 0.0, 0.0],
        EventDelay => [lin(a, 0.03, 0.12), size * lin(b, 0.3, 0.9), 0.0, 0.0],
    };
    Cause { kind, place, p }
}

/// The parameters by name.
pub(crate) fn parameters(cause: &Cause) -> BTreeMap<String, f64> {
    cause.kind.names().2.iter().zip(cause.p).map(|(n, v)| ((*n).to_owned(), v)).collect()
}

/// A uniform number in [low, high).
pub(crate) fn uniform(rng: &mut impl Rng, low: f64, high: f64) -> f64 {
    low + (high - low) * rng.random::<f64>()
}
