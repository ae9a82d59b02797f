//! What a proposed experiment is worth: the process that knows the causes plays it on the same machine, and both
//! recordings are diagnosed together.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Instant;

use anyhow::{Context, anyhow, bail};
use clap::Args;
use parallax_gap::bind::bind;
use parallax_gap::diagnosis::{Options, diagnose_all};
use parallax_gap::excitation::{Design, Wishes, propose};
use parallax_gap::report::{Report, Which};
use parallax_model::system::System;
use parallax_runtime::import;
use parallax_runtime::recording::log::Log;
use parallax_withheld_truth::{Experiment, replay};
use serde::{Deserialize, Serialize};

use super::seal;
use crate::cli::failure::{Failure, Outcome, Sort};

/// Name of the command that plays an experiment on a case's machine.
pub(crate) const PLAY_COMMAND: &str = "withheld-play";

/// The folder of the second recordings in a run's folder.
const SECOND: &str = "second";

/// The designed commands beside a second recording.
const DESIGNED: &str = "experiment.json";

/// Seed of an experiment's phases and switching times, the one that `parallax experiment` takes.
const SEED: u64 = 1;

/// What became of a class of several effects after the experiment that was proposed for it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Separation {
    /// The class of the leading answer.
    pub(crate) before: Vec<String>,
    /// The experiment in words.
    pub(crate) experiment: String,
    /// Probability of a correct decision between the nearest two, as promised.
    pub(crate) promised: f64,
    /// The class of the leading answer to both recordings.
    pub(crate) after: Vec<String>,
    /// The effects that lead it.
    pub(crate) leader: Vec<String>,
    /// How long design and second diagnosis took (s).
    pub(crate) seconds: f64,
    /// Why there is no second answer.
    pub(crate) error: Option<String>,
}

impl Separation {
    /// Whether the true effect was among the alike ones.
    pub(crate) fn held(&self, truth: &str) -> bool {
        self.before.iter().any(|label| label == truth)
    }

    /// Whether the true effect is left, alone or at the head of fewer.
    pub(crate) fn right(&self, truth: &str) -> bool {
        let left = self.after.iter().any(|label| label == truth);
        let leads = self.leader.len() == 1 && self.leader[0] == truth;
        left && (self.after.len() == 1 || (leads && self.after.len() < self.before.len()))
    }
}

/// Proposes an experiment for the leading answer's class, has it played, and diagnoses both recordings. None where the
/// answer stands alone or no experiment promises to separate its class with the sensors that are there.
pub(crate) fn separate(
    out: &Path,
    case: &str,
    report: &Report,
    system: &System,
    log: &Log,
    options: &Options,
) -> Option<Separation> {
    let start = Instant::now();
    let before = leading(report).filter(|answer| answer.class.len() > 1)?.class.clone();
    let confusable = report.confusable.iter().find(|class| class.effects == before)?;
    let promise = confusable.experiment.as_ref().filter(|p| p.separates && p.sensor.is_none())?;
    let mut separation = Separation {
        before: before.clone(),
        experiment: promise.input.clone(),
        promised: promise.probability,
        ..Separation::default()
    };
    match second(out, case, &before, system, log, options) {
        Ok(report) => {
            if let Some(answer) = leading(&report) {
                separation.after.clone_from(&answer.class);
                separation.leader = answer.effects.iter().map(|effect| effect.label()).collect();
            }
        }
        Err(error) => separation.error = Some(format!("{error:#}")),
    }
    separation.seconds = start.elapsed().as_secs_f64();
    Some(separation)
}

/// The leading answer of a report that found a gap.
fn leading(report: &Report) -> Option<&Which> {
    report.which.first().filter(|answer| report.gap.detected && !answer.effects.is_empty())
}

fn second(
    out: &Path,
    case: &str,
    effects: &[String],
    system: &System,
    log: &Log,
    options: &Options,
) -> anyhow::Result<Report> {
    let (equations, experiment) = bind(system, log)?;
    let wishes = Wishes { seed: SEED, ..Wishes::default() };
    let design = propose(equations, experiment, &log.title, effects, options, &wishes)?;
    let folder = out.join(SECOND).join(case);
    std::fs::create_dir_all(&folder).with_context(|| folder.display().to_string())?;
    let file = folder.join(DESIGNED);
    std::fs::write(&file, serde_json::to_string(&commands(&design))?)
        .with_context(|| file.display().to_string())?;
    let mut play = Command::new(std::env::current_exe()?);
    play.arg(PLAY_COMMAND).arg("--out").arg(out).arg("--case").arg(case);
    let played = play.stdout(Stdio::null()).stderr(Stdio::piped()).output()?;
    if !played.status.success() {
        bail!("the experiment was not played: {}", String::from_utf8_lossy(&played.stderr).trim());
    }
    let logs = [log.clone(), import::folder(&folder)?];
    Ok(diagnose_all(system, &logs, options, &|_, _| ())?.report)
}

fn commands(design: &Design) -> Experiment {
    let mut experiment = Experiment { duration: design.duration, ..Experiment::default() };
    let mut all = BTreeMap::new();
    for command in &design.commands {
        experiment.times.clone_from(&command.held.times);
        all.insert(command.signal.clone(), command.held.values.clone());
    }
    experiment.commands = all;
    experiment
}

/// What the process that plays an experiment is told.
#[derive(Args)]
pub(crate) struct Arguments {
    /// The run's folder.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// The case's name.
    #[arg(long)]
    case: String,
}

/// Plays the experiment that lies in the case's second folder. Nothing of the answer leaves this process.
pub(crate) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let hash = seal::sealed_hash(&arguments.out)
        .input()?
        .ok_or_else(|| Failure::input(anyhow!("{} holds no run", arguments.out.display())))?;
    let answers = seal::open(&arguments.out, &hash).input()?;
    let sealed = answers
        .cases
        .get(&arguments.case)
        .ok_or_else(|| Failure::input(anyhow!("there is no case {}", arguments.case)))?;
    let folder = arguments.out.join(SECOND).join(&arguments.case);
    let text = std::fs::read_to_string(folder.join(DESIGNED)).input()?;
    let experiment: Experiment = serde_json::from_str(&text).input()?;
    replay(&sealed.plan, sealed.seed, &experiment, &folder).runtime()?;
    Ok(Outcome::Done)
}
