//! `parallax withheld-truth`: the process that makes the cases and seals their answers. It is the only one that sees both.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use clap::Args;
use parallax_withheld_truth::{Answer, Plan, Set, TruthError, plans, write};
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::seal::{self, Answers, Sealed};
use crate::cli::failure::{Failure, Outcome, Sort};
use crate::cli::output::{self, Count};

/// The folder of the cases in a run's folder.
pub(crate) const CASES: &str = "cases";

/// What a case tells the diagnosis beside its recording.
pub(crate) const OPTIONS: &str = "options.json";

/// How many cases of each set.
#[derive(Args, Clone, Debug)]
pub(crate) struct Counts {
    /// Cases of one effect.
    #[arg(long, value_name = "N", default_value_t = 300)]
    singles: usize,
    /// Cases without an effect.
    #[arg(long, value_name = "N", default_value_t = 200)]
    nulls: usize,
    /// Cases of one effect in another functional form.
    #[arg(long, value_name = "N", default_value_t = 60)]
    other_form: usize,
    /// Cases of two effects.
    #[arg(long, value_name = "N", default_value_t = 60)]
    pairs: usize,
    /// Cases whose cause is outside the library.
    #[arg(long, value_name = "N", default_value_t = 60)]
    outside: usize,
    /// Cases of one effect under poor excitation.
    #[arg(long, value_name = "N", default_value_t = 40)]
    poor: usize,
    /// Cases of one effect in six seconds.
    #[arg(long, value_name = "N", default_value_t = 40)]
    short: usize,
    /// Cases of one effect that the diagnosis must leave out of its library.
    #[arg(long, value_name = "N", default_value_t = 40)]
    leave_out: usize,
    /// Cases of one effect of a machine whose forces scatter from one moment to the next, as those of real ones do.
    #[arg(long, value_name = "N", default_value_t = 40)]
    rough: usize,
    /// Cases of such a machine without an effect.
    #[arg(long, value_name = "N", default_value_t = 20)]
    rough_nulls: usize,
}

impl Counts {
    /// The same counts as arguments of the truth's process.
    pub(crate) fn arguments(&self) -> Vec<String> {
        let counts = [
            ("--singles", self.singles),
            ("--nulls", self.nulls),
            ("--other-form", self.other_form),
            ("--pairs", self.pairs),
            ("--outside", self.outside),
            ("--poor", self.poor),
            ("--short", self.short),
            ("--leave-out", self.leave_out),
            ("--rough", self.rough),
            ("--rough-nulls", self.rough_nulls),
        ];
        counts.iter().flat_map(|(name, count)| [(*name).to_owned(), count.to_string()]).collect()
    }

    /// Whether no case is asked for.
    pub(crate) fn is_empty(&self) -> bool {
        self.sets().iter().all(|(_, count, _)| *count == 0)
    }

    /// Every set with its count, and whether the true effect is left out of the library.
    fn sets(&self) -> [(Set, usize, bool); 10] {
        [
            (Set::Single, self.singles, false),
            (Set::Null, self.nulls, false),
            (Set::OtherForm, self.other_form, false),
            (Set::Pair, self.pairs, false),
            (Set::Outside, self.outside, false),
            (Set::PoorExcitation, self.poor, false),
            (Set::Short, self.short, false),
            (Set::Single, self.leave_out, true),
            (Set::Rough, self.rough, false),
            (Set::RoughNull, self.rough_nulls, false),
        ]
    }
}

#[derive(Args)]
pub(crate) struct Arguments {
    #[command(flatten)]
    counts: Counts,
    /// The seed, from the stream for development; without it one is drawn from the system's randomness.
    #[arg(long, value_name = "SEED")]
    dev_seed: Option<u64>,
    /// The run's folder.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Make those cases of the sealed run in the folder again that are not there.
    #[arg(long)]
    again: bool,
}

/// What the diagnosis of a case is told.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct CaseOptions {
    /// Effects left out of the library.
    pub(crate) exclude: Vec<String>,
}

/// Seeds of reported runs have this bit; seeds for development do not. So no case is in both.
const REPORTED: u64 = 1 << 63;

