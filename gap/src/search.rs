//! Fits every hypothesis and weighs them: short windows find the minimum, the innovation likelihood ranks.

mod fitted;
mod sharp;
mod wave;

use parallax_model::plant::Residual;
use rayon::prelude::*;

use crate::filter::{Noise, Pass};
use crate::hypothesis::{EffectAt, Hypothesis, Slot};
use crate::innovation::{InnovationFit, Known, fit, walk};
use crate::library;
use crate::ridge::Ridge;
use crate::setup::Setup;
use crate::stop::SEVERAL;
use crate::windows::{FEW, Shot, fit_windows, representative, windows};
pub use fitted::{Fit, INEXACT, RESTS};
pub(crate) use sharp::{HALVINGS, sharpened};

/// Most Gauss–Newton steps of a fit.
const ITERATIONS: usize = 15;

/// The walk of the nominal model with its own values along the fitted stretches, and the noise that makes it likeliest.
#[must_use]
pub fn nominal(setup: &Setup) -> (Pass, Noise) {
    let hypothesis = library::hypothesis(setup, &[]);
    let simulator = library::simulator(setup, &hypothesis, Vec::new());
    let values: Vec<f64> = hypothesis.fitted.iter().map(|f| f.null).collect();
    let walked = walk(&simulator, &setup.train, &setup.noise, &setup.noise.initial, &values);
    let noise = walked.refit_noise(
        &setup.noise.scale,
        &setup.noise.initial,
        &setup.noise.limits,
        setup.noise.process_floor,
    );
    (walked, noise)
}

/// The nominal model, refitted: the null hypothesis.
#[must_use]
pub fn null(setup: &Setup) -> Fit {
    let (_, noise) = nominal(setup);
    let hypothesis = library::hypothesis(setup, &[]);
    let start: Vec<f64> = hypothesis.fitted.iter().map(|f| f.null).collect();
    null_from(setup, &noise, &start)
}

/// The same from parameters and a noise that are not far.
#[must_use]
pub fn null_from(setup: &Setup, noise: &Noise, start: &[f64]) -> Fit {
    let hypothesis = library::hypothesis(setup, &[]);
    let simulator = library::simulator(setup, &hypothesis, Vec::new());
    let fitted = |known: Known<'_>, start: &[f64]| {
        fit(&simulator, &hypothesis, &setup.train, &setup.noise, known, start, ITERATIONS)
    };
    let mut innovation = fitted(Known::Nothing(noise), start);
    let shot = |innovation: &InnovationFit| {
        let windows = windows(setup, &simulator, &innovation.pass);
        fit_windows(setup, &simulator, &hypothesis, &windows, &innovation.minimum.theta, ITERATIONS)
    };
    let mut found = shot(&innovation);
    if found.error(setup) <= NEARLY {
        // The noise of other hypotheses is fitted from this one, as closely: a gain of theirs must not be one of the search.
        let closer = fitted(Known::Roughly(&innovation.noise), &innovation.minimum.theta);
        if closer.evidence_cost < innovation.evidence_cost {
            found = shot(&closer);
            innovation = closer;
        }
    }
    Fit::assemble(setup, hypothesis, Vec::new(), innovation, found)
}

/// Mean squared residual of the windows, in noise units squared, up to which a fit nearly reaches the noise.
const NEARLY: f64 = 9.0;

/// What a fit tells of the noise of hypotheses that contain its own. Far from the sensors' noise the likelihood has many hills, and a
/// search in wide steps crosses some.
fn known_from(fit: &Fit) -> Known<'_> {
    if fit.shooting_error <= NEARLY {
        Known::Near(&fit.innovation)
    } else {
        Known::Nothing(&fit.innovation.noise)
    }
}

/// How much work a fit is worth.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Effort {
    /// To convergence, from both losses' answers.
    Full,
    /// A few steps, for what the screen found far behind.
    Light,
    /// None by innovation likelihood, for what windows found too far behind to be any answer.
    Least,
}

