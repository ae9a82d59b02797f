//! Environments of one episode, stepped together through its passes.

use std::mem::take;
use std::ops::Range;

use parallax_model::node_model::{BlockPort, BlockStep, BlockStore, ErasedModel, Scratch};
use parallax_runtime::random::{Purpose, stream};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::environments::Place;
use super::environments::{Environments, Given};
use super::inputs::{Selected, Selecting, SlotStamps};
use super::number::Number;
use super::prefetch::prefetch;
use super::schedule::Entry;
use super::{Batch, Moment};

/// How many numbers a line of the cache holds.
const LINE: usize = 8;

/// Everything that one group of environments needs; nothing is allocated while it runs.
pub(super) struct Group<'a, T: Number> {
    batch: &'a Batch<'a>,
    environments: &'a Environments<'a>,
    /// Which environments, in the order of the lanes.
    members: &'a [usize],
    blocks: usize,
    nodes: Vec<Node<T>>,
    /// The last outputs of every node; then, for every port that selects what it sees, that.
    stores: Vec<BlockStore<T>>,
    /// `[slot]`
    slots: Vec<Ports<T>>,
    /// The delays' places between their bounds, `[connection][block]`; empty where they are not trainable.
    alphas: Vec<Vec<T>>,
    /// Where the given outputs of every lane begin, `[node][lane]`; empty where a node computes them.
    given: Vec<Vec<usize>>,
    /// The place of every node's newest output.
    newest: Vec<u32>,
    scratch: Scratch<T>,
}

/// The ports of one slot.
struct Ports<T> {
    ports: Vec<BlockPort>,
    selected: Vec<Selected<T>>,
    /// For a node that sees its own outputs: where a step writes, because those are still read.
    aside: Option<BlockStore<T>>,
}

