//! Which of the things that the readings show count as causes of the gap, and which are traces of something else.

use parallax_model::effect::Effect;

use crate::answers;
use crate::posterior::Posterior;
use crate::quantify::Row;
use crate::readings::{self, Acted, ReadingEffect};
use crate::report::{FittedEffect, Interval};
use crate::rows::Rows;
use crate::search::Fit;
use crate::setup::Setup;

/// Error of predictions on held-out time, in noise units, up to which their mean counts as explained.
const MEAN_EXPLAINED: f64 = 3.0;

/// Share of a named effect's evidence that times which scatter elsewhere must have to be a cause beside it.
const OF_FORM: f64 = 0.03;
/// The same at an input, where kicks are everywhere.
const OF_FORM_AT_INPUT: f64 = 0.3;

/// How much more than their mean lowers the cost times that scatter must say, and the part that they explain of what a free density
/// gains, to be the cause in its place where nothing predicts what is left.
const OUTWEIGHS: f64 = 5.0;
const MOST: f64 = 0.9;

/// Share of a noise that must be left beside times that scatter for it to be a cause of its own.
const OWN_NOISE: f64 = 0.6;

/// Share of the squared error on held-out time that a residual must leave for the rest to count as chance.
const CHANCE: f64 = 0.5;

/// Mean squared error on held-out time, in noise units squared, up to which a model predicts to the floor of the noise.
const AT_FLOOR: f64 = 1.1;

/// Share of the evidence of readings that lie on a lattice, repeat or jump below which that of a named effect is of what they are
/// off by.
const OF_ODD_READINGS: f64 = 0.02;

/// Whether how the readings scatter is all there is: some lie on a lattice, repeat or jump, the `refitted` model predicts held-out
/// time to the floor of their noise, and the leading answer lowers the cost by little (`gain`) beside them. Likelihoods take what
/// such readings are off by for independent and normal; it is neither where the motion is slow.
pub(super) fn are_all(readings: &[ReadingEffect], refitted: &Row, gain: f64) -> bool {
    let odd = readings.iter().filter(|r| {
        let effect = Effect::from_name(&r.name);
        r.significant && matches!(effect, Some(Effect::Quantization | Effect::Stuck | Effect::Outliers))
    });
    let evidence: f64 = odd.map(|r| -r.evidence).sum();
    refitted.mean_square() < AT_FLOOR && gain < OF_ODD_READINGS * evidence
}

/// Share of the gap on held-out time below which, with certainty, an answer closes nothing of it.
const CLOSES_NOTHING: f64 = 0.02;

/// Whether the times of some readings scatter, and say more than a named answer that closes nothing (`closed`) lowers the cost
/// (`gain`), or far more than one that seems to close nothing: it follows what such readings are off by.
pub(super) fn are_times(scattered: &[ReadingEffect], gain: f64, closed: &Interval) -> bool {
    let least = match closed {
        closed if closed.high < CLOSES_NOTHING => gain,
        closed if closed.value <= 0.0 => OUTWEIGHS * gain,
        _ => f64::INFINITY,
    };
    let times = |r: &&ReadingEffect| r.significant && r.name == "jitter" && r.place.starts_with("output:");
    scattered.iter().filter(times).any(|r| -r.evidence > least)
}

/// What the models say, for what the readings show to be held against.
pub(super) struct Models<'a> {
    setup: &'a Setup,
    /// The named answer; the null model where nothing was named.
    shown: &'a Fit,
    /// Whether effects were named.
    named: bool,
    /// By how much the named answer lowers the cost.
    gain: f64,
    /// What is left of the mean squared error on held-out time, above the noise floor of 1.
    excess: f64,
    /// Neither an effect nor a residual predicts what is left.
    by_chance: bool,
    mean_explained: bool,
    acted: Option<&'a Acted>,
}

