//! The scores as a table on the terminal and as a page.

use std::fmt::Write as _;

use super::score::{DETECTABLE, Goal, Group, Line, Scores, Unit};
use super::statistics::Score;
use crate::cli::output;

const HEADER: [&str; 6] = ["score", "goal", "result", "95 % interval", "cases", "reached"];
const GROUP_HEADER: [&str; 7] =
    ["singles", "cases", "detected", "class, top 1", "effect itself", "place", "mean P(truth)"];

/// Prints goals beside results.
pub(crate) fn print(scores: &Scores) {
    output::line(opening(scores));
    output::line("");
    output::table(&HEADER, &rows(&scores.lines));
    for (name, lines) in &scores.baselines {
        output::line(format!("\n{name}"));
        output::table(&HEADER, &rows(lines));
    }
    for (title, groups) in groups(scores) {
        output::line(format!("\n{title}"));
        output::table(&GROUP_HEADER, &group_rows(groups));
    }
    output::line("\nTrue effect, and what was answered");
    output::table(&["truth", "answered"], &confusion(scores));
    for (case, error) in &scores.failures {
        output::line(format!("failed: {case}: {error}"));
    }
}

/// A page of its own: what was run, where, and what came out.
pub(crate) fn markdown(scores: &Scores) -> String {
    let mut page = String::from("# The diagnosis on withheld causes\n\n");
    let command: Vec<String> = std::env::args().skip(1).collect();
    page += &opening(scores);
    let _ = write!(
        page,
        "\n\nCommand: `parallax {}`. Machine: {}. Day: {}. Answers' SHA-256: `{}`.\n\n",
        command.join(" "),
        machine(),
        day(),
        scores.seal,
    );
    page += &format!(
        "A case is detectable where twice the log-likelihood ratio of the true effect to the best refit, by the generator's own code, is \
         {DETECTABLE} or more. Classes are the generator's as well. Shares have Wilson's 95 % intervals, all else \
         percentiles of a bootstrap over the cases. A cause that never acts in its recording is drawn again. Diagnoses that \
         fail count as wrong in every share and state no probability.\n\n"
    );
    table(&mut page, &HEADER, &rows(&scores.lines));
    if !scores.baselines.is_empty() {
        page += "\n## Other methods on the same cases\n";
    }
    for (name, lines) in &scores.baselines {
        let _ = write!(page, "\n### {name}\n\n");
        table(
            &mut page,
            &HEADER[..5],
            &rows(lines).into_iter().map(|row| row[..5].to_vec()).collect::<Vec<_>>(),
        );
    }
    for (title, groups) in groups(scores) {
        let _ = write!(page, "\n## {title}\n\n");
        table(&mut page, &GROUP_HEADER, &group_rows(groups));
    }
    page += "\n## True effect, and what was answered\n\n";
    table(&mut page, &["truth", "answered"], &confusion(scores));
    if !scores.failures.is_empty() {
        page += "\n## What failed\n\n";
        let failures: Vec<Vec<String>> =
            scores.failures.iter().map(|(case, error)| vec![case.clone(), error.clone()]).collect();
        table(&mut page, &["case", "error"], &failures);
    }
    page
}

fn opening(scores: &Scores) -> String {
    let sets: Vec<String> =
        scores.sets.iter().map(|(set, count)| format!("{} {count}", set.replace('_', " "))).collect();
    let kind = if scores.development { "A seed for development, not to be reported" } else { "A fresh seed" };
    format!("{kind}: {:#018x}. Cases: {}.", scores.seed, sets.join(", "))
}

