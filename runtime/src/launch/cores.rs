//! Which node runs on which core.

use super::error::RunError;
use super::settings::{NodeSettings, Policy};
use crate::graph::Graph;

/// Polling of a node that was to poll always, on a core that it shares.
const SHARED_SPIN: crate::time::Nanos = NodeSettings::SPIN;

/// Gives every node its core: its own, or one of those that exist in turn. The result is what is worth knowing, and what
/// the machine refuses because it has too few cores.
pub(super) fn assign(
    graph: &Graph,
    nodes: &mut [NodeSettings],
    here: impl Fn(usize) -> bool,
    spread: bool,
) -> Result<(Vec<String>, Vec<String>), RunError> {
    let available: Vec<usize> =
        core_affinity::get_core_ids().unwrap_or_default().iter().map(|core| core.id).collect();
    // A number that no machine has is a mistake, not a refusal.
    let possible: Vec<usize> = (0..libc::CPU_SETSIZE as usize).collect();
    if graph.check_cores(&possible).is_err() {
        graph.check_cores(&available)?;
    }
    let mut refused = Vec::new();
    for (place, (node, plan)) in nodes.iter_mut().zip(graph.nodes()).enumerate() {
        if !here(place) {
            node.core = None;
            continue;
        }
        if let Some(core) = node.core.take_if(|core| !available.contains(core)) {
            let cores: Vec<String> = available.iter().map(ToString::to_string).collect();
            refused.push(format!(
                "node {} was to run on core {core}, but this process may use cores {} only; it runs on any of them",
                plan.name,
                cores.join(", ")
            ));
        }
    }
    if spread {
        // Cores that no node claims come first.
        let claimed = |core: &usize| nodes.iter().any(|node| node.core == Some(*core));
        let (taken, mut free): (Vec<usize>, Vec<usize>) = available.iter().partition(|core| claimed(core));
        free.extend(taken);
        let mut next = free.iter().copied().cycle();
        // A node whose core is not there goes where there is room, too.
        let without =
            nodes.iter_mut().enumerate().filter(|(place, node)| here(*place) && node.core.is_none());
        without.for_each(|(_, node)| node.core = next.next());
    }
    refused.extend(too_few(graph, nodes));
    Ok((graph.warnings().iter().map(ToString::to_string).collect(), refused))
}

/// A node that always polls leaves nothing of its core to others: where it has to share one, it does not.
fn too_few(graph: &Graph, nodes: &mut [NodeSettings]) -> Vec<String> {
    let mut refused = Vec::new();
    for index in 0..nodes.len() {
        let Some(core) = nodes[index].core.filter(|_| nodes[index].spin >= NodeSettings::ALWAYS) else {
            continue;
        };
        let other = (0..nodes.len()).find(|&other| other != index && nodes[other].core == Some(core));
        let Some(other) = other else { continue };
        let (name, other) = (&graph.nodes()[index].name, &graph.nodes()[other].name);
        refused.push(format!(
            "node {name} was to poll always, but shares core {core} with node {other}, which {}; it polls for {} us and \
             sleeps then. Give it a core of its own",
            if nodes[index].policy == Policy::Other { "would wait for it" } else { "would never run" },
            SHARED_SPIN / 1000
        ));
        nodes[index].spin = SHARED_SPIN;
    }
    refused
}

/// Puts this thread on its core; gives what was refused.
pub(super) fn pin(node: &str, settings: &NodeSettings) -> Option<String> {
    let core = settings.core?;
    // The launcher asked which cores exist; one may have been taken away since then.
    let done = core_affinity::set_for_current(core_affinity::CoreId { id: core });
    (!done)
        .then(|| format!("node {node} was to run on core {core}, which the system refuses; it runs on any"))
}

/// Lets this thread run on any of these cores.
pub(super) fn allow(cores: &[core_affinity::CoreId]) {
    // SAFETY: a cpu_set_t is plain bits, for which all zeros are a valid value; it outlives the calls, which change nothing
    // but it and this thread's own setting. A refusal leaves the thread where it is.
    unsafe {
        let mut set: libc::cpu_set_t = std::mem::zeroed();
        cores.iter().for_each(|core| libc::CPU_SET(core.id, &mut set));
        libc::sched_setaffinity(0, size_of::<libc::cpu_set_t>(), &set);
    }
}
