//! `parallax diagnose`: where a recording and its simulator part, why, and how far.

use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;

use anyhow::{Context, anyhow};
use clap::Args;
use indicatif::ProgressBar;
use parallax_gap::bind::bind_all;
use parallax_gap::closed_loop;
use parallax_gap::diagnosis::{Diagnosis, DiagnosisError, Options, diagnose_all};
use parallax_gap::experiment::Experiment;
use parallax_gap::nodes;
use parallax_gap::options::{Pattern, Prior};
use parallax_gap::report::{MadeFrom, Overlay, Report, html, svg, text};
use parallax_gap::timing;
use parallax_model::system::{Equations, System, Task};
use parallax_runtime::import::{self, read_system_text};
use parallax_runtime::launch::signals::Signals;
use parallax_runtime::recording::Recording;
use parallax_runtime::recording::log::{Log, Role};
use serde_json::json;

use super::failure::{Failure, Outcome, Sort};
use super::output;

#[derive(Args)]
pub(crate) struct Arguments {
    /// Recordings (.mcap), or folders with recording.toml, all of one machine: parameters are shared, states are not.
    #[arg(required = true)]
    recordings: Vec<PathBuf>,
    /// What the simulator believes: a system.toml, in place of the one attached to the recording.
    #[arg(long, value_name = "FILE")]
    system: Option<PathBuf>,
    /// The folder for report.json, report.html, report.svg, predictions.json and system.corrected.toml.
    #[arg(long, value_name = "DIR", default_value = "out/diagnosis")]
    out: PathBuf,
    /// Leave out what comes before, in seconds from each recording's first stamp: a take-off that the system cannot know.
    /// What stamps and nodes of a recorded graph prove is still that of the whole recording.
    #[arg(long, value_name = "SECONDS", allow_negative_numbers = true)]
    from: Option<f64>,
    /// Leave out what comes from there on, in seconds from each recording's first stamp.
    #[arg(long, value_name = "SECONDS", allow_negative_numbers = true)]
    to: Option<f64>,
    /// How far ahead predictions are scored; by default a quarter of a second, or ten samples if that is
    /// longer (25 of a slow process, read less than five times a second).
    #[arg(long, value_name = "SECONDS", allow_negative_numbers = true)]
    horizon: Option<f64>,
    /// Seed of the simulated comparisons.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Do not try this effect: an effect, a place or both (coulomb, joint:axis, delay@input:u). Repeatable.
    #[arg(long, value_name = "EFFECT[@PLACE]")]
    exclude: Vec<Pattern>,
    /// Try this effect, and others only if named too. Repeatable.
    #[arg(long, value_name = "EFFECT[@PLACE]")]
    only: Vec<Pattern>,
    /// How likely an effect is beforehand, against 1 for every other (coulomb@joint:axis=5). Repeatable.
    #[arg(long, value_name = "EFFECT[@PLACE]=WEIGHT")]
    prior: Vec<Prior>,
    /// Say why this effect is not the answer: its evidence, its best fit, what it explains worse. Repeatable.
    #[arg(long, value_name = "EFFECT[@PLACE]")]
    explain: Vec<Pattern>,
    /// What the machine is there to do, and the controller if no recorded graph holds it: a task.toml. Its score in closed
    /// loop is reported as recorded, and as simulated with and without the effect.
    #[arg(long, value_name = "FILE")]
    task: Option<PathBuf>,
    /// Print report.json instead of the short answer.
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    if arguments.horizon.is_some_and(|horizon| !(horizon.is_finite() && horizon > 0.0)) {
        return Err(Failure::input(anyhow!("--horizon must be above zero and finite")));
    }
    let part = (arguments.from, arguments.to);
    let loaded = Loaded::read(&arguments.recordings, arguments.system.as_deref(), part)?;
    let task = arguments.task.as_deref().map(read_task).transpose()?;
    let signals = Signals::watch().runtime()?;
    let options = Options {
        horizon: arguments.horizon,
        seed: arguments.seed,
        exclude: arguments.exclude.clone(),
        only: arguments.only.clone(),
        priors: arguments.prior.clone(),
        explain: arguments.explain.clone(),
        stop: Some(signals.flag()),
    };
    let bar = output::progress("diagnosing", WHOLE);
    let report = loaded.diagnose(&options, task.as_ref(), &arguments.out, &bar)?;
    if arguments.json {
        output::json(&report)?;
    } else {
        print(&report);
        output::line(format!("written to {}", arguments.out.display()));
    }
    Ok(if report.interrupted.is_some() { Outcome::Interrupted } else { Outcome::Done })
}

/// Logs of one machine and the system that is believed of it.
pub(crate) struct Loaded {
    logs: Vec<Log>,
    /// The text that a corrected system is made from.
    text: String,
    system: System,
    /// The recording of a graph, where there is one alone.
    graph: Option<Recording>,
    /// The files, as whole paths.
    recordings: Vec<PathBuf>,
    system_file: Option<PathBuf>,
    part: Part,
}

