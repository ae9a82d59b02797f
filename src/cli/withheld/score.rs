//! The scores of a run: goals beside results, groups, confusion.

mod others;

use std::collections::BTreeMap;

use parallax_withheld_truth::Set;
use serde::Serialize;

use super::case::CaseResult;
use super::judge::Case;
use super::seal::Answers;
use super::statistics::{Score, area, bootstrap, calibration_error, mean, quantile, share};

/// Twice the log-likelihood ratio of the true effect to the best refit, on the truth's side, from which a case counts as
/// detectable.
pub(crate) const DETECTABLE: f64 = 20.0;

/// Bins of that ratio: each begins where the one before ends.
const BINS: [f64; 6] = [f64::NEG_INFINITY, 5.0, 20.0, 100.0, 1000.0, 10_000.0];

/// The line that compares with methods that name nothing.
const NOMINAL_CLOSED: &str = "held-out gap of the nominal system closed, median, detectable";

/// A goal.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Goal {
    /// The value should be this or more.
    AtLeast(f64),
    /// The value should be this or less.
    AtMost(f64),
    /// The value should be in between.
    Between(f64, f64),
}

impl Goal {
    /// Whether a value reaches it.
    pub(crate) fn reached(self, value: f64) -> bool {
        match self {
            Goal::AtLeast(least) => value >= least,
            Goal::AtMost(most) => value <= most,
            Goal::Between(low, high) => (low..=high).contains(&value),
        }
    }
}

/// How a value is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Unit {
    /// A share, written in percent.
    Percent,
    /// A plain number.
    Plain,
    /// Seconds.
    Seconds,
}

/// One line of the table.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct Line {
    /// What is scored.
    pub(crate) name: &'static str,
    /// What should be reached.
    pub(crate) goal: Option<Goal>,
    /// What was reached.
    pub(crate) score: Score,
    /// How it is written.
    pub(crate) unit: Unit,
}

/// Singles of one kind.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct Group {
    /// Which.
    pub(crate) name: String,
    /// How often a gap was detected.
    pub(crate) detected: Score,
    /// How often the class was right.
    pub(crate) class: Score,
    /// How often the effect itself was.
    pub(crate) raw: Score,
    /// How often the place was.
    pub(crate) place: Score,
    /// Mean probability of the truth.
    pub(crate) probability: Option<f64>,
}

/// All scores of a run.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct Scores {
    /// SHA-256 of the sealed answers, the seed among them.
    pub(crate) seal: String,
    /// The seed.
    pub(crate) seed: u64,
    /// Whether it is one for development; such a run is not to be reported.
    pub(crate) development: bool,
    /// How many cases of each set.
    pub(crate) sets: BTreeMap<String, usize>,
    /// Goals and results.
    pub(crate) lines: Vec<Line>,
    /// The other methods on the same cases, by name.
    pub(crate) baselines: BTreeMap<String, Vec<Line>>,
    /// Singles by system.
    pub(crate) by_system: Vec<Group>,
    /// Singles by effect.
    pub(crate) by_effect: Vec<Group>,
    /// Singles by detectability.
    pub(crate) by_detectability: Vec<Group>,
    /// True effect, what was answered, and how often.
    pub(crate) confusion: BTreeMap<String, BTreeMap<String, usize>>,
    /// Diagnoses, experiments and other methods that failed, and why.
    pub(crate) failures: Vec<(String, String)>,
}

/// Name of a set in the results.
fn set_name(set: Set) -> String {
    serde_json::to_value(set).ok().and_then(|name| name.as_str().map(str::to_owned)).unwrap_or_default()
}

/// What a score is made of: a result for each case that is asked for.
fn rate<'a>(cases: &[Case<'a>], right: impl Fn(&Case<'a>) -> bool) -> Score {
    share(&cases.iter().map(right).collect::<Vec<_>>())
}

fn median_of(values: &[f64]) -> Score {
    bootstrap(values, |drawn| quantile(drawn, 0.5))
}

