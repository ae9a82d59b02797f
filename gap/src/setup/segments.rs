//! Which stretches of a log are fitted, and which are held out.

use std::sync::Arc;

use crate::experiment::Experiment;
use crate::guess::Guess;
use crate::innovation::Segment;

/// Blocks into which a log is cut, at most.
const BLOCKS: usize = 10;

/// Which of every three blocks is held out at first.
pub const HELD_OUT: usize = 2;

/// Cuts the log into blocks: of every three, one is held out. Of three recordings or more, every third is held out as a
/// whole: what was learned must hold on another run.
pub(super) fn segments(
    experiment: &Experiment,
    horizon: f64,
    period: f64,
    guess: &Arc<Guess>,
    held_out: usize,
) -> (Vec<Segment>, Vec<Segment>) {
    let mut train: Vec<Segment> = Vec::new();
    let mut test = Vec::new();
    let segment = |from: f64, to: f64| Segment { from, to, guess: guess.clone() };
    let spans = experiment.spans();
    let whole = spans.len() >= 3;
    for (k, (from, to)) in spans.iter().copied().enumerate() {
        if whole {
            match k % 3 == held_out {
                // The filter needs readings before the first prediction.
                true => test.push(segment((from + 2.0 * horizon).min(to), to + 1e-9)),
                false => train.push(segment(from, to + 1e-9)),
            }
            continue;
        }
        let moving = experiment.moving(from, to);
        let blocks = ((moving / (4.0 * horizon)).floor() as usize).clamp(1, BLOCKS);
        let length = moving / blocks as f64;
        for block in 0..blocks {
            let a = experiment.after(from, block as f64 * length);
            let b = if block + 1 == blocks { to + 1e-9 } else { experiment.until(a, length) };
            if block % 3 == held_out || (blocks == 2 && block == usize::from(held_out == HELD_OUT)) {
                test.push(segment(a, b));
            } else if let Some(last) = train.last_mut().filter(|s| (s.to - a).abs() < 1e-9) {
                last.to = b;
            } else {
                train.push(segment(a, b));
            }
        }
    }
    let gap = GAP.0 * horizon.max(GAP.1 * period);
    (without_gaps(experiment, train, gap), without_gaps(experiment, test, gap))
}

/// Time without readings, in horizons or in tens of periods, over which no state is carried.
pub(super) const GAP: (f64, f64) = (2.0, 10.0);

/// Segments cut where no output was read for longer than `gap`.
fn without_gaps(experiment: &Experiment, segments: Vec<Segment>, gap: f64) -> Vec<Segment> {
    let samples = &experiment.samples;
    let mut out = Vec::new();
    for segment in segments {
        let begin = samples.partition_point(|s| s.stamp < segment.from);
        let inside = &samples[begin..begin + samples[begin..].partition_point(|s| s.stamp < segment.to)];
        let mut from = segment.from;
        for pair in inside.windows(2) {
            if pair[1].stamp - pair[0].stamp > gap {
                out.push(Segment { from, to: pair[0].stamp + 1e-9, ..segment.clone() });
                from = pair[1].stamp;
            }
        }
        out.push(Segment { from, ..segment });
    }
    out
}
