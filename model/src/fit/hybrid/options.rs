//! Settings of the hybrid, and their defaults.

use serde::{Deserialize, Serialize};

/// Settings of [`Hybrid`](super::Hybrid).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct HybridOptions {
    /// Points drawn evenly from the box before the evolution, which begins at the best of them. As leaders and shooters, in
    /// the second round twice as many, in the third three times, and so on.
    pub scouts: usize,
    /// Points in a generation of the evolution; absent: 8 for each parameter, at least 64.
    pub population: Option<usize>,
    /// Generations of the evolution.
    pub generations: usize,
    /// First step size of the evolution, in widths of the box.
    pub sigma: f64,
    /// The shares of the data that count, one after the other; scouts and evolution see the first. Where the loss aimed at is
    /// known, shares between them are taken as well where a step is too large.
    pub shares: Vec<f64>,
    /// From this share of the data on, all of them count in pieces.
    pub enough: f64,
    /// Into how many pieces all of the data are cut; 1: not at all. Absent: whoever evaluates says, who knows the machine.
    pub pieces: Option<usize>,
    /// How tightly the pieces are held together, one after the other: inverse standard deviations in units of the states'
    /// own spread.
    pub tightness: Vec<f64>,
    /// How many of the refined leaders go on to all of the data in pieces.
    pub shooters: usize,
    /// How many of the evolution's leaders, and twice as many of the scouts, Gauss–Newton refines at first; on the second
    /// share as many as leaders, on each further one half as many, and at least two.
    pub leaders: usize,
    /// Most Gauss–Newton steps on each share.
    pub iterations: usize,
    /// A gain in the loss that is not worth a step.
    pub gain: f64,
    /// How often everything starts again where the target is not reached.
    pub restarts: usize,
    /// The loss aimed at, over all of the data. Absent: it starts again until two rounds end at the same loss.
    pub target: Option<f64>,
    /// How many rounds have to end at the same loss before it ends; absent: one where a loss is aimed at, else two.
    pub alike: Option<usize>,
    /// Parameters, by their places, from one end of the box to the other of which it looks again where it would end: on the way
    /// the others follow as its model says. For those in which the loss jumps, such as a delay by which a message comes in
    /// time or not.
    pub swept: Vec<usize>,
    /// Seed of all it draws.
    pub seed: u64,
}

impl Default for HybridOptions {
    fn default() -> Self {
        Self {
            scouts: 1024,
            population: None,
            generations: 12,
            sigma: 0.2,
            shares: vec![0.05, 0.1, 0.2, 0.4, 0.7, 1.0],
            enough: 0.4,
            pieces: None,
            tightness: vec![100.0, 1e3, 1e4],
            shooters: 1,
            leaders: 4,
            iterations: 12,
            gain: 0.1,
            restarts: 8,
            target: None,
            alike: None,
            swept: Vec::new(),
            seed: 1,
        }
    }
}
