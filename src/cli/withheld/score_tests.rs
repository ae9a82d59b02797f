//! Made-up results whose scores are known by hand.

use parallax_withheld_truth::{Answer, Plan, Truth};

use super::*;
use crate::cli::withheld::baselines::BaselineResult;
use crate::cli::withheld::case::{Finding, NamedAnswer, NamedEffect};
use crate::cli::withheld::seal::Sealed;
use crate::cli::withheld::separate::Separation;

/// What was found: each answer as its labels and its probability.
fn found(detected: bool, answers: &[(&[&str], f64)], no_gap: f64, unexplained: f64) -> CaseResult {
    let named = |(labels, probability): &(&[&str], f64)| NamedAnswer {
        effects: labels
            .iter()
            .map(|label| NamedEffect {
                label: (*label).into(),
                parameters: BTreeMap::from([("force".into(), (1.1, Some(0.1)))]),
            })
            .collect(),
        probability: *probability,
    };
    let place = answers.first().and_then(|(labels, _)| labels.first()?.split_once('@'));
    CaseResult {
        seconds: 2.0,
        found: Some(Finding {
            detected,
            answers: answers.iter().map(named).collect(),
            no_gap,
            unexplained,
            unexplained_share: unexplained,
            place: place.map(|(_, place)| place.into()),
            closed: Some(0.9),
            closed_total: Some(0.8),
        }),
        ..CaseResult::default()
    }
}

fn truth(set: Set, effects: &[&str], class: &[&str], detectability: f64) -> Sealed {
    let effects = effects.iter().map(|label| {
        let (name, place) = label.split_once('@').unwrap();
        Truth {
            name: name.into(),
            place: place.into(),
            form: "first".into(),
            parameters: BTreeMap::from([("force".into(), 1.0)]),
        }
    });
    let answer = Answer {
        set,
        system: "arm".into(),
        effects: effects.collect(),
        outside: (set == Set::Outside).then(|| "wall".into()),
        detectability,
        class: class.iter().map(|label| (*label).into()).collect(),
    };
    Sealed { answer, left_out: false, plan: Plan { set, system: 0, effect: 0 }, seed: 0 }
}

fn scored(cases: Vec<(Sealed, CaseResult)>) -> Scores {
    let mut answers = Answers { seed: 1, development: true, cases: BTreeMap::new() };
    let mut results = BTreeMap::new();
    for (k, (sealed, result)) in cases.into_iter().enumerate() {
        let case = format!("{k:04}");
        answers.cases.insert(case.clone(), sealed);
        results.insert(case.clone(), CaseResult { case, ..result });
    }
    Scores::of(&answers, &results, "hash".into())
}

#[track_caller]
fn check(scores: &Scores, name: &str, expected: f64, count: usize) {
    let line = scores.lines.iter().find(|line| line.name == name).expect("the line exists");
    let value = line.score.value.expect("it has a value");
    assert!((value - expected).abs() < 1e-9, "{name}: {value} is not {expected}");
    assert_eq!(line.score.count, count, "{name}");
}

const COULOMB: &str = "coulomb@joint:a";
const LATE: &str = "delay@input:u";
const LAG: &str = "lag@input:u";

/// Four singles: right; right by class only; second best; failed. Two nulls, one of them an alarm.
fn run() -> Scores {
    let failed = CaseResult { error: Some("it panicked".into()), seconds: 4.0, ..CaseResult::default() };
    scored(vec![
        (
            truth(Set::Single, &[COULOMB], &[COULOMB], 50.0),
            found(true, &[(&[COULOMB], 0.98), (&[LATE], 0.02)], 0.0, 0.0),
        ),
        (
            truth(Set::Single, &[LATE], &[LATE, LAG], 50.0),
            found(true, &[(&[LAG], 0.8), (&[COULOMB], 0.2)], 0.0, 0.0),
        ),
        (
            truth(Set::Single, &[LATE], &[LATE], 1.0),
            found(true, &[(&[COULOMB], 0.6), (&[LATE], 0.4)], 0.0, 0.0),
        ),
        (truth(Set::Single, &[LATE], &[LATE], 50.0), failed),
        (truth(Set::Null, &[], &[], 0.0), found(false, &[(&[LATE], 0.1)], 0.9, 0.0)),
        (truth(Set::Null, &[], &[], 0.0), found(true, &[(&[LATE], 0.7)], 0.3, 0.0)),
    ])
}