/// Difference of −2 log evidence by windows to the best hypothesis from which one is no answer, unless it is among so many that
/// a score test of innovations promises most of.
const HOPELESS: (f64, usize) = (200.0, 20);

/// Fits a hypothesis by short windows from the given starts.
fn shoot_from(
    setup: &Setup,
    null: &Fit,
    hypothesis: &Hypothesis,
    starts: &[Vec<f64>],
    effort: Effort,
) -> Option<Shot> {
    let simulator = library::simulator(setup, hypothesis, Vec::new());
    let windows = windows(setup, &simulator, &null.innovation.pass);
    let (count, iterations) = if effort == Effort::Full { (FULL_STARTS, ITERATIONS) } else { (1, FEW) };
    let mut best: Option<Shot> = None;
    for start in starts.iter().take(count) {
        if best.is_some() && setup.stop.asked() {
            break;
        }
        let shot = fit_windows(setup, &simulator, hypothesis, &windows, start, iterations);
        if best.as_ref().is_none_or(|b| shot.cost < b.cost) {
            best = Some(shot);
        }
    }
    best
}

/// Fits a hypothesis by innovation likelihood, from where the windows left it.
fn refine(
    setup: &Setup,
    null: &Fit,
    hypothesis: Hypothesis,
    mut shot: Shot,
    start: &[f64],
    effort: Effort,
) -> Fit {
    let simulator = library::simulator(setup, &hypothesis, Vec::new());
    let known = known_from(null);
    let refine = |start: &[f64], iterations: usize| {
        fit(&simulator, &hypothesis, &setup.train, &setup.noise, known, start, iterations)
    };
    if effort != Effort::Full {
        let innovation = refine(&shot.minimum.theta, usize::from(effort == Effort::Light));
        return Fit::assemble(setup, hypothesis, Vec::new(), innovation, shot);
    }
    let mut innovation = refine(&shot.minimum.theta, ITERATIONS);
    // The two losses can end in different minima; the effect's null is always a candidate.
    let other = refine(start, ITERATIONS);
    if other.evidence_cost < innovation.evidence_cost {
        innovation = other;
    }
    let ridge = Ridge::of(&hypothesis.fitted).into_iter().next();
    let found = innovation.minimum.theta.clone();
    for start in ridge.iter().flat_map(|ridge| SPLITS.map(|ratio| ridge.at(&found, ratio))) {
        if setup.stop.asked() || innovation.evidence_cost > null.innovation.evidence_cost - RIDGE {
            break;
        }
        let other = refine(&start, ITERATIONS);
        if other.evidence_cost < innovation.evidence_cost {
            innovation = other;
        }
    }
    // Each loss starts from the other's answer as well, with the states that its own filter found.
    let own = windows(setup, &simulator, &innovation.pass);
    let again = fit_windows(setup, &simulator, &hypothesis, &own, &innovation.minimum.theta, ITERATIONS);
    if again.cost < shot.cost {
        shot = again;
    }
    Fit::assemble(setup, hypothesis, Vec::new(), innovation, shot)
}

/// Difference of −2 log evidence to the null model from which a spring's split is worth a search of its own.
const RIDGE: f64 = 20.0;

/// Shares of the inertia beyond a spring from which a fit begins again.
const SPLITS: [f64; 3] = [0.2, 0.5, 0.8];

/// Windows of the screen.
const SCREEN_WINDOWS: usize = 48;

/// Starts of an effect that are followed to the end.
const FULL_STARTS: usize = 2;

/// How many hypotheses are followed how far.
#[derive(Clone, Copy, Debug)]
pub struct Width {
    /// Hypotheses that are fitted to convergence by short windows.
    pub shortlist: usize,
    /// Of these, those that are fitted to convergence by innovation likelihood.
    pub finalists: usize,
    /// Of the given order, those that are fitted to convergence by both in any case.
    pub leading: usize,
    /// Whether the best of each effect and place is among the first, and the best of each kind of place among the second.
    pub diverse: bool,
}

