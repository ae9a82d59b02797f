//! Looks at this machine as a place for nodes that must be on time, and says what to change.
//!
//! [`examine`] reads settings from the files under `/proc`, `/sys` and `/dev`, below a root that a test can choose;
//! [`wake_ups`] measures how late this machine wakes a sleeper. A [`Finding`] is what was found, whether it is good, and
//! the command that would change it.
//!
//! ```
//! use parallax_runtime::doctor::{Machine, examine};
//!
//! for finding in examine(&Machine::this()) {
//!     println!("{:?} {}: {}", finding.verdict, finding.check, finding.found);
//! }
//! ```

mod kernel;
mod limits;
mod memory;
mod processor;

use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::Serialize;

use crate::latency::Delays;

/// What a finding means.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Verdict {
    /// As it should be.
    Good,
    /// Worth knowing; there is nothing to change, or it is a matter of taste.
    Note,
    /// It cannot be found out here.
    Unknown,
    /// It makes nodes late, or keeps them from running: to be changed.
    Change,
}

/// What a check found.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// What was looked at.
    pub check: &'static str,
    /// What it means.
    pub verdict: Verdict,
    /// What was found, with its value.
    pub found: String,
    /// What it does to nodes, and what to do about it; empty where all is well.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub advice: String,
    /// The command that changes it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub command: Option<String>,
}

impl Finding {
    fn new(check: &'static str, verdict: Verdict, found: impl Into<String>) -> Self {
        Self { check, verdict, found: found.into(), advice: String::new(), command: None }
    }

    fn good(check: &'static str, found: impl Into<String>) -> Self {
        Self::new(check, Verdict::Good, found)
    }

    fn note(check: &'static str, found: impl Into<String>, advice: impl Into<String>) -> Self {
        Self { advice: advice.into(), ..Self::new(check, Verdict::Note, found) }
    }

    fn unknown(check: &'static str, path: &str) -> Self {
        Self::new(check, Verdict::Unknown, format!("{path} cannot be read"))
    }

    fn change(
        check: &'static str,
        found: impl Into<String>,
        advice: impl Into<String>,
        command: impl Into<String>,
    ) -> Self {
        let command = Some(command.into());
        Self { advice: advice.into(), command, ..Self::new(check, Verdict::Change, found) }
    }
}

/// Where the files of a machine lie.
#[derive(Debug, Clone)]
pub struct Machine {
    root: PathBuf,
}

impl Machine {
    /// The machine that this program runs on.
    pub fn this() -> Self {
        Self::at("/")
    }

    /// A machine whose `/proc`, `/sys` and `/dev` lie below `root`.
    pub fn at(root: impl Into<PathBuf>) -> Self {
        Self { root: root.into() }
    }

    fn path(&self, path: &str) -> PathBuf {
        self.root.join(path.trim_start_matches('/'))
    }

    /// The text of a file, without the space around it.
    fn text(&self, path: &str) -> Option<String> {
        std::fs::read_to_string(self.path(path)).ok().map(|text| text.trim().to_owned())
    }

    /// The folder `path`'s entries, sorted.
    fn entries(&self, path: &str) -> Vec<String> {
        let entries = std::fs::read_dir(self.path(path)).into_iter().flatten().flatten();
        let mut names: Vec<String> =
            entries.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect();
        names.sort();
        names
    }

    /// Whether it is the machine that this program runs on, and may be asked.
    fn live(&self) -> bool {
        self.root == Path::new("/")
    }
}

/// All checks, in the order in which they are best read.
pub fn examine(machine: &Machine) -> Vec<Finding> {
    let mut findings = processor::examine(machine);
    findings.extend(limits::examine(machine));
    findings.extend(kernel::examine(machine));
    findings.extend(memory::examine(machine));
    findings
}

/// Measures how late a sleeping thread wakes at 1 kHz over such a time, under `SCHED_FIFO` where that is allowed, as the
/// tool `cyclictest` does.
pub fn wake_ups(time: Duration) -> (Finding, Delays) {
    const CHECK: &str = "wake-ups";
    let measured = std::thread::spawn(move || crate::latency::sleeper(time));
    let mut delays = Delays::new();
    let Ok((late, fifo)) = measured.join() else {
        return (Finding::new(CHECK, Verdict::Unknown, "the measuring thread failed"), delays);
    };
    delays.extend(late);
    let micros = |ns: u64| format!("{:.0} us", ns as f64 / 1e3);
    let at = |percent: f64| delays.at(percent).map_or_else(|| "-".into(), micros);
    let most = delays.range().1;
    let found = format!(
        "a sleeper wakes {} late (half), {} (99 %), {} (most of {}), {}",
        at(50.0),
        at(99.0),
        micros(most),
        delays.len(),
        if fifo { "under SCHED_FIFO" } else { "like any program" }
    );
    let late = delays.at(99.0).unwrap_or(most);
    let finding = match (late, most) {
        (late, most) if late < 100_000 && most < 1_000_000 => Finding::good(CHECK, found),
        (late, _) if late < 1_000_000 => Finding::note(
            CHECK,
            found,
            "now and then a step starts late: give its node a core of its own and let it poll (--spin)",
        ),
        _ => Finding::change(
            CHECK,
            found,
            "steps of 1 kHz would miss their time: mend what stands above, and look for what else runs",
            "top",
        ),
    };
    (finding, delays)
}