/// How often a case is drawn at most.
const TRIES: usize = 20;

/// The seed of a run: one for development if it is stated, else a fresh one.
fn draw_seed(development: Option<u64>) -> u64 {
    match development {
        Some(seed) => seed & !REPORTED,
        None => rand::rng().random::<u64>() | REPORTED,
    }
}

pub(crate) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    if arguments.again {
        return make_again(&arguments.out);
    }
    let seed = draw_seed(arguments.dev_seed);
    let cases = arguments.out.join(CASES);
    refuse_orphans(&cases)?;
    std::fs::create_dir_all(&cases)
        .with_context(|| format!("the folder {} cannot be made", cases.display()))
        .map_err(Failure::input)?;
    let drafts = drafts(&arguments.counts, seed);
    let count = Count::new("making cases", drafts.len() as u64);
    let made: Result<BTreeMap<String, Sealed>, Failure> = drafts
        .par_iter()
        .map(|draft| {
            let (answer, seed) = draft.make(&cases.join(&draft.name))?;
            count.one_more();
            let plan = draft.plan.clone();
            Ok((draft.name.clone(), Sealed { answer, left_out: draft.left_out, plan, seed }))
        })
        .collect();
    count.finish();
    let answers = Answers { seed, development: arguments.dev_seed.is_some(), cases: made? };
    output::line(seal::seal(&arguments.out, &answers).runtime()?);
    Ok(Outcome::Done)
}

/// Makes the cases of a sealed run again that are not there: all of it is in the seeds that were sealed with the answers.
fn make_again(out: &Path) -> Result<Outcome, Failure> {
    let nothing = || Failure::input(anyhow!("{} holds no sealed run", out.display()));
    let hash = seal::sealed_hash(out).input()?.ok_or_else(nothing)?;
    let answers = seal::open(out, &hash).input()?;
    let cases = out.join(CASES);
    let missing: Vec<(&String, &Sealed)> =
        answers.cases.iter().filter(|(name, _)| !cases.join(name).exists()).collect();
    if missing.is_empty() {
        return Ok(Outcome::Done);
    }
    // Each is moved to its place when it is whole: the shards of a run may all be at this.
    let draft = out.join(format!("again-{}", std::process::id()));
    std::fs::create_dir_all(&cases).runtime()?;
    let count = Count::new("making cases again", missing.len() as u64);
    let made: Result<(), Failure> = missing.par_iter().try_for_each(|(name, sealed)| {
        let folder = draft.join(name);
        std::fs::create_dir_all(&folder).runtime()?;
        let answer = write(&sealed.plan, sealed.seed, &folder).runtime()?;
        if in_file(&answer).runtime()? != sealed.answer {
            return Err(Failure::input(anyhow!(
                "the case {name} cannot be made again: this version of the program makes another one of its seed"
            )));
        }
        write_options(&folder, &answer, sealed.left_out)?;
        let place = cases.join(name);
        match std::fs::rename(&folder, &place) {
            // Another shard was faster.
            Err(_) if place.exists() => {}
            moved => moved.runtime()?,
        }
        count.one_more();
        Ok(())
    });
    count.finish();
    std::fs::remove_dir_all(&draft).runtime()?;
    made.map(|()| Outcome::Done)
}

/// The answer as a file holds it: the last digit of a number may be another one there.
fn in_file(answer: &Answer) -> Result<Answer, serde_json::Error> {
    serde_json::from_str(&serde_json::to_string(answer)?)
}

/// Writes what a case tells the diagnosis.
fn write_options(folder: &Path, answer: &Answer, left_out: bool) -> Result<(), Failure> {
    let mut exclude = Vec::new();
    if left_out {
        exclude.extend(answer.effects.iter().map(|effect| effect.name.clone()));
    }
    let text = serde_json::to_string(&CaseOptions { exclude }).map_err(Failure::runtime)?;
    std::fs::write(folder.join(OPTIONS), text).map_err(Failure::runtime)
}

