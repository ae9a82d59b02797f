//! What is believed of an effect's parameters before the fit: prior, bounds, natural size and starts, from the ranges
//! of the log and from what machines are like.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use parallax_model::effect::{Effect, EffectParameter, PlaceKind, Quantity};

use super::testable::LARGEST_SKEW;
use crate::hypothesis::{EffectAt, Fitted, Prior, Slot};
use crate::limit::limit;
use crate::setup::{JointScale, Range, Setup};
use crate::statistics::{median, quantile};

/// Waves over the range of a joint, at least, for a force to be said to repeat: less of one is an arc, as any spring has.
const LEAST_WAVES: f64 = 1.0;

/// Readings of a contact with a hard stop.
const CONTACT: f64 = 4.0;

/// The entry of θ for one parameter of an effect at the place of this index.
pub(super) fn fitted(
    setup: &Setup,
    at: &EffectAt,
    index: usize,
    spec: &EffectParameter,
    slot: Slot,
) -> Fitted {
    let mut fitted = Fitted {
        slot,
        name: spec.name.into(),
        unit: unit(setup, at.place.kind, index, spec.quantity),
        null: spec.null,
        prior: Prior::Uniform { low: 0.0, high: 1.0 },
        low: spec.low,
        high: spec.high,
        scale: 1.0,
        starts: Vec::new(),
    };
    size(setup, at, index, spec, &mut fitted);
    fitted
}

/// A normal prior around the null value, one-sided where the parameter cannot be negative, bounds at twenty times its
/// size within the physical range, and starts in units of it.
fn sized(fitted: &mut Fitted, size: f64, starts: &[f64]) {
    let null = if fitted.null.is_finite() { fitted.null } else { 0.0 };
    let one_sided = fitted.low >= 0.0 && null == 0.0;
    fitted.scale = 0.2 * size;
    fitted.prior =
        if one_sided { Prior::HalfNormal { std: size } } else { Prior::Normal { mean: null, std: size } };
    fitted.low = fitted.low.max(null - 20.0 * size);
    fitted.high = fitted.high.min(null + 20.0 * size);
    fitted.starts = starts.iter().map(|s| null + s * size).collect();
}

/// A flat prior between bounds.
fn flat(fitted: &mut Fitted, low: f64, high: f64, starts: Vec<f64>) {
    (fitted.low, fitted.high) = (low, high);
    fitted.prior = Prior::Uniform { low, high };
    fitted.scale = 0.1 * (high - low);
    fitted.starts = starts;
}

