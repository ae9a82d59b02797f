//! Environments of one episode, stepped together through its passes.

use std::cell::Cell;

use parallax_model::node_model::{NodeStep, Scratch};
use parallax_runtime::random::{Purpose, stream};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::environments::{Environments, Given};
use super::inputs::{History, Selected, SlotInputs};
use super::number::Number;
use super::schedule::Entry;
use super::{Batch, Moment};

/// Everything that one group of environments needs; nothing is allocated while it runs.
pub(super) struct Group<'a, T: Number> {
    batch: &'a Batch<'a>,
    environments: &'a Environments<'a>,
    /// Which environments, in the order of the lanes.
    members: &'a [usize],
    blocks: usize,
    nodes: Vec<Node<T>>,
    histories: Vec<History<T>>,
    /// `[slot][port]`
    selected: Vec<Vec<Selected<T>>>,
    /// The delays' places between their bounds, `[connection][lane]`; empty where they are not trainable.
    alphas: Vec<Vec<f64>>,
    /// Where the given outputs of every lane begin, `[node][lane]`; empty where a node computes them.
    given: Vec<Vec<usize>>,
    /// The place of every node's newest output.
    newest: Vec<u32>,
    output: Vec<T>,
    scratch: Scratch<T>,
}

/// One node's numbers, for every block.
struct Node<T> {
    params: Vec<T>,
    state: Vec<T>,
    /// How many leaves they have for each block.
    leaves: [usize; 2],
    noise: Vec<T>,
    /// One stream for each environment; none where nothing is drawn.
    random: Vec<ChaCha8Rng>,
    /// The step whose numbers come next from the streams.
    next: i32,
}

impl<T: Number> Node<T> {
    /// Draws the noise of step `seq` of every environment.
    #[inline(always)]
    fn draw(&mut self, seq: i32) {
        let skipped = seq - self.next;
        self.next = seq + 1;
        if self.random.is_empty() {
            return;
        }
        let blocks = self.random.len().div_ceil(T::LANES);
        let noise = self.noise.len() / blocks;
        for (position, random) in self.random.iter_mut().enumerate() {
            // Steps on which nothing depends do not run, but have their numbers.
            for _ in 0..skipped.max(0) as usize * noise {
                let _: f64 = StandardNormal.sample(random);
            }
            let (block, lane) = (position / T::LANES, position % T::LANES);
            for number in &mut self.noise[block * noise..(block + 1) * noise] {
                number.set(lane, StandardNormal.sample(random));
            }
        }
    }
}

impl<'a, T: Number> Group<'a, T> {
    pub(super) fn new(
        batch: &'a Batch<'a>,
        environments: &'a Environments<'a>,
        members: &'a [usize],
    ) -> Self {
        let compiled = batch.compiled;
        let blocks = members.len().div_ceil(T::LANES);
        let nodes = batch.nodes.iter().enumerate().map(|(index, node)| {
            let noise = node.model.as_ref().map_or(0, |model| model.noise());
            let random = members.iter().map(|&member| {
                stream(environments.seeds[member], Purpose::Node, &compiled.nodes[index].name)
            });
            Node {
                params: gather(&environments.params[index], node.params.len(), members, blocks),
                state: gather(&environments.states[index], node.state.len(), members, blocks),
                leaves: [node.params.len(), node.state.len()],
                noise: vec![T::constant(0.0); noise * blocks],
                random: if noise > 0 { random.collect() } else { Vec::new() },
                next: 0,
            }
        });
        let histories: Vec<History<T>> = batch
            .nodes
            .iter()
            .zip(&compiled.nodes)
            .map(|(node, compiled)| History::new(&node.initial, compiled.history, blocks))
            .collect();
        let selected = compiled.slots.iter().map(|slot| {
            slot.rows
                .inputs
                .iter()
                .map(|input| Selected::new(input, histories[input.from].leaves, blocks))
                .collect()
        });
        let lanes = (0..blocks * T::LANES).map(|lane| members[lane.min(members.len() - 1)]);
        let alphas = environments.alphas.iter().map(|alphas| {
            if alphas.is_empty() { Vec::new() } else { lanes.clone().map(|member| alphas[member]).collect() }
        });
        let episode = environments.episodes[members[0]] as usize;
        let given = environments.given.iter().enumerate().map(|(node, given)| {
            let leaves = batch.nodes[node].initial.len();
            given.as_ref().map_or_else(Vec::new, |given| {
                lanes.clone().map(|member| given.row(member, episode) * leaves).collect()
            })
        });
        let widest = batch.nodes.iter().map(|node| node.initial.len()).max().unwrap_or(0);
        Self {
            batch,
            environments,
            members,
            blocks,
            nodes: nodes.collect(),
            selected: selected.collect(),
            alphas: alphas.collect(),
            given: given.collect(),
            newest: vec![0; histories.len()],
            histories,
            output: vec![T::constant(0.0); widest * blocks],
            scratch: Scratch::default(),
        }
    }