#[test]
fn rates_by_hand() {
    let scores = run();
    check(&scores, "false alarms, null", 0.5, 2);
    check(&scores, "detection, singles", 0.75, 4);
    check(&scores, "cause, class, top 1, singles", 0.5, 4);
    check(&scores, "cause, class, top 2, singles", 0.75, 4);
    check(&scores, "cause, top 1, the effect itself", 0.25, 4);
    check(&scores, "cause, class, top 1, detectable", 2.0 / 3.0, 3);
    check(&scores, "cause, top 1, weighted by 1/|class|", (1.0 + 0.5) / 4.0, 4);
    check(&scores, "mean size of a class", 1.25, 4);
    check(&scores, "place, singles", 0.5, 4);
    assert_eq!(scores.failures, [("0003".to_owned(), "it panicked".to_owned())]);
    assert_eq!(scores.confusion["coulomb"]["coulomb"], 1);
    let late = [("coulomb", 1), ("failed", 1), ("lag", 1)].map(|(name, n)| (name.to_owned(), n));
    assert_eq!(scores.confusion["delay"], BTreeMap::from(late));
    assert_eq!(scores.by_effect.len(), 2);
    assert_eq!(scores.by_detectability.iter().map(|g| g.class.count).collect::<Vec<_>>(), [1, 3]);
    assert_eq!(scores.sets, BTreeMap::from([("single".into(), 4), ("null".into(), 2)]));
}

#[test]
fn probabilities_by_hand() {
    let scores = run();
    check(&scores, "mean probability of the truth, singles", (0.98 + 0.8 + 0.4 + 0.0) / 4.0, 4);
    // Off by 0.02, 0.2 and 0.6 in three bins; the one that failed states no probability.
    check(&scores, "calibration error (ECE), singles", (0.02 + 0.2 + 0.6) / 3.0, 3);
    let brier = (0.02_f64.powi(2) * 2.0 + 0.2_f64.powi(2) * 2.0 + 0.6_f64.powi(2) * 2.0 + 1.0) / 4.0;
    check(&scores, "Brier score, singles", brier, 4);
    check(&scores, "right when P > 0.95, singles", 1.0, 1);
}

#[test]
fn parameters_gap_and_time_by_hand() {
    let scores = run();
    // Only where the effect itself leads: 1.1 ± 0.1 for 1.
    check(&scores, "parameter error, median", 0.1, 1);
    check(&scores, "coverage of 95 % intervals", 1.0, 1);
    // Three detectable: 0.9, 0.9, and nothing where the diagnosis failed.
    check(&scores, "held-out gap closed, median, detectable", 0.9, 3);
    check(&scores, "held-out gap closed, 10th percentile, detectable", 0.18, 3);
    check(&scores, "time, median", 2.0, 6);
    check(&scores, "time, longest", 4.0, 6);
    // All four singles count, the one that failed as nothing closed.
    check(&scores, "held-out gap closed, median, all singles", 0.9, 4);
    check(&scores, "diagnoses that failed", 1.0 / 6.0, 6);
}

#[test]
fn a_null_that_is_not_detected_is_no_right_answer_for_a_single() {
    let scores =
        scored(vec![(truth(Set::Single, &[LATE], &[LATE], 50.0), found(false, &[(&[LATE], 0.6)], 0.4, 0.0))]);
    check(&scores, "cause, class, top 1, singles", 0.0, 1);
    check(&scores, "cause, class, top 2, singles", 1.0, 1);
    assert_eq!(scores.confusion["delay"]["no gap"], 1);
}

