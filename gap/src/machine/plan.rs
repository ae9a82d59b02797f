//! What each sensitivity along a step is made of. Most of a machine's states do not depend on most others, and what is
//! zero throughout costs nothing.

use parallax_model::Scalar;

use super::columns::Columns;
use super::tape::Entry;
use super::{Equation, Row};

/// The products behind the derivatives of a field, for sensitivities of which some are known to be zero.
#[derive(Clone, Debug)]
pub(super) struct Plan {
    before: Vec<Columns>,
    width: usize,
    /// What can differ from zero after the step, state by state.
    pub(super) after: Vec<Columns>,
    entries: Vec<Sum>,
    terms: Vec<Term>,
}

/// One sensitivity of a rate of change: a sum of terms and a derivative by θ.
#[derive(Clone, Copy, Debug)]
struct Sum {
    /// Where it is among the sensitivities, states × columns.
    at: u32,
    /// End of the terms whose factor is one.
    ones: u32,
    /// End of all terms.
    end: u32,
    theta: Option<Entry>,
}

/// A factor from the tape times a sensitivity.
#[derive(Clone, Copy, Debug)]
struct Term {
    slot: u32,
    from: u32,
}

impl Plan {
    /// Whether it is made for these sensitivities.
    pub(super) fn fits(&self, before: &[Columns], width: usize) -> bool {
        self.width == width && self.before == before
    }

    /// The plan for rates of change of which `timed` columns come through commands and times as well.
    pub(super) fn new(
        equation: &Equation,
        before: &[Columns],
        seeds: usize,
        width: usize,
        timed: &[usize],
    ) -> Self {
        let rows = &equation.rows;
        let mut after = before.to_vec();
        if width > seeds {
            for (live, row) in after.iter_mut().zip(rows) {
                row.by_theta.iter().for_each(|(j, _)| live.insert(seeds + j));
                timed.iter().for_each(|j| live.insert(seeds + j));
            }
        }
        // Several stages pass on what the first one found.
        let mut grew = true;
        while grew {
            grew = false;
            for (i, row) in rows.iter().enumerate() {
                for (state, _) in &row.by_state {
                    let from = after[*state];
                    grew |= after[i].extend(&from);
                }
            }
        }
        let (mut entries, mut terms) = (Vec::new(), Vec::new());
        for (i, (live, row)) in after.iter().zip(rows).enumerate() {
            for column in live.iter() {
                let from = |state: usize| (state * width + column) as u32;
                let factors = || row.by_state.iter().filter(|(state, _)| after[*state].contains(column));
                terms.extend(
                    factors()
                        .filter(|(_, entry)| *entry == Entry::One)
                        .map(|(state, _)| Term { slot: 0, from: from(*state) }),
                );
                let ones = terms.len() as u32;
                terms.extend(factors().filter_map(|(state, entry)| match entry {
                    Entry::Slot(slot) => Some(Term { slot: *slot, from: from(*state) }),
                    Entry::One => None,
                }));
                let theta = column.checked_sub(seeds).and_then(|j| theta_of(row, j));
                entries.push(Sum { at: from(i), ones, end: terms.len() as u32, theta });
            }
        }
        Plan { before: before.to_vec(), width, after, entries, terms }
    }

    /// Calls `to` with each sensitivity of the rates of change and where it belongs.
    #[inline(always)]
    pub(super) fn slopes<T: Scalar>(&self, slots: &[T], from: &[T], mut to: impl FnMut(usize, T)) {
        let (zero, one) = (T::constant(0.0), T::constant(1.0));
        let mut next = 0;
        for sum in &self.entries {
            let mut value = match sum.theta {
                None => zero,
                Some(Entry::One) => one,
                Some(Entry::Slot(slot)) => slots[slot as usize],
            };
            for term in &self.terms[next..sum.ones as usize] {
                value += from[term.from as usize];
            }
            for term in &self.terms[sum.ones as usize..sum.end as usize] {
                value += slots[term.slot as usize] * from[term.from as usize];
            }
            next = sum.end as usize;
            to(sum.at as usize, value);
        }
    }
}

fn theta_of(row: &Row, j: usize) -> Option<Entry> {
    row.by_theta.iter().find(|(k, _)| *k == j).map(|(_, entry)| *entry)
}
