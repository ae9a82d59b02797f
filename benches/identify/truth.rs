//! What both machines share: how a recording is made of a schedule and of what the machine does, and how an answer is
//! held against the truth.

use std::f64::consts::TAU;

use parallax_runtime::recording::{MessageRecord, Recording};
use parallax_runtime::registry::Registry;
use parallax_runtime::time::to_seconds;
use parallax_sim::identify::{Identified, Specification};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

/// A machine's recording, what is asked of it, and what nobody else knows.
pub(crate) struct Truth {
    pub(crate) recording: Recording,
    pub(crate) registry: Registry,
    pub(crate) specification: Specification,
    /// Root mean square of the noise that was really added, per output.
    pub(crate) floor: Vec<f64>,
    /// Sums of delays that the data can determine, by their names, with their true values, s.
    pub(crate) delays: Vec<(Vec<&'static str>, f64)>,
    /// Standard deviations of the delays that are another one for every message, s.
    pub(crate) spreads: Vec<(&'static str, f64)>,
    /// How far apart two humps of a delay lie, s, and the later one's share; none where there is one.
    pub(crate) humps: Option<(f64, f64)>,
}

/// How far the errors of all outputs are from the noise, root mean square in units of it.
pub(crate) fn share(found: &Identified, floor: &[f64]) -> f64 {
    let (mut square, mut samples) = (0.0, 0.0);
    for (score, floor) in found.outputs.iter().zip(floor) {
        let n = score.samples as f64;
        square += n * (score.fitted / floor).powi(2);
        samples += n;
    }
    (square / samples).sqrt()
}

/// A delay, or the sum of several, with its standard deviation.
pub(crate) fn delay(found: &Identified, names: &[&str]) -> (f64, Option<f64>) {
    let (value, std) = found.sum(names).expect("it was asked for");
    // A standard deviation of 20 ms says nothing of a delay between 0 and 50 ms.
    (value, (std < 0.02).then_some(std))
}

/// Sets what a node sent.
pub(crate) fn send(recording: &mut Recording, node: &str, payload: impl Fn(usize) -> Vec<f64>) {
    let track = recording.nodes.iter_mut().find(|track| track.name == node).expect("a node of the graph");
    let steps = track.steps.iter().enumerate();
    track.messages = steps
        .map(|(k, step)| MessageRecord {
            seq: step.seq,
            sent: step.end,
            payload: payload(k),
            data: Default::default(),
        })
        .collect();
}

/// When a node's messages were sent and what they held, s.
pub(crate) fn sent(recording: &Recording, node: &str) -> Vec<(f64, Vec<f64>)> {
    let track = recording.node(node).expect("a node of the graph");
    track.messages.iter().map(|message| (to_seconds(message.sent), message.payload.clone())).collect()
}

/// When a node's steps started, s.
pub(crate) fn starts(recording: &Recording, node: &str) -> Vec<f64> {
    let track = recording.node(node).expect("a node of the graph");
    track.steps.iter().map(|step| to_seconds(step.start)).collect()
}

/// A standard normal number.
pub(crate) fn normal(random: &mut ChaCha8Rng) -> f64 {
    let (u, v): (f64, f64) = (random.random_range(f64::MIN_POSITIVE..1.0), random.random_range(0.0..TAU));
    (-2.0 * u.ln()).sqrt() * v.cos()
}
