//! What an episode costs.

use parallax_model::system::{Equations, Point};

use super::trace::{Source, Trace};

/// Where a cost is no number.
#[derive(Clone, Debug)]
pub(super) struct NoNumber {
    /// Index of the cost's output: the cost, or the terminal one.
    pub(super) output: usize,
    /// The value.
    pub(super) value: f64,
    /// When (s).
    pub(super) time: f64,
    /// The inputs of the cost there.
    pub(super) inputs: Vec<f64>,
}

/// The score of the episode from `from` to `to` (s): the mean of the cost over time, plus the terminal cost.
///
/// The cost is evaluated whenever a signal that it may read is stamped, with the newest value of each, and holds until
/// the next stamp. `cost` has one or two outputs, the second being the terminal cost; `sources` says what its inputs read.
pub(super) fn score(
    cost: &Equations,
    sources: &[Source],
    trace: &Trace,
    from: f64,
    to: f64,
) -> Result<f64, NoNumber> {
    let parameters = cost.nominal();
    let mut stamps = vec![from];
    for held in sources.iter().map(|source| trace.channel(*source)) {
        stamps.extend(held.times.iter().filter(|t| **t > from && **t < to));
    }
    stamps.sort_by(f64::total_cmp);
    stamps.dedup();
    let at = |time: f64, output: usize| {
        let inputs: Vec<f64> = sources.iter().map(|source| trace.channel(*source).at(time)).collect();
        let point = Point { parameters: &parameters, states: &[], inputs: &inputs, time };
        let value = cost.values(&point, &[]).outputs[output];
        if value.is_finite() { Ok(value) } else { Err(NoNumber { output, value, time, inputs }) }
    };
    let mut sum = 0.0;
    for (k, stamp) in stamps.iter().enumerate() {
        let until = stamps.get(k + 1).copied().unwrap_or(to);
        sum += at(*stamp, 0)? * (until - stamp);
    }
    let mean = sum / (to - from);
    let last = stamps.last().copied().unwrap_or(from);
    Ok(mean + if cost.system().outputs.len() > 1 { at(last, 1)? } else { 0.0 })
}