#[test]
fn pairs_by_hand() {
    let both = [COULOMB, LATE];
    let scores = scored(vec![
        (truth(Set::Pair, &both, &[], 50.0), found(true, &[(&[LATE, COULOMB], 0.9)], 0.0, 0.0)),
        (truth(Set::Pair, &both, &[LAG], 50.0), found(true, &[(&[LAG, COULOMB], 0.9)], 0.0, 0.0)),
        (truth(Set::Pair, &both, &[], 50.0), found(true, &[(&[LATE], 0.9)], 0.0, 0.0)),
        (truth(Set::Pair, &both, &[], 50.0), found(true, &[(&[LATE, "spring@joint:a"], 0.9)], 0.0, 0.0)),
    ]);
    check(&scores, "pairs: exact set", 0.5, 4);
    check(&scores, "pairs: precision", 6.0 / 7.0, 4);
    check(&scores, "pairs: recall", 6.0 / 8.0, 4);
}

#[test]
fn other_sets_by_hand() {
    let mut left_out = truth(Set::Single, &[LATE], &[LATE, LAG], 50.0);
    left_out.left_out = true;
    let named = |label: &'static str, p: f64, unexplained: f64| {
        let labels: &'static [&'static str] = Box::leak(Box::new([label]));
        found(true, &[(labels, p)], 0.0, unexplained)
    };
    let scores = scored(vec![
        (truth(Set::OtherForm, &[COULOMB], &[], 50.0), named("stribeck@joint:a", 0.9, 0.0)),
        (truth(Set::OtherForm, &[COULOMB], &[], 50.0), named(LATE, 0.9, 0.0)),
        (truth(Set::Outside, &[], &[], 50.0), named(LATE, 0.1, 0.9)),
        (truth(Set::Outside, &[], &[], 50.0), named(LATE, 0.8, 0.2)),
        (truth(Set::Single, &[LATE], &[LATE], 50.0), named(LATE, 0.7, 0.3)),
        (truth(Set::PoorExcitation, &[LATE], &[LATE], 50.0), named(LATE, 0.7, 0.3)),
        (truth(Set::Short, &[LATE], &[LATE], 50.0), named(COULOMB, 0.7, 0.3)),
        (truth(Set::Rough, &[LATE], &[LATE], 50.0), named(LATE, 0.97, 0.0)),
        (truth(Set::Rough, &[LATE], &[LATE], 50.0), named(COULOMB, 0.7, 0.3)),
        (truth(Set::RoughNull, &[], &[], 0.0), named(LATE, 0.2, 0.7)),
        (truth(Set::RoughNull, &[], &[], 0.0), named(LATE, 0.8, 0.2)),
        (left_out.clone(), named(LAG, 0.9, 0.1)),
        (left_out.clone(), named(COULOMB, 0.1, 0.9)),
        (left_out, named(COULOMB, 0.9, 0.1)),
    ]);
    check(&scores, "another form: cause, class, top 1", 0.0, 2);
    check(&scores, "another form: family", 0.5, 2);
    check(&scores, "outside the library: AUROC of P(unexplained)", 0.5, 3);
    check(&scores, "poor excitation: cause, class, top 1", 1.0, 1);
    check(&scores, "six seconds: cause, class, top 1", 0.0, 1);
    check(&scores, "rough machine: cause, class, top 1", 0.5, 2);
    check(&scores, "rough machine: right when P > 0.95", 1.0, 1);
    check(&scores, "rough machine: an effect is named where there is none", 0.5, 2);
    check(&scores, "effect left out: none of these, or alike", 2.0 / 3.0, 3);
    check(&scores, "cause, class, top 1, singles", 1.0, 1);
    assert_eq!(scores.sets["single left out"], 3);
}

