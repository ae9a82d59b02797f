//! `parallax withheld`: the diagnosis against causes that it cannot see.
//!
//! A process of its own makes the cases and seals the answers; this one reads the case folders only. The answers are
//! opened when every diagnosis is in, and only if they still have the hash that was printed first.

mod baselines;
mod case;
mod family;
mod judge;
mod page;
mod score;
mod seal;
pub(crate) mod separate;
mod statistics;
pub(crate) mod truth;

use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context, anyhow};
use clap::Args;
use parallax_runtime::launch::signals::Signals;

use super::failure::{Failure, Outcome, Sort};
use super::output::{self, Count};
use case::{CaseResult, diagnose_case, try_baselines};
use score::Scores;
use truth::{CASES, Counts};

/// Name of the command that makes the cases.
pub(crate) const TRUTH_COMMAND: &str = "withheld-truth";

#[derive(Args)]
pub(crate) struct Arguments {
    #[command(flatten)]
    counts: Counts,
    /// Seed of a run for development; without it a fresh seed is drawn, and the run may be reported.
    #[arg(long, value_name = "SEED")]
    dev_seed: Option<u64>,
    /// The folder for cases, sealed answers and results.
    #[arg(long, value_name = "DIR", default_value = "out/withheld")]
    out: PathBuf,
    /// Diagnose only every N-th case, from the I-th on; the shards share the folder and --resume.
    #[arg(long, value_name = "I/N", default_value = "1/1")]
    shard: Shard,
    /// Go on with the run in the folder: cases that are in are not diagnosed again, but get what --baselines asks for.
    /// Answers, seal and results are enough: cases that are not there are made again.
    #[arg(long)]
    resume: bool,
    /// Try other methods as well on the first N cases by their names, which are drawn by chance. Of a quadrotor they may
    /// take ten minutes each.
    #[arg(long, value_name = "N", default_value_t = 0)]
    baselines: usize,
    /// Play the experiments proposed for up to N cases whose answer is a class of several effects, and diagnose again
    /// with what they record. Shards share the number.
    #[arg(long, value_name = "N", default_value_t = 40)]
    separate: usize,
    /// Print the scores as JSON.
    #[arg(long)]
    json: bool,
    /// Write the scores as a page.
    #[arg(long, value_name = "FILE")]
    markdown: Option<PathBuf>,
}

/// One of several equal parts of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Shard {
    index: usize,
    count: usize,
}

impl std::str::FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parts = text.split_once('/').and_then(|(i, n)| Some((i.parse().ok()?, n.parse().ok()?)));
        match parts {
            Some((index, count)) if 1 <= index && index <= count => Ok(Shard { index, count }),
            _ => Err("it must look like I/N with I from 1 to N, such as 2/4".into()),
        }
    }
}

pub(crate) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let signals = Signals::watch().runtime()?;
    let hash = sealed(arguments, &signals)?;
    eprintln!("answers sealed, SHA-256 {hash}");
    let folders = folders(&arguments.out.join(CASES))?;
    diagnose_all(arguments, &folders, &signals)?;

    let results = results(&arguments.out)?;
    let missing = (0..folders.len()).filter(|k| !is_in(arguments, &results, &folders, *k)).count();
    if signals.raised() && missing > 0 {
        let (done, all) = (folders.len() - missing, folders.len());
        output::line(format!("interrupted: {done} of {all} cases are in; go on with --resume"));
        return Ok(Outcome::Interrupted);
    }
    if missing > 0 {
        output::line(format!("{missing} of {} cases are not in yet; the answers stay sealed", folders.len()));
        return Ok(Outcome::Done);
    }
    let answers = seal::open(&arguments.out, &hash).input()?;
    let scores = Scores::of(&answers, &results, hash);
    let text = serde_json::to_string_pretty(&scores).map_err(Failure::runtime)?;
    save(&arguments.out.join("scores.json"), &text)?;
    if let Some(path) = &arguments.markdown {
        super::args::make_parent(path)?;
        save(path, &page::markdown(&scores))?;
    }
    if arguments.json {
        output::line(text)
    } else {
        page::print(&scores)
    }
    Ok(Outcome::Done)
}

