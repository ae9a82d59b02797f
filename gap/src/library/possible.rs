//! What an effect cannot be, whatever it explains.
//!
//! A limit that holds a quantity still removes what a model predicts wrongly, and wins over the true cause wherever the
//! model is poor: a constant is a good prediction of what hardly moves. But a limit is a limit only if something is left
//! between its ends, and a sensor that is clipped never reads beyond them. A lag that is over within a period says nothing
//! but which of two events of one stamp came first.

use parallax_model::effect::{Effect, PlaceKind};

use super::place_index;
use crate::hypothesis::Slot;
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

/// Share of time for which a state that nobody reads must be at its limits: where it begins is unknown, so that the first readings
/// throw it about, and a limit that holds it there is none of the machine.
const AT_LIMIT: f64 = 0.005;

/// How far from a limit a state is clear of it, as a share of its range.
const CLEAR: f64 = 0.01;

/// Share of readings that may lie beyond a clipped sensor's limits: outliers.
const BEYOND: f64 = 0.01;

/// How far beyond a limit, in noise units, a reading must lie to contradict it.
const FAR: f64 = 4.0;

/// Whether a state that went through these values is one that limits hold now and then; `clear` is where it is clear of them.
fn is_limited(went: impl Iterator<Item = f64>, clear: (f64, f64), shown: bool) -> bool {
    let (mut count, mut inside) = (0_usize, 0_usize);
    for x in went {
        count += 1;
        inside += usize::from(x > clear.0 && x < clear.1);
    }
    let least = |share: f64, of: usize| of as f64 >= share * count as f64;
    least(INSIDE, inside) && (shown || least(AT_LIMIT, count - inside))
}

/// Whether every effect of a fit can be what it says it is.
#[must_use]
pub fn is_possible(setup: &Setup, fit: &Fit) -> bool {
    fit.hypothesis.effects.iter().enumerate().all(|(number, at)| {
        let Some(index) = place_index(setup, &at.place) else { return true };
        let value = |name: &str| {
            let own = |slot: &Slot| matches!(slot, Slot::Effect { effect, .. } if *effect == number);
            let fitted = fit.hypothesis.fitted.iter().zip(fit.estimate());
            fitted.filter(|(f, _)| own(&f.slot) && f.name == name).map(|(_, value)| *value).next()
        };
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
                let went = pass.state.iter().copied().skip(index).step_by(pass.states().max(1));
                let clear = CLEAR * setup.state_range[index].width();
                // What overflows shows in the state that it feeds.
                let shown = setup.is_shown(index) || at.effect == Effect::SaturationOverflow;
                is_limited(went, (low + clear, high - clear), shown)
            }
            (Effect::CoulombDahl, _) => {
                let deflection = fit.hypothesis.fitted.iter().position(|f| f.name == "deflection");
                // One that wants to build up over a longer way follows whatever else is unknown.
                deflection.is_none_or(|at| fit.estimate()[at] < LONGEST * fit.hypothesis.fitted[at].high)
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

#[cfg(test)]
mod tests {
    use super::is_limited;

    /// So many of a thousand readings at the upper limit, the others in the middle.
    fn rising(at_limit: usize) -> impl Iterator<Item = f64> {
        (0..1000).map(move |k| if k < at_limit { 1.0 } else { 0.5 })
    }

    #[test]
    fn the_first_readings_of_a_state_that_nobody_reads_are_at_no_limit() {
        let clear = (0.01, 0.99);
        assert!(!is_limited(rising(3), clear, false), "thrown about until it is known");
        assert!(is_limited(rising(3), clear, true), "a reading shows that it is there");
        assert!(is_limited(rising(60), clear, false));
        assert!(!is_limited(rising(950), clear, true), "a constant predicts what is held all the time");
    }
}
