//! Which loss decides, and what it says of a fit.

use std::cmp::Ordering;

use parallax_model::effect::Effect;

use crate::search::{Fit, INEXACT};

/// Gain in −2 log evidence that a further effect must bring.
pub const WORTH: f64 = 10.0;

/// Difference of −2 log evidence that says nothing.
pub const EVEN: f64 = 1.0;

/// Difference of −2 log evidence from which two effects of like signature are told apart all the same.
pub const DECISIVE: f64 = 20.0;

/// Share of an output's squared error beyond the noise that a further effect must close where no hypothesis reaches the noise.
const CLOSED: f64 = 0.25;

/// Share of the gap's square that a further effect must close: what is less may as well be the form of the first one,
/// which nobody knows to the last percent.
const MATERIAL: f64 = 0.005;

/// The same of a further effect at the place of another one: nobody knows an effect's form better.
const MATERIAL_BESIDE: f64 = 0.03;

/// Mean squared error of predictions, in noise units squared, that a further effect must close where it closes too little in windows.
const AHEAD: f64 = 0.01;

/// Share of the gap's square below which nothing is an effect: a thousandth of the motion, to which no two integrations of the
/// same equations agree.
const NUMERICAL: f64 = 1e-6;

/// Share of the gap up to which one hypothesis may explain more than another because of its form alone.
const FORM: f64 = 0.1;

/// Share of what a combination leaves, up to which another effect may leave it where nothing reaches the noise.
const HALF: f64 = 0.5;

/// Variance ratio of the null model's innovations up to which they leave nothing that a filter is misled by.
const WHITE: f64 = 2.0;

/// Variance ratio of innovations up to which they are as good as random, and up to which they may be with yet another effect.
const RANDOM: f64 = 5.0;
const NEARLY_RANDOM: f64 = 10.0;

/// Mean squared error of short windows, in noise units squared, up to which nothing is left but noise.
const AT_FLOOR: f64 = 1.03;

/// Most that any effect may promise, in a score test, beside a combination with which nothing is left: the largest of
/// some hundred tests by chance; and the share of what the last of its effects gained that is nothing as well.
const NOTHING: f64 = 20.0;
const LITTLE: f64 = 0.05;

/// Whether what a score test promises of any further effect (`left`) is nothing beside what the last one gained in −2 log evidence by
/// innovations.
#[must_use]
pub fn is_nothing(left: f64, gained: f64) -> bool {
    left < NOTHING.max(LITTLE * gained)
}

/// What is `explained` of a mean squared error, in units of what a form that closes `gap` and that nobody knows exactly may
/// be off by.
#[must_use]
pub fn share_of_form(explained: f64, gap: f64) -> f64 {
    explained.max(0.0) / (FORM * gap).max(1e-12)
}

/// The judge of all hypotheses on one log.
///
/// Where some hypothesis reaches the sensors' noise, both losses are likelihoods of the data, and their mean decides:
/// the two fail in different cases. Where the null model does already, and its innovations are random, the filter is of
/// nearly the right model whatever is true, and the innovations alone decide: windows choose their first states freely, and
/// hardly show what is small and slow. Where no hypothesis does, as on any real machine, the innovations are ruled by what every
/// hypothesis lacks; the short windows judge what a simulator is for. Either way the windows' readings count for as
/// many as their correlation leaves.
#[derive(Clone, Copy, Debug)]
pub struct Judge {
    independence: f64,
    exact: bool,
    /// How many independent innovations one is worth, at most 1.
    innovations: f64,
    /// Share of the innovations in the cost where some hypothesis reaches the noise; the rest is the windows'.
    share: f64,
    /// The null model's mean squared residual beyond the noise, in noise units squared.
    gap: f64,
    /// The number of states of the nominal model.
    states: usize,
    /// What a hypothesis without further states costs by windows and by innovations: where others have further ones,
    /// these take the place of their windows.
    plain: (f64, f64),
    /// Whether that only bounds what their windows say.
    bounded: bool,
}