/// One node's numbers, for every block.
struct Node<T> {
    params: Vec<T>,
    prepared: Vec<T>,
    state: Vec<T>,
    /// How many parameters, prepared numbers, leaves of the state and normal numbers a block has.
    widths: [usize; 4],
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
        let noise = self.widths[3];
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
            let prepared = node.model.as_ref().map_or(0, |model| model.prepared());
            let random = members
                .iter()
                .map(|&member| stream(environments.seed(member), Purpose::Node, &compiled.nodes[index].name));
            let mut params = gather(&environments.params[index], node.params.len(), members, blocks);
            let mut state = gather(&environments.states[index], node.state.len(), members, blocks);
            incline(environments, members, &mut params, |place| match place {
                Place::Param { node, leaf } if node == index => Some(leaf),
                _ => None,
            });
            incline(environments, members, &mut state, |place| match place {
                Place::State { node, leaf } if node == index => Some(leaf),
                _ => None,
            });
            let quiet = environments.quiet || noise == 0;
            Node {
                prepared: node
                    .model
                    .as_deref()
                    .map_or_else(Vec::new, |model| prepare(model, &params, blocks)),
                params,
                state,
                widths: [node.params.len(), prepared, node.state.len(), noise],
                noise: vec![T::constant(0.0); noise * blocks],
                random: if quiet { Vec::new() } else { random.collect() },
                next: 0,
            }
        });
        let nodes_and_places = batch.nodes.iter().zip(&compiled.nodes);
        let mut stores: Vec<BlockStore<T>> = nodes_and_places
            .map(|(node, compiled)| BlockStore::new(&node.initial, compiled.history, blocks))
            .collect();
        let mut slots = Vec::with_capacity(compiled.slots.len());
        for (slot, offsets) in compiled.slots.iter().zip(&batch.offsets) {
            let names = &batch.nodes[slot.node].ports;
            let inputs = &slot.rows.inputs;
            let mut ports = Vec::with_capacity(inputs.len());
            let mut selected = Vec::with_capacity(inputs.len());
            for ((input, name), &first) in inputs.iter().zip(names).zip(offsets) {
                let mut store = input.from;
                if input.is_open() {
                    store = stores.len();
                    stores.push(BlockStore::new(&batch.nodes[input.from].initial, input.window, blocks));
                }
                ports.push(BlockPort { name: name.clone(), window: input.window, store, first });
                selected.push(Selected::new(input, store, blocks));
            }
            let sees_itself = ports.iter().any(|port| port.store == slot.node);
            let aside = sees_itself.then(|| BlockStore::new(&batch.nodes[slot.node].initial, 1, blocks));
            slots.push(Ports { ports, selected, aside });
        }
        let lanes = (0..blocks * T::LANES).map(|lane| members[lane.min(members.len() - 1)]);
        let alphas = environments.alphas.iter().enumerate().map(|(index, alphas)| {
            if alphas.is_empty() {
                return Vec::new();
            }
            let mut alphas = gather(alphas, 1, members, blocks);
            incline(environments, members, &mut alphas, |place| match place {
                Place::Delay { connection } if connection == index => Some(0),
                _ => None,
            });
            alphas
        });
        let episode = environments.episodes[members[0]] as usize;
        let given = environments.given.iter().enumerate().map(|(node, given)| {
            let leaves = batch.nodes[node].initial.len();
            given.as_ref().map_or_else(Vec::new, |given| {
                lanes.clone().map(|member| given.row(member, episode) * leaves).collect()
            })
        });
        Self {
            batch,
            environments,
            members,
            blocks,
            nodes: nodes.collect(),
            slots,
            alphas: alphas.collect(),
            given: given.collect(),
            newest: vec![0; batch.nodes.len()],
            stores,
            scratch: Scratch::default(),
        }
    }

    /// Runs all passes of the episode. `made` is called for every output, `passed` after every pass.
    pub(super) fn run(&mut self, made: impl FnMut(&Made<'_, T>), passed: impl FnMut(&Moment<'_>)) {
        self.run_for(0..usize::MAX, made, passed);
    }

    /// Gives what the nodes have sent that are not computed, so far back as somebody may still read it: for episodes that
    /// begin in the middle.
    pub(super) fn give_before(&mut self, pass: usize) {
        let batch = self.batch;
        let compiled = batch.compiled;
        let schedule = &batch.schedules[self.environments.episodes[self.members[0]] as usize];
        let is_given = |node: usize| self.environments.given[node].is_some();
        let mut lacking: Vec<usize> = (0..compiled.nodes.len())
            .map(|node| if is_given(node) { compiled.nodes[node].history } else { 0 })
            .collect();
        let mut first = pass.min(schedule.passes());
        while first > 0 && lacking.iter().any(|count| *count > 0) {
            first -= 1;
            for entry in schedule.pass(first) {
                let count = &mut lacking[compiled.slots[entry.slot as usize].node];
                *count = count.saturating_sub(1);
            }
        }
        for entry in (first..pass.min(schedule.passes())).flat_map(|pass| schedule.pass(pass)) {
            let node = compiled.slots[entry.slot as usize].node;
            if let Some(given) = self.environments.given.get(node).and_then(Option::as_ref) {
                self.give(node, given, entry.seq, entry.write);
                self.newest[node] = entry.write;
            }
        }
    }

    /// Runs these passes of the episode.
    pub(super) fn run_for(
        &mut self,
        passes: Range<usize>,
        mut made: impl FnMut(&Made<'_, T>),
        mut passed: impl FnMut(&Moment<'_>),
    ) {
        let batch = self.batch;
        let compiled = batch.compiled;
        let episode = self.environments.episodes[self.members[0]] as usize;
        let schedule = &batch.schedules[episode];
        for pass in passes.start..schedule.passes().min(passes.end) {
            let row = compiled.row(episode, pass);
            for entry in schedule.pass(pass) {
                let (node, seq, write) = (compiled.slots[entry.slot as usize].node, entry.seq, entry.write);
                match self.environments.given.get(node).and_then(Option::as_ref) {
                    Some(given) => self.give(node, given, seq, write),
                    None => self.step(entry, schedule.read(entry), row),
                }
                self.newest[node] = write;
                made(&Made { node, seq, place: write, stores: &self.stores, members: self.members });
            }
            let output = |node: usize, position: usize, leaf: usize| {
                let message = self.stores[node].message(position / T::LANES, self.newest[node] as usize);
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
        let Some(model) = self.batch.nodes[slot.node].model.as_deref() else { return };
        let ports = &mut self.slots[index];
        for (input, selected) in rows.inputs.iter().zip(&mut ports.selected) {
            if input.is_open() {
                let mut seen = take(&mut self.stores[selected.store]);
                let history = &self.stores[input.from];
                if input.trainable.is_some() {
                    let alphas = &self.alphas[input.connection];
                    selected.select(input, row, rows.start[row], (history, &mut seen), alphas);
                } else {
                    for block in 0..self.blocks {
                        let between = Selecting { history, seen: &mut seen, block };
                        selected.select_by_output(input, row, rows.start[row], between);
                    }
                }
                self.stores[selected.store] = seen;
            }
        }
        let node = &mut self.nodes[slot.node];
        node.draw(entry.seq);
        // The step writes where its outputs are kept, unless it reads there.
        let (mut output, place) = match &mut ports.aside {
            Some(aside) => (take(aside), 0),
            None => (take(&mut self.stores[slot.node]), entry.write as usize),
        };
        let mut step = BlockStep {
            blocks: self.blocks,
            widths: node.widths,
            times: [f64::from(entry.seq), entry.due, entry.start],
            params: &node.params,
            prepared: &node.prepared,
            state: &mut node.state,
            noise: &node.noise,
            ports: &ports.ports,
            places: read,
            stores: &self.stores,
            stamps: &SlotStamps { inputs: &rows.inputs, selected: &ports.selected, row },
            output: &mut output,
            place,
        };
        T::step(model, &mut step, &mut self.scratch);
        let Some(aside) = &mut ports.aside else {
            self.stores[slot.node] = output;
            return;
        };
        let history = &mut self.stores[slot.node];
        for block in 0..self.blocks {
            history.message_mut(block, entry.write as usize).copy_from_slice(output.message(block, 0));
        }
        *aside = output;
    }

    /// Writes a given output into the history.
    fn give(&mut self, node: usize, given: &Given<'_>, seq: i32, write: u32) {
        let history = &mut self.stores[node];
        let leaves = history.leaves();
        let (first, values) = (seq as usize * leaves, given.values());
        if first % LINE < leaves {
            // Every environment's outputs lie elsewhere: more places than the machine follows by itself.
            self.given[node].iter().for_each(|row| prefetch(values, row + first + LINE));
        }
        for (block, rows) in self.given[node].chunks_exact(T::LANES).enumerate() {
            for (leaf, place) in history.message_mut(block, write as usize).iter_mut().enumerate() {
                let mut lanes = T::constant(0.0);
                for (lane, row) in rows.iter().enumerate() {
                    lanes.set(lane, values[row + first + leaf]);
                }
                *place = lanes;
            }
        }
    }

    /// How many blocks of lanes the environments fill.
    pub(super) fn blocks(&self) -> usize {
        self.blocks
    }

    /// The state of a node after its last step in one block of environments.
    pub(super) fn block_state(&self, node: usize, block: usize) -> &[T] {
        let node = &self.nodes[node];
        &node.state[block * node.widths[2]..(block + 1) * node.widths[2]]
    }

    /// The states after the last step, one list of leaves for each node and member.
    pub(super) fn state(&self, node: usize, position: usize) -> impl Iterator<Item = f64> {
        let leaves = self.nodes[node].widths[2];
        let (block, lane) = (position / T::LANES, position % T::LANES);
        self.nodes[node].state[block * leaves..(block + 1) * leaves].iter().map(move |leaf| leaf.get(lane))
    }
}

/// An output that was just made, by all environments of a group.
pub(crate) struct Made<'a, T> {
    /// The node, by its place in the graph.
    pub(crate) node: usize,
    /// The number of its step.
    pub(crate) seq: i32,
    place: u32,
    stores: &'a [BlockStore<T>],
    members: &'a [usize],
}

impl<T: Number> Made<'_, T> {
    /// How many blocks the group's environments fill.
    pub(crate) fn blocks(&self) -> usize {
        self.members.len().div_ceil(T::LANES)
    }

    /// The message of every environment of a block.
    #[inline(always)]
    pub(crate) fn block(&self, block: usize) -> &[T] {
        self.stores[self.node].message(block, self.place as usize)
    }

    /// Calls `see` with every environment's place in the group and its message's leaves.
    pub(super) fn each(&self, mut see: impl FnMut(usize, usize, f64)) {
        for position in 0..self.members.len() {
            let message = self.stores[self.node].message(position / T::LANES, self.place as usize);
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

/// Gives a list of numbers, `[block][leaf]`, their derivatives: `find` says which leaf a place is, if it is one of them.
fn incline<T: Number>(
    environments: &Environments<'_>,
    members: &[usize],
    values: &mut [T],
    find: impl Fn(Place) -> Option<usize>,
) {
    let leaves = values.len() / members.len().div_ceil(T::LANES);
    for (position, &member) in members.iter().enumerate() {
        for slope in environments.slopes.get(member).into_iter().flatten() {
            if let Some(leaf) = find(slope.place) {
                values[position / T::LANES * leaves + leaf].incline(slope.direction, slope.slope);
            }
        }
    }
}

/// What a model prepares of the parameters of every block: `[block][number]`.
fn prepare<T: Number>(model: &dyn ErasedModel, params: &[T], blocks: usize) -> Vec<T> {
    let (leaves, count) = (params.len() / blocks, model.prepared());
    let mut prepared = vec![T::constant(0.0); count * blocks];
    for block in 0..blocks {
        let params = &params[block * leaves..(block + 1) * leaves];
        T::prepare(model, params, &mut prepared[block * count..(block + 1) * count]);
    }
    prepared
}
