//! Evaluation on any scalar.

use super::{Function, Op, Program, Value, check::Plan};
use crate::scalar::{Inlined, Scalar};

/// Memory that evaluation needs, kept between calls so that only the first one allocates.
#[derive(Clone, Debug)]
pub struct Workspace<T: Scalar> {
    /// Frames of the functions under way, one behind the other.
    numbers: Vec<T>,
    /// As `numbers`; a value is defined in one of the two.
    masks: Vec<T::Mask>,
}

impl<T: Scalar> Workspace<T> {
    /// An empty workspace; it fits any program.
    pub fn new() -> Self {
        Self { numbers: Vec::new(), masks: Vec::new() }
    }

    fn reserve(&mut self, values: usize) {
        if self.numbers.len() < values {
            let zero = T::constant(0.0);
            self.numbers.resize(values, zero);
            self.masks.resize(values, zero.lt(zero));
        }
    }
}

impl<T: Scalar> Default for Workspace<T> {
    fn default() -> Self {
        Self::new()
    }
}

impl Program {
    /// Computes the outputs from the inputs.
    ///
    /// Inputs are in the order of [`Program::inputs`], outputs in that of [`Program::outputs`]. Only the first call
    /// with a workspace allocates; tracing always does.
    ///
    /// # Panics
    ///
    /// When `inputs` or `outputs` has another length than the program.
    pub fn evaluate<T: Scalar>(&self, inputs: &[T], workspace: &mut Workspace<T>, outputs: &mut [T]) {
        assert_eq!(inputs.len(), self.inputs.len(), "evaluate: one number for each input of the program");
        assert_eq!(outputs.len(), self.outputs.len(), "evaluate: one place for each output of the program");
        let body = self.functions.len() - 1;
        workspace.reserve(self.plans[body].stack);
        let frames = Frames { numbers: &mut workspace.numbers, masks: &mut workspace.masks };
        Machine { functions: &self.functions, plans: &self.plans }.run(body, &[inputs], frames, outputs);
    }
}

/// The free part of a workspace.
struct Frames<'a, T: Scalar> {
    numbers: &'a mut [T],
    masks: &'a mut [T::Mask],
}

#[derive(Clone, Copy)]
struct Machine<'a> {
    functions: &'a [Function],
    plans: &'a [Plan],
}

/// One run of a loaded function.
struct Run<'a, T: Scalar> {
    machine: &'a Machine<'a>,
    index: usize,
    frames: Frames<'a, T>,
    outputs: &'a mut [T],
}

impl<T: Scalar> Inlined for Run<'_, T> {
    type Output = ();
    #[inline(always)]
    fn run(self) {
        self.machine.run_operations(self.index, self.frames, self.outputs);
    }
}

