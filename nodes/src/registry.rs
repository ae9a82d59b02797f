//! All kinds of node that Parallax brings along.

use parallax_runtime::registry::Registry;

use crate::pendulum;

/// The kinds of node that come with Parallax. The pendulum's world hides what the environment says
/// ([`pendulum::hidden::SEED_VARIABLE`]).
///
/// ```
/// let registry = parallax_nodes::registry();
/// let graph = parallax_nodes::pendulum::graph().validate(&registry).unwrap();
/// assert_eq!(graph.nodes()[graph.supervisor()].name, "agent");
/// ```
pub fn registry() -> Registry {
    pendulum::kinds_from_environment(Registry::new())
}