impl Scores {
    /// Scores results by their answers. A case without a result counts as one that failed.
    pub(crate) fn of(answers: &Answers, results: &BTreeMap<String, CaseResult>, seal: String) -> Self {
        let none = CaseResult { error: Some("there is no result".into()), ..CaseResult::default() };
        let cases: Vec<Case> = answers
            .cases
            .iter()
            .map(|(name, truth)| Case { truth, result: results.get(name).unwrap_or(&none) })
            .collect();
        let mut sets = BTreeMap::new();
        for case in &cases {
            let left_out = if case.truth.left_out { " left out" } else { "" };
            *sets.entry(set_name(case.truth.answer.set) + left_out).or_insert(0) += 1;
        }
        let singles = of_set(&cases, Set::Single);
        let mut confusion: BTreeMap<String, BTreeMap<String, usize>> = BTreeMap::new();
        for case in &singles {
            let truth = case.truth.answer.effects.first().map(|e| e.name.clone()).unwrap_or_default();
            *confusion.entry(truth).or_default().entry(case.said()).or_insert(0) += 1;
        }
        let mut failures = Vec::new();
        for (name, case) in answers.cases.keys().zip(&cases) {
            let mut add = |what: String, error: &Option<String>| {
                failures.extend(error.as_ref().map(|error| (what, error.clone())));
            };
            add(name.clone(), &case.result.error);
            if let Some(separation) = &case.result.separation {
                add(format!("{name}, proposed experiment"), &separation.error);
            }
            for (baseline, result) in &case.result.baselines {
                add(format!("{name}, {baseline}"), &result.error);
            }
        }
        Scores {
            seal,
            seed: answers.seed,
            development: answers.development,
            sets,
            lines: lines(&cases),
            baselines: others::lines(&cases),
            by_system: groups(&singles, |case| case.truth.answer.system.clone()),
            by_effect: groups(&singles, |case| {
                case.truth.answer.effects.first().map(|e| e.name.clone()).unwrap_or_default()
            }),
            by_detectability: bins(&singles),
            confusion,
            failures,
        }
    }
}

/// Cases of a set whose true effect is in the library.
fn of_set<'a>(cases: &[Case<'a>], set: Set) -> Vec<Case<'a>> {
    cases.iter().filter(|c| c.truth.answer.set == set && !c.truth.left_out).copied().collect()
}

fn detectable(case: &Case) -> bool {
    case.truth.answer.detectability >= DETECTABLE
}