/// The part of each recording that is diagnosed: from and to, in seconds from its first stamp.
pub(crate) type Part = (Option<f64>, Option<f64>);

impl Loaded {
    /// Reads a part of recordings, and their system: the one at `system`, or the one attached to the recordings.
    pub(crate) fn read(paths: &[PathBuf], system: Option<&Path>, part: Part) -> Result<Self, Failure> {
        let (from, to) = (part.0.unwrap_or(0.0), part.1.unwrap_or(f64::INFINITY));
        if from.is_nan() || from < 0.0 || to.is_nan() || to <= from {
            return Err(Failure::input(anyhow!("--from must be at least zero, and --to after it")));
        }
        let mut logs = Vec::new();
        let mut attached: Option<(&Path, String)> = None;
        let mut graph = None;
        for path in paths {
            let (log, own) = if import::is_folder(path) {
                (import::folder(path).input()?, None)
            } else {
                let recording = Recording::read(path).input()?;
                let own = recording.graph.plant.as_ref().map(|plant| plant.system.clone());
                let log = recording.log();
                graph = (paths.len() == 1).then_some(recording);
                (log, own)
            };
            for note in &log.notes {
                eprintln!("note: {note}");
            }
            let cut = if part == (None, None) { log } else { log.part(from, to) };
            // The command that held before the part is kept.
            let mut measured = cut.signals.iter().filter(|signal| signal.role == Role::Measurement);
            if part != (None, None) && measured.all(|signal| signal.times.is_empty()) {
                return Err(Failure::input(anyhow!(
                    "{} has no measurement from {from} s on{}; check --from and --to",
                    path.display(),
                    if to.is_finite() { format!(" and before {to} s") } else { String::new() }
                )));
            }
            logs.push(cut);
            match (own, &attached) {
                (Some(own), Some((other, text))) if own != *text && system.is_none() => {
                    return Err(Failure::input(anyhow!(
                        "{} and {} have different systems attached; say with --system which one is believed",
                        other.display(),
                        path.display()
                    )));
                }
                (Some(own), None) => attached = Some((path, own)),
                _ => {}
            }
        }
        let (text, parsed) = match (system, attached) {
            (Some(system), _) => read_system_text(system).input()?,
            (None, Some((path, text))) => {
                let system =
                    System::parse(&text, &format!("{} (attached system)", path.display())).input()?;
                (text, system)
            }
            (None, None) => {
                let path = paths.first().map_or(Path::new("."), PathBuf::as_path);
                return Err(Failure::input(anyhow!(
                    "{} does not say what its simulator believes; give a system.toml with --system{}",
                    path.display(),
                    nearby(path)
                )));
            }
        };
        for log in &logs {
            let recorded: Vec<(&str, &str)> =
                log.signals.iter().map(|signal| (signal.name.as_str(), signal.unit.as_str())).collect();
            parsed.check_signals(&recorded).input()?;
        }
        let whole = |path: &Path| std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
        let recordings = paths.iter().map(|path| whole(path)).collect();
        Ok(Self { logs, text, system: parsed, graph, recordings, system_file: system.map(whole), part })
    }

    /// The recordings' titles.
    pub(crate) fn title(&self) -> String {
        self.logs.iter().map(|log| log.title.as_str()).collect::<Vec<_>>().join(", ")
    }

    /// The equations and the recordings in the system's order.
    pub(crate) fn bound(&self) -> Result<(Equations, Experiment), Failure> {
        bind_all(&self.system, &self.logs).input()
    }

    /// Diagnoses, scores the task in closed loop where there is one, and leaves report.json, report.html, report.svg and
    /// system.corrected.toml in `out`. How far it is goes to `bar`, as parts of [`WHOLE`].
    pub(crate) fn diagnose(
        &self,
        options: &Options,
        task: Option<&Task>,
        out: &Path,
        bar: &ProgressBar,
    ) -> Result<Report, Failure> {
        let registry = crate::cli::python::registry();
        let graph = self.graph.as_ref().map(|recording| (recording, &registry));
        let closed_loop = task
            .map(|task| closed_loop::prepare(task, &self.system, &self.logs, graph, options.horizon))
            .transpose()
            .input()?;
        std::fs::create_dir_all(out)
            .with_context(|| format!("the folder {} cannot be made", out.display()))
            .map_err(Failure::input)?;
        let watch = |done: f64, what: &str| {
            tracing::info!("{:.0} % done: {what}", 100.0 * done);
            bar.set_position((done * WHOLE as f64) as u64);
            let stopping = options.stop.as_ref().is_some_and(|stop| stop.load(Ordering::Relaxed));
            let what = if stopping { "stopping; Ctrl-C again ends at once" } else { what };
            bar.set_message(what.to_owned());
        };
        let found = diagnose_all(&self.system, &self.logs, options, &watch);
        let mut diagnosis = found.map_err(|error| match error {
            DiagnosisError::Stopped => Failure::interrupted(error),
            error => Failure::input(error),
        })?;
        match (closed_loop, &mut diagnosis.report.interrupted) {
            (Some(_), Some(interrupted)) => interrupted.not_tried.push("the score in closed loop".into()),
            (Some(prepared), None) => {
                bar.set_message("closing the loop");
                match prepared.scores((&diagnosis).into(), options.seed) {
                    Ok(scores) => diagnosis.report.closed_loop = Some(scores),
                    Err(error) => eprintln!("warning: the closed loop cannot be scored: {error}"),
                }
            }
            (None, _) => {}
        }
        bar.finish_and_clear();
        self.look_at_the_graph(&mut diagnosis.report);
        diagnosis.report.made_from = Some(MadeFrom {
            recordings: self.recordings.clone(),
            system: self.system_file.clone(),
            from: self.part.0,
            to: self.part.1,
            horizon: options.horizon,
            seed: options.seed,
        });
        self.write(diagnosis, out)
    }

