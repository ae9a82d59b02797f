//! The pendulum with 50 ms from a picture to the command that follows from it, and what estimates of it are worth. Used by
//! the tests of the compensation and by its bench.

#![allow(dead_code, clippy::unwrap_used, reason = "each takes its part; what cannot go on has failed")]

use std::f64::consts::{PI, TAU};

use parallax_nodes::pendulum::{self, hidden::HiddenEffect};
use parallax_runtime::delay::Delay;
use parallax_runtime::graph::{ConnectionSpec, GraphSpec, JitterPolicy, NodeSpec};
use parallax_runtime::node::Parameters;
use parallax_runtime::recording::Recording;
use parallax_runtime::registry::Registry;
use parallax_runtime::time::{SECOND, to_seconds};
use serde_json::{Value, json};

/// From what the camera sees to the estimator's step, about, and from there to the motor, s.
pub(crate) const SEEN: f64 = 0.02;
pub(crate) const AHEAD: f64 = 0.03;
/// Of that, what no stamp shows.
pub(crate) const HIDDEN: f64 = 0.015;

pub(crate) fn parameters(value: Value) -> Parameters {
    value.as_object().unwrap().clone()
}

/// The pendulum's graph with 50 ms from a picture to the command that follows from it, and several estimators beside each
/// other: `estimator`, whose estimates the agent gets, `filtered`, which does not predict, and `system`, of the graph's own plant.
pub(crate) fn graph() -> GraphSpec {
    let mut spec = pendulum::graph();
    // A camera and a computer that take longer than a period would fall behind more and more: the time is lost on the wires,
    // which hold their messages back in real time, too.
    let late = |mean: f64| Delay::Normal { mean, std: 1e-3 };
    for connection in &mut spec.connections {
        match (connection.from.as_str(), connection.to.as_str()) {
            ("camera", "estimator") => connection.delay = late(SEEN - 3e-3),
            ("agent", "motor") => connection.delay = late(AHEAD - HIDDEN - 3e-3),
            _ => continue,
        }
        connection.jitter = JitterPolicy::Buffer;
    }
    let compensated = json!({ "motor_delay": HIDDEN, "ahead": AHEAD });
    let estimator = spec.node_mut("estimator").unwrap();
    estimator.kind = "pendulum/ukf".into();
    estimator.parameters = parameters(compensated.clone());
    let mut filtered = compensated;
    filtered["predict"] = false.into();
    add(&mut spec, "filtered", "pendulum/ukf", filtered);
    add(
        &mut spec,
        "system",
        "estimator",
        json!({
            "delay": { "motor": HIDDEN },
            "ahead": AHEAD,
            "initial": { "q": PI, "v": 0.0 },
            "std": { "q": 2.0, "v": 5.0 },
            "disturbance": { "v": 2.0 },
            "circular": { "q": TAU },
        }),
    );
    spec
}

/// One more estimator, with the inputs of the first.
fn add(spec: &mut GraphSpec, name: &str, kind: &str, value: Value) {
    let mut node = NodeSpec::new(name, kind, 100.0);
    node.parameters = parameters(value);
    spec.nodes.push(node);
    let feeding: Vec<ConnectionSpec> =
        spec.connections.iter().filter(|connection| connection.to == "estimator").cloned().collect();
    spec.connections
        .extend(feeding.into_iter().map(|connection| ConnectionSpec { to: name.into(), ..connection }));
}

pub(crate) fn kinds() -> Registry {
    let kinds = pendulum::kinds(Registry::new(), HiddenEffect::Delay { delay: HIDDEN });
    kinds.with("estimator", parallax_nodes::estimator::kind())
}

fn difference(a: f64, b: f64) -> f64 {
    (a - b + PI).rem_euclid(TAU) - PI
}

/// What the world was like at a time (s), between its messages.
fn truth(recording: &Recording, time: f64) -> Option<[f64; 2]> {
    let world = recording.node("world")?;
    let after = world.messages.partition_point(|message| message.payload[2] < time);
    let (a, b) = (&world.messages.get(after.checked_sub(1)?)?.payload, &world.messages.get(after)?.payload);
    let share = (time - a[2]) / (b[2] - a[2]);
    // Between its stamps the world moves by its speed; the angle is a cubic there.
    let h = b[2] - a[2];
    let (s2, s3) = (share * share, share * share * share);
    let angle = (2.0 * s3 - 3.0 * s2 + 1.0) * a[0]
        + (s3 - 2.0 * s2 + share) * h * a[1]
        + (3.0 * s2 - 2.0 * s3) * b[0]
        + (s3 - s2) * h * b[1];
    Some([angle, a[1] + share * (b[1] - a[1])])
}

/// Mean squares of the errors of angle and speed, at the times at which the estimates act.
pub(crate) fn errors(recording: &Recording, node: &str) -> [f64; 2] {
    let track = recording.node(node).unwrap();
    let mut sums = [0.0; 2];
    let mut count = 0.0;
    for (message, step) in track.messages.iter().zip(&track.steps) {
        let acts = to_seconds(step.start) + AHEAD;
        let Some(truth) = truth(recording, acts).filter(|_| step.start > SECOND) else { continue };
        sums[0] += difference(message.payload[0], truth[0]).powi(2);
        sums[1] += (message.payload[1] - truth[1]).powi(2);
        count += 1.0;
    }
    sums.map(|sum: f64| sum / count)
}