impl Width {
    /// For all single effects, in the order of a score test on innovations: windows whose states are free are blind to a
    /// spring inside a joint that swings within them.
    pub const SINGLES: Width = Width { shortlist: 20, finalists: 12, leading: 3, diverse: true };
    /// For an effect beside others, in the order of a score test on innovations: windows are blind to what another start
    /// of each makes good.
    pub const FURTHER: Width = Width { shortlist: 3, finalists: 2, leading: 2, diverse: false };
}

/// A hypothesis with its starts, the most promising first.
#[derive(Clone, Debug)]
struct Screened {
    hypothesis: Hypothesis,
    /// Where the effect is at its first start, calibrated parameters where the null model left them.
    first: Vec<f64>,
    starts: Vec<Vec<f64>>,
    /// −2 log evidence on a sample of the windows, from the best start.
    cost: f64,
}

/// Follows every start of a hypothesis for a few steps, on a sample of the windows.
fn screen(setup: &Setup, base: &Fit, hypothesis: Hypothesis) -> Screened {
    let simulator = library::simulator(setup, &hypothesis, Vec::new());
    let sample = representative(setup, windows(setup, &simulator, &base.innovation.pass), SCREEN_WINDOWS);
    let declared = hypothesis.starts();
    let mut starts = declared.clone();
    for start in &mut starts {
        continue_from(base, &hypothesis, start);
    }
    wave::turned(setup, base, &hypothesis, &mut starts);
    if base.is_strained() {
        starts.extend(declared);
    }
    let first = starts.first().cloned().unwrap_or_default();
    let mut tried: Vec<(f64, Vec<f64>)> = starts
        .into_iter()
        .map(|start| {
            let shot = fit_windows(setup, &simulator, &hypothesis, &sample, &start, FEW);
            let cost = if shot.cost.is_nan() { f64::INFINITY } else { shot.cost };
            (cost, shot.minimum.theta)
        })
        .collect();
    // The sort is stable: of equal starts the first one leads.
    tried.sort_by(|a, b| a.0.total_cmp(&b.0));
    let cost = tried.first().map_or(f64::INFINITY, |t| t.0);
    Screened { hypothesis, first, starts: tried.into_iter().map(|t| t.1).collect(), cost }
}

/// The first `count` of an order, and the first of each group.
fn shortlist<K: PartialEq>(order: &[usize], count: usize, groups: impl Fn(usize) -> Vec<K>) -> Vec<bool> {
    let mut kept = vec![false; order.len()];
    let mut seen: Vec<K> = Vec::new();
    for (rank, index) in order.iter().enumerate() {
        let own = groups(*index);
        kept[*index] = rank < count || own.iter().any(|group| !seen.contains(group));
        seen.extend(own);
    }
    kept
}

fn by_cost(costs: &[f64]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..costs.len()).collect();
    order.sort_by(|a, b| costs[*a].total_cmp(&costs[*b]).then(a.cmp(b)));
    order
}

/// How a report calls a hypothesis that was not tried.
fn untried(hypothesis: &Hypothesis) -> String {
    if hypothesis.effects.len() > 1 { SEVERAL.into() } else { hypothesis.label() }
}