fn size(setup: &Setup, at: &EffectAt, index: usize, spec: &EffectParameter, fitted: &mut Fitted) {
    use Quantity as Q;
    match spec.quantity {
        Q::Time => {
            // A robot's delays are tens of milliseconds; a slow process' are a few of its samples.
            let (from, to) = setup.experiment.span();
            let size = (5.0 * setup.period).max(0.05);
            fitted.low = 0.0;
            sized(fitted, size, &[0.1, 0.5, 1.5]);
            fitted.high = (6.0 * size).min(0.25 * (to - from));
            let system = setup.equations.system();
            let shown = || (0..system.outputs.len()).any(|output| system.shows(output, index));
            if (at.effect, at.place.kind) == (Effect::Delay, PlaceKind::Input) && !shown() {
                // A smooth command acts half a period before its samples, where they are held, and one that is stamped when it is
                // logged up to a whole one. Where a reading shows the command, that would be the order of the two in the log.
                let ahead = setup.experiment.inputs[index].period().max(0.0);
                fitted.low = -ahead;
                fitted.starts.push(-0.5 * ahead);
            }
        }
        Q::Damping => {
            fitted.prior = Prior::Normal { mean: 0.8, std: 0.4 };
            (fitted.scale, fitted.starts) = (0.2, vec![0.7]);
        }
        Q::Ratio if at.effect == Effect::ClockSkew => {
            sized(fitted, 0.3 * LARGEST_SKEW, &[0.0]);
            (fitted.low, fitted.high) = (-2.0 * LARGEST_SKEW, 2.0 * LARGEST_SKEW);
        }
        Q::Ratio => {
            // An angle that turns many times compares with its reading only up to whole turns: a start must be near.
            let wraps = at.place.kind == PlaceKind::Output && setup.experiment.wraps[index].is_some();
            sized(fitted, 0.3, if wraps { &[0.0, 0.3, -0.3, 0.6, -0.6] } else { &[0.0] });
            // Or something is wired, or counted, the other way round.
            fitted.prior = Prior::EitherSign { mean: 1.0, std: 0.3 };
            fitted.starts.push(-1.0);
            fitted.low = -3.0;
        }
        Q::Exponent => sized(fitted, 1.5, &[0.0]),
        Q::Share => sized(fitted, 0.05, &[0.2]),
        Q::LoadShare => sized(fitted, 0.2, &[0.1, 0.7]),
        // All of it, where both states are of one unit.
        Q::Overflow => sized(fitted, 1.0, &[0.5]),
        Q::Level | Q::LevelRate | Q::PerLevel | Q::Low | Q::High => level(setup, at, index, spec, fitted),
        Q::Reading => sized(fitted, 0.3 * reading(setup, index), &[0.0]),
        Q::ReadingRate => {
            let (from, to) = setup.experiment.span();
            sized(fitted, 0.3 * reading(setup, index) / (to - from).max(1e-9), &[0.0]);
        }
        Q::Parameter => {}
        _ => joint(setup, index, at.effect, spec.quantity, fitted),
    }
}

/// Natural size of an output's readings: their deviation; where that is no more than the noise, because the machine rests, which says
/// nothing of how far they go, what they read.
fn reading(setup: &Setup, output: usize) -> f64 {
    let (scale, noise) = (setup.output_scale[output], setup.output_noise[output]);
    let level = if scale < noise { setup.output_range[output].middle().abs() } else { 0.0 };
    scale.max(noise).max(level)
}

/// Parameters in the unit of a command, a state or a reading.
fn level(setup: &Setup, at: &EffectAt, index: usize, spec: &EffectParameter, fitted: &mut Fitted) {
    let range: &Range = match at.place.kind {
        PlaceKind::State => &setup.state_range[index],
        PlaceKind::Output => &setup.output_range[index],
        _ => &setup.input_range[index],
    };
    match spec.quantity {
        Quantity::Low | Quantity::High => {
            let upper = spec.quantity == Quantity::High;
            let end = if upper { range.high } else { range.low };
            fitted.null = end;
            // Where to start and how far to go, in shares of half the range.
            let (shares, farthest): (&[f64], f64) = match at.place.kind {
                // A command may be far above what the machine can do.
                PlaceKind::Input => (&[0.05, 0.3, 0.6, 0.9], 1.0),
                // Nobody saw the state go there: without the limit it is believed to go far beyond.
                PlaceKind::State if !setup.is_shown(index) => (&[0.05, 0.3, 0.6, 1.0, 1.4], 1.8),
                _ => (&[0.05, 0.3, 0.6], 1.0),
            };
            let at_share = |share: &f64| end + share * (range.middle() - end);
            let mut starts: Vec<f64> = shares.iter().map(at_share).collect();
            let mut bound = at_share(&farthest);
            if at.place.kind == PlaceKind::Input {
                // A few kicks one way put the middle where the command hardly ever is.
                let usual = median(&mut setup.experiment.inputs[index].values.clone());
                let inner = if upper { usual.min(bound) } else { usual.max(bound) };
                if (inner - bound).abs() > ONE_SIDED * range.width() {
                    starts.push(end + 0.9 * (inner - end));
                    bound = inner;
                }
            }
            flat(fitted, bound.min(end), bound.max(end), starts);
            if at.place.kind == PlaceKind::Output {
                // Readings rest at a limit: it is nowhere else. Where the eye sees none, noise has the extreme beyond it.
                let (_, readings) = setup.experiment.output(index);
                let noise = setup.output_noise[index];
                let limit = limit(&readings, noise, upper);
                (fitted.low, fitted.high) = (limit.low, limit.high);
                let below = if upper { end - EXTREME * noise } else { end + EXTREME * noise };
                fitted.starts = vec![limit.level.unwrap_or(below)];
            }
        }
        Quantity::Level if at.effect == Effect::SaturationSoft => {
            sized(fitted, 0.15 * range.width().max(1e-12), &[0.3]);
        }
        Quantity::LevelRate => {
            let (top, largest) = fastest(setup, index);
            // A command in steps is faster than any machine: one that takes seconds for its whole range is limited too.
            let slow = range.width() / SLOW;
            let starts = [0.5 * top, 0.2 * top, 0.06 * top, 10.0 * slow, slow];
            let starts = starts.into_iter().filter(|rate| *rate < top);
            let low = (0.005 * top).min(0.1 * slow);
            // One that is faster than every change still takes a part of the period for a step.
            flat(fitted, low, 4.0 * largest, starts.chain([0.5 * largest, 2.0 * largest]).collect());
            fitted.scale = 0.1 * (2.0 * top - low);
            // Beyond any change in the log; an infinity has no place in a list of numbers.
            fitted.null = 1e6 * top;
        }
        Quantity::PerLevel => {
            let largest = range.low.abs().max(range.high.abs()).max(1e-12);
            sized(fitted, 0.2 / largest, &[0.0]);
            fitted.high = 0.9 / largest;
        }
        // Play wider than the command's range holds what moves where it is.
        _ if at.effect == Effect::Backlash => {
            let size = 0.5 * range.std.max(1e-12);
            sized(fitted, size, &[0.1, 0.8, 1.5 * range.width() / size]);
        }
        _ if at.effect == Effect::Offset => sized(fitted, 0.5 * range.std.max(1e-12), &[0.1]),
        _ => sized(fitted, 0.5 * range.std.max(1e-12), &[0.1, 0.8]),
    }
}

