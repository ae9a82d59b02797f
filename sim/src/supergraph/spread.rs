//! Spreads whole episodes over given slots, and searches for fewer slots over which they can be spread.

use super::cut::StartUp;
use super::dag::Steps;
use super::{Embedding, Partitioning};

/// Vertices looked at, about, before the search for fewer slots ends: a clock would make the result depend on the
/// machine.
const WORK: usize = 20_000_000;

/// Episodes, and what it takes to spread them.
pub(super) struct Spread<'a> {
    steps: &'a [Steps],
    start: StartUp,
    /// Per episode and vertex how many running steps consume it.
    readers: Vec<Vec<u32>>,
    bound: Vec<u32>,
    /// The episodes, those that last could not be spread in front.
    suspects: Vec<usize>,
    room: Room,
}

/// What one attempt writes down.
#[derive(Default)]
struct Room {
    open: Vec<u32>,
    left: Vec<usize>,
}

impl<'a> Spread<'a> {
    pub(super) fn new(steps: &'a [Steps], start: StartUp) -> Spread<'a> {
        let readers = steps.iter().map(|steps| {
            let mut readers = vec![0u32; steps.node.len()];
            for &vertex in steps.running.iter().flatten() {
                steps.inputs(vertex).iter().for_each(|&input| readers[input as usize] += 1);
            }
            readers
        });
        let readers = readers.collect();
        let nodes = steps.first().map_or(0, |steps| steps.running.len());
        let bound =
            (0..nodes).map(|node| steps.iter().map(|steps| fewest(steps, node, start)).max().unwrap_or(0));
        let bound = bound.collect();
        Spread { steps, start, readers, bound, suspects: (0..steps.len()).collect(), room: Room::default() }
    }

    pub(super) fn episodes(&self) -> usize {
        self.steps.len()
    }

    /// The fewest slots of every node, the supervisor excepted: what it needs if no step waited for another node's.
    pub(super) fn bound(&self) -> &[u32] {
        &self.bound
    }

    /// Whether every episode can be spread over `sequence` followed by the supervisor's slot.
    fn fits_all(&mut self, sequence: &[u32]) -> bool {
        let (steps, readers, room, start) = (self.steps, &self.readers, &mut self.room, self.start);
        let misfit = self.suspects.iter().position(|&episode| {
            !spread(&steps[episode], &readers[episode], start, sequence, room, |_, _, _| ())
        });
        match misfit {
            Some(place) => {
                self.suspects[..=place].rotate_right(1);
                false
            }
            None => true,
        }
    }

    /// A sequence that is no longer, starting from one over which every episode can be spread.
    pub(super) fn improve(&mut self, mut best: Vec<u32>, backtrack: usize) -> Vec<u32> {
        let bound = self.bound.iter().sum::<u32>() as usize;
        let vertices: usize = self.steps.iter().map(|steps| steps.node.len()).sum();
        let mut attempts = backtrack.min(WORK / vertices.max(1));
        best = self.shrink(best);
        'shorter: while best.len() > bound {
            // Leave one slot out and move another one.
            for out in 0..best.len() {
                let mut counts = vec![0u32; self.bound.len()];
                best.iter().for_each(|&label| counts[label as usize] += 1);
                if counts[best[out] as usize] <= self.bound[best[out] as usize] {
                    continue;
                }
                let mut shorter = best.clone();
                shorter.remove(out);
                for (from, to) in
                    (0..shorter.len()).flat_map(|from| (0..shorter.len()).map(move |to| (from, to)))
                {
                    if from == to || from == to + 1 {
                        continue;
                    }
                    if attempts == 0 {
                        break 'shorter;
                    }
                    attempts -= 1;
                    let mut moved = shorter.clone();
                    let label = moved.remove(from);
                    moved.insert(to, label);
                    if self.fits_all(&moved) {
                        best = self.shrink(moved);
                        continue 'shorter;
                    }
                }
            }
            break;
        }
        best
    }

    /// Leaves out every slot that can be.
    fn shrink(&mut self, mut sequence: Vec<u32>) -> Vec<u32> {
        let mut counts = vec![0u32; self.bound.len()];
        sequence.iter().for_each(|&label| counts[label as usize] += 1);
        for slot in (0..sequence.len()).rev() {
            let label = sequence[slot];
            if counts[label as usize] <= self.bound[label as usize] {
                continue;
            }
            sequence.remove(slot);
            if self.fits_all(&sequence) {
                counts[label as usize] -= 1;
            } else {
                sequence.insert(slot, label);
            }
        }
        sequence
    }