    /// Runs all passes of the episode. `made` is called for every output, `passed` after every pass.
    pub(super) fn run(&mut self, mut made: impl FnMut(&Made<'_, T>), mut passed: impl FnMut(&Moment<'_>)) {
        let batch = self.batch;
        let compiled = batch.compiled;
        let episode = self.environments.episodes[self.members[0]] as usize;
        let schedule = &batch.schedules[episode];
        for pass in 0..schedule.passes() {
            let row = compiled.row(episode, pass);
            for entry in schedule.pass(pass) {
                let (node, seq, write) = (compiled.slots[entry.slot as usize].node, entry.seq, entry.write);
                match self.environments.given.get(node).and_then(Option::as_ref) {
                    Some(given) => self.give(node, given, seq, write),
                    None => self.step(entry, schedule.read(entry), row),
                }
                self.newest[node] = write;
                made(&Made { node, seq, place: write, histories: &self.histories, members: self.members });
            }
            let output = |node: usize, position: usize, leaf: usize| {
                let message = self.histories[node].message(position / T::LANES, self.newest[node]);
                message[leaf].get(position % T::LANES)
            };
            passed(&Moment {
                pass,
                step: pass.checked_sub(compiled.warm_up),
                members: self.members,
                output: &output,
            });
        }
    }

    /// Every block's step in a slot.
    #[inline(always)]
    fn step(&mut self, entry: &Entry, read: &[u32], row: usize) {
        let index = entry.slot as usize;
        let slot = &self.batch.compiled.slots[index];
        let rows = &slot.rows;
        let shape = &self.batch.nodes[slot.node];
        let Some(model) = shape.model.as_deref() else { return };
        let times = [f64::from(entry.seq), entry.due, entry.start].map(T::constant);
        for (input, selected) in rows.inputs.iter().zip(&mut self.selected[index]) {
            if input.trainable.is_some() {
                let history = &self.histories[input.from];
                for (block, alphas) in self.alphas[input.connection].chunks_exact(T::LANES).enumerate() {
                    selected.select(input, row, entry.start, history, block, alphas);
                }
            }
            if input.from_output.is_some() {
                let history = &self.histories[input.from];
                for block in 0..self.blocks {
                    selected.select_by_output(input, row, rows.start[row], history, block);
                }
            }
        }
        let node = &mut self.nodes[slot.node];
        node.draw(entry.seq);
        let noise = node.noise.len() / self.blocks;
        let leaves = shape.initial.len();
        let inputs = SlotInputs {
            ports: &shape.ports,
            inputs: &rows.inputs,
            selected: &self.selected[index],
            row,
            read,
            offsets: &self.batch.offsets[index],
            histories: &self.histories,
            block: Cell::new(0),
        };
        // Made once for all blocks: lanes are too large to be copied for nothing.
        let mut step = NodeStep::new(times, &[], &inputs);
        let [params, state] = node.leaves;
        for block in 0..self.blocks {
            inputs.block.set(block);
            step.noise = &node.noise[block * noise..(block + 1) * noise];
            T::step(
                model,
                &node.params[block * params..(block + 1) * params],
                &mut node.state[block * state..(block + 1) * state],
                &step,
                &mut self.scratch,
                &mut self.output[block * leaves..(block + 1) * leaves],
            );
        }
        let history = &mut self.histories[slot.node];
        for block in 0..self.blocks {
            let output = &self.output[block * leaves..(block + 1) * leaves];
            history.message_mut(block, entry.write).copy_from_slice(output);
        }
    }

    /// Writes a given output into the history.
    fn give(&mut self, node: usize, given: &Given<'_>, seq: i32, write: u32) {
        let leaves = self.batch.nodes[node].initial.len();
        let (first, values) = (seq as usize * leaves, given.values());
        for (block, rows) in self.given[node].chunks_exact(T::LANES).enumerate() {
            let message = self.histories[node].message_mut(block, write);
            for (leaf, place) in message.iter_mut().enumerate() {
                let mut lanes = *place;
                for (lane, row) in rows.iter().enumerate() {
                    lanes.set(lane, values[row + first + leaf]);
                }
                *place = lanes;
            }
        }
    }

    /// The states after the last step, one list of leaves for each node and member.
    pub(super) fn state(&self, node: usize, position: usize) -> impl Iterator<Item = f64> {
        let leaves = self.nodes[node].leaves[1];
        let (block, lane) = (position / T::LANES, position % T::LANES);
        self.nodes[node].state[block * leaves..(block + 1) * leaves].iter().map(move |leaf| leaf.get(lane))
    }
}

/// An output that was just made, by all environments of a group.
pub(super) struct Made<'a, T> {
    pub(super) node: usize,
    pub(super) seq: i32,
    place: u32,
    histories: &'a [History<T>],
    members: &'a [usize],
}

impl<T: Number> Made<'_, T> {
    /// Calls `see` with every environment's place in the group and its message's leaves.
    pub(super) fn each(&self, mut see: impl FnMut(usize, usize, f64)) {
        for position in 0..self.members.len() {
            let message = self.histories[self.node].message(position / T::LANES, self.place);
            for (leaf, value) in message.iter().enumerate() {
                see(position, leaf, value.get(position % T::LANES));
            }
        }
    }
}

/// Rows of environments as blocks of lanes: `[block][leaf]`. Lanes without an environment repeat the last one.
fn gather<T: Number>(rows: &[f64], leaves: usize, members: &[usize], blocks: usize) -> Vec<T> {
    let mut values = vec![T::constant(0.0); blocks * leaves];
    for lane in 0..blocks * T::LANES {
        let member = members[lane.min(members.len() - 1)];
        for leaf in 0..leaves {
            values[lane / T::LANES * leaves + leaf].set(lane % T::LANES, rows[member * leaves + leaf]);
        }
    }
    values
}