impl<'a> Models<'a> {
    /// `named`: a gap was detected, and effects were named; `detected`: a gap was detected; `times_are_all`: the times of readings,
    /// which scatter, say more than any mean.
    pub(super) fn new(
        setup: &'a Setup,
        null: &'a Fit,
        answers: &'a Posterior,
        rows: &Rows,
        (detected, named): (bool, bool),
        acted: Option<&'a Acted>,
        times_are_all: bool,
    ) -> Self {
        let best = answers.leader(null);
        let left = rows.with_effect.mean_square();
        // Commands that scatter move the machine by chance: neither an effect nor a residual predicts it over a
        // horizon, and innovations alone tell.
        let by_chance = rows.black_box.mean_square() > CHANCE * left;
        // An answer that makes the predictions worse explains no mean.
        let least = left.min(rows.refitted.mean_square());
        Self {
            setup,
            shown: if named { best } else { null },
            named,
            gain: if named { answers.cost(null) - answers.cost(best) } else { 0.0 },
            excess: least - 1.0,
            by_chance,
            mean_explained: times_are_all || least < MEAN_EXPLAINED.powi(2) || (!detected && by_chance),
            acted,
        }
    }

    /// Those of the `readings`' effects that are causes. How readings scatter is a cause of the gap only where their
    /// mean leaves nothing larger.
    pub(super) fn causes(&self, readings: &[ReadingEffect]) -> Vec<ReadingEffect> {
        let chosen = readings.iter().filter(|r| {
            r.significant
                && (self.mean_explained || self.moves_by_chance(r) || self.names_its_mean(r))
                && !self.clipped(r)
                && !self.of_times(r, readings)
                && !self.of_form(r)
                && !self.of_rounding(r, readings)
                && !self.left_by_acted(r)
                && !readings::is_trace(r, readings)
        });
        chosen.cloned().collect()
    }

    /// Whether it moves the machine, or its readings, by what is left of the error.
    fn moves_by_chance(&self, r: &ReadingEffect) -> bool {
        if !self.by_chance {
            return false;
        }
        match readings::over_readings(self.setup, r) {
            // Predictions begin where such readings saw the machine: they are off as well.
            Some(off) => off > CHANCE * CHANCE * self.excess,
            None => readings::over_horizon(self.setup, self.shown, r).is_some_and(|moved| {
                // Where the innovations say more for it than for the named answer, or that is but its mean, the size may be
                // off by a factor of two.
                let leads = -r.evidence > self.gain || self.has_mean_of(r);
                let share = if leads { CHANCE * CHANCE } else { CHANCE };
                moved > share * self.excess
            }),
        }
    }

    /// What commands that acted otherwise leave where they are not quite known, as scatter does at other places.
    fn left_by_acted(&self, r: &ReadingEffect) -> bool {
        self.acted.is_some_and(|acted| {
            let scatters = matches!(r.name.as_str(), "jitter" | "drops");
            acted.effect.place == r.place || scatters && r.evidence > readings::TRACE * acted.effect.evidence
        })
    }

    /// The corners of a clipped reading look like outliers and bad times.
    fn clipped(&self, r: &ReadingEffect) -> bool {
        let effects = if self.named { &self.shown.hypothesis.effects[..] } else { &[] };
        effects.iter().any(|at| at.effect == Effect::SensorSaturation && at.place.to_string() == r.place)
    }

    /// A reading that is rounded errs most where it moves, as one whose times scatter: what such times explain is more than what
    /// rounding leaves, or that.
    fn of_rounding(&self, r: &ReadingEffect, readings: &[ReadingEffect]) -> bool {
        let on_lattice = |e: &ReadingEffect| e.significant && e.name == "quantization" && e.place == r.place;
        let outputs = self.setup.equations.system().outputs.len() as f64;
        // Of one output, whose noise contains its rounding.
        let off = || readings::over_readings(self.setup, r).map_or(0.0, |off| off * outputs);
        r.name == "jitter" && readings.iter().any(on_lattice) && off() < 1.0
    }

    /// Times that scatter look like noise to those who do not know how fast the reading moves.
    fn of_times(&self, r: &ReadingEffect, readings: &[ReadingEffect]) -> bool {
        let outputs = &self.setup.equations.system().outputs;
        let jitter = readings.iter().find(|j| j.significant && j.name == "jitter" && j.place == r.place);
        let output = outputs.iter().position(|o| r.place == format!("output:{}", o.name));
        let (Some(jitter), Some(output), "noise") = (jitter, output, r.name.as_str()) else { return false };
        let spread = jitter.parameters.get("spread").map_or(0.0, |spread| spread.value);
        let declared = outputs[output].noise.unwrap_or(f64::INFINITY);
        let alleged = r.parameters.get("std").map_or(0.0, |std| std.value);
        let least = declared.hypot(OWN_NOISE * alleged);
        readings::noise_beside(self.setup, self.shown, output, spread).is_some_and(|std| std < least)
    }