/// Fits hypotheses in parallel, each with as much work as it is worth; `done` is told of each.
///
/// All are screened from all of their starts on a sample of the windows. The most promising, and the best of each effect
/// and of each place, are fitted by short windows to convergence; the best of these, and the best of each kind of place, by
/// innovation likelihood as well.
///
/// Once the diagnosis shall end, only finalists are brought to an end, in a few steps; the others are left out.
#[must_use]
pub fn fit_all(
    setup: &Setup,
    base: &Fit,
    hypotheses: Vec<Hypothesis>,
    width: Width,
    done: &(dyn Fn(&str) + Sync),
) -> Vec<Fit> {
    let leading = if setup.stop.asked() { 0 } else { width.leading };
    let screened: Vec<Screened> = hypotheses
        .into_par_iter()
        .filter(|hypothesis| !setup.stop.leaves_out(|| untried(hypothesis)))
        .map(|hypothesis| screen(setup, base, hypothesis))
        .collect();
    let order = by_cost(&screened.iter().map(|s| s.cost).collect::<Vec<_>>());
    let last = |index: usize| screened[index].hypothesis.effects.last();
    let promising = shortlist(&order, width.shortlist, |index| match last(index) {
        Some(at) if width.diverse => vec![at.effect.name().to_owned(), at.place.to_string()],
        _ => Vec::new(),
    });
    let effort = |kept: bool| if kept { Effort::Full } else { Effort::Light };
    let shots: Vec<Option<Shot>> = (0..screened.len())
        .into_par_iter()
        .map(|k| {
            let Screened { hypothesis, starts, .. } = &screened[k];
            if setup.stop.leaves_out(|| untried(hypothesis)) {
                return None;
            }
            shoot_from(setup, base, hypothesis, starts, effort(promising[k] || k < leading))
        })
        .collect();
    let costs: Vec<f64> = shots.iter().map(|s| s.as_ref().map_or(f64::INFINITY, |s| s.cost)).collect();
    let finalists = shortlist(&by_cost(&costs), width.finalists, |index| match last(index) {
        Some(at) if width.diverse => vec![at.place.kind],
        _ => Vec::new(),
    });
    let finalist = |k: usize| finalists[k] || k < leading;
    let best = costs.iter().copied().fold(f64::INFINITY, f64::min);
    let hopeless: Vec<bool> =
        costs.iter().enumerate().map(|(k, cost)| *cost > best + HOPELESS.0 && k >= HOPELESS.1).collect();
    let all: Vec<(usize, (Screened, Option<Shot>))> = screened.into_iter().zip(shots).enumerate().collect();
    all.into_par_iter()
        .filter_map(|(k, (screened, shot))| {
            let label = screened.hypothesis.label();
            let shot = shot?;
            if !finalist(k) && setup.stop.leaves_out(|| untried(&screened.hypothesis)) {
                return None;
            }
            let effort = match effort(finalist(k) && !setup.stop.asked()) {
                Effort::Light if hopeless[k] => Effort::Least,
                effort => effort,
            };
            let fit = refine(setup, base, screened.hypothesis, shot, &screened.first, effort);
            done(&label);
            Some(fit)
        })
        .filter(|fit| library::is_possible(setup, fit))
        .collect()
}

/// Fits one hypothesis as well as can be: every start by short windows, the best of them by innovation likelihood.
#[must_use]
pub fn fit_hypothesis(setup: &Setup, base: &Fit, hypothesis: Hypothesis) -> Fit {
    let Screened { hypothesis, first, starts, .. } = screen(setup, base, hypothesis);
    match shoot_from(setup, base, &hypothesis, &starts, Effort::Full) {
        Some(shot) => refine(setup, base, hypothesis, shot, &first, Effort::Full),
        None => base.clone(),
    }
}

/// Fits some of the effects of a fitted hypothesis, from where they are in it, in steps no coarser where friction is dry; an effect in
/// another form from where its parameters are that both forms have.
#[must_use]
pub fn fit_part(setup: &Setup, null: &Fit, hypothesis: Hypothesis, whole: &Fit) -> Fit {
    let hypothesis = hypothesis.no_coarser_than(&whole.hypothesis);
    let mut start: Vec<f64> = hypothesis.fitted.iter().map(|f| f.null).collect();
    start_where(whole, &hypothesis, &mut start);
    fit_at(setup, null, hypothesis, &start)
}

/// Fits the effects of two fits together, from where they are in these, calibrated parameters as the second has them.
#[must_use]
pub fn fit_together(setup: &Setup, hypothesis: Hypothesis, first: &Fit, second: &Fit) -> Fit {
    let mut start: Vec<f64> = hypothesis.fitted.iter().map(|f| f.null).collect();
    start_where(first, &hypothesis, &mut start);
    start_where(second, &hypothesis, &mut start);
    fit_at(setup, first, hypothesis, &start)
}

