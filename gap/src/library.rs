//! The hypotheses a system allows: every effect at every place where it can act, and why others cannot.

use parallax_model::effect::{Effect, Place, PlaceKind, Quantity};
use parallax_model::plant::{Plant, Residual};

use crate::equations::EquationsSimulator;
use crate::hypothesis::{EffectAt, Fitted, Hypothesis, Prior, Slot};
use crate::setup::Setup;

/// An effect that this system or this log cannot show.
#[derive(Clone, Debug, PartialEq)]
pub struct NotTestable {
    /// The effect and its place.
    pub effect: EffectAt,
    /// Why, as the end of a sentence.
    pub reason: String,
}

/// Every single effect at every place, and those that cannot be tested.
#[must_use]
pub fn candidates(setup: &Setup) -> (Vec<EffectAt>, Vec<NotTestable>) {
    let system = setup.equations.system();
    let mut found = Vec::new();
    let mut not = Vec::new();
    for effect in Effect::ALL {
        for kind in effect.places() {
            let keys: Vec<String> = match kind {
                PlaceKind::Input => system.inputs.iter().map(|i| i.name.clone()).collect(),
                PlaceKind::Output => system.outputs.iter().map(|o| o.name.clone()).collect(),
                PlaceKind::Joint => system.joints.iter().map(|j| j.name.clone()).collect(),
                PlaceKind::Parameter => system
                    .parameters
                    .iter()
                    .filter(|p| p.calibrate.is_none())
                    .map(|p| p.name.clone())
                    .collect(),
                PlaceKind::State | PlaceKind::Connection | PlaceKind::Node => Vec::new(),
            };
            for (index, key) in keys.into_iter().enumerate() {
                let at = EffectAt { effect, place: Place::new(*kind, key) };
                match testable(setup, *kind, index) {
                    Ok(()) => found.push(at),
                    Err(reason) => not.push(NotTestable { effect: at, reason }),
                }
            }
        }
    }
    (found, not)
}

fn testable(setup: &Setup, kind: PlaceKind, index: usize) -> Result<(), String> {
    match kind {
        PlaceKind::Input => {
            let range = &setup.input_range[index];
            if range.high > range.low { Ok(()) } else { Err("the command never changes in this log".into()) }
        }
        PlaceKind::Joint => {
            setup.equations.system().joints[index].entry().map_err(str::to_owned)?;
            if setup.joints[index].speed > 1e-9 {
                Ok(())
            } else {
                Err("the joint never moves in this log".into())
            }
        }
        _ => Ok(()),
    }
}

/// The hypothesis with these effects, over the calibrated parameters.
#[must_use]
pub fn hypothesis(setup: &Setup, effects: &[EffectAt]) -> Hypothesis {
    let mut fitted = calibrated(setup);
    for (e, at) in effects.iter().enumerate() {
        let index = place_index(setup, &at.place).unwrap_or(0);
        if at.effect == Effect::Parameter {
            fitted.retain(|f| f.slot != Slot::Nominal(index));
            fitted.push(free_parameter(setup, index));
            continue;
        }
        for (k, spec) in at.effect.parameters().iter().enumerate() {
            let slot = Slot::Effect { effect: e, parameter: k };
            fitted.push(effect_parameter(
                setup,
                spec.name,
                spec.quantity,
                spec.signed,
                at.place.kind,
                index,
                slot,
            ));
        }
    }
    Hypothesis { effects: effects.to_vec(), fitted, residual: false }
}

/// The nominal parameters that a user lets a fit move.
fn calibrated(setup: &Setup) -> Vec<Fitted> {
    let parameters = setup.equations.system().parameters.iter().enumerate();
    parameters
        .filter_map(|(index, p)| {
            let [low, high] = p.calibrate?;
            let prior = match p.std {
                Some(std) => Prior::Normal { mean: p.value, std },
                None => Prior::Uniform { low, high },
            };
            Some(Fitted {
                slot: Slot::Nominal(index),
                name: p.name.clone(),
                unit: p.unit.clone(),
                null: p.value,
                prior,
                low,
                high,
                scale: p.std.unwrap_or((0.1 * p.value.abs()).max(0.02 * (high - low)).min(high - low)),
                starts: Vec::new(),
            })
        })
        .collect()
}

/// A parameter that is held nominal, let free: how far off it may be is taken as a third of its value.
fn free_parameter(setup: &Setup, index: usize) -> Fitted {
    let p = &setup.equations.system().parameters[index];
    let size = if p.value == 0.0 { 1.0 } else { p.value.abs() };
    // A parameter that is positive by nature stays so.
    let (low, high) = if p.value > 0.0 { (1e-3 * p.value, 20.0 * size) } else { (-20.0 * size, 20.0 * size) };
    Fitted {
        slot: Slot::Nominal(index),
        name: "value".into(),
        unit: p.unit.clone(),
        null: p.value,
        prior: Prior::Normal { mean: p.value, std: 0.3 * size },
        low,
        high,
        scale: 0.1 * size,
        starts: vec![p.value],
    }
}

