//! Merges one partial order into a sequence of slots with as few new slots as a bounded search finds.

use super::poset::Poset;

/// How far the search has come: how many vertices of every chain have a slot, at the price of how many new ones.
struct State {
    counts: Vec<u32>,
    new: u32,
    /// New and missing slots: a lower bound on the price in the end.
    least: u32,
    /// The last decision, an index into the list of all.
    decision: u32,
}

/// Before `slot`, what `vertex` still waits for gets new slots, and `vertex` gets `slot`.
#[derive(Clone, Copy)]
struct Decision {
    before: u32,
    slot: u32,
    vertex: u32,
}

const FIRST: u32 = u32::MAX;

/// The sequence with slots inserted so that `poset` fits. What fitted before still does.
///
/// The search goes through the slots once. A slot whose label's next vertex is ready is taken: that is never worse. If
/// that vertex still waits for others, either the slot is passed over, or all that the vertex waits for get new slots
/// right before it; no other insertion can help a slot to be taken. The `width` cheapest states are kept.
pub(super) fn merge(poset: &Poset, sequence: &[u32], labels: usize, width: usize) -> Vec<u32> {
    let chains = poset.chains.len();
    let mut chain_of_label = vec![usize::MAX; labels];
    let mut chain_of = vec![0u32; poset.len()];
    let mut length = vec![0u32; chains];
    for (chain, &(label, _)) in poset.chains.iter().enumerate() {
        chain_of_label[label as usize] = chain;
        length[chain] = poset.chain(chain).len() as u32;
        poset.chain(chain).for_each(|vertex| chain_of[vertex as usize] = chain as u32);
    }
    let order = poset.order();
    // How many vertices of every chain come before a vertex.
    let mut waits = vec![0u32; poset.len() * chains];
    for &vertex in &order {
        let own = vertex as usize * chains;
        for &input in poset.below(vertex) {
            for chain in 0..chains {
                waits[own + chain] = waits[own + chain].max(waits[input as usize * chains + chain]);
            }
            let chain = chain_of[input as usize] as usize;
            waits[own + chain] = waits[own + chain].max(input - poset.chain(chain).start + 1);
        }
    }
    let waits = |vertex: u32| &waits[vertex as usize * chains..(vertex as usize + 1) * chains];

    let mut remaining = vec![0u32; chains];
    for &label in sequence {
        if let Some(count) = remaining.get_mut(chain_of_label[label as usize]) {
            *count += 1;
        }
    }
    let least = |new: u32, counts: &[u32], remaining: &[u32]| {
        let missing =
            (0..chains).map(|chain| (length[chain] - counts[chain]).saturating_sub(remaining[chain]));
        new + missing.sum::<u32>()
    };
    let start = vec![0u32; chains];
    let mut states =
        vec![State { new: 0, least: least(0, &start, &remaining), counts: start, decision: FIRST }];
    let mut decisions: Vec<Decision> = Vec::new();
    for (slot, &label) in sequence.iter().enumerate() {
        let chain = chain_of_label[label as usize];
        if chain == usize::MAX {
            continue;
        }
        remaining[chain] -= 1;
        let mut branches = Vec::new();
        for state in &mut states {
            if state.counts[chain] == length[chain] {
                continue;
            }
            let vertex = poset.chains[chain].1 + state.counts[chain];
            let lacking =
                waits(vertex).iter().zip(&state.counts).map(|(&needed, &count)| needed.saturating_sub(count));
            let lacking: u32 = lacking.sum();
            if lacking == 0 {
                state.counts[chain] += 1;
                continue;
            }
            let mut counts: Vec<u32> =
                waits(vertex).iter().zip(&state.counts).map(|(&needed, &count)| needed.max(count)).collect();
            counts[chain] += 1;
            let new = state.new + lacking;
            let decision = decisions.len() as u32;
            decisions.push(Decision { before: state.decision, slot: slot as u32, vertex });
            branches.push(State { new, least: least(new, &counts, &remaining), counts, decision });
            // Passed over: the slot is lost.
            state.least = least(state.new, &state.counts, &remaining);
        }
        if !branches.is_empty() {
            states.append(&mut branches);
            states.sort_by(|a, b| (a.least, a.new, &b.counts).cmp(&(b.least, b.new, &a.counts)));
            states.dedup_by(|later, first| later.counts == first.counts);
            states.truncate(width.max(1));
        }
    }
    // What has no slot in the end gets a new one there, so `least` is the price.
    let best = states.iter().min_by_key(|state| least(state.new, &state.counts, &remaining));
    let mut chosen: Vec<Decision> = Vec::new();
    let mut decision = best.map_or(FIRST, |state| state.decision);
    while decision != FIRST {
        chosen.push(decisions[decision as usize]);
        decision = decisions[decision as usize].before;
    }

    let mut merged = Vec::with_capacity(sequence.len() + 4);
    let mut counts = vec![0u32; chains];
    for (slot, &label) in sequence.iter().enumerate() {
        if let Some(&Decision { vertex, .. }) =
            chosen.last().filter(|decision| decision.slot as usize == slot)
        {
            chosen.pop();
            let needed = waits(vertex);
            for &other in &order {
                let chain = chain_of[other as usize] as usize;
                let number = other - poset.chains[chain].1;
                if counts[chain] <= number && number < needed[chain] {
                    merged.push(poset.labels[other as usize]);
                    counts[chain] = number + 1;
                }
            }
        }
        merged.push(label);
        let chain = chain_of_label[label as usize];
        if chain != usize::MAX && counts[chain] < length[chain] {
            let vertex = poset.chains[chain].1 + counts[chain];
            if waits(vertex).iter().zip(&counts).all(|(needed, count)| needed <= count) {
                counts[chain] += 1;
            }
        }
    }
    for &other in &order {
        let chain = chain_of[other as usize] as usize;
        if counts[chain] <= other - poset.chains[chain].1 {
            merged.push(poset.labels[other as usize]);
        }
    }
    merged
}