fn groups(scores: &Scores) -> [(&'static str, &[Group]); 3] {
    [
        ("By system", &scores.by_system),
        ("By effect", &scores.by_effect),
        ("By detectability", &scores.by_detectability),
    ]
}

fn rows(lines: &[Line]) -> Vec<Vec<String>> {
    let row = |line: &Line| {
        let Score { value, low, high, count } = line.score;
        let interval = match (low, high) {
            (Some(low), Some(high)) => format!("{} to {}", number(low, line.unit), number(high, line.unit)),
            _ => String::new(),
        };
        let reached = match (line.goal, value) {
            (Some(goal), Some(value)) if goal.reached(value) => "yes",
            (Some(_), Some(_)) => "no",
            _ => "",
        };
        vec![
            line.name.to_owned(),
            line.goal.map_or_else(String::new, |goal| written(goal, line.unit)),
            value.map_or_else(|| "none".into(), |value| number(value, line.unit)),
            interval,
            count.to_string(),
            reached.to_owned(),
        ]
    };
    lines.iter().map(row).collect()
}

fn group_rows(groups: &[Group]) -> Vec<Vec<String>> {
    let percent = |score: Score| score.value.map_or_else(String::new, |v| number(v, Unit::Percent));
    let row = |group: &Group| {
        vec![
            group.name.clone(),
            group.class.count.to_string(),
            percent(group.detected),
            percent(group.class),
            percent(group.raw),
            percent(group.place),
            group.probability.map_or_else(String::new, |v| number(v, Unit::Plain)),
        ]
    };
    groups.iter().map(row).collect()
}

fn confusion(scores: &Scores) -> Vec<Vec<String>> {
    let row = |(truth, said): (&String, &std::collections::BTreeMap<String, usize>)| {
        let mut said: Vec<(&String, &usize)> = said.iter().collect();
        said.sort_by(|a, b| b.1.cmp(a.1).then(a.0.cmp(b.0)));
        let said: Vec<String> = said.iter().map(|(name, count)| format!("{name} {count}")).collect();
        vec![truth.clone(), said.join(", ")]
    };
    scores.confusion.iter().map(row).collect()
}

fn number(value: f64, unit: Unit) -> String {
    match unit {
        Unit::Percent => format!("{:.1} %", 100.0 * value),
        Unit::Plain => format!("{value:.3}"),
        Unit::Seconds => format!("{value:.1} s"),
    }
}

fn written(goal: Goal, unit: Unit) -> String {
    match goal {
        Goal::AtLeast(least) => format!("≥ {}", number(least, unit)),
        Goal::AtMost(most) => format!("≤ {}", number(most, unit)),
        Goal::Between(low, high) => format!("{} to {}", number(low, unit), number(high, unit)),
    }
}

fn table(page: &mut String, header: &[&str], rows: &[Vec<String>]) {
    let clean = |cell: &str| cell.replace('|', "\\|").replace('\n', " ");
    let line = |cells: Vec<String>| format!("| {} |\n", cells.join(" | "));
    *page += &line(header.iter().map(|cell| clean(cell)).collect());
    *page += &line(header.iter().map(|_| "---".to_owned()).collect());
    for row in rows {
        *page += &line(row.iter().map(|cell| clean(cell)).collect());
    }
}

/// The processor and how many threads it runs.
fn machine() -> String {
    let text = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model =
        text.lines().find_map(|line| line.strip_prefix("model name")?.split_once(':').map(|(_, m)| m.trim()));
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    format!("{}, {threads} threads", model.unwrap_or("unknown processor"))
}

/// Today's date, UTC, by Howard Hinnant's days-to-civil algorithm.
fn day() -> String {
    let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap_or_default();
    let days = (now.as_secs() / 86_400) as i64;
    let (year, month, day) = civil(days);
    format!("{year:04}-{month:02}-{day:02}")
}

/// Year, month and day of a day counted from 1970-01-01.
fn civil(days: i64) -> (i64, i64, i64) {
    let z = days + 719_468;
    let era = z.div_euclid(146_097);
    let of_era = z.rem_euclid(146_097);
    let year_of_era = (of_era - of_era / 1460 + of_era / 36_524 - of_era / 146_096) / 365;
    let of_year = of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let shifted = (5 * of_year + 2) / 153;
    let day = of_year - (153 * shifted + 2) / 5 + 1;
    let month = if shifted < 10 { shifted + 3 } else { shifted - 9 };
    (year_of_era + era * 400 + i64::from(month <= 2), month, day)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn days_are_dates() {
        assert_eq!(civil(0), (1970, 1, 1));
        assert_eq!(civil(19_782), (2024, 2, 29));
        assert_eq!(civil(20_088), (2024, 12, 31));
    }
}