/// Share of a command's range by which what it usually is lies off the middle where it goes far one way only.
const ONE_SIDED: f64 = 0.1;

/// Standard deviations of noise by which the extreme of some hundred readings at a limit lies beyond it.
const EXTREME: f64 = 2.5;

/// The fastest change of a command that is not rare, the 98th percentile of those that change at all, and the fastest of all.
fn fastest(setup: &Setup, input: usize) -> (f64, f64) {
    let held = &setup.experiment.inputs[input];
    let steps = held.times.windows(2).zip(held.values.windows(2));
    let mut rates: Vec<f64> = steps
        .map(|(t, v)| ((v[1] - v[0]) / (t[1] - t[0]).max(1e-9)).abs())
        .filter(|rate| *rate > 0.0)
        .collect();
    if rates.is_empty() {
        return (1.0, 1.0);
    }
    let top = quantile(&mut rates, 0.98).max(1e-12);
    (top, rates.iter().copied().fold(top, f64::max))
}

/// Turns that a phase may go either way.
const ROUND: f64 = 20.0;

/// How long a slow machine takes for the whole range of a command (s).
const SLOW: f64 = 5.0;

/// Parameters in units of a joint's motion.
fn joint(setup: &Setup, index: usize, effect: Effect, quantity: Quantity, fitted: &mut Fitted) {
    use Quantity as Q;
    let scale = &setup.joints[index];
    let (force, speed) = (scale.force, scale.speed);
    let width = scale.position.width().max(1e-12);
    match quantity {
        Q::Force => match effect {
            Effect::Cogging | Effect::PeriodicDisturbance => sized(fitted, 0.5 * force, &[0.2]),
            Effect::ConstantForce | Effect::Wind => sized(fitted, 0.5 * force, &[0.0]),
            Effect::Stribeck => sized(fitted, 0.5 * force, &[0.05, 0.2]),
            _ => sized(fitted, 0.5 * force, &[0.05, 0.4]),
        },
        Q::ForcePerSpeed if effect == Effect::AsymmetricViscous => {
            sized(fitted, 0.5 * force / speed, &[0.01, 0.3]);
        }
        Q::ForcePerSpeed => sized(fitted, 0.5 * force / speed, &[0.0, 0.3]),
        Q::ForcePerSpeedSquared => sized(fitted, 0.5 * force / (speed * speed), &[0.0, 0.3]),
        Q::StribeckSpeed => {
            let low = (3.0 * scale.smoothing).max(0.01 * speed);
            let high = (2.0 * speed).max(2.0 * low);
            fitted.null = high;
            flat(fitted, low, high, [0.1, 0.5].map(|s| (s * speed).clamp(low, high)).to_vec());
        }
        Q::Wavenumber => {
            let (low, high) = (LEAST_WAVES * TAU / width, (64.0 * TAU / width).max(48.0));
            let mut starts: Vec<f64> = scale.wavenumbers.iter().copied().filter(|w| *w >= low).collect();
            if starts.is_empty() {
                starts.push(TAU / width);
            }
            fitted.null = starts[0];
            flat(fitted, low, high, starts);
            fitted.scale = 0.2 * PI / width;
        }
        Q::Frequency => {
            let (from, to) = setup.experiment.span();
            let mut starts = setup.frequencies.clone();
            if starts.is_empty() {
                starts.push(4.0 / (to - from).max(1e-9));
            }
            fitted.null = starts[0];
            // Less than two periods in the log is a trend.
            flat(fitted, 2.0 / (to - from).max(1e-9), 0.5 / setup.period, starts);
            fitted.scale = 0.1 / (to - from).max(1e-9);
        }
        Q::Phase => {
            fitted.prior = Prior::Uniform { low: -PI, high: PI };
            // A search may go round some times while it finds the wave's length.
            (fitted.low, fitted.high) = (-ROUND * TAU, ROUND * TAU);
            (fitted.scale, fitted.starts) = (0.3, vec![0.0]);
        }
        Q::Inertia => sized(fitted, 0.3 * scale.inertia, &[0.0, 0.5]),
        Q::Mass => {
            let size = 0.3 * mass(setup, index);
            sized(fitted, size, &[0.0]);
            fitted.low = -0.9 * size / 0.3;
        }
        Q::Angle => {
            sized(fitted, 0.15, &[0.0]);
            (fitted.low, fitted.high) = (-FRAC_PI_2, FRAC_PI_2);
        }
        Q::Stiffness => sized(fitted, 0.5 * force / width, &[0.05, 0.4]),
        Q::Presliding => {
            sized(fitted, 0.02 * width, &[0.1, 1.0]);
            // What builds up over a good part of the way is a spring.
            (fitted.low, fitted.high) = (1e-6 * width, 0.1 * width);
        }
        Q::CubicStiffness => sized(fitted, 2.0 * force / width.powi(3), &[0.2, 2.0]),
        Q::Position => {
            fitted.prior = Prior::Normal { mean: scale.position.middle(), std: width };
            let (middle, reach) = (scale.position.middle(), 10.0 * width);
            (fitted.low, fitted.high) = (middle - reach, middle + reach);
            (fitted.scale, fitted.starts) = (0.2 * width, vec![middle]);
        }
        Q::FlexibleStiffness | Q::FlexibleDamping | Q::FarShare => flexible(setup, scale, quantity, fitted),
        Q::UpperStop | Q::LowerStop => {
            let upper = quantity == Q::UpperStop;
            let (low, high) = if upper {
                (scale.position.middle(), scale.position.high)
            } else {
                (scale.position.low, scale.position.middle())
            };
            fitted.null = if upper { high } else { low };
            let starts = [0.1, 0.4].map(|s| fitted.null + s * (scale.position.middle() - fitted.null));
            flat(fitted, low, high, starts.to_vec());
        }
        Q::StopStiffness => {
            // A stop may be as stiff as an integration step can follow, and as soft as what drives the joint. One that is hit is left
            // within some readings, π √(J/k).
            let stiffest = scale.inertia / (setup.step * setup.step);
            let soft = (20.0 * force / width).min(0.5 * stiffest);
            let hard = (scale.inertia * (PI / (CONTACT * setup.period)).powi(2)).min(0.5 * stiffest);
            let size = soft.max(hard);
            sized(fitted, size, &[0.2 * soft / size, 0.2 * hard / size]);
            fitted.high = stiffest;
        }
        Q::AirSpeed => sized(fitted, speed, &[0.0]),
        _ => {}
    }
}