/// Goals and results.
fn lines(cases: &[Case]) -> Vec<Line> {
    use Goal::{AtLeast, AtMost, Between};
    use Unit::{Percent, Plain, Seconds};
    let singles = of_set(cases, Set::Single);
    let nulls = of_set(cases, Set::Null);
    let other = of_set(cases, Set::OtherForm);
    let pairs = of_set(cases, Set::Pair);
    let seen: Vec<Case> = singles.iter().filter(|c| detectable(c)).copied().collect();
    let left_out: Vec<Case> = cases.iter().filter(|c| c.truth.left_out).copied().collect();

    let confidence: Vec<(f64, bool)> = singles.iter().filter_map(Case::confidence).collect();
    let rough = of_set(cases, Set::Rough);
    let parameters: Vec<(f64, Option<bool>)> = singles.iter().flat_map(Case::parameters).collect();
    let covered: Vec<bool> = parameters.iter().filter_map(|(_, inside)| *inside).collect();
    let errors: Vec<f64> = parameters.iter().map(|(error, _)| *error).collect();
    let lowering = |from: &[Case]| -> Vec<f64> {
        let found = from.iter().filter(|c| c.can_lower());
        found.map(|c| c.result.found.as_ref().and_then(|f| f.closed).unwrap_or(0.0)).collect()
    };
    let (closed, closed_all) = (lowering(&seen), lowering(&singles));
    let total: Vec<f64> = seen
        .iter()
        .filter(|c| c.can_lower())
        .map(|c| c.result.found.as_ref().and_then(|f| f.closed_total).unwrap_or(0.0))
        .collect();
    let open = open_set(&singles, &of_set(cases, Set::Outside), |case| case.unexplained().0);
    let open_by_share = open_set(&singles, &of_set(cases, Set::Outside), |case| case.unexplained().1);
    let times: Vec<f64> = cases.iter().map(|c| c.result.seconds).collect();
    let weights: Vec<f64> = singles
        .iter()
        .map(|c| f64::from(u8::from(c.right_within(1))) / c.class().len().max(1) as f64)
        .collect();
    let sizes: Vec<f64> = singles.iter().map(|c| c.class().len() as f64).collect();
    let truth: Vec<f64> = singles.iter().map(Case::probability_of_truth).collect();
    let brier: Vec<f64> = singles.iter().map(Case::brier).collect();
    let separations: Vec<(bool, bool)> = cases.iter().filter_map(Case::separation).collect();
    let separated: Vec<bool> =
        separations.iter().filter(|(held, _)| *held).map(|(_, right)| *right).collect();
    let separated_all: Vec<bool> = separations.iter().map(|(_, right)| *right).collect();
    let matched: Vec<(usize, usize, usize)> = pairs.iter().map(Case::matched).collect();

    let line = |name, goal, unit, score| Line { name, goal, score, unit };
    vec![
        line("false alarms, null", Some(AtMost(0.02)), Percent, rate(&nulls, Case::detected)),
        line("detection, singles", Some(AtLeast(0.95)), Percent, rate(&singles, Case::detected)),
        line(
            "cause, class, top 1, singles",
            Some(AtLeast(0.95)),
            Percent,
            rate(&singles, |c| c.right_within(1)),
        ),
        line(
            "cause, class, top 2, singles",
            Some(AtLeast(0.99)),
            Percent,
            rate(&singles, |c| c.right_within(2)),
        ),
        line("cause, top 1, the effect itself", None, Percent, rate(&singles, Case::raw)),
        line(
            "cause, class, top 1, detectable",
            Some(AtLeast(0.98)),
            Percent,
            rate(&seen, |c| c.right_within(1)),
        ),
        line("cause, top 1, weighted by 1/|class|", None, Percent, bootstrap(&weights, mean)),
        line("mean size of a class", None, Plain, bootstrap(&sizes, mean)),
        line("place, singles", Some(AtLeast(0.97)), Percent, rate(&singles, Case::place)),
        line("mean probability of the truth, singles", None, Plain, bootstrap(&truth, mean)),
        line(
            "calibration error (ECE), singles",
            Some(AtMost(0.03)),
            Plain,
            bootstrap(&confidence, calibration_error),
        ),
        line("Brier score, singles", None, Plain, bootstrap(&brier, mean)),
        line("right when P > 0.95, singles", Some(AtLeast(0.98)), Percent, share(&sure_of(&singles))),
        line("parameter error, median", Some(AtMost(0.03)), Percent, median_of(&errors)),
        line("coverage of 95 % intervals", Some(Between(0.90, 0.99)), Percent, share(&covered)),
        line("held-out gap closed, median, detectable", Some(AtLeast(0.97)), Plain, median_of(&closed)),
        line(
            "held-out gap closed, 10th percentile, detectable",
            Some(AtLeast(0.90)),
            Plain,
            bootstrap(&closed, |drawn| quantile(drawn, 0.1)),
        ),
        line("held-out gap closed, median, all singles", None, Plain, median_of(&closed_all)),
        line(
            "held-out gap closed, 10th percentile, all singles",
            None,
            Plain,
            bootstrap(&closed_all, |drawn| quantile(drawn, 0.1)),
        ),
        line(NOMINAL_CLOSED, None, Plain, median_of(&total)),
        line(
            "another form: cause, class, top 1",
            Some(AtLeast(0.88)),
            Percent,
            rate(&other, |c| c.right_within(1)),
        ),
        line("another form: family", Some(AtLeast(0.97)), Percent, rate(&other, Case::family)),
        line(
            "pairs: exact set",
            Some(AtLeast(0.85)),
            Percent,
            rate(&pairs, |c| {
                let (said, right, count) = c.matched();
                said == count && right == count
            }),
        ),
        line("pairs: precision", Some(AtLeast(0.97)), Percent, bootstrap(&matched, precision)),
        line("pairs: recall", None, Percent, bootstrap(&matched, recall)),
        line("outside the library: AUROC of P(unexplained)", Some(AtLeast(0.97)), Plain, open),
        line("outside the library: AUROC of the share left", None, Plain, open_by_share),
        line("effect left out: none of these, or alike", None, Percent, rate(&left_out, Case::none_or_alike)),
        line(
            "poor excitation: cause, class, top 1",
            None,
            Percent,
            rate(&of_set(cases, Set::PoorExcitation), |c| c.right_within(1)),
        ),
        line(
            "six seconds: cause, class, top 1",
            None,
            Percent,
            rate(&of_set(cases, Set::Short), |c| c.right_within(1)),
        ),
        line("rough machine: cause, class, top 1", None, Percent, rate(&rough, |c| c.right_within(1))),
        line("rough machine: place", None, Percent, rate(&rough, Case::place)),
        line("rough machine: right when P > 0.95", None, Percent, share(&sure_of(&rough))),
        line(
            "rough machine: an effect is named where there is none",
            None,
            Percent,
            rate(&of_set(cases, Set::RoughNull), |c| c.leader().is_some()),
        ),
        line(
            "proposed experiment separates a confusable pair",
            Some(AtLeast(0.85)),
            Percent,
            share(&separated),
        ),
        line(
            "proposed experiment ends at the truth, classes without it included",
            None,
            Percent,
            share(&separated_all),
        ),
        line("diagnoses that failed", Some(AtMost(0.0)), Percent, rate(cases, Case::failed)),
        line("time, median", Some(AtMost(10.0)), Seconds, median_of(&times)),
        line("time, 90 %", None, Seconds, bootstrap(&times, |drawn| quantile(drawn, 0.9))),
        line(
            "time, longest",
            None,
            Seconds,
            Score { value: quantile(&times, 1.0), count: times.len(), ..Score::default() },
        ),
    ]
}