fn effect_parameter(
    setup: &Setup,
    name: &str,
    quantity: Quantity,
    signed: bool,
    kind: PlaceKind,
    index: usize,
    slot: Slot,
) -> Fitted {
    let system = setup.equations.system();
    let span = setup.experiment.span();
    let mut fitted = Fitted {
        slot,
        name: name.into(),
        unit: String::new(),
        null: 0.0,
        prior: Prior::Uniform { low: 0.0, high: 1.0 },
        low: 0.0,
        high: f64::INFINITY,
        scale: 1.0,
        starts: Vec::new(),
    };
    let sized = |fitted: &mut Fitted, size: f64, starts: &[f64]| {
        fitted.scale = 0.2 * size;
        fitted.low = if signed { -20.0 * size } else { 0.0 };
        fitted.high = 20.0 * size;
        fitted.prior =
            if signed { Prior::Normal { mean: 0.0, std: size } } else { Prior::HalfNormal { std: size } };
        fitted.starts = starts.iter().map(|s| s * size).collect();
    };
    match quantity {
        Quantity::Time => {
            // A robot's delays are tens of milliseconds; a slow process' are a few of its samples.
            let size = (5.0 * setup.period).max(0.05);
            sized(&mut fitted, size, &[0.1, 0.5, 1.5]);
            fitted.high = (6.0 * size).min(0.25 * (span.1 - span.0));
            fitted.unit = "s".into();
        }
        Quantity::Input => {
            let range = &setup.input_range[index];
            sized(&mut fitted, 0.5 * range.std.max(1e-12), &[0.1, 0.8]);
        }
        Quantity::InputLow | Quantity::InputHigh => {
            let range = &setup.input_range[index];
            let middle = 0.5 * (range.low + range.high);
            let upper = quantity == Quantity::InputHigh;
            let (low, high) = if upper { (middle, range.high) } else { (range.low, middle) };
            fitted.null = if upper { range.high } else { range.low };
            (fitted.low, fitted.high) = (low, high);
            fitted.prior = Prior::Uniform { low, high };
            fitted.scale = 0.1 * (high - low);
            fitted.starts =
                [0.05, 0.3, 0.6].iter().map(|s| fitted.null + s * (middle - fitted.null)).collect();
        }
        Quantity::Force => sized(&mut fitted, 0.5 * setup.joints[index].force, &[0.05, 0.4]),
        Quantity::ForcePerSpeed => {
            let joint = &setup.joints[index];
            sized(&mut fitted, 0.5 * joint.force / joint.speed, &[0.0, 0.3]);
        }
        Quantity::Output => {
            sized(&mut fitted, 0.3 * setup.output_scale[index].max(setup.output_noise[index]), &[0.0]);
            fitted.unit = system.outputs[index].unit.clone();
        }
        Quantity::Parameter => {}
    }
    match kind {
        PlaceKind::Joint => {
            let [force, per_speed] = joint_units(setup, index);
            fitted.unit = if quantity == Quantity::ForcePerSpeed { per_speed } else { force }.into();
        }
        PlaceKind::Input if quantity != Quantity::Time => {
            fitted.unit = setup.experiment.input_units.get(index).cloned().unwrap_or_default();
        }
        _ => {}
    }
    fitted
}

/// Units of a joint's force and of force per speed, from the unit in which its position is read; units are labels, so
/// where no output reads the position there is none.
fn joint_units(setup: &Setup, joint: usize) -> [&'static str; 2] {
    let system = setup.equations.system();
    let position = system.joints[joint].position.text().trim();
    let unit = system.outputs.iter().find(|o| o.value.text().trim() == position).map(|o| o.unit.as_str());
    match unit {
        Some("rad") => ["N m", "N m s/rad"],
        Some("m") => ["N", "N s/m"],
        _ => ["", ""],
    }
}

/// Index of a place among the system's inputs, outputs, joints, states or parameters.
#[must_use]
pub fn place_index(setup: &Setup, place: &Place) -> Option<usize> {
    let system = setup.equations.system();
    let key = place.key.as_str();
    match place.kind {
        PlaceKind::Input => system.inputs.iter().position(|i| i.name == key),
        PlaceKind::Output => system.outputs.iter().position(|o| o.name == key),
        PlaceKind::Joint => system.joints.iter().position(|j| j.name == key),
        PlaceKind::State => system.states.iter().position(|s| s.name == key),
        PlaceKind::Parameter => system.parameters.iter().position(|p| p.name == key),
        PlaceKind::Connection | PlaceKind::Node => None,
    }
}

/// The simulator of a hypothesis.
#[must_use]
pub fn simulator<'a>(
    setup: &'a Setup,
    hypothesis: &Hypothesis,
    residuals: Vec<Residual>,
) -> EquationsSimulator<'a> {
    let mut effects = Vec::new();
    for at in &hypothesis.effects {
        effects.push((at.effect, at.place.kind, place_index(setup, &at.place).unwrap_or(0)));
    }
    let smoothing = setup.joints.iter().map(|j| j.smoothing).collect();
    let plant = Plant::new(setup.equations.clone(), &effects, residuals, smoothing);
    let slots = hypothesis.fitted.iter().map(|f| f.slot).collect();
    EquationsSimulator::new(plant, slots, &setup.experiment, setup.step)
}
