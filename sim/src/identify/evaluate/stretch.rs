//! Parts of recordings that run by themselves: whole ones, or the pieces into which they are cut.

use std::ops::Range;

use parallax_model::fit::View;

use super::Evaluator;
use crate::batch::{Number, Passes, Place, States};
use crate::identify::problem::Problem;
use crate::identify::simulators::longest;

/// A part of a recording.
#[derive(Debug, Clone)]
pub(super) struct Stretch {
    pub(super) episode: usize,
    /// Its number within the recording.
    pub(super) piece: usize,
    pub(super) passes: Passes,
    /// Per output, the steps among which those are that count.
    pub(super) steps: Vec<Range<usize>>,
}

/// Recordings as they are looked at: `[episode][piece]`.
#[derive(Debug, Clone)]
pub(super) struct Stretches {
    pub(super) all: Vec<Stretch>,
    pub(super) pieces: usize,
    pub(super) tightness: f64,
}

/// The numbers with which a cut piece begins.
#[derive(Debug, Clone)]
pub(super) struct Carried {
    /// Where they stand.
    pub(super) places: Vec<Place>,
    /// About how far each spreads over a recording.
    pub(super) scales: Vec<f64>,
    /// How long it takes, s, until all that is compared comes from after a piece's beginning; absent: never.
    pub(super) settles: Option<f64>,
}

/// Pieces are no shorter than so many times the time in which they settle.
const SETTLED: f64 = 4.0;
/// Pieces are as long as this many values of the output that has the most, if they settle in that time.
const VALUES: f64 = 32.0;

impl Carried {
    /// How many numbers there are.
    pub(super) fn len(&self) -> usize {
        self.places.len()
    }

    /// Them, in one block of a group.
    pub(super) fn of<T: Number>(&self, states: &States<'_, '_, T>, block: usize) -> impl Iterator<Item = T> {
        self.places.iter().map(move |place| match *place {
            Place::State { node, leaf } => states.block(node, block)[leaf],
            _ => T::constant(f64::NAN),
        })
    }
}

/// How long it takes until nothing of what is compared comes from before a cut. A computed node that sends to another one by
/// a connection does so from its state, but what it has sent before the cut is lost: that is made up for only where the
/// receiver neither carries a state nor sends on to one that does.
pub(super) fn settles(problem: &Problem, carriers: &[usize]) -> Option<f64> {
    let graph = &problem.graph;
    let computed = |node: usize| !problem.given.iter().any(|given| given.node == graph.nodes()[node].name);
    let mut total = 0.0;
    for (index, connection) in graph.connections().iter().enumerate() {
        if !computed(connection.from) {
            continue;
        }
        if carriers.contains(&connection.to)
            || !graph.connections().iter().all(|next| next.from != connection.to || !computed(next.to))
        {
            return None;
        }
        let edge = &graph.spec().connections[index];
        let hidden = problem.specification().delays.iter().filter(|delay| {
            delay.from == edge.from
                && delay.to == edge.to
                && delay.port.as_deref().is_none_or(|port| edge.port() == port)
        });
        let delay = hidden.map(longest).fold(edge.delay.expected(), f64::max);
        let period = 1.0 / graph.spec().nodes[connection.from].rate;
        total = f64::max(total, delay + (connection.window as f64 + 2.0) * period);
    }
    Some(total)
}

impl Evaluator<'_> {
    /// Into how many pieces the recordings are best cut: 1 where pieces would not run by themselves.
    pub fn pieces(&self) -> usize {
        let (Some(settles), false) = (self.carried.settles, self.carried.places.is_empty()) else { return 1 };
        let problem = self.problem;
        let of = |episode: usize| {
            let [from, until, _] = problem.spans[episode];
            let samples = problem.outputs.iter().map(|output| {
                (0..output.times[episode].len())
                    .filter(|&step| output.counts(episode, step, from, until))
                    .count()
            });
            let values = samples.max().unwrap_or(0) as f64;
            let length = until - from;
            (values / VALUES).min(length / (SETTLED * settles).max(f64::MIN_POSITIVE)).floor()
        };
        let least = (0..problem.episodes).map(of).fold(f64::INFINITY, f64::min);
        (least as usize).clamp(1, 64)
    }

    /// The parts of the recordings that a view shows.
    pub(super) fn stretches(&self, view: View) -> Stretches {
        let problem = self.problem;
        let pieces = view.pieces.max(1);
        let settles = self.carried.settles.unwrap_or(0.0);
        let mut all = Vec::with_capacity(problem.episodes * pieces);
        for episode in 0..problem.episodes {
            let from = problem.spans[episode][0];
            // Pieces are of all the data.
            let until = problem.until(episode, if pieces > 1 { 1.0 } else { view.share });
            let border = |piece: usize| from + (until - from) * piece as f64 / pieces as f64;
            let begin =
                |piece: usize| if piece == 0 { 0 } else { self.batch.pass_at(episode, border(piece)) };
            for piece in 0..pieces {
                let last = piece + 1 == pieces;
                let first = begin(piece);
                let time = Range {
                    start: if piece == 0 { from } else { border(piece) + settles },
                    end: if last { until } else { border(piece + 1) + settles },
                };
                // The pass in which a step of that time runs is the one after.
                let end = self.batch.pass_at(episode, time.end) + 1;
                let cut = if last { end } else { begin(piece + 1) };
                let steps = problem.outputs.iter().map(|output| {
                    let times = &output.times[episode];
                    times.partition_point(|t| *t < time.start)..times.partition_point(|t| *t < time.end)
                });
                let steps = steps.collect();
                all.push(Stretch { episode, piece, passes: Passes { first, cut, end }, steps });
            }
        }
        Stretches { all, pieces, tightness: view.tightness }
    }

    /// How many numbers a point has, states at the cuts included.
    pub(super) fn width(&self, stretches: &Stretches) -> usize {
        let cuts = self.problem.episodes * (stretches.pieces - 1);
        self.problem.coordinates.len() + cuts * self.carried.len()
    }

    /// Where the numbers begin with which a stretch begins; none for the first of a recording.
    pub(super) fn first_of(&self, stretches: &Stretches, stretch: &Stretch) -> Option<usize> {
        let cut = stretch.piece.checked_sub(1)?;
        let cuts = stretch.episode * (stretches.pieces - 1) + cut;
        Some(self.problem.coordinates.len() + cuts * self.carried.len())
    }

    /// The numbers of a point that a stretch feels.
    pub(super) fn columns(&self, stretches: &Stretches, stretch: &Stretch) -> Vec<usize> {
        use crate::identify::coordinate::Sort;
        let coordinates = self.problem.coordinates.iter().enumerate().filter(|(_, coordinate)| {
            let own = coordinate.recording.is_none_or(|recording| recording == stretch.episode);
            own && (coordinate.sort != Sort::State || stretch.piece == 0)
        });
        let states = self.first_of(stretches, stretch).map(|first| first..first + self.carried.len());
        coordinates.map(|(index, _)| index).chain(states.into_iter().flatten()).collect()
    }
}