    /// Whether the named answer holds what these times are late by on average.
    fn has_mean_of(&self, r: &ReadingEffect) -> bool {
        self.means_of(r).iter().any(|(place, is_mean)| *is_mean && *place == r.place)
    }

    /// Whether the named answer is no more than what the times of these readings are late by on average, which by chance are late
    /// far more than that: what is late anywhere shows everywhere behind it.
    fn names_its_mean(&self, r: &ReadingEffect) -> bool {
        let means = self.means_of(r);
        r.name == "jitter"
            && r.place.starts_with("output:")
            && self.by_chance
            && !means.is_empty()
            && means.iter().all(|(_, is_mean)| *is_mean)
            && -r.evidence > OUTWEIGHS * self.gain
            && r.share.is_some_and(|share| share > MOST)
    }

    /// The places of the named effects, and whether each may be what times that scatter so are late by on average.
    fn means_of(&self, r: &ReadingEffect) -> Vec<(String, bool)> {
        let spread = r.parameters.get("spread").map_or(0.0, |spread| spread.value);
        let fitted = if self.named { answers::fitted_effects(self.setup, self.shown) } else { Vec::new() };
        let is_mean = |e: &FittedEffect| answers::is_mean_of(self.setup, e, spread);
        fitted.into_iter().map(|e| (e.place.clone(), is_mean(&e))).collect()
    }

    /// The form of a named effect is off by a little, which leaves traces where commands or readings change.
    fn of_form(&self, r: &ReadingEffect) -> bool {
        let effects = if self.named { &self.shown.hypothesis.effects[..] } else { &[] };
        let here = effects.iter().all(|at| at.place.to_string() == r.place);
        let share = if r.place.starts_with("input:") { OF_FORM_AT_INPUT } else { OF_FORM };
        r.name == "jitter" && !here && !self.has_mean_of(r) && -r.evidence < share * self.gain
    }
}

#[cfg(test)]
mod tests {
    use super::{are_all, are_times};
    use crate::quantify::{Block, Row};
    use crate::readings::{LogDensity, ReadingEffect};
    use crate::report::Interval;

    fn shown(name: &str, place: &str, evidence: f64) -> ReadingEffect {
        let parameters = std::collections::BTreeMap::new();
        let (significant, log_density, share) = (evidence < -10.0, LogDensity::default(), None);
        ReadingEffect {
            name: name.into(),
            place: place.into(),
            parameters,
            evidence,
            significant,
            log_density,
            share,
        }
    }

    fn off_by(error: f64) -> Row {
        Row { blocks: vec![Block { squares: 4.0 * error * error, count: 4 }], readings: Vec::new() }
    }

    #[test]
    fn little_evidence_beside_odd_readings_at_their_floor_is_none() {
        let odd = [shown("quantization", "output:q", -4000.0)];
        assert!(are_all(&odd, &off_by(1.0), 25.0));
        assert!(!are_all(&odd, &off_by(1.0), 500.0), "what weighs much is an effect");
        assert!(!are_all(&odd, &off_by(2.0), 25.0), "a mean is left to be explained");
        assert!(
            !are_all(&[shown("noise", "output:q", -4000.0)], &off_by(1.0), 25.0),
            "noise is what is assumed"
        );
        assert!(!are_all(&[shown("stuck", "output:q", -5.0)], &off_by(1.0), 0.0), "it is not there");
    }

    #[test]
    fn times_of_readings_say_more_than_an_answer_that_closes_nothing() {
        let of = |place: &str, evidence: f64| [shown("jitter", place, evidence)];
        let closed = |value: f64, high: f64| Interval { value, low: -1.0, high };
        let nothing = closed(-0.2, 0.0);
        assert!(are_times(&of("output:q", -3000.0), 700.0, &nothing));
        assert!(!are_times(&of("output:q", -300.0), 700.0, &nothing));
        assert!(
            !are_times(&of("input:u", -3000.0), 700.0, &nothing),
            "a command that scatters moves the machine"
        );
        // Where an answer may close something, they must say far more.
        assert!(!are_times(&of("output:q", -3000.0), 700.0, &closed(-0.1, 0.3)));
        assert!(are_times(&of("output:q", -3000.0), 100.0, &closed(-0.1, 0.3)));
        assert!(
            !are_times(&of("output:q", -3000.0), 100.0, &closed(0.1, 0.3)),
            "what closes something is there"
        );
    }
}