impl Machine<'_> {
    /// Runs a function on the concatenation of `inputs`.
    fn run<T: Scalar>(&self, index: usize, inputs: &[&[T]], frames: Frames<'_, T>, outputs: &mut [T]) {
        let mut next = 0;
        for part in inputs {
            frames.numbers[next..next + part.len()].copy_from_slice(part);
            next += part.len();
        }
        self.run_loaded(index, frames, outputs);
    }

    /// Runs a function whose inputs are already at the start of its frame.
    fn run_loaded<T: Scalar>(&self, index: usize, frames: Frames<'_, T>, outputs: &mut [T]) {
        // Recursive, so never inlined into a kernel: it asks for the kernel's instructions by itself.
        T::compiled(Run { machine: self, index, frames, outputs });
    }

    #[inline(always)]
    fn run_operations<T: Scalar>(&self, index: usize, frames: Frames<'_, T>, outputs: &mut [T]) {
        let function = &self.functions[index];
        let (numbers, inner_numbers) = frames.numbers.split_at_mut(self.plans[index].frame);
        let (masks, inner_masks) = frames.masks.split_at_mut(self.plans[index].frame);
        let mut next = function.inputs as usize;
        for op in &function.ops {
            match op {
                Op::Constant(value) => numbers[next] = T::constant(*value),
                Op::Unary(unary, a) => numbers[next] = unary.apply(numbers[*a as usize]),
                Op::Binary(binary, a, b) => {
                    numbers[next] = binary.apply(numbers[*a as usize], numbers[*b as usize]);
                }
                Op::Powi(a, exponent) => numbers[next] = numbers[*a as usize].powi(*exponent),
                Op::Compare(compare, a, b) => {
                    masks[next] = compare.apply(numbers[*a as usize], numbers[*b as usize]);
                }
                Op::And(a, b) => masks[next] = masks[*a as usize] & masks[*b as usize],
                Op::Or(a, b) => masks[next] = masks[*a as usize] | masks[*b as usize],
                Op::Not(a) => masks[next] = !masks[*a as usize],
                Op::Select(mask, then, otherwise) => {
                    numbers[next] = T::select(
                        masks[*mask as usize],
                        numbers[*then as usize],
                        numbers[*otherwise as usize],
                    );
                }
                structured => {
                    let inner = Frames { numbers: inner_numbers, masks: inner_masks };
                    // Operands come before the results, so the two parts do not overlap.
                    let (known, results) = numbers.split_at_mut(next);
                    next += if T::STRUCTURED {
                        self.rewrite(structured, known, results)
                    } else {
                        self.unroll(structured, known, results, inner)
                    };
                    continue;
                }
            }
            next += 1;
        }
        for (output, value) in outputs.iter_mut().zip(&function.outputs) {
            *output = numbers[*value as usize];
        }
    }

    /// Runs a structured operation as a loop, without allocating. Gives the number of its results.
    fn unroll<T: Scalar>(&self, op: &Op, known: &[T], results: &mut [T], inner: Frames<'_, T>) -> usize {
        match op {
            Op::Call { function, inputs } => {
                let index = *function as usize;
                gather(known, inputs, &mut inner.numbers[..inputs.len()]);
                let count = self.functions[index].outputs.len();
                self.run_loaded(index, inner, &mut results[..count]);
                count
            }
            Op::Scan { function, length, carry, xs, captures } => {
                let (index, length) = (*function as usize, *length as usize);
                let (nc, nx) = (carry.len(), xs.len().checked_div(length).unwrap_or(0));
                let ny = self.functions[index].outputs.len() - nc;
                let (carried, ys) = results[..nc + ny * length].split_at_mut(nc);
                gather(known, carry, carried);
                for step in 0..length {
                    inner.numbers[..nc].copy_from_slice(carried);
                    gather(known, &xs[step * nx..(step + 1) * nx], &mut inner.numbers[nc..nc + nx]);
                    gather(known, captures, &mut inner.numbers[nc + nx..nc + nx + captures.len()]);
                    let frames = Frames { numbers: &mut *inner.numbers, masks: &mut *inner.masks };
                    self.run_step(index, frames, carried, &mut ys[step * ny..(step + 1) * ny]);
                }
                nc + ny * length
            }
            Op::Map { function, length, xs, captures } => {
                let (index, length) = (*function as usize, *length as usize);
                let nx = xs.len().checked_div(length).unwrap_or(0);
                let ny = self.functions[index].outputs.len();
                for step in 0..length {
                    gather(known, &xs[step * nx..(step + 1) * nx], &mut inner.numbers[..nx]);
                    gather(known, captures, &mut inner.numbers[nx..nx + captures.len()]);
                    let frames = Frames { numbers: &mut *inner.numbers, masks: &mut *inner.masks };
                    self.run_step(index, frames, &mut [], &mut results[step * ny..(step + 1) * ny]);
                }
                ny * length
            }
            _ => unreachable!("only structured operations come here"),
        }
    }

    /// Runs a loaded function once and divides its outputs into carry and ys.
    fn run_step<T: Scalar>(&self, index: usize, frames: Frames<'_, T>, carry: &mut [T], ys: &mut [T]) {
        let Frames { numbers, masks } = frames;
        // The outputs stay in the frame: they are read from there, so that no buffer is needed between.
        self.run_loaded(index, Frames { numbers: &mut *numbers, masks }, &mut []);
        let (carry_values, y_values) = self.functions[index].outputs.split_at(carry.len());
        gather(numbers, carry_values, carry);
        gather(numbers, y_values, ys);
    }

    /// Writes a structured operation into the program under trace, as the same structure.
    fn rewrite<T: Scalar>(&self, op: &Op, known: &[T], results: &mut [T]) -> usize {
        let pick = |values: &[Value]| values.iter().map(|value| known[*value as usize]).collect::<Vec<T>>();
        let fresh = |index: usize, inputs: &[&[T]], outputs: &mut [T]| {
            let mut workspace = Workspace::new();
            workspace.reserve(self.plans[index].stack);
            self.run(
                index,
                inputs,
                Frames { numbers: &mut workspace.numbers, masks: &mut workspace.masks },
                outputs,
            );
        };
        match op {
            Op::Call { function, inputs } => {
                let target = &self.functions[*function as usize];
                let count = target.outputs.len();
                T::call_values(&target.name, &pick(inputs), &mut results[..count], |xs, ys| {
                    fresh(*function as usize, &[xs], ys);
                });
                count
            }
            Op::Scan { function, length, carry, xs, captures } => {
                let (index, length, nc) = (*function as usize, *length as usize, carry.len());
                let count = nc + (self.functions[index].outputs.len() - nc) * length;
                let (carried, ys) = results[..count].split_at_mut(nc);
                carried.copy_from_slice(&pick(carry));
                let captures = pick(captures);
                T::scan_values(length, carried, &pick(xs), ys, |carry, x, y| {
                    let mut outputs = [&*carry, &*y].concat();
                    fresh(index, &[carry, x, &captures], &mut outputs);
                    carry.copy_from_slice(&outputs[..nc]);
                    y.copy_from_slice(&outputs[nc..]);
                });
                count
            }
            Op::Map { function, length, xs, captures } => {
                let (index, length) = (*function as usize, *length as usize);
                let count = self.functions[index].outputs.len() * length;
                let captures = pick(captures);
                T::map_values(length, &pick(xs), &mut results[..count], |x, y| {
                    fresh(index, &[x, &captures], y)
                });
                count
            }
            _ => unreachable!("only structured operations come here"),
        }
    }
}

#[inline]
fn gather<T: Copy>(from: &[T], values: &[Value], to: &mut [T]) {
    for (slot, value) in to.iter_mut().zip(values) {
        *slot = from[*value as usize];
    }
}