/// The mass that a joint carries, from its inertia and its lever; one kilogram where neither says.
fn mass(setup: &Setup, joint: usize) -> f64 {
    let system = setup.equations.system();
    let nominal = setup.equations.nominal();
    let zeros = vec![0.0; system.states.len()];
    let inputs = vec![0.0; system.inputs.len()];
    let point =
        parallax_model::system::Point { parameters: &nominal, states: &zeros, inputs: &inputs, time: 0.0 };
    let lets = setup.equations.lets(&point, &[]);
    match setup.equations.joint(joint, &point, &lets).lever {
        Some(lever) if lever.abs() > 0.0 && system.joints[joint].payload.is_empty() => {
            setup.joints[joint].inertia / (lever * lever)
        }
        _ => {
            // A payload's mapping moves parameters; a mass that doubles the most sensitive of them is large.
            let heavier = setup.equations.loaded(joint, &nominal, 1.0);
            let relative = heavier.iter().zip(&nominal).map(|(a, b)| (a - b).abs() / b.abs().max(1e-9));
            let most = relative.fold(0.0, f64::max);
            if most > 0.0 { 1.0 / most } else { 1.0 }
        }
    }
}

/// Natural size of a spring's deflection and of its rate, for one that swings in the middle of what can be seen, or a softer one of the
/// stated stiffness: no further than the joint goes.
pub(super) fn deflection(setup: &Setup, joint: usize, stated: Option<f64>) -> (f64, f64) {
    let scale = &setup.joints[joint];
    let highest = HIGHEST / setup.period;
    if let Some(line) = ringing(setup, scale, highest).filter(|_| stated.is_none()) {
        return (scale.speed / (TAU * line), scale.speed);
    }
    let turns = TAU * 0.3 * highest;
    // Of equal halves of the inertia.
    let usual = turns * turns * scale.inertia * 0.25;
    let range = scale.position.width();
    let softest = if range > 0.0 { scale.force / range } else { usual };
    let stiffness = stated.map_or(usual, |stated| stated.max(softest).min(usual));
    let size = scale.force / stiffness;
    (0.5 * size, 0.2 * size * turns * (stiffness / usual).sqrt())
}

