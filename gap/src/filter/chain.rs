//! What becomes of a small deviation from the filter's walk: carried on by each step, forgotten by each reading, and added to
//! by commands that are others than those of the walk. To first order, so that any number of deviations costs one walk.

use parallax_model::lanes::F64x16;

use crate::simulator::{At, Event, Gradient, Motion, Run};

/// The deviations along one stretch, step by step.
#[derive(Clone, Debug, Default)]
pub(crate) struct Chain {
    /// How many states there are.
    pub(crate) states: usize,
    /// What happens, in order.
    pub(crate) links: Vec<Link>,
    numbers: Vec<f64>,
}

/// One step of a chain; its numbers begin at `at`.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Link {
    /// Time passes after event `event`.
    Advance { event: usize, at: usize },
    /// A reading is compared.
    Read {
        /// The event.
        event: usize,
        /// The innovation of the walk and its variance.
        innovation: f64,
        variance: f64,
        at: usize,
    },
}

impl Chain {
    /// Along `states` states.
    pub(crate) fn new(states: usize) -> Self {
        Chain { states, ..Chain::default() }
    }

    /// Time passes after an event: the transition, row by row, and what the other command adds to each state.
    pub(crate) fn advance(
        &mut self,
        event: usize,
        transition: impl IntoIterator<Item = f64>,
        added: impl IntoIterator<Item = f64>,
    ) {
        self.links.push(Link::Advance { event, at: self.numbers.len() });
        self.numbers.extend(transition);
        self.numbers.extend(added);
    }

    /// A reading is compared: the innovation of the walk and its variance, the reading's derivatives by the states, the gain, and
    /// what the other command adds to the prediction.
    pub(crate) fn read(
        &mut self,
        event: usize,
        (innovation, variance): (f64, f64),
        by_state: impl IntoIterator<Item = f64>,
        gain: impl IntoIterator<Item = f64>,
        direct: f64,
    ) {
        self.links.push(Link::Read { event, innovation, variance, at: self.numbers.len() });
        self.numbers.extend(by_state);
        self.numbers.extend(gain);
        self.numbers.push(direct);
    }

    /// Of an advance: the transition, row by row, and what the other command adds to each state.
    pub(crate) fn transition(&self, at: usize) -> (&[f64], &[f64]) {
        let n = self.states;
        (&self.numbers[at..at + n * n], &self.numbers[at + n * n..at + n * n + n])
    }

    /// Of a reading: its derivatives by the states, the gain, and what the other command adds to the prediction.
    pub(crate) fn reading(&self, at: usize) -> (&[f64], &[f64], f64) {
        let n = self.states;
        (&self.numbers[at..at + n], &self.numbers[at + n..at + 2 * n], self.numbers[at + 2 * n])
    }
}

/// Records chains along a walk, beside a run under other commands.
pub(super) struct Probe<'a> {
    other: &'a mut dyn Run,
    motion: Motion,
    scratch: Gradient,
    direct: F64x16,
    pub(super) chains: Vec<Chain>,
}

impl<'a> Probe<'a> {
    pub(super) fn new(other: &'a mut dyn Run, states: usize, lanes: usize) -> Self {
        Probe {
            other,
            motion: Motion::default(),
            scratch: Gradient::default(),
            direct: F64x16::splat(0.0),
            chains: vec![Chain::new(states); lanes],
        }
    }

    /// Before the walk takes a step.
    pub(super) fn advance(&mut self, at: &At, motion: &Motion) {
        self.motion.clone_from(motion);
        self.other.advance_lanes(at, &mut self.motion);
    }

    /// After it.
    pub(super) fn advanced(&mut self, at: &At, motion: &Motion) {
        let n = motion.x.len();
        for (lane, chain) in self.chains.iter_mut().enumerate() {
            let Some(event) = at[lane] else { continue };
            let rows = motion.by.chunks(motion.columns.max(1)).take(n);
            let transition = rows.flat_map(|row| row[..n].iter().map(|entry| entry[lane]));
            let both = self.motion.x.iter().zip(&motion.x);
            chain.advance(event, transition, both.map(|(other, own)| other[lane] - own[lane]));
        }
    }

    /// Where the walk has predicted a reading.
    pub(super) fn compare(&mut self, at: &At, motion: &Motion, value: &F64x16) {
        let other = self.other.compare_lanes(at, motion, &mut self.scratch);
        self.direct = other - *value;
    }

    /// Where it has taken it in.
    pub(super) fn read<'b>(
        &mut self,
        at: &At,
        events: &[Event],
        (by_state, gain): (&'b [F64x16], &'b [F64x16]),
        (innovation, variance): (&F64x16, &F64x16),
    ) {
        for (lane, chain) in self.chains.iter_mut().enumerate() {
            let Some(event) = at[lane].filter(|event| events[*event].reading.is_some()) else { continue };
            let of = |all: &'b [F64x16]| all.iter().map(move |entry| entry[lane]);
            chain.read(event, (innovation[lane], variance[lane]), of(by_state), of(gain), self.direct[lane]);
        }
    }
}
