//! Where in the graph the numbers stand that were found, by the names that the graph has for them.

use serde::{Deserialize, Serialize};

use super::problem::Problem;
use crate::batch::Place;

/// A place in the graph that an estimate sets.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Location {
    /// A leaf of a node's parameters.
    Parameter {
        /// The node.
        node: String,
        /// The leaf.
        parameter: String,
    },
    /// A leaf of a node's first state.
    State {
        /// The node.
        node: String,
        /// The leaf.
        state: String,
        /// The recording whose it is, from 1; absent: of all.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        recording: Option<usize>,
    },
    /// The delay of a connection.
    Delay {
        /// The sender.
        from: String,
        /// The receiver.
        to: String,
        /// The receiver's input.
        port: String,
        /// What of it.
        of: Moment,
    },
    /// What multiplies a leaf of the prediction of an output, and is no parameter of the graph.
    Coefficient {
        /// The output, `NODE.LEAF`.
        output: String,
        /// The leaf that it multiplies; absent: 1.
        multiplies: Option<String>,
    },
}

/// What of a distribution a number is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Moment {
    /// The mean.
    Mean,
    /// The standard deviation.
    Spread,
}

/// The locations of all estimates, in their order: coordinates, then linear coefficients.
pub(super) fn locations(problem: &Problem) -> Vec<Vec<Location>> {
    let coordinates = problem.coordinates.iter().map(|coordinate| {
        let recording = coordinate.recording.map(|recording| recording + 1);
        coordinate.places.iter().map(|place| of(problem, *place, recording)).collect()
    });
    let linear = problem.outputs.iter().flat_map(|output| {
        let predicted = &problem.graph.nodes()[output.node].kind.output().leaves;
        output.names.iter().zip(&output.terms).map(move |(name, term)| {
            vec![match parameter(problem, name) {
                Some(place) => of(problem, place, None),
                None => Location::Coefficient {
                    output: output.name.clone(),
                    multiplies: term.map(|leaf| predicted[leaf].clone()),
                },
            }]
        })
    });
    coordinates.chain(linear).collect()
}

/// The parameter that a coefficient called `NODE.PARAMETER` sets, if there is one.
pub(super) fn parameter(problem: &Problem, name: &str) -> Option<Place> {
    let (node, leaf) = name.split_once('.')?;
    let node = problem.graph.index(node)?;
    let model = problem.graph.nodes()[node].kind.node_model()?.model();
    let leaf = model.params().iter().position(|known| known == leaf)?;
    Some(Place::Param { node, leaf })
}

fn of(problem: &Problem, place: Place, recording: Option<usize>) -> Location {
    let graph = &problem.graph;
    // A place was found by its name: the leaf is there.
    let name = |node: usize, leaf: usize, state: bool| {
        let model = graph.nodes()[node].kind.node_model().map(|kind| kind.model());
        let leaves = model.map_or_else(Vec::new, |model| if state { model.state() } else { model.params() });
        leaves.get(leaf).cloned().unwrap_or_default()
    };
    let node_name = |node: usize| graph.nodes()[node].name.clone();
    match place {
        Place::Param { node, leaf } => {
            Location::Parameter { node: node_name(node), parameter: name(node, leaf, false) }
        }
        Place::State { node, leaf } => {
            Location::State { node: node_name(node), state: name(node, leaf, true), recording }
        }
        Place::Delay { connection } => {
            let edge = &graph.spec().connections[connection];
            Location::Delay {
                from: edge.from.clone(),
                to: edge.to.clone(),
                port: edge.port().to_owned(),
                of: Moment::Mean,
            }
        }
    }
}
