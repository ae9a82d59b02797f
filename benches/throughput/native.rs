//! What runs without Python: the native batch, the simulated clock, the bare dynamics on lanes, and the limit.

use std::hint::black_box;
use std::time::Instant;

use parallax_model::lanes::{F32x32, F64x16, InMemory, Kernel, Lanes, Level, Simd};
use parallax_model::tree::Tree;
use parallax_model::{Model, Scalar};
use parallax_nodes::models::pendulum::{Input, Params, Pendulum, STEP, State};
use parallax_runtime::graph::Graph;
use parallax_sim::batch::{Batch, Given, Precision};
use parallax_sim::compiled::{CompileOptions, CompiledGraph, compile};
use parallax_sim::{Executor, generate_many};

use crate::graphs::{Case, cases, large};
use crate::handwritten::{Block, run_f32, run_f64};
use crate::line::{Line, Timing};

/// Who we are in the report.
pub(crate) const OURS: &str = "Parallax, native";
/// The loop written by hand.
pub(crate) const LIMIT: &str = "limit: written by hand";
/// Of the supervisor, Hz.
const RATE: usize = 50;
/// Of an episode, s.
pub(crate) const SECONDS: usize = 20;
/// Different schedules, spread over the environments.
const EPISODES: usize = 20;

/// The tables over [`EPISODES`] schedules drawn for this graph; the supervisor's outputs are given.
fn compiled(graph: &Graph, seconds: usize) -> anyhow::Result<CompiledGraph> {
    // A little more, so that late ends of steps do not take the last one away.
    let episodes = generate_many(graph, 1, seconds as i64 * 1_000_000_000 + 100_000_000, EPISODES)?;
    let options = CompileOptions { pinned: vec![graph.supervisor()], ..CompileOptions::default() };
    Ok(compile(graph, &episodes, &options)?)
}

/// Seconds of rollouts of so many environments, and how many steps the supervisor made in each.
fn rollouts(
    case: &Case,
    graph: &Graph,
    tables: &CompiledGraph,
    environments: usize,
    precision: Precision,
    timing: Timing,
) -> anyhow::Result<(usize, Vec<f64>)> {
    let steps = tables.steps + 1;
    let actions = case.actions(environments, steps);
    let batch = Batch::new(graph, tables, 1)?;
    let mut work = batch.environments(environments);
    work.give("agent", Given::PerEnvironment { steps, values: &actions })?;
    for ((leaf, _), values) in case.nominal.iter().zip(case.parameters(environments)) {
        work.set_param("world", leaf, &values)?;
    }
    // Lanes stay full where there are enough environments for every schedule to have whole blocks of them.
    let block = match precision {
        Precision::SingleLanes => F32x32::LANES,
        _ => F64x16::LANES,
    };
    let block = if environments >= block * tables.episodes { block } else { 1 };
    let episodes: Vec<u32> = (0..environments).map(|env| (env / block % tables.episodes) as u32).collect();
    work.set_episodes(&episodes)?;
    let mean = episodes.iter().map(|episode| tables.lengths[*episode as usize] as usize).sum::<usize>();
    batch.rollout(&work, precision, &[])?;
    let seconds = timing.measure(|| {
        black_box(batch.rollout(&work, precision, &[]).expect("it ran before"));
    });
    Ok((mean / environments, seconds))
}

/// The whole graph with delays, for every number of environments.
pub(crate) fn batches(envs: &[usize], timing: Timing, report: &mut dyn FnMut(Line)) -> anyhow::Result<()> {
    for case in cases() {
        let start = Instant::now();
        let graph = case.graph()?;
        let tables = compiled(&graph, SECONDS)?;
        let ready = start.elapsed().as_secs_f64();
        let once = Timing { seconds: 0.0, repeats: 1 };
        rollouts(&case, &graph, &tables, 1, Precision::Double, once)?;
        let name = format!("{}, from graph to first rollout", case.name);
        report(Line::value(OURS, name, start.elapsed().as_secs_f64(), "s").detail(format!(
            "{ready:.3} s until the graph is compiled; {} slots, efficiency {:.3}",
            tables.slots.len(),
            tables.efficiency()
        )));
        for &count in envs {
            for precision in [Precision::Double, Precision::DoubleLanes, Precision::SingleLanes] {
                if (count == 1) != (precision == Precision::Double) {
                    continue;
                }
                let (steps, seconds) = rollouts(&case, &graph, &tables, count, precision, timing)?;
                let dtype = if precision == Precision::SingleLanes { "f32" } else { "f64" };
                let name = format!("{}, graph with delays", case.name);
                report(Line::throughput(OURS, name, dtype, count, steps, &seconds));
            }
        }
    }
    Ok(())
}