/// Makes the cases in a process of its own, unless they are there already; gives the hash of their answers.
fn sealed(arguments: &Arguments, signals: &Signals) -> Result<String, Failure> {
    let found = seal::sealed_hash(&arguments.out).input()?;
    match found {
        Some(hash) if arguments.resume => {
            make(&["--again"], arguments, signals)?;
            return Ok(hash);
        }
        Some(_) => {
            let out = arguments.out.display();
            return Err(Failure::input(anyhow!(
                "{out} holds a run already; go on with --resume, or name another --out"
            )));
        }
        None => truth::refuse_orphans(&arguments.out.join(CASES))?,
    }
    if arguments.resume {
        let out = arguments.out.display();
        return Err(Failure::input(anyhow!(
            "{out} holds no sealed run to go on with; begin one without --resume, or name the --out of one"
        )));
    }
    if arguments.counts.is_empty() {
        return Err(Failure::input(anyhow!(
            "no case is asked for; give at least one set a count, such as --singles 10"
        )));
    }
    let mut words = arguments.counts.arguments();
    words.extend(arguments.dev_seed.iter().flat_map(|seed| ["--dev-seed".into(), seed.to_string()]));
    make(&words, arguments, signals)?;
    seal::sealed_hash(&arguments.out)
        .runtime()?
        .ok_or_else(|| Failure::runtime(anyhow!("the process that makes the cases left no seal")))
}

/// Has the process of its own make cases.
fn make(words: &[impl AsRef<OsStr>], arguments: &Arguments, signals: &Signals) -> Result<(), Failure> {
    let program = std::env::current_exe().runtime()?;
    let mut command = Command::new(program);
    command.arg(TRUTH_COMMAND).args(words).arg("--out").arg(&arguments.out);
    let status = command.stdout(Stdio::null()).status().runtime()?;
    if !status.success() && signals.raised() {
        let cases = arguments.out.join(CASES);
        return Err(Failure::interrupted(match arguments.resume {
            true => anyhow!("interrupted while cases were made again; go on with --resume"),
            false => anyhow!(
                "interrupted while the cases were made; remove {} before the next run",
                cases.display()
            ),
        }));
    }
    // It has said what was wrong with what it was given.
    if status.code() == Some(2) {
        return Err(Failure::input(anyhow!("no cases were made, for the reason above")));
    }
    if !status.success() {
        return Err(Failure::runtime(anyhow!("the process that makes the cases failed: {status}")));
    }
    Ok(())
}

/// The cases, in the order of their names.
fn folders(cases: &Path) -> Result<Vec<PathBuf>, Failure> {
    let entries = std::fs::read_dir(cases)
        .with_context(|| format!("{} cannot be read", cases.display()))
        .map_err(Failure::input)?;
    let paths: Result<Vec<PathBuf>, std::io::Error> = entries.map(|entry| Ok(entry?.path())).collect();
    let mut paths = paths.input()?;
    paths.sort();
    Ok(paths)
}