/// The strongest line (Hz) of what the model leaves of a joint that swings to and fro faster than what drives it could have it do as a
/// whole: a part of it rings, and a spring bends about as far as the joint goes.
fn ringing(setup: &Setup, scale: &JointScale, highest: f64) -> Option<f64> {
    let line = setup.frequencies.first().copied()?;
    // Amplitude and speed of a swing give how often it turns.
    let range = scale.position.width();
    let turns = 8.0_f64.sqrt() * scale.speed / range;
    let rings = range > 0.0 && scale.inertia * scale.speed * turns > scale.force;
    (rings && (LOWEST * highest..0.3 * highest).contains(&line)).then_some(line)
}

/// Share of the highest frequency of a spring inside a joint below which none is looked for.
const LOWEST: f64 = 0.02;

/// Highest frequency of a spring inside a joint that readings show, in their own frequency.
const HIGHEST: f64 = 0.35;

/// Lines of what the model leaves, the strongest first, at which a spring is tried beside the usual frequencies.
const LINES: usize = 2;

/// A spring inside a joint, by the frequency at which equal halves of the joint would swing against each other. Where a loop is closed
/// over a soft one it rings, and that is far from any other start.
fn flexible(setup: &Setup, scale: &JointScale, quantity: Quantity, fitted: &mut Fitted) {
    let highest = HIGHEST / setup.period;
    let lowest = LOWEST * highest;
    let stiffness = |hertz: f64| (TAU * hertz).powi(2) * scale.inertia * 0.25;
    let lines = setup.frequencies.iter().copied().filter(|line| (lowest..highest).contains(line));
    let hertz: Vec<f64> =
        [0.12, 0.3, 0.7].into_iter().map(|share| share * highest).chain(lines.take(LINES)).collect();
    match quantity {
        Quantity::FlexibleStiffness => {
            let (low, high) = (stiffness(lowest), stiffness(highest));
            flat(fitted, low, high, hertz.iter().copied().map(stiffness).collect());
            fitted.null = high;
            fitted.scale = 0.2 * stiffness(hertz[0]);
        }
        Quantity::FlexibleDamping => {
            // Two ζ √(k J/4), with ζ of a tenth.
            let damping = |hertz: f64| 0.2 * (stiffness(hertz) * 0.25 * scale.inertia).sqrt();
            sized(fitted, 3.0 * damping(hertz[1]), &[0.0]);
            fitted.starts = hertz.iter().copied().map(damping).collect();
        }
        _ => {
            flat(fitted, 0.0, 0.998, vec![0.3]);
        }
    }
}