/// Puts what a hypothesis has in common with a fit where that has it.
fn start_where(whole: &Fit, hypothesis: &Hypothesis, start: &mut [f64]) {
    for (e, at) in hypothesis.effects.iter().enumerate() {
        let known = whole.hypothesis.effects.iter();
        let same = known.clone().position(|other| other == at);
        let Some(of) = same.or_else(|| known.clone().position(|other| other.label() == at.label())) else {
            continue;
        };
        let other = &whole.hypothesis.effects[of].effect;
        for (value, fitted) in start.iter_mut().zip(&hypothesis.fitted) {
            let slot = match fitted.slot {
                Slot::Effect { effect, parameter } if effect == e => {
                    let name = at.effect.parameters()[parameter].name;
                    let Some(parameter) = other.parameters().iter().position(|spec| spec.name == name) else {
                        continue;
                    };
                    Slot::Effect { effect: of, parameter }
                }
                Slot::Nominal(index) => Slot::Nominal(index),
                _ => continue,
            };
            if let Some(j) = whole.hypothesis.fitted.iter().position(|f| f.slot == slot) {
                *value = whole.estimate()[j];
            }
        }
    }
}

/// Fits a hypothesis from one start.
fn fit_at(setup: &Setup, null: &Fit, hypothesis: Hypothesis, start: &[f64]) -> Fit {
    match shoot_from(setup, null, &hypothesis, &[start.to_vec()], Effort::Full) {
        Some(shot) => refine(setup, null, hypothesis, shot, start, Effort::Full),
        None => null.clone(),
    }
}

/// Where a fit with a residual begins by either loss.
#[derive(Clone, Debug)]
pub struct Begin {
    /// Parameters for the innovation likelihood.
    pub innovations: Vec<f64>,
    /// Parameters for short windows; where these left a fit may differ from where the innovations did.
    pub windows: Vec<f64>,
}

/// Fits a hypothesis with a residual near another one (`base`), from the best of the starts, with at most so many steps by the innovation
/// likelihood; the windows' states have to follow, which takes more.
#[must_use]
pub fn fit_from(
    setup: &Setup,
    base: &Fit,
    hypothesis: Hypothesis,
    residuals: Vec<Residual>,
    starts: &[Begin],
    iterations: usize,
) -> Fit {
    let simulator = library::simulator(setup, &hypothesis, residuals.clone());
    let known = known_from(base);
    let by_innovations = |start: &Begin| {
        fit(&simulator, &hypothesis, &setup.train, &setup.noise, known, &start.innovations, iterations)
    };
    let windows = windows(setup, &simulator, &base.innovation.pass);
    let by_windows =
        |start: &Begin| fit_windows(setup, &simulator, &hypothesis, &windows, &start.windows, 3 * iterations);
    let innovation =
        starts.iter().map(by_innovations).min_by(|a, b| a.evidence_cost.total_cmp(&b.evidence_cost));
    let shot = starts.iter().map(by_windows).min_by(|a, b| a.cost.total_cmp(&b.cost));
    match innovation.zip(shot) {
        Some((innovation, shot)) => Fit::assemble(setup, hypothesis, residuals, innovation, shot),
        None => base.clone(),
    }
}

/// Puts the calibrated parameters where the null model's fit left them.
fn continue_from(null: &Fit, hypothesis: &Hypothesis, start: &mut [f64]) {
    for (value, fitted) in start.iter_mut().zip(&hypothesis.fitted) {
        let known = null.hypothesis.fitted.iter().position(|f| f.slot == fitted.slot);
        if let Some(index) = known {
            *value = null.theta()[index];
        }
    }
}

/// Fits all single effects, in parallel, the first of them to convergence in any case; `done` is told of each.
#[must_use]
pub fn singles(setup: &Setup, null: &Fit, effects: &[EffectAt], done: &(dyn Fn(&str) + Sync)) -> Vec<Fit> {
    let hypotheses = effects.iter().map(|at| library::hypothesis(setup, std::slice::from_ref(at))).collect();
    fit_all(setup, null, hypotheses, Width::SINGLES, done)
}