/// Whether answers that are all but certain are right.
fn sure_of(cases: &[Case]) -> Vec<bool> {
    let confidence = cases.iter().filter_map(Case::confidence);
    confidence.filter(|(p, _)| *p > 0.95).map(|(_, right)| right).collect()
}

/// Of the effects that were answered, how many are true.
fn precision(matched: &[(usize, usize, usize)]) -> Option<f64> {
    let said: usize = matched.iter().map(|m| m.0).sum();
    let right: usize = matched.iter().map(|m| m.1).sum();
    (said > 0).then(|| right as f64 / said as f64)
}

/// Of the true effects, how many were answered.
fn recall(matched: &[(usize, usize, usize)]) -> Option<f64> {
    let count: usize = matched.iter().map(|m| m.2).sum();
    let right: usize = matched.iter().map(|m| m.1).sum();
    (count > 0).then(|| right as f64 / count as f64)
}

/// How well a score tells causes outside the library from those inside.
fn open_set<'a>(inside: &[Case<'a>], outside: &[Case<'a>], score: impl Fn(&Case<'a>) -> f64) -> Score {
    let cases: Vec<(f64, bool)> =
        (outside.iter().map(|c| (score(c), true))).chain(inside.iter().map(|c| (score(c), false))).collect();
    bootstrap(&cases, area)
}

fn groups<'a>(singles: &[Case<'a>], key: impl Fn(&Case<'a>) -> String) -> Vec<Group> {
    let mut by: BTreeMap<String, Vec<Case>> = BTreeMap::new();
    for case in singles {
        by.entry(key(case)).or_default().push(*case);
    }
    by.into_iter().map(|(name, cases)| group(name, &cases)).collect()
}

fn group(name: String, cases: &[Case]) -> Group {
    let truth: Vec<f64> = cases.iter().map(Case::probability_of_truth).collect();
    Group {
        name,
        detected: rate(cases, Case::detected),
        class: rate(cases, |c| c.right_within(1)),
        raw: rate(cases, Case::raw),
        place: rate(cases, Case::place),
        probability: mean(&truth),
    }
}

fn bins(singles: &[Case]) -> Vec<Group> {
    let bin = |k: usize| {
        let (low, high) = (BINS[k], BINS.get(k + 1).copied().unwrap_or(f64::INFINITY));
        let cases: Vec<Case> =
            singles.iter().filter(|c| (low..high).contains(&c.truth.answer.detectability)).copied().collect();
        let name = if k == 0 {
            format!("below {high}")
        } else if high.is_finite() {
            format!("{low} to {high}")
        } else {
            format!("{low} and more")
        };
        (!cases.is_empty()).then(|| group(name, &cases))
    };
    (0..BINS.len()).filter_map(bin).collect()
}

#[cfg(test)]
#[path = "score_tests.rs"]
mod tests;