/// The label of a parameter's unit; empty where it has none or none is known.
fn unit(setup: &Setup, kind: PlaceKind, index: usize, quantity: Quantity) -> String {
    use Quantity as Q;
    let system = setup.equations.system();
    let own = match kind {
        PlaceKind::Input => setup.experiment.input_units.get(index).cloned().unwrap_or_default(),
        PlaceKind::Output => system.outputs[index].unit.clone(),
        PlaceKind::State => {
            let shown = system.shown_as(&system.states[index].name);
            shown.map(|output| system.outputs[output].unit.clone()).unwrap_or_default()
        }
        PlaceKind::Parameter => system.parameters[index].unit.clone(),
        _ => String::new(),
    };
    let per = |unit: &str| if unit.is_empty() { String::new() } else { format!("{unit}/s") };
    match quantity {
        Q::Time => "s".into(),
        Q::Phase | Q::Angle => "rad".into(),
        Q::Mass => "kg".into(),
        Q::Frequency => "Hz".into(),
        Q::Level | Q::Low | Q::High | Q::Reading | Q::Parameter => own,
        Q::LevelRate | Q::ReadingRate => per(&own),
        Q::PerLevel if !own.is_empty() => format!("1/{own}"),
        Q::PerLevel
        | Q::Ratio
        | Q::Share
        | Q::Overflow
        | Q::Damping
        | Q::Exponent
        | Q::LoadShare
        | Q::FarShare
        | Q::AirSpeed => String::new(),
        _ => joint_unit(setup, index, quantity).into(),
    }
}

/// Units of a joint's quantities, from the unit in which its position is read; units are labels, so where no output
/// reads the position there is none.
fn joint_unit(setup: &Setup, joint: usize, quantity: Quantity) -> &'static str {
    use Quantity as Q;
    let system = setup.equations.system();
    let position = system.joints[joint].position.text().trim();
    let read = system.shown_as(position).map(|output| system.outputs[output].unit.as_str());
    let [rotating, sliding] = match quantity {
        Q::Force => ["N m", "N"],
        Q::ForcePerSpeed | Q::FlexibleDamping => ["N m s/rad", "N s/m"],
        Q::ForcePerSpeedSquared => ["N m s^2/rad^2", "N s^2/m^2"],
        Q::StribeckSpeed => ["rad/s", "m/s"],
        Q::Wavenumber => ["1/rad", "rad/m"],
        Q::Inertia => ["kg m^2", "kg"],
        Q::CubicStiffness => ["N m/rad^3", "N/m^3"],
        Q::Stiffness | Q::StopStiffness | Q::FlexibleStiffness => ["N m/rad", "N/m"],
        Q::Position | Q::Presliding | Q::UpperStop | Q::LowerStop => ["rad", "m"],
        _ => ["", ""],
    };
    match read {
        Some("rad") => rotating,
        Some("m") => sliding,
        _ => "",
    }
}
