//! Supervisor steps per second of native batch rollouts: a whole pendulum graph with Gaussian delays, whose agent's
//! actions are drawn beforehand.
//!
//! `cargo bench -p parallax-sim --bench batch [-- THREADS] [--only 1024DoubleLanes]`; one thread unless said otherwise.

use std::time::Instant;

use parallax_model::Scalar;
use parallax_model::node_model::{NodeModel, NodeStep};
use parallax_nodes::pendulum::{self, Estimate, WorldState};
use parallax_runtime::delay::Delay;
use parallax_runtime::graph::{Graph, GraphBuilder};
use parallax_runtime::node::Port;
use parallax_runtime::random::{Purpose, stream};
use parallax_runtime::registry::{NodeKind, Registry};
use parallax_sim::batch::{Batch, Given, Precision};
use parallax_sim::compiled::{CompileOptions, compile};
use parallax_sim::generate_many;
use rand_distr::{Distribution, Uniform};

const SECONDS: usize = 20;
const WORLD: Port<WorldState> = Port::new("world");

/// Reads angle and speed from the shaft, without noise.
struct Sensor;

impl NodeModel for Sensor {
    const NAME: &'static str = "sensor";
    type Params<T: Scalar> = ();
    type State<T: Scalar> = ();
    type Output<T: Scalar> = Estimate<T>;

    #[inline(always)]
    fn step<T: Scalar>((): &(), (): (), step: &NodeStep<'_, T>) -> ((), Estimate<T>) {
        let WorldState { angle, speed, stamp } = step.latest::<WorldState<T>>(WORLD.name()).message;
        ((), Estimate { angle, speed, stamp })
    }
}

fn graph() -> Result<Graph, Box<dyn std::error::Error>> {
    let sensor = NodeKind::model::<Sensor>(|_| Ok(((), ()))).input(WORLD);
    let registry = pendulum::kinds_from_environment(Registry::new()).with("bench/sensor", sensor);
    let mut graph = GraphBuilder::new("pendulum-bench");
    let normal = |mean: f64, std: f64| Delay::Normal { mean, std };
    let world = graph.model::<pendulum::plant::Plant>("world", "pendulum/plant", 100.0).add();
    let sensor =
        graph.model::<Sensor>("sensor", "bench/sensor", 50.0).computation(normal(2e-3, 0.4e-3)).add();
    let agent = graph
        .model::<pendulum::agent::Agent>("agent", "pendulum/agent", 50.0)
        .computation(normal(2e-3, 0.5e-3))
        .add();
    let motor = graph
        .model::<pendulum::motor::Motor>("motor", "pendulum/motor", 50.0)
        .computation(normal(1e-3, 0.2e-3))
        .add();
    let wire = || normal(1e-3, 0.3e-3);
    graph.connect(world, sensor, WORLD).add();
    graph.connect(sensor, agent, pendulum::agent::ESTIMATOR).blocking().delay(wire()).add();
    graph.connect(agent, motor, pendulum::motor::AGENT).blocking().delay(wire()).add();
    graph.connect(motor, world, pendulum::plant::MOTOR).skip().delay(wire()).add();
    Ok(graph.supervisor(agent).validate(&registry)?)
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let threads = std::env::args().skip(1).find_map(|argument| argument.parse().ok()).unwrap_or(1);
    rayon::ThreadPoolBuilder::new().num_threads(threads).build_global()?;
    let arguments: Vec<String> = std::env::args().collect();
    let only =
        arguments.iter().position(|argument| argument == "--only").map(|place| arguments[place + 1].as_str());
    let graph = graph()?;
    let agent = graph.supervisor();
    let episodes = generate_many(&graph, 1, SECONDS as i64 * 1_000_000_000, 32)?;
    let options = CompileOptions { pinned: vec![agent], ..CompileOptions::default() };
    let compiled = compile(&graph, &episodes, &options)?;
    println!(
        "{} slots, {} passes to warm up, efficiency {:.2}, histories {:?}; {threads} thread(s)",
        compiled.slots.len(),
        compiled.warm_up,
        compiled.efficiency(),
        compiled.nodes.iter().map(|node| node.history).collect::<Vec<_>>(),
    );
    let batch = Batch::new(&graph, &compiled, 1)?;
    println!("environments  precision     steps/s      ns per environment and step");
    for (count, precision) in [
        (1, Precision::Double),
        (1024, Precision::Double),
        (16, Precision::DoubleLanes),
        (1024, Precision::DoubleLanes),
        (1024, Precision::SingleLanes),
    ] {
        if only.is_some_and(|only| only != format!("{count}{precision:?}")) {
            continue;
        }
        let mut random = stream(1, Purpose::Node, "actions");
        let steps = SECONDS * 50;
        let voltage = Uniform::new(-4.0, 4.0)?;
        let actions: Vec<f64> = (0..count * steps).map(|_| voltage.sample(&mut random)).collect();
        let mut environments = batch.environments(count);
        let masses: Vec<f64> =
            (0..count).map(|index| 0.05 * (1.0 + 0.1 * index as f64 / count as f64)).collect();
        environments.set_param("world", "pendulum.mass", &masses)?;
        environments.give("agent", Given::PerEnvironment { steps, values: &actions })?;
        if count == 16 {
            environments.set_episodes(&[0; 16])?;
        }
        let supervised: usize =
            (0..count).map(|index| compiled.lengths[index % compiled.episodes] as usize).sum();
        let mut best = f64::INFINITY;
        for _ in 0..25 {
            let begin = Instant::now();
            let results = batch.fold(
                &environments,
                precision,
                |_| 0.0,
                |sum, moment| {
                    *sum += moment.output(0, 0, 0);
                },
            )?;
            best = best.min(begin.elapsed().as_secs_f64());
            assert!(results.iter().all(|(_, sum)| sum.is_finite()));
        }
        let each = best * 1e9 / supervised as f64;
        println!("{count:12}  {precision:<12?}  {:6.2} M  {each:8.2}", 1e3 / each);
    }
    Ok(())
}
