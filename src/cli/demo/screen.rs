//! What the demo shows while it goes on: on a terminal one screen of stages that fill, elsewhere a line for each.
//!
//! Lines are cut to the terminal and not padded: one that was as wide as the terminal breaks when that is made narrower.

use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{MultiProgress, ProgressBar, ProgressStyle};
use parallax_runtime::launch::{LiveRun, Progress, Sample, Snapshot};
use parallax_runtime::time::{Nanos, to_seconds};

use crate::cli::output;

/// The stages, in their order.
const STAGES: [&str; 4] = ["Run", "Replay", "Diagnose", "Compare"];

/// Columns of a stage's bar and what stands around it.
const BAR: usize = 19;

/// Where the demo shows what it does.
pub(super) enum Screen {
    /// The stages on a terminal, each with a line below it for what goes on in it.
    Drawn(Vec<Stage>),
    /// Lines.
    Plain,
    /// Nothing, for whoever reads JSON.
    Silent,
}

/// A stage's place on the screen.
pub(super) struct Stage {
    head: ProgressBar,
    now: ProgressBar,
}

impl Screen {
    /// The screen that fits where the output goes.
    pub(super) fn new(json: bool) -> Self {
        if json {
            return Self::Silent;
        }
        if !(std::io::stdout().is_terminal() && std::io::stderr().is_terminal()) {
            return Self::Plain;
        }
        let all = MultiProgress::new();
        let line = |template: &str| {
            let bar = all.add(ProgressBar::no_length());
            bar.set_style(style(template));
            bar
        };
        let stages = STAGES.map(|name| {
            let stage = Stage { head: line("  {prefix} {msg}"), now: line("    {msg:.dim}") };
            stage.head.set_prefix("·");
            stage.head.set_message(name.to_owned());
            stage.now.set_message("");
            stage
        });
        Self::Drawn(stages.into())
    }

    /// A stage begins.
    pub(super) fn begin(&self, stage: usize, what: &str) {
        match self {
            Self::Drawn(stages) => {
                let Stage { head, .. } = &stages[stage];
                head.set_style(style("  {spinner} {msg}"));
                head.set_message(headed(stage, what));
                head.enable_steady_tick(Duration::from_millis(120));
            }
            Self::Plain => output::line(format!("{}. {what}", stage + 1)),
            Self::Silent => {}
        }
    }

    /// A stage is over.
    pub(super) fn done(&self, stage: usize, what: &str) {
        match self {
            Self::Drawn(stages) => {
                let Stage { head, now } = &stages[stage];
                now.finish_and_clear();
                head.set_style(style("  {prefix:.green} {msg}"));
                head.set_prefix("✓");
                head.finish_with_message(headed(stage, what));
            }
            Self::Plain => output::line(format!("   {what}")),
            Self::Silent => {}
        }
    }

    /// Somebody stopped the demo in this stage: the next ones are not going to be.
    pub(super) fn stopped(&self, stage: usize, what: &str) {
        match self {
            Self::Drawn(stages) => {
                for Stage { head, now } in stages.iter().skip(stage + 1) {
                    now.finish_and_clear();
                    head.finish_and_clear();
                }
                let Stage { head, now } = &stages[stage];
                now.finish_and_clear();
                head.set_style(style("  {prefix} {msg}"));
                head.set_prefix("-");
                head.finish_with_message(headed(stage, what));
            }
            Self::Plain => output::line(format!("   {what}")),
            Self::Silent => {}
        }
    }

    /// The bar of what goes on in a stage; hidden where nothing is drawn.
    pub(super) fn bar(&self, stage: usize, total: u64) -> ProgressBar {
        match self {
            Self::Drawn(stages) => {
                let now = &stages[stage].now;
                now.set_style(style("    [{bar:12}] {msg:.dim}").progress_chars("=> "));
                now.set_length(total);
                now.clone()
            }
            _ => ProgressBar::hidden(),
        }
    }

    /// Shows a run as it is, a few times a second.
    pub(super) fn watch(&self, stage: usize, duration: Nanos) -> Box<dyn FnMut(Progress) -> bool> {
        let Self::Drawn(_) = self else { return Box::new(|_| true) };
        let bar = self.bar(stage, duration.unsigned_abs());
        let mut live = Live::default();
        Box::new(move |progress| {
            bar.set_position(progress.elapsed.max(0).unsigned_abs());
            if let Some(snapshot) = live.look() {
                bar.set_message(in_words(&snapshot, duration));
            }
            true
        })
    }
}

/// A stage's name and what is said of it, as far as the terminal is wide.
fn headed(stage: usize, what: &str) -> String {
    format!("{:<9} {}", STAGES[stage], clipped(what, 15))
}

/// Text as far as the terminal is wide, from this column on.
fn clipped(text: &str, column: usize) -> String {
    let room = output::columns(usize::MAX).saturating_sub(column);
    if text.chars().count() <= room {
        return text.into();
    }
    text.chars().take(room.saturating_sub(1)).chain(['…']).collect()
}

fn style(template: &str) -> ProgressStyle {
    ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar())
}

/// The run of this process, as `parallax top` sees it.
#[derive(Default)]
struct Live {
    run: Option<LiveRun>,
    before: Option<Sample>,
    looked: Option<Instant>,
}

impl Live {
    /// The last second of the run; `None` when it is too early for the next look.
    fn look(&mut self) -> Option<Snapshot> {
        if self.looked.is_some_and(|at| at.elapsed() < Duration::from_millis(500)) {
            return None;
        }
        self.looked = Some(Instant::now());
        if self.run.is_none() {
            self.run = LiveRun::find(Some(&std::process::id().to_string())).ok();
        }
        let run = self.run.as_ref()?;
        let now = run.sample();
        let snapshot = self.before.as_ref().map(|before| run.snapshot(before, &now));
        self.before = Some(now);
        snapshot
    }
}

/// A look at the run on one line; on a narrow terminal of the rates alone, since the bar shows the time.
fn in_words(snapshot: &Snapshot, duration: Nanos) -> String {
    let nodes: Vec<String> = snapshot
        .nodes
        .iter()
        .map(|node| format!("{} {}", node.node, node.rate.map_or("-".into(), |rate| format!("{rate:.0}"))))
        .collect();
    let steps: u64 = snapshot.nodes.iter().map(|node| node.steps).sum();
    let rates = format!("{} Hz", nodes.join(", "));
    let (elapsed, whole) = (to_seconds(snapshot.elapsed.max(0)), to_seconds(duration));
    let all = format!("{elapsed:.0} of {whole:.0} s · {steps} steps · {rates}");
    let fits = BAR + all.chars().count() < output::columns(usize::MAX);
    clipped(if fits { &all } else { &rates }, BAR + 1)
}
