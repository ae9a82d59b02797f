//! Commands within a tick as straight lines.
//!
//! A simulator that integrates to the stamps of its commands feels every microsecond of their delay, and its predictions
//! change smoothly with it: within a tick what the commands make, steps at the times at which they were received, is replaced
//! by the straight line of the same mean and first moment, which moves a machine as they do up to the third order of the
//! tick.

use parallax_model::Scalar;
use parallax_model::node_model::NodeStep;

/// For every leaf of the commands at `port`, over the tick of `period` seconds that ends at the step's start: their mean, and
/// how far the line's ends are from it. `moment` is 12/h³; `before` is what acts before the first command is there.
#[inline(always)]
#[allow(clippy::needless_range_loop, reason = "what iterates over two lists stays a call in a large kernel")]
pub(crate) fn lines<T: Scalar, const N: usize>(
    step: &NodeStep<'_, T>,
    port: &str,
    period: T,
    moment: T,
    before: [T; N],
) -> [(T, T); N] {
    let window = step.window(port);
    let begin = step.start - period;
    let zero = T::constant(0.0);
    let mut sums = [(zero, zero); N];
    let mut from = zero;
    for index in 0..window {
        let to = if index + 1 < window {
            let ([_, _, received], _) = step.raw(port, index + 1);
            (received - begin).max(zero).min(period)
        } else {
            period
        };
        let ([seq, ..], leaves) = step.raw(port, index);
        let never = seq.lt(zero);
        let (length, square) = (to - from, (to * to - from * from) * 0.5);
        for leaf in 0..N {
            let value = T::select(never, before[leaf], leaves[leaf].loaded());
            sums[leaf].0 += value * length;
            sums[leaf].1 += value * square;
        }
        from = to;
    }
    let (per_period, half) = (T::constant(1.0) / period, period * 0.5);
    for leaf in 0..N {
        let (sum, first) = sums[leaf];
        let slope = (first - sum * half) * moment;
        sums[leaf] = (sum * per_period, slope * half);
    }
    sums
}
