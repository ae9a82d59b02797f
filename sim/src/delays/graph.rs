//! The graph of a recording, with the delays that it showed.

use parallax_runtime::graph::{GraphError, GraphSpec};
use parallax_runtime::recording::Recording;
use parallax_runtime::registry::Registry;

use super::collect::{Measured, Place, measured};
use super::fit::{DelayFit, fit};

/// A graph whose delays were measured.
#[derive(Debug, Clone)]
pub struct FittedGraph {
    /// The recording's graph with the fitted delays in place of those that it declared.
    pub graph: GraphSpec,
    /// The fits, nodes first, in the order of the graph.
    pub fits: Vec<DelayFit>,
    /// What was measured, in the same order.
    pub measured: Vec<Measured>,
    /// Places without a single measured delay: they keep what the graph declares.
    pub missing: Vec<Place>,
}

/// Fits all delays of a recording and puts them into its graph, which is checked against the kinds in `registry`.
///
/// A computation that the graph declares to follow from the output is replaced as any other: what was measured is its
/// distribution over the run.
///
/// # Errors
///
/// What [`GraphSpec::validate`] finds wrong with the recording's graph.
pub fn fitted_graph(recording: &Recording, registry: &Registry) -> Result<FittedGraph, GraphError> {
    let mut graph = recording.graph.clone();
    let (mut fits, mut kept, mut missing) = (Vec::new(), Vec::new(), Vec::new());
    for measured in measured(recording) {
        let Some(fit) = fit(&measured) else {
            missing.push(measured.place);
            continue;
        };
        match &fit.place {
            Place::Computation { node } => {
                if let Some(node) = graph.node_mut(node) {
                    node.computation = fit.fit.clone();
                }
            }
            Place::Communication { from, to, port } => {
                for connection in &mut graph.connections {
                    if connection.from == *from && connection.to == *to && connection.port() == port {
                        connection.delay = fit.fit.clone();
                    }
                }
            }
        }
        fits.push(fit);
        kept.push(measured);
    }
    graph.validate(registry)?;
    Ok(FittedGraph { graph, fits, measured: kept, missing })
}
