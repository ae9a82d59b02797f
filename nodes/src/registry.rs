//! All kinds of node and all graphs that Parallax brings along.

use parallax_runtime::graph::GraphSpec;
use parallax_runtime::registry::Registry;

use crate::{dynamixel, estimator, pendulum, playback, quadrotor};

/// The kinds of node that come with Parallax, each also as one that plays a file ([`playback`]). The pendulum's world hides what the environment says
/// ([`pendulum::hidden::SEED_VARIABLE`]).
///
/// ```
/// let registry = parallax_nodes::registry();
/// let graph = parallax_nodes::pendulum::graph().validate(&registry).unwrap();
/// assert_eq!(graph.nodes()[graph.supervisor()].name, "agent");
/// ```
pub fn registry() -> Registry {
    let robots = quadrotor::kinds(pendulum::kinds_from_environment(Registry::new()));
    playback::with_playback(dynamixel::kinds(robots)).with("estimator", estimator::kind())
}

/// The names of the graphs that come with Parallax.
pub const GRAPHS: [&str; 3] = ["pendulum", "pendulum-simulated", "quadrotor-simulated"];

/// The graph of this name, one of [`GRAPHS`].
pub fn graph(name: &str) -> Option<GraphSpec> {
    match name {
        "pendulum" => Some(pendulum::graph()),
        "pendulum-simulated" => Some(pendulum::simulated()),
        "quadrotor-simulated" => Some(quadrotor::simulated()),
        _ => None,
    }
}