    /// What stamps and recorded edges prove, where a whole graph was recorded.
    fn look_at_the_graph(&self, report: &mut Report) {
        let Some(recording) = &self.graph else { return };
        report.timing = Some(timing::timing(recording));
        match nodes::nodes(recording, &crate::cli::python::registry()) {
            Ok(nodes) => report.nodes = Some(nodes),
            Err(error) => eprintln!("warning: the nodes cannot be replayed alone: {error}"),
        }
    }

    fn write(&self, diagnosis: Diagnosis, out: &Path) -> Result<Report, Failure> {
        let Diagnosis { mut report, overlays, calibrated, effects, .. } = diagnosis;
        let save = |name: &str, text: &str| {
            let path = out.join(name);
            std::fs::write(&path, text)
                .with_context(|| format!("{} cannot be written", path.display()))
                .map_err(Failure::input)
        };
        // What a recording's constants supply is not the file's to correct.
        let stated = |(name, _): &(String, f64)| self.system.parameter(name).is_some();
        let calibrated: Vec<(String, f64)> = calibrated.into_iter().filter(stated).collect();
        match self.system.corrected(&self.text, &calibrated, &effects) {
            Ok(text) => {
                save(CORRECTED, &text)?;
                report.corrected_system = Some(CORRECTED.into());
            }
            Err(error) => eprintln!("warning: no corrected system is written: {error}"),
        }
        save("report.json", &serde_json::to_string_pretty(&report).map_err(Failure::runtime)?)?;
        save(PREDICTIONS, &predictions(&overlays))?;
        save("report.html", &html::page(&report, &overlays))?;
        save("report.svg", &svg::figure(&report, &overlays))?;
        Ok(report)
    }
}

/// How far a diagnosis is, at its end, on the bar that shows it.
pub(crate) const WHOLE: u64 = 1000;

/// The nominal file with what was found.
const CORRECTED: &str = "system.corrected.toml";

/// What was measured and predicted on held-out time, for other programs.
const PREDICTIONS: &str = "predictions.json";

/// The readings of each output: a number that is none is null.
fn predictions(overlays: &[Overlay]) -> String {
    let output = |overlay: &Overlay| {
        json!({
            "output": overlay.output,
            "unit": overlay.unit,
            "noise": overlay.noise,
            "time": overlay.stamp,
            "measured": overlay.measured,
            "before": overlay.before,
            "after": overlay.after,
        })
    };
    serde_json::Value::Array(overlays.iter().map(output).collect()).to_string()
}

fn read_task(path: &Path) -> Result<Task, Failure> {
    let text = std::fs::read_to_string(path)
        .with_context(|| format!("the task file {} cannot be read", path.display()))
        .map_err(Failure::input)?;
    Task::parse(&text, &path.display().to_string()).input()
}

/// A system.toml beside the folder is probably meant.
fn nearby(path: &Path) -> String {
    let places = [path.join("system.toml"), path.join("..").join("system.toml")];
    let found = places.iter().find(|place| place.exists());
    found.map_or_else(String::new, |place| format!(", such as {}", place.display()))
}

/// Columns of the short answer, where the terminal has as many.
const COLUMNS: usize = 100;

/// The short answer.
pub(crate) fn print(report: &Report) {
    let summary = text::summary(report);
    let columns = output::columns(COLUMNS);
    let fit = |text: &str| if columns < COLUMNS { output::folded(text, columns) } else { text.to_owned() };
    // On a narrow terminal the sentence is broken anew, and the rest where it does not fit.
    let text = match summary.split_once("\n\n") {
        Some((_, rest)) if columns < COLUMNS => format!("{}\n\n{rest}", report.summary),
        _ => summary,
    };
    output::line(fit(text.trim_end()));
    for explanation in &report.explanations {
        output::line(fit(&format!("\n{}", explanation.to_string().trim_end())));
    }
}