#[test]
fn experiments_by_hand() {
    let after = |before: &[&str], after: &[&str], error: Option<&str>| {
        let all = |labels: &[&str]| labels.iter().map(|label| (*label).to_owned()).collect::<Vec<_>>();
        let separation = Separation {
            before: all(before),
            after: all(after),
            leader: all(&after[..after.len().min(1)]),
            error: error.map(str::to_owned),
            ..Separation::default()
        };
        CaseResult { separation: Some(separation), ..found(true, &[(&[LATE], 0.9)], 0.0, 0.0) }
    };
    let single = || truth(Set::Single, &[LATE], &[LATE, LAG], 50.0);
    let mut left_out = single();
    left_out.left_out = true;
    let scores = scored(vec![
        (single(), after(&[LAG, LATE], &[LATE], None)),
        (single(), after(&[LAG, LATE], &[LAG], None)),
        (single(), after(&[LAG, LATE, COULOMB], &[LATE, LAG], None)),
        (single(), after(&[LAG, LATE, COULOMB], &[LAG, LATE], None)),
        (single(), after(&[LAG, LATE], &[LATE, LAG], None)),
        (single(), after(&[LAG, LATE], &[], Some("it ran away"))),
        (single(), after(&[LAG, COULOMB], &[LATE], None)),
        (left_out, after(&[LAG, COULOMB], &[LAG], None)),
    ]);
    check(&scores, "proposed experiment separates a confusable pair", 2.0 / 6.0, 6);
    check(&scores, "proposed experiment ends at the truth, classes without it included", 3.0 / 7.0, 7);
    check(&scores, "diagnoses that failed", 0.0, 8);
    assert_eq!(scores.failures, [("0005, proposed experiment".to_owned(), "it ran away".to_owned())]);
}

#[test]
fn another_method_stands_beside_the_diagnosis_of_the_same_cases_and_closes_nothing_where_it_fails() {
    let name = "nominal refit only";
    let with = |result: BaselineResult| CaseResult {
        baselines: BTreeMap::from([(name.to_owned(), result)]),
        ..found(true, &[(&[LATE], 0.9)], 0.0, 0.0)
    };
    let failed = BaselineResult { error: Some("it panicked".into()), ..BaselineResult::default() };
    let single = || truth(Set::Single, &[LATE], &[LATE], 50.0);
    let scores = scored(vec![
        (single(), with(BaselineResult { closed: Some(0.6), ..BaselineResult::default() })),
        (single(), with(failed.clone())),
        (truth(Set::Null, &[], &[], 0.0), with(failed)),
        // Nothing else was tried on it.
        (single(), found(true, &[(&[LAG], 0.9)], 0.0, 0.0)),
    ]);
    let of = |line: &str| scores.baselines[name].iter().find(|l| l.name == line).unwrap().score;
    let closed = of(NOMINAL_CLOSED);
    assert_eq!((closed.value, closed.count), (Some(0.3), 2));
    assert_eq!((of("failed").value, of("failed").count), (Some(2.0 / 3.0), 3));
    assert_eq!(scores.failures.len(), 2);
    let own = |line: &str| scores.baselines["The diagnosis"].iter().find(|l| l.name == line).unwrap().score;
    let right = own("cause, class, top 1, singles");
    assert_eq!((right.value, right.count), (Some(1.0), 2));
    assert_eq!(own("false alarms, null").count, 1);
}

#[test]
fn a_case_without_a_result_is_a_failure() {
    let mut answers = Answers { seed: 1, development: true, cases: BTreeMap::new() };
    answers.cases.insert("a".into(), truth(Set::Single, &[LATE], &[LATE], 50.0));
    let scores = Scores::of(&answers, &BTreeMap::new(), String::new());
    check(&scores, "detection, singles", 0.0, 1);
    assert_eq!(scores.failures.len(), 1);
}