/// Cases that no seal covers are left over from a process that died: they would be diagnosed without an answer.
pub(crate) fn refuse_orphans(cases: &Path) -> Result<(), Failure> {
    let some = std::fs::read_dir(cases).is_ok_and(|mut entries| entries.next().is_some());
    if some {
        return Err(Failure::input(anyhow!(
            "{} holds cases whose answers were never sealed; remove that folder, or name another --out",
            cases.display()
        )));
    }
    Ok(())
}

/// A case before it is made.
struct Draft {
    name: String,
    plan: Plan,
    seed: u64,
    left_out: bool,
}

/// All cases of a run under names that say nothing: in the order of the names, sets are mixed.
fn drafts(counts: &Counts, seed: u64) -> Vec<Draft> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut drafts = Vec::new();
    for (set, count, left_out) in counts.sets() {
        // Each set has a seed of its own, so that its cases do not depend on how many others there are.
        let own = random.random();
        let mut seeds = ChaCha8Rng::seed_from_u64(own);
        for plan in plans(set, count, own) {
            let seed = (seeds.random::<u64>() & !REPORTED) | (seed & REPORTED);
            drafts.push(Draft { name: String::new(), plan, seed, left_out });
        }
    }
    let mut names: Vec<u32> = (0..drafts.len() as u32).collect();
    let offset = random.random_range(0..0x1000_0000_u32);
    names.shuffle(&mut random);
    for (draft, name) in drafts.iter_mut().zip(names) {
        // An odd factor maps different numbers to different names.
        draft.name = format!("{:08x}", (name + offset).wrapping_mul(0x9e37_79b1));
    }
    drafts
}

impl Draft {
    /// Makes the case; gives its answer and the seed that it was made from.
    fn make(&self, folder: &Path) -> Result<(Answer, u64), Failure> {
        std::fs::create_dir_all(folder)
            .with_context(|| format!("the folder {} cannot be made", folder.display()))
            .map_err(Failure::runtime)?;
        // A machine that ran away is of no use: it is drawn again.
        let mut seeds = ChaCha8Rng::seed_from_u64(self.seed);
        let mut seed = self.seed;
        let mut tries = 1;
        let answer = loop {
            match write(&self.plan, seed, folder) {
                Err(TruthError::Diverged) if tries < TRIES => {
                    seed = (seeds.random::<u64>() & !REPORTED) | (self.seed & REPORTED);
                    tries += 1;
                }
                made => break made.runtime()?,
            }
        };
        write_options(folder, &answer, self.left_out)?;
        Ok((answer, seed))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn cases_without_a_seal_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let cases = folder.path().join(CASES);
        assert!(refuse_orphans(&cases).is_ok());
        std::fs::create_dir_all(cases.join("one")).unwrap();
        assert!(refuse_orphans(&cases).is_err());
    }

    #[test]
    fn development_and_reported_seeds_never_meet() {
        for seed in [0, 1, u64::MAX, REPORTED] {
            assert_eq!(draw_seed(Some(seed)) & REPORTED, 0);
        }
        assert_eq!(draw_seed(None) & REPORTED, REPORTED);
        assert_ne!(draw_seed(None), draw_seed(None), "reported seeds are drawn anew");
        let counts = Counts {
            singles: 5,
            nulls: 5,
            other_form: 1,
            pairs: 1,
            outside: 1,
            poor: 1,
            short: 1,
            leave_out: 2,
            rough: 1,
            rough_nulls: 1,
        };
        for run in [3, 3 | REPORTED] {
            let drafts = drafts(&counts, run);
            assert!(drafts.iter().all(|draft| draft.seed & REPORTED == run & REPORTED));
            let names: BTreeSet<&str> = drafts.iter().map(|draft| draft.name.as_str()).collect();
            assert_eq!(names.len(), drafts.len(), "names differ");
            assert_eq!(drafts.iter().filter(|draft| draft.left_out).count(), 2);
            let seeds: BTreeSet<u64> = drafts.iter().map(|draft| draft.seed).collect();
            assert_eq!(seeds.len(), drafts.len(), "seeds differ");
        }
    }
}
