//! Operations in batches of one kind: a processor that has chosen what to do does it for all that are ready.

use parallax_model::Scalar;
use parallax_model::program::{Binary, Compare, Unary};

/// An operation on slots. Masks are numbers: 1 where it holds, 0 where it does not. Constants are their bits, so that
/// equal steps can be found again.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) enum Step {
    Constant(u64),
    Unary(Unary, u32),
    Binary(Binary, u32, u32),
    Powi(u32, i32),
    Compare(Compare, u32, u32),
    Select(u32, u32, u32),
}

/// What an operation does, whatever its operands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Constant(u64),
    Unary(Unary),
    Binary(Binary),
    Powi(i32),
    Compare(Compare),
    Select,
}

impl Step {
    fn kind(&self) -> Kind {
        match *self {
            Step::Constant(bits) => Kind::Constant(bits),
            Step::Unary(f, _) => Kind::Unary(f),
            Step::Binary(f, ..) => Kind::Binary(f),
            Step::Powi(_, exponent) => Kind::Powi(exponent),
            Step::Compare(f, ..) => Kind::Compare(f),
            Step::Select(..) => Kind::Select,
        }
    }

    /// What it works on; what it has fewer of is repeated.
    pub(super) fn operands(&self) -> Option<[u32; 3]> {
        match *self {
            Step::Constant(_) => None,
            Step::Unary(_, a) | Step::Powi(a, _) => Some([a; 3]),
            Step::Binary(_, a, b) | Step::Compare(_, a, b) => Some([a, b, b]),
            Step::Select(mask, a, b) => Some([mask, a, b]),
        }
    }
}

/// Operations in the order in which they run.
#[derive(Clone, Debug, Default)]
pub(super) struct Batches {
    batches: Vec<Batch>,
    /// Three operands and where the result goes.
    slots: Vec<[u32; 4]>,
}

#[derive(Clone, Copy, Debug)]
struct Batch {
    kind: Kind,
    /// End among the slots.
    end: usize,
}

impl Batches {
    /// Adds an operation at the end.
    pub(super) fn push(&mut self, step: Step, out: u32) {
        let [a, b, c] = step.operands().unwrap_or_default();
        self.slots.push([a, b, c, out]);
        let (kind, end) = (step.kind(), self.slots.len());
        match self.batches.last_mut().filter(|batch| batch.kind == kind) {
            Some(batch) => batch.end = end,
            None => self.batches.push(Batch { kind, end }),
        }
    }

    /// Runs the operations.
    #[inline(always)]
    pub(super) fn run<T: Scalar>(&self, slots: &mut [T]) {
        let (zero, one) = (T::constant(0.0), T::constant(1.0));
        let mut first = 0;
        for batch in &self.batches {
            let all = &self.slots[first..batch.end];
            first = batch.end;
            // A macro, since a function that is passed on is compiled by itself.
            macro_rules! each {
                (|$a:ident, $b:ident, $c:ident| $result:expr) => {
                    for [a, b, c, out] in all {
                        let ($a, $b, $c) = (slots[*a as usize], slots[*b as usize], slots[*c as usize]);
                        slots[*out as usize] = $result;
                    }
                };
                (|$a:ident, $b:ident| $result:expr) => {
                    for [a, b, _, out] in all {
                        let ($a, $b) = (slots[*a as usize], slots[*b as usize]);
                        slots[*out as usize] = $result;
                    }
                };
                (|$a:ident| $result:expr) => {
                    for [a, _, _, out] in all {
                        let $a = slots[*a as usize];
                        slots[*out as usize] = $result;
                    }
                };
            }
            match batch.kind {
                Kind::Constant(bits) => {
                    for [.., out] in all {
                        slots[*out as usize] = T::constant(f64::from_bits(bits));
                    }
                }
                Kind::Binary(Binary::Add) => each!(|a, b| a + b),
                Kind::Binary(Binary::Sub) => each!(|a, b| a - b),
                Kind::Binary(Binary::Mul) => each!(|a, b| a * b),
                Kind::Binary(f) => each!(|a, b| f.apply(a, b)),
                Kind::Unary(f) => each!(|a| f.apply(a)),
                Kind::Powi(exponent) => each!(|a| a.powi(exponent)),
                Kind::Compare(f) => each!(|a, b| T::select(f.apply(a, b), one, zero)),
                Kind::Select => each!(|mask, then, other| T::select(mask.eq(zero), other, then)),
            }
        }
    }
}

/// The order of operations that makes few batches: always the kind of which most are ready. `nodes` are the operations
/// in an order in which they could run; `step` gives one, with operands that are nodes or known before.
pub(super) fn order(nodes: &[usize], step: impl Fn(usize) -> Step) -> Vec<usize> {
    let last = nodes.iter().max().map_or(0, |last| last + 1);
    let mut own = vec![false; last];
    nodes.iter().for_each(|node| own[*node] = true);
    let mut waiting = vec![0; last];
    let mut users: Vec<Vec<usize>> = vec![Vec::new(); last];
    let mut ready: Vec<(Kind, Vec<usize>)> = Vec::new();
    let put = |ready: &mut Vec<(Kind, Vec<usize>)>, node: usize| {
        let kind = step(node).kind();
        match ready.iter_mut().find(|(of, _)| *of == kind) {
            Some((_, list)) => list.push(node),
            None => ready.push((kind, vec![node])),
        }
    };
    for &node in nodes {
        for operand in step(node).operands().into_iter().flatten() {
            let operand = operand as usize;
            if operand < last && own[operand] {
                waiting[node] += 1;
                users[operand].push(node);
            }
        }
        if waiting[node] == 0 {
            put(&mut ready, node);
        }
    }
    let mut ordered = Vec::with_capacity(nodes.len());
    // Of equally many the kind that was ready first, so that the order is always the same.
    while let Some(best) = (0..ready.len()).rev().max_by_key(|k| ready[*k].1.len()) {
        let mut next = 0;
        // What becomes ready on the way and is of the same kind goes with them.
        while let Some(&node) = ready[best].1.get(next) {
            next += 1;
            ordered.push(node);
            for &user in &users[node] {
                waiting[user] -= 1;
                if waiting[user] == 0 {
                    put(&mut ready, user);
                }
            }
        }
        ready.remove(best);
    }
    ordered
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_order_is_complete_and_keeps_what_depends_behind() {
        let steps = [
            Step::Binary(Binary::Mul, 100, 101),
            Step::Unary(Unary::Sin, 0),
            Step::Binary(Binary::Mul, 101, 102),
            Step::Binary(Binary::Add, 0, 2),
            Step::Binary(Binary::Mul, 2, 2),
            Step::Binary(Binary::Add, 1, 3),
        ];
        let ordered = order(&[0, 1, 2, 3, 4, 5], |node| steps[node]);
        assert_eq!(ordered, [0, 2, 4, 1, 3, 5]);
    }
}