    /// One episode spread over `sequence`.
    pub(super) fn partitions(&self, episode: usize, sequence: &[u32]) -> (Partitioning, Vec<Embedding>) {
        let steps = &self.steps[episode];
        let mut place = vec![0i32; steps.node.len()];
        let mut given = vec![0u32; steps.node.len()];
        let mut order = Vec::new();
        let fits = spread(
            steps,
            &self.readers[episode],
            self.start,
            sequence,
            &mut Room::default(),
            |vertex, pass, slot| {
                place[vertex as usize] = pass;
                given[vertex as usize] = slot;
                order.push(vertex);
            },
        );
        debug_assert!(fits, "only sequences are kept over which every episode can be spread");
        order.reverse();
        let partitioning = Partitioning::collect(steps, &place, &order);
        let slots = partitioning.steps.iter().map(|partition| {
            let vertices = partition.iter().map(|&(node, seq)| steps.offset[node as usize] + seq);
            Embedding { slots: vertices.map(|vertex| given[vertex as usize]).collect() }
        });
        let slots = slots.collect();
        (partitioning, slots)
    }
}

/// From the last step back, gives every step the last slot of its node that is free and before all that depends on it;
/// false if some step's would come before its inputs are known, or further ahead than allowed. By induction no way of
/// spreading gives any step a later slot, so false means that there is none.
///
/// `visit` sees the vertices from the last to the first, each with its partition and its slot.
fn spread(
    steps: &Steps,
    readers: &[u32],
    start: StartUp,
    sequence: &[u32],
    room: &mut Room,
    mut visit: impl FnMut(u32, i32, u32),
) -> bool {
    room.open.clear();
    room.open.extend_from_slice(readers);
    room.left.clear();
    room.left.extend(steps.running.iter().map(Vec::len));
    let (open, left) = (&mut room.open, &mut room.left);
    let mut missing: usize = left.iter().sum();
    let mut pass = steps.partitions() as i32 - 1;
    while missing > 0 {
        let before = missing;
        if pass >= 0 {
            let vertex = steps.running[steps.supervisor][pass as usize];
            if open[vertex as usize] > 0 {
                return false;
            }
            left[steps.supervisor] -= 1;
            missing -= 1;
            steps.inputs(vertex).iter().for_each(|&input| open[input as usize] -= 1);
            visit(vertex, pass, sequence.len() as u32);
        } else if start == StartUp::First {
            return false;
        }
        for (slot, &label) in sequence.iter().enumerate().rev() {
            let count = left[label as usize];
            if count == 0 {
                continue;
            }
            let vertex = steps.running[label as usize][count - 1];
            if open[vertex as usize] > 0 || steps.latest[vertex as usize] < pass {
                continue;
            }
            left[label as usize] -= 1;
            missing -= 1;
            steps.inputs(vertex).iter().for_each(|&input| open[input as usize] -= 1);
            visit(vertex, pass, slot as u32);
        }
        for (node, &count) in left.iter().enumerate() {
            if count > 0
                && steps.earliest[steps.running[node][count - 1] as usize] >= pass
                && node != steps.supervisor
            {
                return false;
            }
        }
        if pass < 0 && missing == before {
            return false;
        }
        pass -= 1;
    }
    true
}

/// The fewest slots of one node in any supergraph of the episode, its own order and its bounds considered.
fn fewest(steps: &Steps, node: usize, start: StartUp) -> u32 {
    let running = &steps.running[node];
    if node == steps.supervisor || running.is_empty() {
        return 0;
    }
    let fits = |slots: usize| {
        let mut left = running.len();
        let mut pass = steps.partitions() as i32 - 1;
        while left > 0 && (pass >= 0 || start == StartUp::Passes) {
            let due = |vertex: u32| steps.latest[vertex as usize] >= pass;
            let stay = running[..left].iter().rev().take(slots).take_while(|&&vertex| due(vertex)).count();
            left -= stay;
            if left > 0 && steps.earliest[running[left - 1] as usize] >= pass {
                return false;
            }
            pass -= 1;
        }
        left == 0
    };
    // More slots never hurt, and as many as there are steps do.
    let (mut none, mut enough) = (0, running.len());
    while enough - none > 1 {
        let middle = none.midpoint(enough);
        if fits(middle) { enough = middle } else { none = middle }
    }
    enough as u32
}
