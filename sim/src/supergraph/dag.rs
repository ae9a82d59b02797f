//! The computation graph of one episode: which step depends on which, and the bounds within which a step may move.

use std::collections::VecDeque;

use parallax_runtime::time::Nanos;

use super::SupergraphError;

/// The steps of one episode and what they consumed. Nodes are labelled by their index.
#[derive(Debug, Clone, Default)]
pub struct Dag<'a> {
    /// The nodes, in the order of the graph.
    pub nodes: Vec<DagNode<'a>>,
}

/// The steps of one node.
#[derive(Debug, Clone, Default)]
pub struct DagNode<'a> {
    /// When each step started; its index is the step's number.
    pub start: &'a [Nanos],
    /// Whether a step depends on the node's step before.
    pub stateful: bool,
    /// Whether steps that the supervisor never depends on are run as well.
    pub keep: bool,
    /// What the steps consumed.
    pub inputs: Vec<DagInput<'a>>,
}

/// What the steps of a node consumed from one sender.
#[derive(Debug, Clone, Copy)]
pub struct DagInput<'a> {
    /// The sending node.
    pub from: u32,
    /// Messages per step (with a trainable delay: all that a step might see).
    pub window: usize,
    /// Per step of the receiver `window` sequence numbers; negative for an initial message, which depends on nothing.
    pub seq: &'a [i64],
}

/// Before everything: what depends on no step of the supervisor may run as early as it likes.
pub(super) const ANY_TIME: i32 = i32::MIN / 2;
const NEVER: i32 = i32::MAX;

/// The steps that will run, with their dependencies and bounds; vertices are numbered node by node.
pub(super) struct Steps {
    pub(super) supervisor: usize,
    /// The first vertex of every node, and the number of all vertices.
    pub(super) offset: Vec<u32>,
    pub(super) node: Vec<u32>,
    /// The vertices that run, per node, in the order of their steps.
    pub(super) running: Vec<Vec<u32>>,
    /// All vertices in a topological order.
    pub(super) order: Vec<u32>,
    /// The first partition in which the inputs of a vertex are known, and the last before it is needed.
    pub(super) earliest: Vec<i32>,
    pub(super) latest: Vec<i32>,
    first_input: Vec<u32>,
    inputs: Vec<u32>,
}

impl Steps {
    pub(super) fn new(dag: &Dag<'_>, supervisor: u32) -> Result<Steps, SupergraphError> {
        let nodes = dag.nodes.len();
        if supervisor as usize >= nodes {
            return Err(SupergraphError::NoSupervisor { supervisor, nodes });
        }
        let mut offset = vec![0u32];
        for node in &dag.nodes {
            offset.push(offset[offset.len() - 1] + node.start.len() as u32);
        }
        let vertices = offset[nodes] as usize;
        let mut steps = Steps {
            supervisor: supervisor as usize,
            node: Vec::with_capacity(vertices),
            running: vec![Vec::new(); nodes],
            order: Vec::new(),
            earliest: vec![ANY_TIME; vertices],
            latest: vec![NEVER; vertices],
            first_input: Vec::with_capacity(vertices + 1),
            inputs: Vec::new(),
            offset,
        };
        for (index, node) in dag.nodes.iter().enumerate() {
            steps.add(dag, index, node)?;
        }
        steps.first_input.push(steps.inputs.len() as u32);
        steps.sort()?;
        steps.bound(dag);
        Ok(steps)
    }

    fn add(&mut self, dag: &Dag<'_>, index: usize, node: &DagNode<'_>) -> Result<(), SupergraphError> {
        let count = node.start.len();
        for input in &node.inputs {
            if (input.from as usize) >= dag.nodes.len() || input.seq.len() != count * input.window {
                let (from, window, listed) = (input.from, input.window, input.seq.len());
                return Err(SupergraphError::Input { node: index, from, window, listed, steps: count });
            }
        }
        for step in 0..count {
            let begin = self.inputs.len();
            self.first_input.push(begin as u32);
            self.node.push(index as u32);
            if step > 0 && (node.stateful || index == self.supervisor) {
                self.inputs.push(self.offset[index] + step as u32 - 1);
            }
            for input in &node.inputs {
                let from = input.from as usize;
                for &seq in &input.seq[step * input.window..(step + 1) * input.window] {
                    if seq < 0 {
                        continue;
                    }
                    let sent = dag.nodes[from].start.len();
                    if seq >= sent as i64 {
                        return Err(SupergraphError::NoMessage {
                            node: index,
                            step,
                            from: input.from,
                            seq,
                            steps: sent,
                        });
                    }
                    let vertex = self.offset[from] + seq as u32;
                    if !self.inputs[begin..].contains(&vertex) {
                        self.inputs.push(vertex);
                    }
                }
            }
        }
        Ok(())
    }

    /// The number of partitions: one for every step of the supervisor.
    pub(super) fn partitions(&self) -> usize {
        (self.offset[self.supervisor + 1] - self.offset[self.supervisor]) as usize
    }

    /// What a vertex consumed, the step before it of a node with a state included.
    pub(super) fn inputs(&self, vertex: u32) -> &[u32] {
        &self.inputs
            [self.first_input[vertex as usize] as usize..self.first_input[vertex as usize + 1] as usize]
    }

    pub(super) fn is_supervisor(&self, vertex: u32) -> bool {
        self.node[vertex as usize] as usize == self.supervisor
    }

