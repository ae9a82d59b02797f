//! `parallax demo`: a machine with a hidden flaw is run, recorded, replayed and diagnosed.

mod screen;

use std::path::{Path, PathBuf};
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
use screen::Screen;

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
    let screen = Screen::new(arguments.json);
    let say = |text: String| {
        if !arguments.json {
            output::line(text);
        }
    };
    let seed = arguments.seed.unwrap_or_else(drawn);
    let path = arguments.out.join("recording.mcap");
    make_parent(&path)?;

    let spec = pendulum::graph();
    screen.begin(
        RUN,
        &format!(
            "{} processes for {} s; the world hides a flaw, or none (seed {seed}).",
            spec.nodes.len(),
            to_seconds(arguments.duration)
        ),
    );
    let secret = [(hidden::SEED_VARIABLE.to_owned(), seed.to_string())];
    let options = RunOptions {
        duration: Some(arguments.duration),
        // The recording states the seed of the run, and must not tell the one that drew the flaw.
        seed: derived(seed, "run"),
        recording: Some(path.clone()),
        // Only the world's process is told: neither the recording nor the diagnosis can know.
        private: [("world".to_owned(), secret.into())].into(),
        progress: Some(screen.watch(RUN, arguments.duration)),
        ..RunOptions::default()
    };
    let report = launch::run(&spec, &crate::cli::python::registry(), options).map_err(run::sort)?;
    let outcome = run::ended(&report)?;
    let steps: u64 = report.nodes.iter().map(|node| node.steps).sum();
    if outcome != Outcome::Done {
        let after = to_seconds(report.duration);
        screen.stopped(RUN, &format!("stopped after {after:.1} s; {steps} steps are in {}", path.display()));
        return Ok(outcome);
    }
    screen.done(RUN, &format!("{steps} steps, recorded to {}", path.display()));

    screen.begin(REPLAY, "Running every node again on the messages that it consumed.");
    let recording = Recording::read(&path).runtime()?;
    let replayed =
        replay(&recording, &crate::cli::python::registry(), &ReplayOptions::default()).runtime()?;
    screen.done(
        REPLAY,
        &format!(
            "{} steps on {} messages; {}.",
            replayed.steps(),
            replayed.consumed(),
            match replayed.first_difference() {
                _ if replayed.is_exact() => "all outputs are the same bits".into(),
                Some(difference) => format!("not the same: {difference}"),
                None => "the same bits, but not the same schedule".into(),
            }
        ),
    );

    screen.begin(DIAGNOSE, "Looking for the cause of the gap, in the recording alone.");
    let found = Loaded::read(std::slice::from_ref(&path), None, (None, None))?.diagnose(
        &Options::default(),
        None,
        &arguments.out,
        &screen.bar(DIAGNOSE, diagnose::WHOLE),
    )?;
    screen.done(DIAGNOSE, &format!("{} hypotheses weighed.", found.which.len()));

    let effect = hidden::HiddenEffect::draw(seed);
    screen.begin(COMPARE, "Running the world again, and asking it what it hid.");
    let world_exact = world_repeats(&recording, effect)?;
    let truth = effect.truth();
    let truth_name = truth.as_ref().map(|truth| format!("{}@{}", truth.effect, truth.place));
    let right = is_right(&found, truth_name.as_deref());
    let truth = truth.map_or_else(|| "nothing".to_owned(), |truth| truth.to_string());
    let more = found.which.first().filter(|_| found.gap.detected).map_or(0, |leader| leader.effects.len());
    screen.done(
        COMPARE,
        &format!(
            "{}: {truth} was hidden{}.",
            if right { "Right" } else { "Wrong" },
            if right && more > usize::from(truth_name.is_some()) { "; more is named" } else { "" }
        ),
    );
    // The whole answer is in the report, and what the second command below prints: this stays one screen.
    say(format!("\n{}", output::folded(&found.summary, output::columns(100))));
    say(format!(
        "\nThe world, run again with what it hid, gives {}.",
        if world_exact { "the same bits" } else { "other readings than it gave" }
    ));
    say(next(&arguments.out, &path));
    if arguments.json {
        output::json(&json!({
            "seed": seed, "steps": steps, "replay_exact": replayed.is_exact(), "world_exact": world_exact,
            "hidden": truth_name, "hidden_in_words": truth, "right": right, "report": found,
        }))?;
    }
    Ok(if replayed.is_exact() && world_exact { Outcome::Done } else { Outcome::Negative })
}

/// The stages of the [`Screen`].
const RUN: usize = 0;
const REPLAY: usize = 1;
const DIAGNOSE: usize = 2;
const COMPARE: usize = 3;

/// Where the report is, and how to go on, in commands that work where this one did.
fn next(out: &Path, recording: &Path) -> String {
    let program = std::env::args().next().unwrap_or_else(|| "parallax".into());
    let (out, recording) = (out.display(), recording.display());
    format!(
        "The report is {out}/report.html\n\nNext, to see what was recorded, why a cause lost, and a machine of your own:\n  \
         {program} info {recording}\n  {program} diagnose {recording} --explain delay --out {out}\n  \
         {program} import YOUR_LOG.csv"
    )
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
            || leader.effects.iter().any(|effect| effect.label() == truth)
    })
}

/// A seed that differs from run to run.
fn drawn() -> u64 {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::from(now.subsec_nanos()) ^ now.as_secs()
}