fn name(folder: &Path) -> String {
    folder.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// Whether everything is in that is asked for of the `k`-th case.
fn is_in(
    arguments: &Arguments,
    results: &BTreeMap<String, CaseResult>,
    folders: &[PathBuf],
    k: usize,
) -> bool {
    let in_full = |result: &CaseResult| k >= arguments.baselines || !result.baselines.is_empty();
    results.get(&name(&folders[k])).is_some_and(in_full)
}

/// Diagnoses the shard's cases that are not in yet, and tries the other methods where they are asked for and have not been.
/// Each result is on disk before the next case begins; a case that a signal interrupts is left for the next run.
fn diagnose_all(arguments: &Arguments, folders: &[PathBuf], signals: &Signals) -> Result<(), Failure> {
    let Shard { index, count } = arguments.shard;
    let done = results(&arguments.out)?;
    let mine: Vec<usize> = (0..folders.len()).filter(|k| k % count == index - 1).collect();
    let separated = |k: &&usize| done.get(&name(&folders[**k])).is_some_and(|r| r.separation.is_some());
    let mut to_separate =
        arguments.separate.div_ceil(count).saturating_sub(mine.iter().filter(separated).count());
    let open: Vec<usize> = mine.into_iter().filter(|k| !is_in(arguments, &done, folders, *k)).collect();
    let path = arguments.out.join(format!("results-{index}-of-{count}.jsonl"));
    let mut file = std::fs::OpenOptions::new()
        .create(true)
        .append(true)
        .open(&path)
        .with_context(|| format!("{} cannot be written", path.display()))
        .map_err(Failure::input)?;
    let progress = Count::new("diagnosing", open.len() as u64);
    for k in open {
        let folder = &folders[k];
        let out = (to_separate > 0).then_some(arguments.out.as_path());
        let known = done.get(&name(folder)).cloned();
        let fresh = known.is_none();
        let Some(mut result) = known.or_else(|| diagnose_case(folder, out, &signals.flag())) else { break };
        to_separate -= usize::from(fresh && result.separation.is_some());
        if k < arguments.baselines {
            let Some(tried) = try_baselines(folder, result, &signals.flag()) else { break };
            result = tried;
        }
        // A line break first: a line that an interruption cut short stays alone.
        let line = serde_json::to_string(&result).map_err(Failure::runtime)?;
        file.write_all(format!("\n{line}").as_bytes()).and_then(|()| file.flush()).runtime()?;
        progress.one_more();
    }
    progress.finish();
    Ok(())
}

/// The results of all shards so far. A line that was cut short by an interruption counts as not there.
fn results(out: &Path) -> Result<BTreeMap<String, CaseResult>, Failure> {
    let mut all = BTreeMap::new();
    let entries = std::fs::read_dir(out)
        .with_context(|| format!("{} cannot be read", out.display()))
        .map_err(Failure::input)?;
    for entry in entries {
        let path = entry.input()?.path();
        if path.extension().is_none_or(|extension| extension != "jsonl") {
            continue;
        }
        let text = std::fs::read_to_string(&path)
            .with_context(|| format!("{} cannot be read", path.display()))
            .map_err(Failure::input)?;
        for result in text.lines().filter_map(|line| serde_json::from_str::<CaseResult>(line).ok()) {
            // One that other methods were tried on later is there twice.
            if all.get(&result.case).is_none_or(|known: &CaseResult| known.baselines.is_empty()) {
                all.insert(result.case.clone(), result);
            }
        }
    }
    Ok(all)
}

fn save(path: &Path, text: &str) -> Result<(), Failure> {
    std::fs::write(path, text)
        .with_context(|| format!("{} cannot be written", path.display()))
        .map_err(Failure::input)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shards_are_parts_of_a_whole() {
        assert_eq!("2/3".parse(), Ok(Shard { index: 2, count: 3 }));
        for text in ["0/3", "4/3", "1", "a/b", "1/0"] {
            assert!(text.parse::<Shard>().is_err(), "{text}");
        }
    }

    #[test]
    fn a_line_cut_short_is_diagnosed_again() {
        let folder = tempfile::tempdir().unwrap();
        let line = |case: &str| {
            serde_json::to_string(&CaseResult { case: case.into(), ..CaseResult::default() }).unwrap()
        };
        let cut = &line("b")[..20];
        std::fs::write(folder.path().join("results-1-of-2.jsonl"), format!("\n{}\n{cut}", line("a")))
            .unwrap();
        std::fs::write(folder.path().join("results-2-of-2.jsonl"), format!("\n{}", line("c"))).unwrap();
        let found = results(folder.path()).unwrap();
        assert_eq!(found.keys().collect::<Vec<_>>(), ["a", "c"]);
    }

    #[test]
    fn other_methods_that_were_tried_later_count() {
        let folder = tempfile::tempdir().unwrap();
        let plain = CaseResult { case: "a".into(), seconds: 2.0, ..CaseResult::default() };
        let tried = CaseResult {
            baselines: [("nominal refit only".to_owned(), baselines::BaselineResult::default())].into(),
            ..plain.clone()
        };
        let line = |result: &CaseResult| serde_json::to_string(result).unwrap();
        // In whichever order the files of shards are read.
        for (first, second) in [(&plain, &tried), (&tried, &plain)] {
            std::fs::write(folder.path().join("results-1-of-2.jsonl"), line(first)).unwrap();
            std::fs::write(folder.path().join("results-2-of-2.jsonl"), line(second)).unwrap();
            assert_eq!(results(folder.path()).unwrap()["a"], tried);
        }
    }
}