    /// A vertex's step number.
    pub(super) fn seq(&self, vertex: u32) -> u32 {
        vertex - self.offset[self.node[vertex as usize] as usize]
    }

    /// Whether a vertex runs at all.
    pub(super) fn runs(&self, vertex: u32) -> bool {
        self.latest[vertex as usize] != NEVER
    }

    /// The step before a vertex of the same node, if there is one.
    fn before(&self, vertex: u32) -> Option<u32> {
        (self.seq(vertex) > 0).then(|| vertex - 1)
    }

    /// Orders the vertices so that inputs come first and the steps of a node keep their order.
    fn sort(&mut self) -> Result<(), SupergraphError> {
        let vertices = self.node.len();
        let mut first_reader = vec![0u32; vertices + 1];
        for &input in &self.inputs {
            first_reader[input as usize + 1] += 1;
        }
        for index in 0..vertices {
            first_reader[index + 1] += first_reader[index];
        }
        let mut place = first_reader.clone();
        let mut readers = vec![0u32; self.inputs.len()];
        let mut waiting = vec![0u32; vertices];
        for vertex in 0..vertices as u32 {
            for &input in self.inputs(vertex) {
                readers[place[input as usize] as usize] = vertex;
                place[input as usize] += 1;
            }
            waiting[vertex as usize] = self.inputs(vertex).len() as u32 + u32::from(self.seq(vertex) > 0);
        }
        let mut ready: VecDeque<u32> =
            (0..vertices as u32).filter(|&vertex| waiting[vertex as usize] == 0).collect();
        self.order.reserve(vertices);
        while let Some(vertex) = ready.pop_front() {
            self.order.push(vertex);
            let mut release = |next: u32| {
                waiting[next as usize] -= 1;
                if waiting[next as usize] == 0 {
                    ready.push_back(next);
                }
            };
            let next = vertex as usize + 1;
            if next < vertices && self.node[next] == self.node[vertex as usize] {
                release(next as u32);
            }
            for &reader in &readers[first_reader[vertex as usize] as usize..first_reader[next] as usize] {
                release(reader);
            }
        }
        match waiting.iter().position(|&count| count > 0) {
            Some(vertex) => {
                let (node, step) = (self.node[vertex] as usize, self.seq(vertex as u32) as usize);
                Err(SupergraphError::Cycle { node, step })
            }
            None => Ok(()),
        }
    }

    /// Finds what runs, and for each vertex the first and the last partition in which it may.
    fn bound(&mut self, dag: &Dag<'_>) {
        let order = std::mem::take(&mut self.order);
        for &vertex in &order {
            let own = self.is_supervisor(vertex).then(|| self.seq(vertex) as i32);
            let known = self
                .inputs(vertex)
                .iter()
                .copied()
                .chain(self.before(vertex))
                .map(|input| self.earliest[input as usize] + i32::from(self.is_supervisor(input)));
            self.earliest[vertex as usize] = own.unwrap_or(known.max().unwrap_or(ANY_TIME));
        }
        let supervisor = dag.nodes[self.supervisor].start;
        let mut needed = vec![false; order.len()];
        for &vertex in order.iter().rev() {
            let node = &dag.nodes[self.node[vertex as usize] as usize];
            let own = if self.is_supervisor(vertex) {
                self.seq(vertex) as i32
            } else if node.keep {
                let start = node.start[self.seq(vertex) as usize];
                let next = supervisor.partition_point(|&supervisor| supervisor < start) as i32;
                let next = next.max(self.earliest[vertex as usize]);
                if next < supervisor.len() as i32 { next } else { NEVER }
            } else {
                NEVER
            };
            needed[vertex as usize] |= own != NEVER;
            if needed[vertex as usize] {
                self.latest[vertex as usize] = own;
                for input in self.first_input[vertex as usize]..self.first_input[vertex as usize + 1] {
                    needed[self.inputs[input as usize] as usize] = true;
                }
            }
        }
        for node in 0..self.running.len() {
            let steps = self.offset[node]..self.offset[node + 1];
            self.running[node] = steps.filter(|&vertex| needed[vertex as usize]).collect();
        }
        // A step is needed no later than what consumes it, and than the next step of its node: these keep their order.
        let mut previous = vec![u32::MAX; order.len()];
        for running in &self.running {
            for pair in running.windows(2) {
                previous[pair[1] as usize] = pair[0];
            }
        }
        for &vertex in order.iter().rev() {
            let latest = self.latest[vertex as usize];
            let before = previous[vertex as usize];
            if before != u32::MAX && needed[vertex as usize] {
                self.latest[before as usize] = self.latest[before as usize].min(latest);
            }
            if needed[vertex as usize] {
                for input in self.first_input[vertex as usize]..self.first_input[vertex as usize + 1] {
                    let input = self.inputs[input as usize] as usize;
                    self.latest[input] = self.latest[input].min(latest);
                }
            }
        }
        self.order = order;
    }

    /// Lets no step run more than `ahead` partitions before it is needed, the start excepted.
    pub(super) fn limit(&mut self, ahead: usize) {
        for vertex in 0..self.node.len() {
            let latest = self.latest[vertex];
            if latest > 0 && latest != NEVER {
                self.earliest[vertex] = self.earliest[vertex].max(latest.saturating_sub(ahead as i32));
            }
        }
    }
}