/// The simulated clock with a recording in memory: every event and every message.
pub(crate) fn simulated_clock(timing: Timing, report: &mut dyn FnMut(Line)) -> anyhow::Result<()> {
    for case in cases() {
        let executor = Executor::new(case.graph()?, 1);
        let duration = SECONDS as i64 * 1_000_000_000;
        let recording = executor.record(duration)?;
        let steps: usize = recording.nodes.iter().map(|node| node.steps.len()).sum();
        let seconds = timing.measure(|| {
            black_box(executor.record(duration).expect("it ran before"));
        });
        let name = format!("{}, simulated clock", case.name);
        report(Line::throughput(OURS, name, "f64", 1, RATE * SECONDS, &seconds));
        let best = seconds.iter().copied().fold(f64::INFINITY, f64::min);
        let name = format!("{}, node steps under the simulated clock", case.name);
        report(Line::value(OURS, name, steps as f64 / best, "1/s").detail("recording on".to_owned()));
    }
    Ok(())
}

/// Blocks of environments through the model `Pendulum`, on lanes.
struct Bare<'a, T> {
    params: &'a [[T; 7]],
    actions: &'a [Vec<T>],
    states: &'a mut [[T; 2]],
}

impl<T: InMemory> Kernel for Bare<'_, T> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self) {
        let dt = T::On::<S>::constant(STEP);
        for ((params, actions), state) in self.params.iter().zip(self.actions).zip(self.states) {
            let p = Params::read_from(T::registers::<S>(params));
            let mut x = State::read_from(T::registers::<S>(state));
            for &voltage in T::registers::<S>(actions) {
                let input = Input { voltage };
                x = Pendulum::step(&p, x, input, dt).0;
                x = Pendulum::step(&p, x, input, dt).0;
            }
            x.write_to(T::registers_mut::<S>(state));
        }
    }
}

/// The bare dynamics of the pendulum: ours on lanes and the loop written by hand, over the same numbers.
macro_rules! bare {
    ($name:ident, $lanes:ident, $float:ty, $width:literal, $dtype:literal, $by_hand:ident) => {
        fn $name(environments: usize, timing: Timing, report: &mut dyn FnMut(Line)) {
            let steps = RATE * SECONDS;
            let blocks = environments.div_ceil($width);
            let case = &cases()[0];
            let parameters = case.parameters(blocks * $width);
            let drawn = case.actions(blocks * $width, steps);
            let action = |block: usize, step: usize| -> [$float; $width] {
                std::array::from_fn(|lane| drawn[(block * $width + lane) * steps + step] as $float)
            };
            let pendulum = |place: usize| -> Params<f64> {
                let leaves: Vec<f64> = parameters.iter().map(|values| values[place]).collect();
                Params::read_from(&leaves)
            };
            let case = || "pendulum, bare".to_owned();

            let params: Vec<[$lanes; 7]> = (0..blocks)
                .map(|block| {
                    std::array::from_fn(|leaf| {
                        Lanes::from_fn(|lane| parameters[leaf][block * $width + lane] as $float)
                    })
                })
                .collect();
            let actions: Vec<Vec<$lanes>> = (0..blocks)
                .map(|block| (0..steps).map(|step| Lanes::load(&action(block, step))).collect())
                .collect();
            let first = [$lanes::constant(std::f64::consts::PI), $lanes::constant(0.0)];
            let mut states = vec![first; blocks];
            let seconds = timing.measure(|| {
                states.fill(first);
                Level::widest().run(Bare { params: &params, actions: &actions, states: &mut states });
                black_box(&states);
            });
            report(
                Line::throughput(OURS, case(), $dtype, blocks * $width, steps, &seconds)
                    .detail(format!("lanes, {:?}", Level::widest())),
            );

            let start: Vec<_> = (0..blocks)
                .map(|block| {
                    Block::<$float, $width>::new(std::array::from_fn(|lane| pendulum(block * $width + lane)))
                })
                .collect();
            let actions: Vec<Vec<[$float; $width]>> =
                (0..blocks).map(|block| (0..steps).map(|step| action(block, step)).collect()).collect();
            let mut by_hand = start.clone();
            let seconds = timing.measure(|| {
                by_hand.copy_from_slice(&start);
                by_hand.iter_mut().zip(&actions).for_each(|(block, actions)| $by_hand(block, actions));
                black_box(&by_hand);
            });
            report(Line::throughput(LIMIT, case(), $dtype, blocks * $width, steps, &seconds));
            check(&states, &by_hand);
        }
    };
}

