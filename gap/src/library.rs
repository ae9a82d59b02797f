//! The hypotheses a system allows: every effect at every place where it can act, and why others cannot.

mod one_clock;
mod possible;
mod sizes;
mod testable;

use parallax_model::effect::{Effect, Place, PlaceKind};
use parallax_model::plant::{ExtraState, Plant, Residual};
use parallax_model::system::{OwnParameter, StatedEffect, System};

use crate::equations::EquationsSimulator;
use crate::hypothesis::{EffectAt, Fitted, Hypothesis, Prior, Slot};
use crate::setup::Setup;

pub use possible::is_possible;

/// An effect that this system or this log cannot show.
#[derive(Clone, Debug, PartialEq)]
pub struct NotTestable {
    /// The effect and its place.
    pub effect: EffectAt,
    /// Why, as the end of a sentence.
    pub reason: String,
}

/// Every single effect at every place that changes predictions, each form as one entry, and those that cannot be
/// tested. What leaves predictions as they are is listed by [`statistical`].
///
/// Where no form of an effect can be tested at a place, the reason is the first form's.
#[must_use]
pub fn candidates(setup: &Setup) -> (Vec<EffectAt>, Vec<NotTestable>) {
    let mut found: Vec<EffectAt> = Vec::new();
    let mut not: Vec<NotTestable> = Vec::new();
    for (at, index) in everywhere(setup, |effect| !effect.statistical()) {
        match testable::testable(setup, &at, index) {
            Ok(()) => found.push(at),
            Err(reason) => not.push(NotTestable { effect: at, reason }),
        }
    }
    let mut seen = std::collections::BTreeSet::new();
    not.retain(|n| !found.iter().any(|f| f.label() == n.effect.label()) && seen.insert(n.effect.label()));
    (found, not)
}

/// The effects that leave the mean of every prediction as it is, at every place: they show in stamps and residuals.
#[must_use]
pub fn statistical(setup: &Setup) -> Vec<EffectAt> {
    everywhere(setup, Effect::statistical).into_iter().map(|(at, _)| at).collect()
}

/// Every effect at every place, whether it can be tested or not.
#[must_use]
pub fn known(setup: &Setup) -> Vec<EffectAt> {
    let (found, not) = candidates(setup);
    found.into_iter().chain(not.into_iter().map(|n| n.effect)).chain(statistical(setup)).collect()
}

/// Effects at all places of their kinds, with the index of the place.
fn everywhere(setup: &Setup, chosen: impl Fn(Effect) -> bool) -> Vec<(EffectAt, usize)> {
    let system = setup.equations.system();
    let mut all = Vec::new();
    for effect in Effect::ALL.into_iter().filter(|effect| chosen(*effect)) {
        for kind in effect.places() {
            let keys: Vec<String> = match kind {
                PlaceKind::Input => system.inputs.iter().map(|i| i.name.clone()).collect(),
                PlaceKind::Output => system.outputs.iter().map(|o| o.name.clone()).collect(),
                PlaceKind::Joint => system.joints.iter().map(|j| j.name.clone()).collect(),
                PlaceKind::Parameter => system
                    .parameters
                    .iter()
                    .enumerate()
                    .filter(|(index, p)| p.calibrate.is_none() && owner(system, *index).is_none())
                    .map(|(_, p)| p.name.clone())
                    .collect(),
                PlaceKind::State => system.states.iter().map(|s| s.name.clone()).collect(),
                PlaceKind::Connection | PlaceKind::Node => Vec::new(),
            };
            for key in keys {
                let at = EffectAt { effect, place: Place::new(*kind, key) };
                let index = place_index(setup, &at.place).unwrap_or(0);
                all.push((at, index));
            }
        }
    }
    for own in system.own.iter().filter(|own| chosen(own.effect)) {
        let at = EffectAt { effect: own.effect, place: own.place.clone() };
        let index = place_index(setup, &at.place).unwrap_or(0);
        all.push((at, index));
    }
    all
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
        if let Some(own) = setup.equations.system().own.iter().find(|own| own.effect == at.effect) {
            fitted.extend(own.parameters.iter().map(|parameter| own_parameter(setup, parameter)));
            continue;
        }
        for (k, spec) in at.effect.parameters().iter().enumerate() {
            let slot = Slot::Effect { effect: e, parameter: k };
            fitted.push(sizes::fitted(setup, at, index, spec, slot));
        }
    }
    Hypothesis { effects: effects.to_vec(), fitted, residual: false, halvings: 0 }
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
                scale: p.std.unwrap_or(natural(p.value, low, high)),
                starts: Vec::new(),
            })
        })
        .collect()
}

