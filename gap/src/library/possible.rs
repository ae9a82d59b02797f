//! What an effect cannot be, whatever it explains.
//!
//! A limit that holds a quantity still removes what a model predicts wrongly, and wins over the true cause wherever the
//! model is poor: a constant is a good prediction of what hardly moves. But a limit is a limit only if something is left
//! between its ends, and a sensor that is clipped never reads beyond them. A lag that is over within a period says nothing
//! but which of two events of one stamp came first.

use parallax_model::effect::{Effect, PlaceKind};

use super::place_index;
use crate::search::{Fit, INEXACT};
use crate::setup::Setup;
use crate::statistics::standard_deviation;

/// Share of a command's period within which a lag must not be over where a reading shows the command at once: that the
/// reading comes first within the period would pass for it, and a log does not tell.
const WITHIN: f64 = 0.25;

/// Share of a command's deviation that a saturation must leave; and where what is left explains everything.
const LEFT: f64 = 0.25;
const LEFT_EXACT: f64 = 0.02;

/// Share of its largest deflection below which dry friction must have built up.
const LONGEST: f64 = 0.9;

/// Share of time that a clipped state must be clear of its limits.
const INSIDE: f64 = 0.1;

/// How far from a limit a state is clear of it, as a share of its range.
const CLEAR: f64 = 0.01;

/// Share of readings that may lie beyond a clipped sensor's limits: outliers.
const BEYOND: f64 = 0.01;

/// How far beyond a limit, in noise units, a reading must lie to contradict it.
const FAR: f64 = 4.0;

/// Whether every effect of a fit can be what it says it is.
#[must_use]
pub fn is_possible(setup: &Setup, fit: &Fit) -> bool {
    fit.hypothesis.effects.iter().enumerate().all(|(number, at)| {
        let Some(index) = place_index(setup, &at.place) else { return true };
        let at_name =
            |name: &str| fit.hypothesis.of_effect(number).find(|k| fit.hypothesis.fitted[*k].name == name);
        let value = |name: &str| at_name(name).map(|k| fit.estimate()[k]);
        let (low, high) = (value("low").unwrap_or(f64::NEG_INFINITY), value("high").unwrap_or(f64::INFINITY));
        match (at.effect, at.place.kind) {
            (Effect::Lag | Effect::LagSecondOrder, PlaceKind::Input) => {
                let system = setup.equations.system();
                let shown = (0..system.outputs.len()).any(|output| system.shows(output, index));
                let period = setup.experiment.inputs[index].period();
                // The mean lag: the time constant, or 2ζ of them.
                let late = value("time_constant").unwrap_or(0.0) * value("damping").map_or(1.0, |z| 2.0 * z);
                !shown || late >= WITHIN * period
            }
            (Effect::Saturation | Effect::SaturationSoft, PlaceKind::Input) => {
                let sent = &setup.experiment.inputs[index].values;
                let left: Vec<f64> = sent.iter().map(|u| u.max(low).min(high)).collect();
                let least = if fit.shooting_error <= INEXACT { LEFT_EXACT } else { LEFT };
                standard_deviation(&left) >= least * standard_deviation(sent)
            }
            (Effect::Saturation | Effect::SaturationOverflow, PlaceKind::State) => {
                let pass = &fit.innovation.pass;
                let went = pass.state.iter().skip(index).step_by(pass.states().max(1));
                let clear = CLEAR * setup.state_range[index].width();
                let inside = went.clone().filter(|x| **x > low + clear && **x < high - clear).count();
                inside as f64 >= INSIDE * went.count() as f64
            }
            (Effect::CoulombDahl, _) => {
                // One that wants to build up over a longer way follows whatever else is unknown.
                at_name("deflection")
                    .is_none_or(|at| fit.estimate()[at] < LONGEST * fit.hypothesis.fitted[at].high)
            }
            (Effect::SensorSaturation, _) => {
                let noise = setup.output_noise[index];
                let (_, readings) = setup.experiment.output(index);
                let far = FAR * noise;
                let beyond = readings.iter().filter(|y| **y < low - far || **y > high + far).count();
                beyond as f64 <= BEYOND * readings.len() as f64
            }
            _ => true,
        }
    })
}
