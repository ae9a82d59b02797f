//! How a clock runs: its rate, the spread of its steps, its gaps.

use serde::Serialize;

use super::plan::Plan;
use super::{Clock, convert};

/// A step that is so many times longer than the middle one is a gap.
const GAP: f64 = 5.0;

/// How a clock runs. All times are in seconds, and steps are between rows that have stamps.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Run {
    /// The earliest stamp.
    pub first_s: f64,
    /// From the earliest to the latest.
    pub span_s: f64,
    /// One over the middle step, in Hz.
    pub rate_hz: f64,
    /// Nineteen steps of twenty are longer than this.
    pub step_low_s: f64,
    /// Nineteen steps of twenty are shorter than this.
    pub step_high_s: f64,
    /// Steps of more than five times the middle one.
    pub gaps: usize,
    /// The longest step.
    pub longest_s: f64,
    /// When it began, from the earliest stamp.
    pub longest_at_s: f64,
    /// Rows with the stamp of the row before.
    pub repeated: usize,
    /// Rows with an earlier stamp than the row before.
    pub backwards: usize,
    /// Rows without a stamp.
    pub missing: usize,
}

impl Clock {
    /// How it runs as `plan` reads it; `None` when its unit is not known, or a stamp cannot be read.
    pub fn run(&self, plan: &Plan) -> Option<Run> {
        let stamps = self.stamps(convert::unit(self, plan)?).ok()?;
        let known: Vec<i64> = stamps.iter().copied().flatten().collect();
        let (first, last) = (known.iter().min()?, known.iter().max()?);
        let seconds = |nanos: i64| nanos as f64 / 1e9;
        let mut steps: Vec<f64> =
            known.windows(2).map(|pair| seconds(pair[1] - pair[0])).filter(|step| *step > 0.0).collect();
        let longest = known
            .windows(2)
            .max_by_key(|pair| pair[1] - pair[0])
            .map(|pair| (pair[1] - pair[0], pair[0] - first));
        steps.sort_by(f64::total_cmp);
        let at = |share: f64| {
            steps.get(((steps.len().saturating_sub(1)) as f64 * share).round() as usize).copied()
        };
        let middle = at(0.5)?;
        Some(Run {
            first_s: seconds(*first),
            span_s: seconds(last - first),
            rate_hz: 1.0 / middle,
            step_low_s: at(0.05)?,
            step_high_s: at(0.95)?,
            gaps: steps.iter().filter(|step| **step > GAP * middle).count(),
            longest_s: longest.map_or(0.0, |(step, _)| seconds(step)),
            longest_at_s: longest.map_or(0.0, |(_, at)| seconds(at)),
            repeated: known.windows(2).filter(|pair| pair[1] == pair[0]).count(),
            backwards: known.windows(2).filter(|pair| pair[1] < pair[0]).count(),
            missing: stamps.len() - known.len(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::import::foreign::TimeUnit;

    #[test]
    fn a_run_is_measured() {
        let texts = ["0", "10", "20", "20", "15", "30", "", "130", "140"].map(Into::into).to_vec();
        let clock = Clock::of_texts("t", Some(TimeUnit::Ms), texts).unwrap();
        let run = clock.run(&Plan::default()).unwrap();
        assert_eq!((run.repeated, run.backwards, run.missing, run.gaps), (1, 1, 1, 1));
        assert_eq!((run.rate_hz.round(), run.span_s), (100.0, 0.14));
        assert!((run.longest_s - 0.1).abs() < 1e-12 && (run.longest_at_s - 0.03).abs() < 1e-12);
    }
}
