//! What was found, for people and for scripts.

use parallax_runtime::import::foreign::{Clock, Found, Group, Plan, Run, Series, UnitFrom};
use parallax_runtime::recording::log::Role;
use serde_json::{Value, json};

use crate::cli::failure::Failure;
use crate::cli::output::{self, number};

/// Prints all that is in the files.
pub(super) fn list(found: &[Found], plan: &Plan, as_json: bool) -> Result<(), Failure> {
    if as_json {
        return output::json(&found.iter().map(|found| describe(found, plan)).collect::<Vec<_>>());
    }
    for found in found {
        output::line(format!("{}: {}", found.path.display(), found.form));
        for group in &found.groups {
            let kind = if group.kind.is_empty() {
                String::new()
            } else {
                format!("{} ({}): ", group.name, group.kind)
            };
            output::line(format!("\n{kind}{} rows", group.rows));
            for (index, clock) in group.clocks.iter().enumerate() {
                let used = group.series.iter().any(|series| series.clock == index);
                if used || group.clocks.len() < 4 {
                    output::line(format!(
                        "  {}{}",
                        clock_line(clock, plan),
                        if used { "" } else { " (not used)" }
                    ));
                }
            }
            if group.clocks.is_empty() {
                output::line("  no column looks like a time: name one with --time, or say --rate HZ");
            }
            table(group);
        }
        for note in &found.notes {
            output::line(format!("note: {note}"));
        }
    }
    Ok(())
}

fn table(group: &Group) {
    let several = group.clocks.len() > 1 && group.kind.is_empty();
    let mut header = vec!["signal", "unit", "values", "missing", "smallest", "largest", "looks like"];
    if several {
        header.push("time");
    }
    let rows: Vec<Vec<String>> = group
        .series
        .iter()
        .filter(|series| is_shown(group, series))
        .map(|series| {
            let (low, high) = range(series);
            let missing = missing(series);
            let mut row = vec![
                series.name.clone(),
                series.unit.clone(),
                (series.values.len() - missing).to_string(),
                if missing == 0 { String::new() } else { missing.to_string() },
                number(low),
                number(high),
                looks(series),
            ];
            if several {
                row.push(group.clocks.get(series.clock).map_or_else(String::new, |clock| clock.name.clone()));
            }
            row
        })
        .collect();
    output::table(&header, &rows);
    if rows.len() < group.series.len() {
        let others = group.series.len() - rows.len();
        output::line(format!(
            "  and {others} that never change, or count, or say how sure others are (--json names them)"
        ));
    }
}

/// A table is shown whole; of a topic only what may be wanted, for messages have much that nobody set.
fn is_shown(group: &Group, series: &Series) -> bool {
    group.kind.is_empty() || series.role.is_some()
}

/// What a series seems to be, in a word or two.
pub(super) fn looks(series: &Series) -> String {
    let (low, high) = range(series);
    let role = series.role.map_or("nothing to diagnose", Role::name);
    if low == high { format!("{role}, constant") } else { role.into() }
}

fn range(series: &Series) -> (f64, f64) {
    let known = || series.values.iter().copied().filter(|value| !value.is_nan());
    (known().fold(f64::INFINITY, f64::min), known().fold(f64::NEG_INFINITY, f64::max))
}

fn missing(series: &Series) -> usize {
    series.values.iter().filter(|value| value.is_nan()).count()
}

fn clock_line(clock: &Clock, plan: &Plan) -> String {
    let name = &clock.name;
    let Some(run) = clock.run(plan) else {
        return format!(
            "time `{name}`: the unit is not known, its steps are {}; say --time-unit",
            number(clock.step())
        );
    };
    let from = match clock.unit {
        _ if plan.time_unit.is_some() => "",
        Some((unit, UnitFrom::Epoch)) => &format!(", taken for {unit} since 1970 by its size"),
        Some((unit, UnitFrom::Steps)) => &format!(", taken for {unit} by its steps"),
        Some((_, UnitFrom::Dates)) => ", dates",
        _ => "",
    };
    let Run { span_s, rate_hz, step_low_s, step_high_s, .. } = &run;
    let mut text = format!(
        "time `{name}`{from}: {} at {} Hz, steps {} to {}",
        output::seconds(*span_s),
        number(*rate_hz),
        output::seconds(*step_low_s),
        output::seconds(*step_high_s)
    );
    if run.gaps > 0 {
        let (longest, at) = (output::seconds(run.longest_s), output::seconds(run.longest_at_s));
        text += &format!(", {} gaps, the longest {longest} after {at}", run.gaps);
    }
    for (count, what) in
        [(run.repeated, "repeated"), (run.backwards, "backwards"), (run.missing, "without a time")]
    {
        if count > 0 {
            text += &format!(", {count} {what}");
        }
    }
    text
}

fn describe(found: &Found, plan: &Plan) -> Value {
    let series = |series: &Series| {
        let (low, high) = range(series);
        json!({
            "name": series.name, "column": series.column, "unit": series.unit, "missing": missing(series),
            "smallest": low, "largest": high, "suggested": series.role, "clock": series.clock,
        })
    };
    let clock = |clock: &Clock| {
        json!({
            "name": clock.name, "unit": clock.unit.map(|(unit, _)| unit), "unit_from": clock.unit.map(|(_, from)| from),
            "step": clock.step(), "run": clock.run(plan),
        })
    };
    let groups: Vec<Value> = found
        .groups
        .iter()
        .map(|group| {
            json!({
                "topic": group.name, "type": group.kind, "rows": group.rows,
                "clocks": group.clocks.iter().map(clock).collect::<Vec<_>>(),
                "signals": group.series.iter().map(series).collect::<Vec<_>>(),
            })
        })
        .collect();
    json!({ "path": found.path, "form": found.form, "groups": groups, "notes": found.notes })
}

/// Names of the series that look like `role`.
pub(super) fn suggested(found: &[Found], role: Role) -> Vec<String> {
    let all = found.iter().flat_map(Found::series).map(|(_, series)| series);
    all.filter(|series| series.role == Some(role)).map(|series| series.name.clone()).collect()
}

/// What to do where nobody can be asked.
pub(super) fn how_to_answer(found: &[Found]) -> String {
    let suggestions: Vec<String> = Role::ALL
        .into_iter()
        .map(|role| (role, suggested(found, role)))
        .filter(|(_, names)| !names.is_empty())
        .map(|(role, names)| format!("--{role} {}", names.join(",")))
        .collect();
    format!(
        "nobody says which signals are which; --list shows what is there. --yes takes what they look like:\n  {}",
        suggestions.join("\n  ")
    )
}
