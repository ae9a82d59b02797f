//! The scores of other methods beside those of the diagnosis, on the same cases.

use std::collections::BTreeMap;

use parallax_withheld_truth::Set;

use super::{Line, NOMINAL_CLOSED, Score, Unit, detectable, median_of, of_set, rate, share};
use crate::cli::withheld::baselines::{self, BaselineResult};
use crate::cli::withheld::judge::Case;

/// The other methods, by what of a diagnosis they give.
/// The diagnosis stands first, on the cases that they were tried on.
pub(super) fn lines(cases: &[Case]) -> BTreeMap<String, Vec<Line>> {
    let mut all = BTreeMap::new();
    let tried: Vec<Case> = cases.iter().filter(|case| !case.result.baselines.is_empty()).copied().collect();
    if !tried.is_empty() {
        all.insert("The diagnosis".to_owned(), of_the_diagnosis(&tried));
    }
    for baseline in baselines::ALL {
        let said = |set: Set| -> Vec<(Case, &BaselineResult)> {
            let of = of_set(cases, set).into_iter();
            of.filter_map(|case| Some((case, case.result.baselines.get(baseline.name)?))).collect()
        };
        let (singles, nulls) = (said(Set::Single), said(Set::Null));
        if singles.is_empty() && nulls.is_empty() {
            continue;
        }
        let top = |k: usize| {
            let right = |(case, result): &(Case, &BaselineResult)| {
                result.detected && result.ranking.iter().take(k).any(|label| case.class().contains(label))
            };
            share(&singles.iter().map(right).collect::<Vec<_>>())
        };
        let detected = |from: &[(Case, &BaselineResult)]| {
            share(&from.iter().map(|(_, result)| result.detected).collect::<Vec<_>>())
        };
        let closed: Vec<f64> = singles
            .iter()
            .filter(|(case, _)| case.can_lower() && detectable(case))
            // One that failed closes nothing.
            .filter_map(|(_, result)| result.closed.or(result.error.as_ref().map(|_| 0.0)))
            .collect();
        let both: Vec<(Case, &BaselineResult)> = singles.iter().chain(&nulls).copied().collect();
        let seconds: Vec<f64> = both.iter().map(|(_, result)| result.seconds).collect();
        let failed = rate_of(&both, |result| result.error.is_some());
        let line = |name, unit, score| Line { name, goal: None, score, unit };
        let mut lines = if baseline.names {
            vec![
                line("false alarms, null", Unit::Percent, detected(&nulls)),
                line("detection, singles", Unit::Percent, detected(&singles)),
                line("cause, class, top 1, singles", Unit::Percent, top(1)),
                line("cause, class, top 2, singles", Unit::Percent, top(2)),
            ]
        } else {
            vec![line(NOMINAL_CLOSED, Unit::Plain, median_of(&closed))]
        };
        lines.push(line("failed", Unit::Percent, failed));
        lines.push(line("time, median", Unit::Seconds, median_of(&seconds)));
        all.insert(baseline.name.to_owned(), lines);
    }
    all
}

fn of_the_diagnosis(tried: &[Case]) -> Vec<Line> {
    let (singles, nulls) = (of_set(tried, Set::Single), of_set(tried, Set::Null));
    let lowered = singles.iter().filter(|case| case.can_lower() && detectable(case));
    let closed: Vec<f64> =
        lowered.map(|case| case.result.found.as_ref().and_then(|f| f.closed_total).unwrap_or(0.0)).collect();
    let both: Vec<Case> = singles.iter().chain(&nulls).copied().collect();
    let seconds: Vec<f64> = both.iter().map(|case| case.result.seconds).collect();
    let line = |name, unit, score| Line { name, goal: None, score, unit };
    vec![
        line("false alarms, null", Unit::Percent, rate(&nulls, Case::detected)),
        line("detection, singles", Unit::Percent, rate(&singles, Case::detected)),
        line("cause, class, top 1, singles", Unit::Percent, rate(&singles, |case| case.right_within(1))),
        line("cause, class, top 2, singles", Unit::Percent, rate(&singles, |case| case.right_within(2))),
        line(NOMINAL_CLOSED, Unit::Plain, median_of(&closed)),
        line("failed", Unit::Percent, rate(&both, Case::failed)),
        line("time, median", Unit::Seconds, median_of(&seconds)),
    ]
}

fn rate_of(from: &[(Case, &BaselineResult)], is: impl Fn(&BaselineResult) -> bool) -> Score {
    share(&from.iter().map(|(_, result)| is(result)).collect::<Vec<_>>())
}
