//! What the options choose.

use std::path::PathBuf;

use anyhow::anyhow;
use parallax_runtime::import::foreign::{Choice, Found, Plan, series};
use parallax_runtime::recording::log::Role;

use super::{Arguments, Pair};
use crate::cli::failure::{Failure, Sort};

/// The plan that the options make: without choices when they name none and do not take what is suggested.
pub(super) fn plan(found: &[Found], arguments: &Arguments) -> Result<Plan, Failure> {
    let mut plan = Plan {
        title: arguments.title.clone().unwrap_or_else(|| title(found)),
        time_unit: arguments.time_unit,
        rate: arguments.rate,
        rows: arguments.rows,
        spread: arguments.spread,
        ..Plan::default()
    };
    for (role, names) in [
        (Role::Command, &arguments.command),
        (Role::Measurement, &arguments.measurement),
        (Role::Context, &arguments.context),
        (Role::Reference, &arguments.reference),
    ] {
        for name in names {
            let series = series(found, name).input()?.name.clone();
            let twice = plan.choices.iter().find(|choice| choice.series == series);
            if let Some(Choice { role: other, .. }) = twice {
                return Err(Failure::input(anyhow!(
                    "`{name}` is a {role} and a {other}; a signal has one role"
                )));
            }
            plan.choices.push(Choice { name: series.clone(), series, role, unit: None, scale: 1.0 });
        }
    }
    if arguments.yes {
        let suggested = Plan::suggested(found).choices;
        let named: Vec<String> = plan.choices.iter().map(|choice| choice.series.clone()).collect();
        plan.choices.extend(suggested.into_iter().filter(|choice| !named.contains(&choice.series)));
    }
    for time in &arguments.time {
        // A column's name may hold an equals sign; a signal's name before one is what counts.
        let of = time.split_once('=').and_then(|(name, clock)| Some((series(found, name).ok()?, clock)));
        plan.clocks.push(match of {
            Some((series, clock)) => (Some(series.name.clone()), clock.to_owned()),
            None => (None, time.clone()),
        });
    }
    // Before anything is chosen, options about signals wait for the answers.
    if !plan.choices.is_empty() {
        change(found, &mut plan, arguments)?;
    }
    Ok(plan)
}

fn change(found: &[Found], plan: &mut Plan, arguments: &Arguments) -> Result<(), Failure> {
    for Pair { name, value } in &arguments.unit {
        choice(found, plan, name)?.unit = Some(value.clone());
    }
    for Pair { name, value } in &arguments.scale {
        let factor = value.parse().ok().filter(|factor: &f64| factor.is_finite() && *factor != 0.0);
        choice(found, plan, name)?.scale = factor
            .ok_or_else(|| Failure::input(anyhow!("--scale {name}={value}: the factor is no number")))?;
    }
    for Pair { name, value } in &arguments.rename {
        choice(found, plan, name)?.name.clone_from(value);
    }
    Ok(())
}

/// The choice of a series.
fn choice<'a>(found: &[Found], plan: &'a mut Plan, name: &str) -> Result<&'a mut Choice, Failure> {
    let series = series(found, name).input()?.name.clone();
    plan.choices.iter_mut().find(|choice| choice.series == series).ok_or_else(|| {
        Failure::input(anyhow!(
            "`{name}` is not among the signals that are chosen; name its role: --measurement {name}"
        ))
    })
}

fn title(found: &[Found]) -> String {
    let stem = |found: &Found| found.path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    found.iter().map(stem).collect::<Vec<_>>().join(", ")
}

/// Where to write when nobody says: beside nothing that is there, in a folder of the log's name.
pub(super) fn place(logs: &[PathBuf]) -> PathBuf {
    let stem = logs.first().and_then(|path| path.file_stem()).unwrap_or_default().to_string_lossy();
    PathBuf::from(format!("{stem}_log"))
}
