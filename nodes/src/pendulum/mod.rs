//! The pendulum: a graph of five nodes that swings it up, balances it and shakes it, with a world that stands in for the
//! hardware.
//!
//! ```text
//! world ──> camera ──> estimator ──> agent ──> motor ──> world
//!                          ^────────────────────┘
//! ```
//!
//! The world hides at most one effect that the nominal simulator ([`SYSTEM`]) does not know; see [`hidden`].

pub mod agent;
pub mod camera;
pub mod camera_map;
pub mod detector;
pub mod encoder;
pub mod estimator;
pub mod film;
pub mod hidden;
mod messages;
pub mod motor;
pub mod plant;
pub mod sight;
pub mod simulator;
pub mod ukf;
pub mod view;
pub mod world;

use std::f64::consts::{PI, TAU};

use parallax_model::Scalar;
use parallax_runtime::delay::Delay;
use parallax_runtime::graph::{GraphBuilder, GraphSpec};
use parallax_runtime::registry::Registry;

pub use messages::{Angle, Estimate, Voltage, WorldState};

use crate::stand_in::COMMANDS;
use agent::Agent;
use camera::Camera;
use encoder::Encoder;
use estimator::Estimator;
use hidden::HiddenEffect;
use motor::Motor;
use plant::Plant;
use view::View;
use world::World;

/// The nominal simulator of the stretch between `motor.voltage` and `camera.angle`: the text of a `system.toml`.
pub const SYSTEM: &str = include_str!("system.toml");

/// The kinds of node of this graph, with a world that hides `effect`.
///
/// The effect reaches the world through the registry alone, so that neither the graph nor a recording of it tells it.
pub fn kinds(registry: Registry, effect: HiddenEffect) -> Registry {
    everything_but_the_machine(registry)
        .with("pendulum/world", world::kind(move |_| Ok(effect)))
        .with("pendulum/film", film::kind(|_, stand| Ok(View::nominal(stand))))
}

/// The kinds of node of this graph, with a world that hides what the seed in the environment draws
/// ([`hidden::SEED_VARIABLE`]), or nothing when there is none; where it draws a whole machine, its cameras stand where nobody
/// knows, too.
pub fn kinds_from_environment(registry: Registry) -> Registry {
    everything_but_the_machine(registry)
        .with("pendulum/world", world::kind(hidden::from_environment))
        .with("pendulum/film", film::kind(hidden::view_from_environment))
}

fn everything_but_the_machine(registry: Registry) -> Registry {
    registry
        .with("pendulum/camera", camera::kind())
        .with("pendulum/encoder", encoder::kind())
        .with("pendulum/camera-map", camera_map::kind())
        .with("pendulum/detector", detector::kind())
        .with("pendulum/detector-simulated", detector::simulated())
        .with("pendulum/estimator", estimator::kind())
        .with("pendulum/ukf", ukf::kind())
        .with("pendulum/agent", agent::kind())
        .with("pendulum/motor", motor::kind())
        .with("pendulum/plant", plant::kind())
        .with("pendulum/sight", sight::kind())
        .with("pendulum/simulator", simulator::kind())
        .with("pendulum/pid", crate::pid::kind::<Angle, Voltage>())
        .with("pendulum/policy", crate::policy::kind::<Estimate, Voltage>())
        .with("pendulum/camera-policy", crate::policy::kind::<Angle, Voltage>())
}

/// The graph. Its delays are those of a small camera and computer.
pub fn graph() -> GraphSpec {
    let mut graph = GraphBuilder::new("pendulum");
    let normal = |mean: f64, std: f64| Delay::Normal { mean, std };
    let world =
        graph.node::<World>("world", "pendulum/world", 200.0).computation(Delay::constant(50e-6)).add();
    let camera =
        graph.model::<Camera>("camera", "pendulum/camera", 100.0).computation(normal(2e-3, 0.2e-3)).add();
    let estimator = graph
        .node::<Estimator>("estimator", "pendulum/estimator", 100.0)
        .computation(normal(0.2e-3, 0.02e-3))
        .add();
    let agent = graph.model::<Agent>("agent", "pendulum/agent", 50.0).computation(normal(1e-3, 0.2e-3)).add();
    let motor =
        graph.model::<Motor>("motor", "pendulum/motor", 100.0).computation(Delay::constant(0.1e-3)).add();
    let wire = || normal(0.3e-3, 0.05e-3);
    graph.connect(world, camera, camera::WORLD).blocking().delay(wire()).add();
    graph.connect(camera, estimator, estimator::CAMERA).blocking().delay(wire()).add();
    graph.connect(motor, estimator, estimator::MOTOR).skip().window(estimator::COMMANDS).delay(wire()).add();
    graph.connect(estimator, agent, agent::ESTIMATOR).blocking().delay(wire()).add();
    graph.connect(agent, motor, motor::AGENT).delay(wire()).add();
    graph.connect(motor, world, world::MOTOR).skip().window(COMMANDS).delay(wire()).add();
    graph.plant(SYSTEM);
    graph.supervisor(agent)
}

/// The loop with its nominal simulator instead of a world, and an encoder instead of camera and estimator: every node is
/// a model, so that the graph compiles.
///
/// ```text
/// world ──> encoder ──> agent ──> motor ──> world
/// ```
pub fn simulated() -> GraphSpec {
    let mut graph = GraphBuilder::new("pendulum-simulated");
    let normal = |mean: f64, std: f64| Delay::Normal { mean, std };
    let world = graph.model::<Plant>("world", "pendulum/plant", 100.0).add();
    let encoder =
        graph.model::<Encoder>("encoder", "pendulum/encoder", 100.0).computation(normal(2e-3, 0.4e-3)).add();
    let agent = graph.model::<Agent>("agent", "pendulum/agent", 50.0).computation(normal(2e-3, 0.5e-3)).add();
    let motor = graph.model::<Motor>("motor", "pendulum/motor", 50.0).computation(normal(1e-3, 0.2e-3)).add();
    let wire = || normal(1e-3, 0.3e-3);
    graph.connect(world, encoder, encoder::WORLD).add();
    graph.connect(encoder, agent, agent::ESTIMATOR).blocking().delay(wire()).add();
    graph.connect(agent, motor, motor::AGENT).blocking().delay(wire()).add();
    graph.connect(motor, world, plant::MOTOR).skip().delay(wire()).add();
    graph.supervisor(agent)
}

/// The same angle, rad, within [−π, π).
#[inline(always)]
pub(crate) fn wrapped<T: Scalar>(angle: T) -> T {
    let turns = ((angle + PI) / TAU).floor();
    angle - turns * TAU
}
