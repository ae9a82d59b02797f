//! Delays around a simulator of whose own time nothing is seen: where all that reaches it and all that leaves it is late by
//! unknown times, it could run earlier or later, and everything that is recorded would stay. The data tell the ways
//! through it, each the sum of a delay before it and one behind it; what the information says beyond is how a simulation
//! rounds between its ticks.

use super::coordinate::Sort;
use super::problem::Problem;
use crate::batch::Place;

/// The coordinates that are delays around one node.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Around {
    /// Of what reaches it.
    pub(super) before: Vec<usize>,
    /// Of what leaves it.
    pub(super) behind: Vec<usize>,
}

impl Around {
    /// The ways through the node.
    pub(super) fn ways(&self) -> impl Iterator<Item = [usize; 2]> + '_ {
        self.before.iter().flat_map(|&before| self.behind.iter().map(move |&behind| [before, behind]))
    }

    /// How much later a sum of these delays comes to be where the node runs later by one.
    pub(super) fn shift(&self, factor: impl Fn(usize) -> i32) -> i32 {
        let of = |delays: &[usize]| delays.iter().map(|&i| factor(i)).sum::<i32>();
        of(&self.before) - of(&self.behind)
    }
}

/// All such nodes.
pub(super) fn all_around(problem: &Problem) -> Vec<Around> {
    let specification = problem.specification();
    let simulators = specification.nodes.iter().filter(|node| node.rate.is_some());
    let unseen =
        simulators.filter(|node| !specification.outputs.iter().any(|output| output.node == node.node));
    unseen.filter_map(|node| around(problem, &node.node)).collect()
}

/// Those of a node; none where a delay of it is known, which is its clock.
fn around(problem: &Problem, name: &str) -> Option<Around> {
    let mut found = Around::default();
    for (connection, edge) in problem.graph().spec().connections.iter().enumerate() {
        let own = match (edge.from == name, edge.to == name) {
            (false, true) => &mut found.before,
            (true, false) => &mut found.behind,
            _ => continue,
        };
        let sets = |place: &Place| *place == Place::Delay { connection };
        let delay =
            problem.coordinates.iter().position(|c| c.sort == Sort::Delay && c.places.iter().any(sets));
        own.push(delay?);
    }
    (!found.before.is_empty() && !found.behind.is_empty()).then_some(found)
}
