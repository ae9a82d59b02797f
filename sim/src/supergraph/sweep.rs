//! Balances the partitions of an episode: a sweep from its end that keeps every node to its mean rate.

use super::cut::StartUp;
use super::dag::{Dag, Steps};

/// The steps of one node that are still to be placed, and the line that their number should follow.
struct Lane {
    /// Steps that run, in order; all before `left` are not placed yet.
    left: usize,
    /// How many must be placed before the current partition, and how many of these have had their inputs seen to.
    before: usize,
    settled: usize,
    line: Line,
}

/// A node's number of steps up to partition k should be `floor(rate (k + 1) + offset)`.
struct Line {
    rate: f64,
    offset: f64,
    most: usize,
    least: usize,
}

impl Line {
    fn new(dag: &Dag<'_>, steps: &Steps, node: usize) -> Line {
        let partitions = steps.partitions() as f64;
        let running = &steps.running[node];
        let span = |node: usize, steps: &[i64]| match (steps.first(), steps.last()) {
            (Some(first), Some(last)) if last > first => {
                Some((last - first) as f64 / (dag.nodes[node].start.len() - 1) as f64)
            }
            _ => None,
        };
        let period = span(steps.supervisor, dag.nodes[steps.supervisor].start);
        let raw = match (period, span(node, dag.nodes[node].start)) {
            (Some(supervisor), Some(own)) => {
                // Pruned steps are no steps here.
                let share =
                    running.len() as f64 / running.last().map_or(1.0, |&last| f64::from(steps.seq(last) + 1));
                supervisor / own * share
            }
            _ => running.len() as f64 / partitions.max(1.0),
        };
        // Rates are mostly simple ratios of the supervisor's: take the simplest within one step over the episode.
        let simple = (1..=12).map(|below| ((raw * f64::from(below)).round(), f64::from(below)));
        let mut simple = simple.filter(|(above, below)| (above / below - raw).abs() * partitions <= 1.0);
        let (rate, grid) = simple.next().map_or((raw, 0.0), |(above, below)| (above / below, below));
        let behind = running
            .iter()
            .enumerate()
            .map(|(index, &vertex)| (index + 1) as f64 - rate * f64::from(steps.latest[vertex as usize] + 1));
        let behind = behind.fold(f64::NEG_INFINITY, f64::max);
        let offset = if grid > 0.0 { (behind * grid - 1e-6).ceil() / grid } else { behind };
        let (most, least) = ((rate - 1e-9).ceil().max(1.0) as usize, (rate + 1e-9).floor() as usize);
        Line { rate, offset, most, least }
    }

    fn until(&self, partition: i32) -> usize {
        // The number is whole for simple rates, up to rounding.
        (self.rate * f64::from(partition + 1) + self.offset + 1e-6).floor().max(0.0) as usize
    }
}

/// The partition of every vertex: negative before that of the supervisor's first step.
///
/// From the last partition to the first, every node hands as many of its steps to the partitions before as its line asks
/// for, at most as many as have their inputs by then, at least as many as are needed by then; what is handed on takes its
/// inputs along. Handing on is always possible: the inputs of a step are known no later than those of the step.
pub(super) fn balance(dag: &Dag<'_>, steps: &Steps, start: StartUp) -> Vec<i32> {
    let mut place = steps.latest.clone();
    let mut index_of = vec![0u32; place.len()];
    for running in &steps.running {
        for (index, &vertex) in running.iter().enumerate() {
            index_of[vertex as usize] = index as u32;
        }
    }
    let mut lanes: Vec<Lane> = (0..steps.running.len())
        .map(|node| Lane {
            left: steps.running[node].len(),
            before: 0,
            settled: 0,
            line: Line::new(dag, steps, node),
        })
        .collect();
    let mut partition = steps.partitions() as i32 - 1;
    let mut raised = Vec::new();
    while lanes.iter().any(|lane| lane.left > 0) {
        let last = partition <= 0 && start == StartUp::First;
        for (node, lane) in lanes.iter_mut().enumerate() {
            if node == steps.supervisor || last {
                let supervisor = partition.max(0) as usize;
                lane.before = if last { 0 } else { supervisor.min(lane.left) };
                lane.settled = lane.before;
                continue;
            }
            let running = &steps.running[node][..lane.left];
            let by = |bound: &[i32]| running.partition_point(|&vertex| bound[vertex as usize] < partition);
            let (least, most) = (by(&steps.latest), by(&steps.earliest));
            let line = &lane.line;
            let wanted = if partition > 0 {
                let fewest = lane.left.saturating_sub(line.most);
                line.until(partition - 1).clamp(fewest, lane.left.saturating_sub(line.least))
            } else {
                lane.left.saturating_sub(line.most)
            };
            lane.settled = least;
            lane.before = wanted.min(most).max(least);
            if lane.before > least {
                raised.push(node);
            }
        }
        while let Some(node) = raised.pop() {
            for index in lanes[node].settled..lanes[node].before {
                for &input in steps.inputs(steps.running[node][index]) {
                    let sender = steps.node[input as usize] as usize;
                    let needed = index_of[input as usize] as usize + 1;
                    if sender != steps.supervisor && lanes[sender].before < needed {
                        lanes[sender].before = needed;
                        raised.push(sender);
                    }
                }
            }
            lanes[node].settled = lanes[node].before;
        }
        for (node, lane) in lanes.iter_mut().enumerate() {
            for &vertex in &steps.running[node][lane.before..lane.left] {
                place[vertex as usize] = partition;
            }
            lane.left = lane.before;
        }
        partition -= 1;
    }
    place
}
