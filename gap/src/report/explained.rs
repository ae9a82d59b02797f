//! The page's answers to what the user asked: why an effect is not the cause.

use super::draw::{escape, typeset};
use super::{Report, format};
use crate::explain::{Explanation, Fate, Worse};

/// One entry for every effect that was asked about; nothing where none was.
pub(super) fn content(report: &Report) -> Option<String> {
    let entries: String = report.explanations.iter().map(entry).collect();
    (!entries.is_empty()).then(|| format!("<div class=\"explained\">\n{entries}</div>\n"))
}

fn set(number: &str) -> String {
    escape(&typeset(number))
}

fn entry(explanation: &Explanation) -> String {
    let Explanation { effect, winner, .. } = explanation;
    let winner = format!("<code>{}</code>", escape(winner));
    let fate = match &explanation.fate {
        Fate::Leads => "is the answer.".to_owned(),
        Fate::Alike => format!("belongs to the answer's class: this data cannot tell it from {winner}."),
        Fate::Loses => format!("loses to {winner}."),
        Fate::Refuted => {
            "is left out: with it held-out time is predicted worse than without any effect, or far worse than with another answer.".to_owned()
        }
        Fate::Absorbed { by } => {
            format!("is not fitted: the calibrated parameter <code>{}</code> does the same here.", escape(by))
        }
        Fate::Impossible => {
            "is not an answer: its best fit would be a limit that leaves next to nothing or that readings \
                             exceed, or a lag that is over before it shows."
                .to_owned()
        }
        Fate::NotShown { reason } => format!("is not named: {}.", escape(reason)),
        Fate::NotTestable { reason } => format!("is not testable: {}.", escape(reason)),
    };
    let leads = explanation.fate == Fate::Leads;
    let mut rows = Vec::new();
    if let Some(null) = explanation.against_no_effect {
        let evidence = explanation.evidence.filter(|_| !leads);
        let against_winner =
            evidence.map_or_else(String::new, |evidence| format!("{} against {winner}, ", signed(evidence)));
        rows.push(("log evidence", format!("{against_winner}{} against no effect at all", signed(null))));
    }
    if !explanation.parameters.is_empty() {
        let parameters = explanation.parameters.iter();
        let parameters: Vec<String> = parameters
            .map(|(name, value)| format!("{} <b>{}</b>", escape(name), set(&format::uncertain(value))))
            .collect();
        rows.push(("best fit", parameters.join(", ")));
    }
    if let (Some(error), Some(best)) = (explanation.error, explanation.winner_error) {
        let than =
            if leads { String::new() } else { format!(", {} with {winner}", set(&format::number(best, 3))) };
        rows.push(("error ahead", format!("{} noise units{than}", set(&format::number(error, 3)))));
    }
    if !explanation.worse.is_empty() {
        let regions: Vec<String> = explanation.worse.iter().map(region).collect();
        rows.push(("worse at", regions.join("<br/>")));
    }
    let rows: String = rows.iter().map(|(name, text)| format!("<dt>{name}</dt><dd>{text}</dd>\n")).collect();
    let rows = if rows.is_empty() { rows } else { format!("<dl>\n{rows}</dl>\n") };
    format!("<p><code><b>{}</b></code> {fate}</p>\n{rows}", escape(effect))
}

/// With its sign, which says who is ahead.
fn signed(evidence: f64) -> String {
    let sign = if evidence > 0.0 { "+" } else { "" };
    set(&format!("{sign}{}", format::number(evidence, 3)))
}

fn region(worse: &Worse) -> String {
    format!(
        "{} {} to {}: {} of the difference, on {} of the readings",
        escape(&worse.quantity),
        set(&format::number(worse.from, 3)),
        set(&format::number(worse.to, 3)),
        set(&format::share(worse.share)),
        set(&format::share(worse.readings)),
    )
}