impl Judge {
    /// From all fits, the null model's among them.
    #[must_use]
    pub fn new<'a>(null: &'a Fit, fits: impl IntoIterator<Item = &'a Fit> + Clone) -> Self {
        let all = || fits.clone().into_iter();
        let best =
            all().chain([null]).min_by(|a, b| a.shooting_error.total_cmp(&b.shooting_error)).unwrap_or(null);
        let states = null.innovation.pass.states();
        let exact = best.shooting_error <= INEXACT;
        let bounded = !exact || null.shooting_error <= INEXACT;
        // Where some hypothesis reaches the noise and the null does not, the null's two losses are of different worlds:
        // the best hypothesis with the null's states stands in for it: the best by both, for one that is good by the windows
        // alone would make a gain of what it lacks by innovations.
        let mut plain = null;
        if !bounded {
            let both = |f: &Fit| f.innovation.evidence_cost + best.independence * f.shooting_cost;
            let same = all().filter(|f| f.innovation.pass.states() == states);
            plain = same.min_by(|a, b| both(a).total_cmp(&both(b))).unwrap_or(null);
        }
        let plain = (plain.shooting_cost, plain.innovation.evidence_cost);
        let gap = (null.shooting_error - 1.0).max(0.0);
        let likeliest = all().chain([null]).min_by(by_innovations).unwrap_or(null);
        let innovations = 1.0 / likeliest.variance_ratio.max(1.0);
        let small = null.shooting_error <= INEXACT && null.variance_ratio <= WHITE;
        let share = if small { 1.0 } else { 0.5 };
        Judge { independence: best.independence, exact, innovations, share, gap, states, plain, bounded }
    }

    /// Whether `fit`, which has more effects than `base`, is worth them.
    ///
    /// Where no hypothesis reaches the sensors' noise, whatever is flexible gains by either loss: a further effect must
    /// gain by both, and take a good part of what is left in some output; unless with it the noise is reached.
    #[must_use]
    pub fn is_worth(&self, fit: &Fit, base: &Fit) -> bool {
        if self.cost(fit) >= self.cost(base) - WORTH {
            return false;
        }
        if base.shooting_error <= INEXACT && !self.is_material(fit, base) {
            return false;
        }
        if is_beside(fit, base) && base.shooting_error - fit.shooting_error < MATERIAL_BESIDE * self.gap {
            return false;
        }
        // In noise units squared, of which one is the noise's, that nothing closes.
        let closes = |(after, before): (&f64, &f64)| {
            *before > INEXACT && after - 1.0 < (1.0 - CLOSED) * (before - 1.0)
        };
        self.exact
            || fit.shooting_error <= INEXACT
            || self.leaves_chance(fit, base)
            || (fit.innovation.evidence_cost < base.innovation.evidence_cost
                && fit.output_errors.iter().zip(&base.output_errors).any(closes))
    }

    /// The same; what is too small to be told from the first effect's form counts where nothing is [`left`](is_nothing) with it: a form
    /// that is off leaves more than one effect takes. Or where windows with it leave nothing, and predictions over the horizon gain as much
    /// as they would have to: windows choose their first states freely, and hardly show a force that changes slowly. `predicts` gives the
    /// mean squared errors of the null model's predictions, of those of `base`, and of `fit`, in noise units squared. Another value of a
    /// parameter follows what a form is off by too well to be told from it, and so does what has states of its own.
    #[must_use]
    pub fn is_worth_or(
        &self,
        fit: &Fit,
        base: &Fit,
        left: impl FnOnce() -> f64,
        predicts: impl FnOnce() -> [f64; 3],
    ) -> bool {
        let complete = || is_nothing(left(), base.innovation.evidence_cost - fit.innovation.evidence_cost);
        let same = || (base.shooting_error - fit.shooting_error).abs() < NUMERICAL * self.gap;
        let at_floor = fit.shooting_error <= AT_FLOOR;
        if self.is_worth(fit, base) {
            return at_floor
                || self.beyond_form(fit, base) >= 1.0
                || self.halves(fit, base)
                || self.leaves_chance(fit, base)
                || complete();
        }
        let known = &base.hypothesis.effects;
        let tuned =
            || fit.hypothesis.effects.iter().any(|at| at.effect == Effect::Parameter && !known.contains(at));
        // Further states are free in every window, and take what the filter's steps through a stop or a limit leave as well.
        let freer = || fit.innovation.pass.states() > base.innovation.pass.states();
        let ahead = || {
            let [null, before, after] = predicts();
            before - after >= (MATERIAL * (null - 1.0)).max(AHEAD)
        };
        base.shooting_error <= INEXACT
            && self.gains(fit, base)
            && !same()
            && !tuned()
            && !freer()
            && (complete() || (at_floor && ahead()))
    }

    /// Whether `fit` explains more than `other`, which has as many effects: clearly by what decides, or, where nothing reaches the noise,
    /// decisively by the innovations if that says little.
    #[must_use]
    pub fn is_better(&self, fit: &Fit, other: &Fit) -> bool {
        let gain = self.cost(other) - self.cost(fit);
        gain > WORTH || (!self.exact && gain > -WORTH && is_preferred(fit, other))
    }

    /// The one of `fits` that explains most: of those that what decides does not clearly tell from the best the one that the innovations
    /// prefer decisively.
    #[must_use]
    pub fn best<'a>(&self, fits: impl Iterator<Item = &'a Fit> + Clone) -> Option<&'a Fit> {
        let least = fits.clone().min_by(|a, b| self.cost(a).total_cmp(&self.cost(b)))?;
        let better = fits.filter(|fit| self.is_better(fit, least));
        Some(better.min_by(by_innovations).unwrap_or(least))
    }

    /// Whether a further effect elsewhere takes more than half of what is left, where nothing reaches the noise, and the innovations
    /// prefer it decisively: a form that is off has no such remedy elsewhere.
    fn halves(&self, fit: &Fit, base: &Fit) -> bool {
        !self.exact
            && !is_beside(fit, base)
            && base.shooting_error - fit.shooting_error > MATERIAL_BESIDE * self.gap
            && fit.shooting_error - 1.0 < HALF * (base.shooting_error - 1.0)
            && is_preferred(fit, base)
    }

    /// Whether both losses prefer a further effect elsewhere where nothing reaches the noise, and it leaves innovations that are as good
    /// as random: then their likelihood is that of the data, and no form is off by more than chance; nor does a calibrated parameter stand
    /// in for one at its bound.
    fn leaves_chance(&self, fit: &Fit, base: &Fit) -> bool {
        fit.variance_ratio <= RANDOM && !fit.is_strained() && self.both_prefer(fit, base)
    }

    /// The same of one that leaves not much more than chance: yet another one may.
    #[must_use]
    pub fn nearly_leaves_chance(&self, fit: &Fit, base: &Fit) -> bool {
        fit.variance_ratio <= NEARLY_RANDOM && self.both_prefer(fit, base)
    }

    /// Whether both losses prefer a further effect elsewhere, each for what its readings are worth, where nothing reaches the noise.
    fn both_prefer(&self, fit: &Fit, base: &Fit) -> bool {
        let windows = self.independence * (base.shooting_cost - fit.shooting_cost);
        let innovations = base.innovation.evidence_cost - fit.innovation.evidence_cost;
        !self.exact && !is_beside(fit, base) && windows > WORTH && self.innovations * innovations > DECISIVE
    }

    /// [`Judge::cost`] of a fit with one effect more than `base`: what is no more than another form at a place of `base` must explain
    /// decisively more than what acts elsewhere.
    #[must_use]
    pub fn cost_beyond(&self, fit: &Fit, base: &Fit) -> f64 {
        let beside = !self.exact && is_beside(fit, base);
        self.cost(fit) + if beside { DECISIVE } else { 0.0 }
    }

    /// Whether a further effect at a place of its own brings more than [`WORTH`] by both losses.
    #[must_use]
    pub fn gains(&self, fit: &Fit, base: &Fit) -> bool {
        !is_beside(fit, base)
            && self.cost(fit) < self.cost(base) - WORTH
            && fit.innovation.evidence_cost < base.innovation.evidence_cost - WORTH
    }

    /// Whether what `fit` explains beyond `base` is more than a form that is known to a few percent may be off by.
    #[must_use]
    pub fn is_material(&self, fit: &Fit, base: &Fit) -> bool {
        self.is_material_from(base.shooting_error, fit.shooting_error)
    }

    /// The same of mean squared residuals before and after, in noise units squared.
    #[must_use]
    pub fn is_material_from(&self, before: f64, after: f64) -> bool {
        before - after >= MATERIAL * self.gap
    }

    /// Whether an effect of `fit` has a parameter to spare, and without it, as `to` has it, the evidence is hardly worse: one
    /// that the data do not tell from its null follows what a form leaves.
    #[must_use]
    pub fn is_spare(&self, fit: &Fit, effect: usize, to: &Fit) -> bool {
        fit.has_spare(effect) && self.cost(to) - self.cost(fit) < 2.0 * DECISIVE
    }

    /// Whether some hypothesis reaches the sensors' noise.
    #[must_use]
    pub fn is_exact(&self) -> bool {
        self.exact
    }

    /// What `fit` explains beyond `base`, in units of what a form that nobody knows exactly may be off by.
    #[must_use]
    pub fn beyond_form(&self, fit: &Fit, base: &Fit) -> f64 {
        share_of_form(base.shooting_error - fit.shooting_error, self.gap)
    }

    /// −2 log evidence, up to a constant.
    #[must_use]
    pub fn cost(&self, fit: &Fit) -> f64 {
        let innovations = fit.innovation.evidence_cost;
        let mut windows = fit.shooting_cost;
        // States beyond the nominal ones are free in each window: they may follow there what the hypothesis does not
        // explain, and pay each time for what is not known of them. The filter carries them from window to window: its
        // gain takes the place of the windows', or bounds it: what does not follow the windows though it is free in each is off.
        if fit.innovation.pass.states() > self.states {
            let (plain_windows, plain_innovations) = self.plain;
            let carried = plain_windows + innovations - plain_innovations;
            let bounded = self.bounded || fit.shooting_error > INEXACT;
            windows = if bounded { windows.max(carried) } else { carried };
        }
        let windows = self.independence * windows;
        if self.exact { self.share * innovations + (1.0 - self.share) * windows } else { windows }
    }
}

fn by_innovations(a: &&Fit, b: &&Fit) -> Ordering {
    a.innovation.evidence_cost.total_cmp(&b.innovation.evidence_cost)
}

/// Whether the innovations prefer `fit` decisively.
fn is_preferred(fit: &Fit, other: &Fit) -> bool {
    fit.innovation.evidence_cost < other.innovation.evidence_cost - DECISIVE
}

/// Whether `fit` has more effects than `base`, all of them where `base` has some.
fn is_beside(fit: &Fit, base: &Fit) -> bool {
    let known: Vec<_> = base.hypothesis.effects.iter().map(|at| &at.place).collect();
    !known.is_empty()
        && fit.hypothesis.effects.len() > known.len()
        && fit.hypothesis.effects.iter().all(|at| known.contains(&&at.place))
}