/// The natural size of a parameter between bounds: of the order of its value, and of its range where that has one.
fn natural(value: f64, low: f64, high: f64) -> f64 {
    // Bounds that are decades apart leave open even in which unit a value is: they say nothing of its size.
    let open = low > 0.0 && high > DECADES * low;
    let of_range = if open { 0.0 } else { 0.02 * (high - low) };
    (0.1 * value.abs()).max(of_range).min(high - low)
}

/// Ratio of bounds from which they are no measure of what lies between them.
const DECADES: f64 = 100.0;

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

/// A parameter of an effect that the system's file adds: anywhere between its bounds, more likely near its null value.
fn own_parameter(setup: &Setup, parameter: &OwnParameter) -> Fitted {
    let p = &setup.equations.system().parameters[parameter.index];
    let OwnParameter { low, high, .. } = *parameter;
    let size = 0.25 * (high - low);
    let start = |share: f64| {
        let above = p.value + share * size;
        if above <= high { above } else { p.value - share * size }
    };
    let mut starts = vec![start(0.05), start(0.5)];
    if p.value - 0.5 * size >= low {
        starts.push(p.value - 0.5 * size);
    }
    Fitted {
        slot: Slot::Nominal(parameter.index),
        name: p.name.clone(),
        unit: p.unit.clone(),
        null: p.value,
        prior: Prior::Normal { mean: p.value, std: size },
        low,
        high,
        scale: 0.2 * size,
        starts,
    }
}

/// The effect of the system's file to which a parameter belongs.
#[must_use]
pub fn owner(system: &System, parameter: usize) -> Option<&StatedEffect> {
    system.own.iter().find(|own| own.parameters.iter().any(|p| p.index == parameter))
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
    let finer = hypothesis.fineness();
    let smoothing = setup.joints.iter().map(|j| j.smoothing / finer).collect();
    let plant = Plant::new(setup.equations.clone(), &effects, residuals, smoothing);
    let slots = hypothesis.fitted.iter().map(|f| f.slot).collect();
    let std = extra_std(setup, &plant);
    EquationsSimulator::new(plant, slots, &setup.experiment, setup.step / finer)
        .with_extra_std(std)
        .with_noise(&setup.output_noise)
}

/// How uncertain the states are that effects bring with them, where a stretch of the recording begins.
#[must_use]
pub fn extra_std(setup: &Setup, plant: &Plant) -> Vec<f64> {
    plant
        .extra_states()
        .iter()
        .map(|state| match *state {
            // As far as a reading goes in a twentieth of a second.
            ExtraState::ReadingRate { output, .. } => output_rate(setup, output),
            ExtraState::Reading { output, .. } => {
                let rate = output_rate(setup, output);
                (0.05 * rate).min(0.3 * setup.output_scale[output]).max(setup.output_noise[output])
            }
            // Anything between all of it one way and all of it the other.
            ExtraState::Bristles { .. } | ExtraState::Slip { .. } => 0.6,
            // As far as the driving force bends a spring that swings in the middle of what can be seen; one that is stated may be softer.
            ExtraState::Deflection { effect, joint } => {
                sizes::deflection(setup, joint, stated_stiffness(plant, effect)).0
            }
            ExtraState::DeflectionRate { effect, joint } => {
                sizes::deflection(setup, joint, stated_stiffness(plant, effect)).1
            }
        })
        .collect()
}

/// The stiffness of a spring inside a joint that the system states.
fn stated_stiffness(plant: &Plant, effect: usize) -> Option<f64> {
    plant.effects()[effect].fixed.as_ref().and_then(|stated| stated.first()).copied()
}

/// Root mean square of how fast an output's readings change, in its unit per second.
fn output_rate(setup: &Setup, output: usize) -> f64 {
    let (_, values) = setup.experiment.output(output);
    let values = crate::noise::unwrapped(&values, setup.experiment.wraps[output]);
    let steps: Vec<f64> = values.windows(2).map(|w| w[1] - w[0]).collect();
    crate::statistics::root_mean_square(&steps) / setup.period
}
