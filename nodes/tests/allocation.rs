//! The step path allocates nothing: neither the pendulum's nodes nor the evaluation of a program.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use parallax_model::Dual;
use parallax_model::program::Workspace;
use parallax_model::trace::trace_model;
use parallax_nodes::models::quadrotor::Quadrotor;
use parallax_nodes::policy::Policy;
use parallax_nodes::{pendulum, registry};
use parallax_runtime::node::{Consumed, InputWindow, Step};
use parallax_runtime::time::SECOND;

/// Counts this thread's allocations.
struct Counting;

thread_local! {
    static COUNT: Cell<usize> = const { Cell::new(0) };
}

// SAFETY: every call is passed on to the system's allocator unchanged; the counter is a plain cell without a
// destructor, so touching it never allocates.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        COUNT.with(|count| count.set(count.get() + 1));
        // SAFETY: the caller keeps `GlobalAlloc::alloc`'s contract.
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller keeps `GlobalAlloc::dealloc`'s contract, and the memory came from `System`.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

fn allocations(run: impl FnOnce()) -> usize {
    let before = COUNT.with(Cell::get);
    run();
    COUNT.with(Cell::get) - before
}

#[test]
fn the_counter_counts() {
    assert_eq!(allocations(|| drop(std::hint::black_box(vec![1.0]))), 1);
}

#[test]
fn steps_of_the_pendulums_nodes_allocate_nothing() {
    let graph = pendulum::graph().validate(&registry()).expect("valid");
    for (index, plan) in graph.nodes().iter().enumerate() {
        let mut node = graph.build(index, 1).expect("builds");
        let mut inputs: Vec<InputWindow> = plan
            .inputs
            .iter()
            .map(|&connection| &graph.connections()[connection])
            .map(|plan| InputWindow::new(&plan.port, plan.leaves, plan.window))
            .collect();
        let mut output = vec![0.0; plan.kind.output().leaves.len()];
        for tick in 0..100u64 {
            let time = (tick as i64 + 1) * SECOND / 100;
            for input in &mut inputs {
                input.clear(0);
                let port =
                    plan.kind.inputs().iter().find(|port| port.name == input.port()).expect("declared");
                let leaves = vec![0.01 * tick as f64; port.layout.leaves.len()];
                input.push(Consumed { seq: Some(tick), sent: time - 1, received: time - 1 }, &leaves);
            }
            let step = Step::new(tick, time, time, &inputs);
            let count = allocations(|| node.step_into(&step, &mut output).expect("a step"));
            assert_eq!(count, 0, "step {tick} of `{}`", plan.name);
        }
    }
}

/// Estimators take their memory at the first step, late readings and sixteen commands in flight included.
#[test]
fn steps_of_estimators_allocate_nothing() {
    let sends = serde_json::json!({
        "message": "pendulum/Estimate", "leaves": ["angle", "speed", "stamp"], "values": ["q", "v", "stamp"],
    });
    let system = serde_json::json!({
        "initial": { "q": 3.1, "v": 0.0 }, "std": { "q": 2.0, "v": 5.0 }, "disturbance": { "v": 2.0 }, "ahead": 0.03,
        "reorder": 2, "sends": sends, "scaling": { "alpha": 0.1, "beta": 2.0, "kappa": 0.0 },
    });
    let ukf = serde_json::json!({ "ahead": 0.03, "reorder": 2 });
    for (kind, parameters) in [("pendulum/ukf", ukf), ("estimator", system)] {
        let mut spec = pendulum::graph();
        let estimator = spec.node_mut("estimator").expect("it has one");
        estimator.kind = kind.into();
        estimator.parameters = serde_json::from_value(parameters).expect("a table");
        let graph = spec.validate(&registry()).expect("valid");
        let mut node = graph.build(graph.index("estimator").expect("there"), 1).expect("builds");
        let mut output = [0.0; 3];
        let (mut camera, mut motor) = (InputWindow::new("camera", 2, 1), InputWindow::new("motor", 1, 16));
        for tick in 1..100u64 {
            let now = tick as i64 * SECOND / 100;
            camera.clear(0);
            // Every third picture is older than the one before.
            let seen = now as f64 * 1e-9 - if tick % 3 == 0 { 0.025 } else { 0.01 };
            camera.push(Consumed { seq: Some(tick), sent: now, received: now }, &[3.1, seen]);
            motor.clear(0);
            for back in (0..16).rev() {
                let sent = now - back * SECOND / 100;
                motor.push(Consumed { seq: Some(tick), sent, received: sent }, &[0.5]);
            }
            let inputs = [camera.clone(), motor.clone()];
            let step = Step::new(tick, now, now, &inputs);
            let count = allocations(|| node.step_into(&step, &mut output).expect("a step"));
            assert!(tick == 1 || count == 0, "step {tick} of `{kind}`: {count}");
            assert!(output[0].is_finite() && (output[2] - now as f64 * 1e-9 - 0.03).abs() < 1e-9);
        }
    }
}

#[test]
fn steps_of_a_policy_allocate_nothing() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/policy/policy.safetensors");
    let mut policy =
        Policy::<pendulum::Estimate, pendulum::Voltage>::read(path.as_ref()).expect("the fixture");
    for leaves in [[0.1, 0.2, 0.3], [-3.0, 20.0, 1.0]] {
        assert_eq!(allocations(|| drop(policy.act(&leaves))), 0);
    }
}

#[test]
fn evaluating_a_program_allocates_on_the_first_call_only() {
    let program = trace_model::<Quadrotor>();
    let inputs = vec![Dual::<8>::from_value(0.5); program.inputs().len()];
    let mut outputs = vec![Dual::default(); program.outputs().len()];
    let mut workspace = Workspace::new();
    assert!(allocations(|| program.evaluate(&inputs, &mut workspace, &mut outputs)) > 0);
    assert_eq!(allocations(|| program.evaluate(&inputs, &mut workspace, &mut outputs)), 0);
}