bare!(bare_f64, F64x16, f64, 16, "f64", run_f64);
bare!(bare_f32, F32x32, f32, 32, "f32", run_f32);

/// Both loops must do the same work: after the friction's sign has been met at different rounding they part slowly, so
/// that their mean energy, not every angle, is compared.
fn check<F: Copy + Into<f64> + parallax_model::lanes::Element, const N: usize>(
    ours: &[[Lanes<F, N>; 2]],
    by_hand: &[Block<F, N>],
) {
    let count = (ours.len() * N) as f64;
    let of_ours = ours.iter().flat_map(|[_, speed]| speed.to_array()).map(|s| s.into().powi(2)).sum::<f64>();
    let of_hand = by_hand.iter().flat_map(|block| block.speed).map(|s| s.into().powi(2)).sum::<f64>();
    let (ours, by_hand) = ((of_ours / count).sqrt(), (of_hand / count).sqrt());
    assert!(
        (ours - by_hand).abs() < 0.25 * ours.max(by_hand),
        "the loops do not do the same work: root mean square speeds of {ours} and {by_hand} rad/s"
    );
}

/// The bare dynamics for every number of environments.
pub(crate) fn bare(envs: &[usize], timing: Timing, report: &mut dyn FnMut(Line)) {
    for &count in envs {
        if count >= 32 {
            bare_f64(count, timing, report);
            bare_f32(count, timing, report);
        }
    }
}

/// How time grows with environments and with steps, and how long a large graph takes.
pub(crate) fn growth(timing: Timing, report: &mut dyn FnMut(Line)) -> anyhow::Result<()> {
    let case = &cases()[0];
    let graph = case.graph()?;
    for seconds in [5, 10, 20, 40, 80] {
        let tables = compiled(&graph, seconds)?;
        let (steps, taken) = rollouts(case, &graph, &tables, 128, Precision::DoubleLanes, timing)?;
        let name = format!("pendulum, growth with steps: {seconds} s");
        report(Line::throughput(OURS, name, "f64", 128, steps, &taken));
    }
    let tables = compiled(&graph, SECONDS)?;
    for count in (0..=13).map(|power| 1 << power) {
        let precision = if count < 16 { Precision::Double } else { Precision::DoubleLanes };
        let (steps, taken) = rollouts(case, &graph, &tables, count, precision, timing)?;
        let name = "pendulum, growth with environments".to_owned();
        report(Line::throughput(OURS, name, "f64", count, steps, &taken));
    }

    let nodes = 200;
    let graph = large(nodes)?;
    let name =
        |what: &str| format!("graph of {nodes} nodes and {} connections, {what}", graph.connections().len());
    let start = Instant::now();
    let episodes = generate_many(&graph, 1, 10_000_000_000, EPISODES)?;
    let seconds = start.elapsed().as_secs_f64();
    report(Line::value(OURS, name("generating 20 episodes of 10 s"), seconds, "s"));
    let start = Instant::now();
    let tables = compile(&graph, &episodes, &CompileOptions::default())?;
    report(Line::value(OURS, name("compiling them"), start.elapsed().as_secs_f64(), "s").detail(format!(
        "{} slots, efficiency {:.3}, {} steps of nodes",
        tables.slots.len(),
        tables.efficiency(),
        tables.executed
    )));
    let batch = Batch::new(&graph, &tables, 1)?;
    let work = batch.environments(128);
    let start = Instant::now();
    let rollout = batch.rollout(&work, Precision::DoubleLanes, &[])?;
    let seconds = start.elapsed().as_secs_f64();
    assert!(rollout.states.iter().flatten().all(|value| value.is_finite()), "the large graph runs away");
    report(Line::value(OURS, name("running 128 environments"), seconds, "s").detail(format!(
        "{:.1} M node steps/s",
        tables.executed as f64 / tables.episodes as f64 * 128.0 / seconds / 1e6
    )));
    Ok(())
}
