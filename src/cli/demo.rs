//! `parallax demo`: a machine with a hidden flaw is run, recorded, replayed and diagnosed.

use std::path::PathBuf;
use std::time::{SystemTime, UNIX_EPOCH};

use clap::Args;
use parallax_gap::diagnosis::Options;
use parallax_gap::report::Report;
use parallax_nodes::pendulum::{self, hidden};
use parallax_runtime::launch::{self, RunOptions};
use parallax_runtime::random::derived;
use parallax_runtime::recording::Recording;
use parallax_runtime::registry::Registry;
use parallax_runtime::time::{Nanos, to_seconds};
use parallax_sim::{ReplayOptions, replay};
use serde_json::json;

use super::args::{duration, make_parent};
use super::diagnose::{self, Loaded};
use super::failure::{Failure, Outcome, Sort};
use super::{output, run};

#[derive(Args)]
pub(crate) struct Arguments {
    /// Which flaw the world hides; without it, one is drawn.
    #[arg(long)]
    seed: Option<u64>,
    /// How long to run.
    #[arg(long, value_name = "SECONDS", default_value = "20", value_parser = duration, allow_negative_numbers = true)]
    duration: Nanos,
    /// The folder for recording.mcap, report.json and report.html.
    #[arg(long, value_name = "DIR", default_value = "out/demo")]
    out: PathBuf,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let say = |text: String| {
        if !arguments.json {
            output::line(text);
        }
    };
    let seed = arguments.seed.unwrap_or_else(drawn);
    let path = arguments.out.join("recording.mcap");
    make_parent(&path)?;

    let spec = pendulum::graph();
    let names: Vec<&str> = spec.nodes.iter().map(|node| node.name.as_str()).collect();
    say(format!(
        "1. Running {} as processes for {} s. The world hides a flaw, or none (seed {seed}).",
        names.join(", "),
        to_seconds(arguments.duration)
    ));
    let bar = run::bar(&spec.name, Some(arguments.duration));
    let secret = [(hidden::SEED_VARIABLE.to_owned(), seed.to_string())];
    let options = RunOptions {
        duration: Some(arguments.duration),
        // The recording states the seed of the run, and must not tell the one that drew the flaw.
        seed: derived(seed, "run"),
        recording: Some(path.clone()),
        // Only the world's process is told: neither the recording nor the diagnosis can know.
        private: [("world".to_owned(), secret.into())].into(),
        progress: Some(run::watch(&bar)),
        ..RunOptions::default()
    };
    let report = launch::run(&spec, &crate::cli::python::registry(), options).map_err(run::sort)?;
    bar.finish_and_clear();
    let outcome = run::ended(&report)?;
    if outcome != Outcome::Done {
        return Ok(outcome);
    }
    let steps: u64 = report.nodes.iter().map(|node| node.steps).sum();
    say(format!("   {steps} steps, recorded to {}", path.display()));

    let recording = Recording::read(&path).runtime()?;
    let replayed =
        replay(&recording, &crate::cli::python::registry(), &ReplayOptions::default()).runtime()?;
    say(format!(
        "2. Replayed: {} steps on the {} messages that they consumed; {}.",
        replayed.steps(),
        replayed.consumed(),
        match replayed.first_difference() {
            _ if replayed.is_exact() => "all outputs are the same bits".into(),
            Some(difference) => format!("not the same: {difference}"),
            None => "the same bits, but not the same schedule".into(),
        }
    ));

    say("3. Diagnosing from the recording alone.".into());
    let found = Loaded::read(std::slice::from_ref(&path), None, (None, None))?.diagnose(
        &Options::default(),
        None,
        &arguments.out,
    )?;
    if !arguments.json {
        output::line("");
        diagnose::print(&found);
        output::line("");
    }

    let effect = hidden::HiddenEffect::draw(seed);
    let world_exact = world_repeats(&recording, effect)?;
    let truth = effect.truth();
    let truth_name = truth.as_ref().map(|truth| format!("{}@{}", truth.effect, truth.place));
    let right = is_right(&found, truth_name.as_deref());
    let truth = truth.map_or_else(|| "nothing".to_owned(), |truth| truth.to_string());
    say(format!("4. Hidden was {truth}: the diagnosis is {}.", if right { "right" } else { "wrong" }));
    say(format!(
        "   The world, run again with what it hid, gives {}.",
        if world_exact { "the same bits" } else { "other readings than it gave" }
    ));
    say(format!("   The report is {}", arguments.out.join("report.html").display()));
    if arguments.json {
        output::json(&json!({
            "seed": seed, "steps": steps, "replay_exact": replayed.is_exact(), "world_exact": world_exact,
            "hidden": truth_name, "hidden_in_words": truth, "right": right, "report": found,
        }))?;
    }
    Ok(if replayed.is_exact() && world_exact { Outcome::Done } else { Outcome::Negative })
}

/// Runs the world again, which a replay otherwise takes for hardware, with the effect that it hid.
fn world_repeats(recording: &Recording, effect: hidden::HiddenEffect) -> Result<bool, Failure> {
    let kinds = pendulum::kinds(Registry::new(), effect);
    let options = ReplayOptions {
        overrides: Some(Box::new(move |context| {
            (context.name == "world")
                .then(|| kinds.get("pendulum/world").map(|kind| kind.build(context)))
                .flatten()
        })),
    };
    Ok(replay(recording, &crate::cli::python::registry(), &options).runtime()?.is_exact())
}

/// Whether the leading answer names the flaw, or a class that holds it.
fn is_right(report: &Report, truth: Option<&str>) -> bool {
    let Some(truth) = truth else { return !report.gap.detected };
    let leader = report.which.first().filter(|_| report.gap.detected);
    leader.is_some_and(|leader| {
        leader.class.iter().any(|name| name == truth)
            || leader.effects.iter().any(|effect| format!("{}@{}", effect.name, effect.place) == truth)
    })
}

/// A seed that differs from run to run.
fn drawn() -> u64 {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::from(now.subsec_nanos()) ^ now.as_secs()
}
