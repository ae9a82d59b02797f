//! Cuts the computation graph of an episode into partitions at the steps of the supervisor.

use super::dag::Steps;
use super::{Dag, Partition, SupergraphError, sweep};

/// Which steps run together with which step of the supervisor.
///
/// Either way the steps of a node keep their order, every step runs after all that it consumed and no later than what
/// consumes it. A step runs only if a step of the supervisor depends on it, or if its node is kept: then by the first
/// step of the supervisor that starts no earlier. After the last step of the supervisor nothing runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Cut {
    /// Every step runs as late as it may: before the first step of the supervisor that depends on it.
    Ancestors,
    /// Steps are moved ahead, where their inputs allow it, so that a node takes as even a number of steps in every
    /// partition as can be: at its mean rate, as the steps of a clock without jitter would fall.
    Balanced {
        /// The most partitions that a step is moved ahead: what it sends is kept for as long. Steps due by the first
        /// step of the supervisor are not bounded by it.
        ahead: usize,
    },
}

impl Default for Cut {
    fn default() -> Cut {
        Cut::Balanced { ahead: 2 }
    }
}

/// Where the steps run that are due before the supervisor's first step: often many, while the graph fills.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum StartUp {
    /// In the first partition. It may then be larger than any other and cost slots that stay empty ever after.
    First,
    /// In partitions of their own ahead of the first, without a step of the supervisor, as many as it takes
    /// ([`Partitioning::warm_up`]).
    #[default]
    Passes,
}

/// An episode in partitions.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Partitioning {
    /// How many of the partitions come before that of the supervisor's first step; they hold no step of it.
    pub warm_up: usize,
    /// The partitions in the order in which they run; from `warm_up` on one per step of the supervisor.
    pub partitions: Vec<Partition>,
    /// Per partition the node and the step number of every vertex.
    pub steps: Vec<Vec<(u32, u32)>>,
}

impl Partitioning {
    /// The number of steps that run.
    pub fn vertices(&self) -> usize {
        self.partitions.iter().map(|partition| partition.labels.len()).sum()
    }

    /// Collects the partitions when every vertex's is known; `sequence` is a topological order.
    pub(super) fn collect(steps: &Steps, place: &[i32], sequence: &[u32]) -> Partitioning {
        let running = sequence.iter().filter(|&&vertex| steps.runs(vertex));
        let first = running.clone().map(|&vertex| place[vertex as usize]).min().unwrap_or(0).min(0);
        let warm_up = first.unsigned_abs() as usize;
        let count = warm_up + steps.partitions();
        let mut found = Partitioning {
            warm_up,
            partitions: vec![Partition::default(); count],
            steps: vec![Vec::new(); count],
        };
        let mut local = vec![0u32; place.len()];
        let supervisor = steps.offset[steps.supervisor]..steps.offset[steps.supervisor + 1];
        // The supervisor's step comes last: nothing in its partition depends on it.
        for &vertex in
            running.filter(|&&vertex| !steps.is_supervisor(vertex)).chain(&supervisor.collect::<Vec<_>>())
        {
            let index = (place[vertex as usize] - first) as usize;
            let partition = &mut found.partitions[index];
            local[vertex as usize] = partition.labels.len() as u32;
            partition.labels.push(steps.node[vertex as usize]);
            found.steps[index].push((steps.node[vertex as usize], steps.seq(vertex)));
            for &input in steps.inputs(vertex) {
                if place[input as usize] == place[vertex as usize] {
                    partition.edges.push((local[input as usize], local[vertex as usize]));
                }
            }
        }
        found
    }
}

/// Cuts an episode at the steps of the supervisor, a node of `dag` by its index.
///
/// Errors: lists that do not fit together, a message that nobody sent, steps that depend on each other in a cycle.
pub fn partition(
    dag: &Dag<'_>,
    supervisor: u32,
    cut: Cut,
    start: StartUp,
) -> Result<Partitioning, SupergraphError> {
    let mut steps = Steps::new(dag, supervisor)?;
    let place = match cut {
        Cut::Ancestors => steps.latest.clone(),
        Cut::Balanced { ahead } => {
            steps.limit(ahead);
            sweep::balance(dag, &steps, start)
        }
    };
    Ok(Partitioning::collect(&steps, &place, &steps.order))
}
