//! Why a log or a system cannot show an effect, before any fit.

use parallax_model::effect::{Effect, PlaceKind};

use super::one_clock::stamped_with;
use crate::hypothesis::EffectAt;
use crate::setup::Setup;

/// Least part of a turn that must be covered to see what repeats with position: a wave of a motor with 24 a turn.
const LEAST_TURN: f64 = 1.0 / 24.0;

/// Least share of its mean by which a supply voltage must change.
const LEAST_VOLTAGE: f64 = 0.005;

/// Largest skew that two clocks are believed to have.
pub(super) const LARGEST_SKEW: f64 = 0.01;

/// Whether this log can show an effect at a place of this index; otherwise why not, as the end of a sentence.
pub(super) fn testable(setup: &Setup, at: &EffectAt, index: usize) -> Result<(), String> {
    match at.place.kind {
        PlaceKind::Input => input(setup, at.effect, index)?,
        PlaceKind::Output => output(setup, at.effect, index)?,
        PlaceKind::Joint => joint(setup, at.effect, index)?,
        PlaceKind::State => {
            let range = &setup.state_range[index];
            let moves = range.width() > 1e-9 * range.high.abs().max(range.low.abs()).max(1e-9);
            need(moves, "the state never changes in this log")?;
            let system = setup.equations.system();
            if at.effect == Effect::SaturationOverflow {
                system.fed_by(index)?;
            }
            let mut joints = system.joints.iter();
            let held = at.effect == Effect::Saturation;
            need(
                !held || joints.all(|joint| joint.position_state != Some(index)),
                "it is the position of a joint, which an `end_stop` limits",
            )?;
        }
        PlaceKind::Parameter | PlaceKind::Connection | PlaceKind::Node => {}
    }
    if at.effect == Effect::ClockSkew {
        let (from, to) = setup.experiment.span();
        need(
            LARGEST_SKEW * (to - from) > 0.5 * setup.period,
            &format!("{:.1} s are too short for clocks to part", to - from),
        )?;
        if let Some(other) = stamped_with(setup, at.place.kind, index) {
            return Err(format!(
                "one clock stamped it and `{other}`: their stamps are the same, irregular as they are"
            ));
        }
    }
    Ok(())
}

fn need(holds: bool, reason: &str) -> Result<(), String> {
    if holds { Ok(()) } else { Err(reason.into()) }
}

fn input(setup: &Setup, effect: Effect, index: usize) -> Result<(), String> {
    let range = &setup.input_range[index];
    need(range.high > range.low, "the command never changes in this log")?;
    let largest = range.low.abs().max(range.high.abs());
    match effect {
        Effect::Deadband => {
            let least =
                setup.experiment.inputs[index].values.iter().fold(f64::INFINITY, |m, v| v.abs().min(m));
            need(least < 0.5 * largest, "the command never comes near zero in this log")
        }
        Effect::SupplySag => {
            let supply = setup.experiment.supply(index).ok_or("the input names no `supply`")?;
            let ratios: Vec<f64> = supply.voltage.times.iter().map(|t| supply.ratio(*t)).collect();
            let ratio = crate::setup::Range::of(&ratios);
            need(
                ratio.std > LEAST_VOLTAGE || (ratio.middle() - 1.0).abs() > LEAST_VOLTAGE,
                "the supply voltage never leaves its nominal value in this log",
            )
        }
        Effect::SupplySagLoad => {
            need(setup.experiment.supply(index).is_none(), "the supply voltage is recorded and decides it")
        }
        _ => Ok(()),
    }
}

fn output(setup: &Setup, effect: Effect, index: usize) -> Result<(), String> {
    let range = &setup.output_range[index];
    match effect {
        Effect::Scale => need(range.high.abs().max(range.low.abs()) > 0.0, "the reading is always zero"),
        Effect::SensorSaturation => {
            need(range.width() > 4.0 * setup.output_noise[index], "the reading never leaves its noise")?;
            need(setup.experiment.wraps[index].is_none(), "the reading turns around, and has no limits")
        }
        Effect::SensorLag | Effect::SensorLagSecondOrder => {
            let system = setup.equations.system();
            need(range.width() > 0.0, "the reading never changes in this log")?;
            need(!system.states.is_empty(), "the reading is the command itself: it is a lag of the command")
        }
        Effect::Delay | Effect::ClockSkew => {
            need(range.width() > 0.0, "the reading never changes in this log")
        }
        _ => Ok(()),
    }
}

fn joint(setup: &Setup, effect: Effect, index: usize) -> Result<(), String> {
    let system = setup.equations.system();
    system.joints[index].supports(effect).map_err(str::to_owned)?;
    let scale = &setup.joints[index];
    need(scale.speed > 1e-9, "the joint never moves in this log")?;
    // Slower than this is noise around rest.
    let least = 0.02 * scale.speed;
    match effect {
        Effect::AsymmetricFriction | Effect::AsymmetricViscous => {
            need(scale.velocity.low < -least, "the joint never moves backward in this log")?;
            need(scale.velocity.high > least, "the joint never moves forward in this log")
        }
        Effect::Coulomb | Effect::LoadFriction => need(
            scale.velocity.low < -least && scale.velocity.high > least || effect == Effect::LoadFriction,
            "the speed never reverses in this log, so that it is a constant force",
        ),
        Effect::Cogging => {
            let turns = scale.position.width() / std::f64::consts::TAU;
            let rotates = system.joints[index].position_state.is_none_or(|state| {
                let name = system.states[state].name.as_str();
                system.outputs.iter().filter(|o| o.value.text().trim() == name).all(|o| o.unit != "m")
            });
            need(!rotates || turns >= LEAST_TURN, &format!("the log covers {turns:.3} turns"))
        }
        // Where the joint names its air, wind is a speed of that.
        Effect::Wind => need(system.joints[index].air.is_none(), "the joint names `air`"),
        _ => Ok(()),
    }
}
