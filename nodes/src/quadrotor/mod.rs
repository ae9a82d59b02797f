//! The quadrotor: a graph of four models that flies a circle at a constant height, as in the paper's second task.
//!
//! ```text
//! world ──> mocap ──> agent ──> pid ──> world
//!             └────────────────^
//! ```
//!
//! A machine that stands in for hardware takes the places of world, motion capture and controller: [`world`] and
//! [`drivers`], of which nothing is known but the equations ([`hidden`]).

pub mod agent;
pub mod airframe;
pub mod drivers;
pub mod hidden;
mod messages;
pub mod mocap;
pub mod pid;
pub mod plant;
pub mod simulator;
pub mod surveyor;
pub mod world;

use parallax_runtime::delay::Delay;
use parallax_runtime::graph::{GraphBuilder, GraphSpec};
use parallax_runtime::registry::Registry;

pub use messages::{Command, Motion, Reference};

use agent::Agent;
use mocap::Mocap;
use pid::HeightPid;
use plant::Plant;

/// The kinds of node of this graph.
pub fn kinds(registry: Registry) -> Registry {
    registry
        .with("quadrotor/plant", plant::kind())
        .with("quadrotor/simulator", simulator::kind())
        .with("quadrotor/mocap", mocap::kind())
        .with("quadrotor/agent", agent::kind())
        .with("quadrotor/pid", pid::kind())
        .with("quadrotor/surveyor", surveyor::kind())
        .with("quadrotor/world", world::kind())
        .with("quadrotor/tracker", drivers::tracker())
        .with("quadrotor/onboard", drivers::onboard())
        .with("quadrotor/policy", crate::policy::kind::<Motion, Reference>())
}

/// The graph. Its delays are of the size that the paper found for motion capture, radio and computation.
pub fn simulated() -> GraphSpec {
    let mut graph = GraphBuilder::new("quadrotor-simulated");
    let normal = |mean: f64, std: f64| Delay::Normal { mean, std };
    let world = graph.model::<Plant>("world", "quadrotor/plant", 100.0).add();
    let mocap =
        graph.model::<Mocap>("mocap", "quadrotor/mocap", 100.0).computation(normal(4e-3, 0.5e-3)).add();
    let agent =
        graph.model::<Agent>("agent", "quadrotor/agent", 50.0).computation(normal(2e-3, 0.4e-3)).add();
    let pid = graph.model::<HeightPid>("pid", "quadrotor/pid", 50.0).computation(normal(1e-3, 0.2e-3)).add();
    let wire = || normal(1e-3, 0.3e-3);
    graph.connect(world, mocap, mocap::WORLD).add();
    graph.connect(mocap, agent, agent::MOCAP).delay(wire()).add();
    graph.connect(mocap, pid, pid::MOCAP).delay(wire()).add();
    graph.connect(agent, pid, pid::AGENT).blocking().delay(wire()).add();
    graph.connect(pid, world, plant::PID).skip().delay(normal(5e-3, 1e-3)).add();
    graph.supervisor(agent)
}
