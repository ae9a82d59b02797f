//! One line of the report: what a peer, or a part of ours, reached. Scripts of peers print the same as JSON.

use std::time::Instant;

use serde::{Deserialize, Serialize};

/// One measurement: a throughput, or some other value.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub(crate) struct Line {
    /// Who.
    pub(crate) peer: String,
    /// What was run.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub(crate) case: String,
    /// Which of several ways to run it.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub(crate) way: String,
    /// Precision, `f32` or `f64`.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub(crate) dtype: String,
    /// Environments at once.
    #[serde(skip_serializing_if = "is_zero")]
    pub(crate) envs: usize,
    /// Supervisor steps a second of every repetition, ascending.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(crate) steps_per_second: Vec<f64>,
    /// What else was measured.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub(crate) value: String,
    /// How much of it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) amount: Option<f64>,
    /// Its unit.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub(crate) unit: String,
    /// What else is to be said.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub(crate) detail: String,
}

fn is_zero(count: &usize) -> bool {
    *count == 0
}

impl Line {
    /// A throughput, from the seconds that `steps` steps of each environment took.
    pub(crate) fn throughput(
        peer: &str,
        case: String,
        dtype: &str,
        envs: usize,
        steps: usize,
        seconds: &[f64],
    ) -> Self {
        let mut rates: Vec<f64> = seconds.iter().map(|seconds| (envs * steps) as f64 / seconds).collect();
        rates.sort_by(f64::total_cmp);
        Self {
            peer: peer.to_owned(),
            case,
            dtype: dtype.to_owned(),
            envs,
            steps_per_second: rates,
            ..Self::default()
        }
    }

    /// Something that is no throughput.
    pub(crate) fn value(peer: &str, value: String, amount: f64, unit: &str) -> Self {
        let (peer, unit) = (peer.to_owned(), unit.to_owned());
        Self { peer, value, amount: Some(amount), unit, ..Self::default() }
    }

    /// The same, with something to be said.
    pub(crate) fn detail(self, detail: String) -> Self {
        Self { detail, ..self }
    }

    /// The best repetition.
    pub(crate) fn best(&self) -> f64 {
        self.steps_per_second.last().copied().unwrap_or(f64::NAN)
    }

    /// The median of the repetitions.
    pub(crate) fn median(&self) -> f64 {
        self.steps_per_second.get(self.steps_per_second.len() / 2).copied().unwrap_or(f64::NAN)
    }
}

/// How long and how often something is timed.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Timing {
    /// Least seconds of one repetition.
    pub(crate) seconds: f64,
    /// Repetitions.
    pub(crate) repeats: usize,
}

impl Timing {
    /// Seconds of one call, once for each repetition. The first two calls warm caches up and are not counted.
    pub(crate) fn measure(self, mut run: impl FnMut()) -> Vec<f64> {
        run();
        let start = Instant::now();
        run();
        let once = start.elapsed().as_secs_f64();
        let calls = ((self.seconds / once.max(1e-9)) as usize).max(1);
        let repetition = || {
            let start = Instant::now();
            (0..calls).for_each(|_| run());
            start.elapsed().as_secs_f64() / calls as f64
        };
        std::iter::repeat_with(repetition).take(self.repeats).collect()
    }
}
