//! A program written out flat together with its derivatives, to be run on lanes.
//!
//! Derivatives are taken operation by operation (forward mode, Griewank & Walther, "Evaluating Derivatives", chapter 3),
//! and only where something depends on a column: a parameter that enters one product costs one product. What depends on
//! parameters alone runs once, what depends on commands as well runs once per interval, and only the rest runs in every
//! stage of an integration step.

use std::collections::HashMap;

use parallax_model::Scalar;
use parallax_model::program::{Binary, Compare, Op, Program, Unary, Value};

use super::batches::{Batches, Step, order};

/// How often an instruction has to run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Rhythm {
    /// Once for given parameters.
    Fixed,
    /// Whenever a command changes.
    Held,
    /// Whenever the state or the time changes.
    Moving,
}

/// A derivative: the number one, or what a slot holds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Entry {
    /// Exactly one.
    One,
    /// The number in this slot.
    Slot(u32),
}

/// A flat program with the derivatives of its outputs.
#[derive(Clone, Debug)]
pub struct Tape {
    /// Slots that an evaluation needs; the first ones are the program's inputs.
    pub slots: usize,
    /// The slot of each output.
    pub outputs: Vec<u32>,
    /// The derivatives of each output that are not zero throughout: column and entry, by column.
    pub derivatives: Vec<Vec<(u32, Entry)>>,
    /// Whether each input is used.
    pub uses: Vec<bool>,
    instructions: [Batches; 3],
}

impl Tape {
    /// Differentiates a program. `rhythm` and `column` say for each of its inputs how often it changes, and which
    /// column of the derivatives belongs to it.
    #[must_use]
    pub fn new(program: &Program, rhythm: &[Rhythm], column: &[Option<u32>]) -> Self {
        let mut writer =
            Writer { nodes: Vec::new(), rhythm: rhythm.to_vec(), known: HashMap::new(), first: rhythm.len() };
        let mut inputs = Vec::with_capacity(rhythm.len());
        for (k, column) in column.iter().enumerate() {
            let gradient = column.map(|c| (c, Part::One)).into_iter().collect();
            inputs.push(Variable { at: k as u32, gradient });
        }
        let body = program.functions().len() - 1;
        let outputs = writer.function(program, body, inputs);
        writer.finish(&outputs)
    }

    /// Runs the instructions of one rhythm.
    #[inline(always)]
    pub fn run<T: Scalar>(&self, rhythm: Rhythm, slots: &mut [T]) {
        self.instructions[rhythm as usize].run(slots);
    }
}

/// A part of a gradient while the tape is written.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Part {
    One,
    Node(u32),
}

/// A value of the source program: its node, and its derivatives by column, in order.
#[derive(Clone, Debug)]
struct Variable {
    at: u32,
    gradient: Vec<(u32, Part)>,
}

struct Writer {
    nodes: Vec<Step>,
    rhythm: Vec<Rhythm>,
    known: HashMap<Step, u32>,
    first: usize,
}

impl Writer {
    fn push(&mut self, step: Step) -> u32 {
        // The same bits, in a kind of which there are many.
        let step = match step {
            Step::Powi(a, 1) => return a,
            Step::Powi(a, 2) => Step::Binary(Binary::Mul, a, a),
            step => step,
        };
        if let Some(at) = self.known.get(&step) {
            return *at;
        }
        let operands = step.operands().into_iter().flatten();
        let rhythm = operands.map(|a| self.rhythm[a as usize]).max().unwrap_or(Rhythm::Fixed);
        let at = self.rhythm.len() as u32;
        self.nodes.push(step);
        self.rhythm.push(rhythm);
        self.known.insert(step, at);
        at
    }

    fn constant(&mut self, value: f64) -> u32 {
        self.push(Step::Constant(value.to_bits()))
    }

    fn binary(&mut self, f: Binary, a: u32, b: u32) -> u32 {
        self.push(Step::Binary(f, a, b))
    }

    fn unary(&mut self, f: Unary, a: u32) -> u32 {
        self.push(Step::Unary(f, a))
    }

    fn node(&mut self, part: Part) -> u32 {
        match part {
            Part::One => self.constant(1.0),
            Part::Node(at) => at,
        }
    }

    /// slope × part.
    fn times(&mut self, slope: u32, part: Part) -> Part {
        match part {
            Part::One => Part::Node(slope),
            Part::Node(at) => Part::Node(self.binary(Binary::Mul, slope, at)),
        }
    }

    fn chain(&mut self, a: &Variable, slope: u32) -> Vec<(u32, Part)> {
        a.gradient.iter().map(|(c, part)| (*c, self.times(slope, *part))).collect()
    }

    /// Joins two gradients column by column; `both` gets what each has, at least one of them something.
    fn join(
        &mut self,
        a: &[(u32, Part)],
        b: &[(u32, Part)],
        mut both: impl FnMut(&mut Self, Option<Part>, Option<Part>) -> Part,
    ) -> Vec<(u32, Part)> {
        let (mut i, mut j) = (0, 0);
        let mut out = Vec::new();
        while i < a.len() || j < b.len() {
            let ca = a.get(i).map_or(u32::MAX, |p| p.0);
            let cb = b.get(j).map_or(u32::MAX, |p| p.0);
            let column = ca.min(cb);
            let left = (ca == column).then(|| a[i].1);
            let right = (cb == column).then(|| b[j].1);
            i += usize::from(left.is_some());
            j += usize::from(right.is_some());
            out.push((column, both(self, left, right)));
        }
        out
    }

    fn sum(&mut self, a: &[(u32, Part)], b: &[(u32, Part)]) -> Vec<(u32, Part)> {
        self.join(a, b, |w, x, y| match (x, y) {
            (Some(x), Some(y)) => {
                let (x, y) = (w.node(x), w.node(y));
                Part::Node(w.binary(Binary::Add, x, y))
            }
            (x, y) => x.or(y).unwrap_or(Part::One),
        })
    }

    fn function(&mut self, program: &Program, index: usize, inputs: Vec<Variable>) -> Vec<Variable> {
        let function = &program.functions()[index];
        let mut values = inputs;
        for op in &function.ops {
            let results = self.operation(program, op, &values);
            values.extend(results);
        }
        function.outputs.iter().map(|v| values[*v as usize].clone()).collect()
    }

    fn operation(&mut self, program: &Program, op: &Op, values: &[Variable]) -> Vec<Variable> {
        let pick = |list: &[Value]| list.iter().map(|v| values[*v as usize].clone()).collect::<Vec<_>>();
        let of = |v: &Value| &values[*v as usize];
        let plain = |at: u32| vec![Variable { at, gradient: Vec::new() }];
        match op {
            Op::Constant(value) => plain(self.constant(*value)),
            Op::Unary(f, a) => vec![self.unary_value(*f, of(a))],
            Op::Binary(f, a, b) => vec![self.binary_value(*f, of(a), of(b))],
            Op::Powi(a, exponent) => {
                let a = of(a);
                let at = self.push(Step::Powi(a.at, *exponent));
                let gradient = if a.gradient.is_empty() || *exponent == 0 {
                    Vec::new()
                } else {
                    let power = self.push(Step::Powi(a.at, exponent.saturating_sub(1)));
                    let factor = self.constant(f64::from(*exponent));
                    let slope = self.binary(Binary::Mul, factor, power);
                    self.chain(a, slope)
                };
                vec![Variable { at, gradient }]
            }
            Op::Compare(f, a, b) => plain(self.push(Step::Compare(*f, of(a).at, of(b).at))),
            Op::And(a, b) => plain(self.binary(Binary::Mul, of(a).at, of(b).at)),
            Op::Or(a, b) => {
                let one = self.constant(1.0);
                plain(self.push(Step::Select(of(a).at, one, of(b).at)))
            }
            Op::Not(a) => {
                let one = self.constant(1.0);
                plain(self.binary(Binary::Sub, one, of(a).at))
            }
            Op::Select(mask, then, otherwise) => {
                let (mask, then, otherwise) = (of(mask).at, of(then), of(otherwise));
                let at = self.push(Step::Select(mask, then.at, otherwise.at));
                let gradient = self.join(&then.gradient, &otherwise.gradient, |w, x, y| {
                    let zero = w.constant(0.0);
                    let x = x.map_or(zero, |p| w.node(p));
                    let y = y.map_or(zero, |p| w.node(p));
                    if x == y { Part::Node(x) } else { Part::Node(w.push(Step::Select(mask, x, y))) }
                });
                vec![Variable { at, gradient }]
            }
            Op::Call { function, inputs } => self.function(program, *function as usize, pick(inputs)),
            Op::Scan { function, length, carry, xs, captures } => {
                let (index, length) = (*function as usize, *length as usize);
                let nx = xs.len().checked_div(length).unwrap_or(0);
                let (mut carried, mut ys) = (pick(carry), Vec::new());
                for step in 0..length {
                    let mut inputs = carried;
                    inputs.extend(pick(&xs[step * nx..(step + 1) * nx]));
                    inputs.extend(pick(captures));
                    let mut outputs = self.function(program, index, inputs);
                    ys.extend(outputs.split_off(carry.len()));
                    carried = outputs;
                }
                carried.extend(ys);
                carried
            }
            Op::Map { function, length, xs, captures } => {
                let (index, length) = (*function as usize, *length as usize);
                let nx = xs.len().checked_div(length).unwrap_or(0);
                let mut ys = Vec::new();
                for step in 0..length {
                    let mut inputs = pick(&xs[step * nx..(step + 1) * nx]);
                    inputs.extend(pick(captures));
                    ys.extend(self.function(program, index, inputs));
                }
                ys
            }
        }
    }

    /// As the dual numbers do: slopes that are infinite at a point are zero there.
    fn unary_value(&mut self, f: Unary, a: &Variable) -> Variable {
        let at = self.unary(f, a.at);
        if a.gradient.is_empty() {
            return Variable { at, gradient: Vec::new() };
        }
        let slope = match f {
            Unary::Sign | Unary::Floor => return Variable { at, gradient: Vec::new() },
            Unary::Neg => self.constant(-1.0),
            Unary::Sin => self.unary(Unary::Cos, a.at),
            Unary::Cos => {
                let sine = self.unary(Unary::Sin, a.at);
                self.unary(Unary::Neg, sine)
            }
            Unary::Tan => {
                let (one, square) = (self.constant(1.0), self.binary(Binary::Mul, at, at));
                self.binary(Binary::Add, one, square)
            }
            Unary::Tanh => {
                let (one, square) = (self.constant(1.0), self.binary(Binary::Mul, at, at));
                self.binary(Binary::Sub, one, square)
            }
            Unary::Exp => at,
            Unary::Ln => {
                let one = self.constant(1.0);
                self.binary(Binary::Div, one, a.at)
            }
            Unary::Sqrt => {
                let half = self.constant(0.5);
                self.quotient_or_zero(half, at)
            }
            Unary::Abs => self.unary(Unary::Sign, a.at),
            Unary::Atan => {
                let (one, square) = (self.constant(1.0), self.binary(Binary::Mul, a.at, a.at));
                let sum = self.binary(Binary::Add, one, square);
                self.binary(Binary::Div, one, sum)
            }
            Unary::Asin | Unary::Acos => {
                let (one, square) = (self.constant(1.0), self.binary(Binary::Mul, a.at, a.at));
                let rest = self.binary(Binary::Sub, one, square);
                let root = self.unary(Unary::Sqrt, rest);
                let slope = self.quotient_or_zero(one, root);
                if f == Unary::Asin { slope } else { self.unary(Unary::Neg, slope) }
            }
        };
        Variable { at, gradient: self.chain(a, slope) }
    }

    fn quotient_or_zero(&mut self, a: u32, b: u32) -> u32 {
        let (zero, quotient) = (self.constant(0.0), self.binary(Binary::Div, a, b));
        let vanishes = self.push(Step::Compare(Compare::Eq, b, zero));
        self.push(Step::Select(vanishes, zero, quotient))
    }

    fn binary_value(&mut self, f: Binary, a: &Variable, b: &Variable) -> Variable {
        let at = self.binary(f, a.at, b.at);
        let (left, right) = (!a.gradient.is_empty(), !b.gradient.is_empty());
        let gradient = match f {
            Binary::Add => self.sum(&a.gradient, &b.gradient),
            Binary::Sub => self.join(&a.gradient, &b.gradient, |w, x, y| match (x, y) {
                (Some(x), Some(y)) => {
                    let (x, y) = (w.node(x), w.node(y));
                    Part::Node(w.binary(Binary::Sub, x, y))
                }
                (Some(x), None) => x,
                (None, y) => {
                    let y = w.node(y.unwrap_or(Part::One));
                    Part::Node(w.unary(Unary::Neg, y))
                }
            }),
            Binary::Mul => {
                let by_a = if left { self.chain(a, b.at) } else { Vec::new() };
                let by_b = if right { self.chain(b, a.at) } else { Vec::new() };
                self.sum(&by_a, &by_b)
            }
            Binary::Div => {
                let mut by_a = Vec::new();
                if left || right {
                    let one = self.constant(1.0);
                    let inverse = self.binary(Binary::Div, one, b.at);
                    if left {
                        by_a = self.chain(a, inverse);
                    }
                    if right {
                        let product = self.binary(Binary::Mul, at, inverse);
                        let slope = self.unary(Unary::Neg, product);
                        let by_b = self.chain(b, slope);
                        by_a = self.sum(&by_a, &by_b);
                    }
                }
                by_a
            }
            Binary::Atan2 => {
                // y is the first operand: d atan2(y, x) = (x dy − y dx)/(x² + y²).
                let (yy, xx) = (self.binary(Binary::Mul, a.at, a.at), self.binary(Binary::Mul, b.at, b.at));
                let square = self.binary(Binary::Add, yy, xx);
                let by_y = self.quotient_or_zero(b.at, square);
                let negative = self.unary(Unary::Neg, a.at);
                let by_x = self.quotient_or_zero(negative, square);
                let by_a = self.chain(a, by_y);
                let by_b = self.chain(b, by_x);
                self.sum(&by_a, &by_b)
            }
            Binary::Powf => self.power_gradient(at, a, b),
        };
        Variable { at, gradient }
    }

    fn power_gradient(&mut self, at: u32, a: &Variable, b: &Variable) -> Vec<(u32, Part)> {
        let (zero, one) = (self.constant(0.0), self.constant(1.0));
        let mut gradient = Vec::new();
        if !a.gradient.is_empty() {
            let less = self.binary(Binary::Sub, b.at, one);
            let power = self.binary(Binary::Powf, a.at, less);
            let slope = self.binary(Binary::Mul, b.at, power);
            // At zero only the exponent one has a finite slope that is not zero.
            let straight = self.push(Step::Compare(Compare::Eq, b.at, one));
            let at_zero = self.push(Step::Select(straight, one, zero));
            let vanishes = self.push(Step::Compare(Compare::Eq, a.at, zero));
            let slope = self.push(Step::Select(vanishes, at_zero, slope));
            gradient = self.chain(a, slope);
        }
        if !b.gradient.is_empty() {
            let logarithm = self.unary(Unary::Ln, a.at);
            let product = self.binary(Binary::Mul, at, logarithm);
            let positive = self.push(Step::Compare(Compare::Lt, zero, a.at));
            let slope = self.push(Step::Select(positive, product, zero));
            let by_b = self.chain(b, slope);
            gradient = self.sum(&gradient, &by_b);
        }
        gradient
    }

    /// Keeps what the outputs need, and numbers the slots.
    fn finish(self, outputs: &[Variable]) -> Tape {
        let mut needed = vec![false; self.rhythm.len()];
        for variable in outputs {
            needed[variable.at as usize] = true;
            for (_, part) in &variable.gradient {
                if let Part::Node(at) = part {
                    needed[*at as usize] = true;
                }
            }
        }
        for (k, step) in self.nodes.iter().enumerate().rev() {
            if needed[self.first + k] {
                step.operands().into_iter().flatten().for_each(|a| needed[a as usize] = true);
            }
        }
        let mut place: Vec<u32> = (0..self.rhythm.len() as u32).collect();
        let mut slots = self.first as u32;
        let mut instructions: [Batches; 3] = Default::default();
        for rhythm in [Rhythm::Fixed, Rhythm::Held, Rhythm::Moving] {
            let nodes: Vec<usize> =
                (self.first..needed.len()).filter(|at| needed[*at] && self.rhythm[*at] == rhythm).collect();
            for at in order(&nodes, |at| self.nodes[at - self.first]) {
                let to = |a: u32| place[a as usize];
                let step = match self.nodes[at - self.first] {
                    Step::Constant(bits) => Step::Constant(bits),
                    Step::Unary(f, a) => Step::Unary(f, to(a)),
                    Step::Powi(a, e) => Step::Powi(to(a), e),
                    Step::Binary(f, a, b) => Step::Binary(f, to(a), to(b)),
                    Step::Compare(f, a, b) => Step::Compare(f, to(a), to(b)),
                    Step::Select(m, a, b) => Step::Select(to(m), to(a), to(b)),
                };
                place[at] = slots;
                instructions[rhythm as usize].push(step, slots);
                slots += 1;
            }
        }
        let entry = |part: &Part| match part {
            Part::One => Entry::One,
            Part::Node(at) => Entry::Slot(place[*at as usize]),
        };
        Tape {
            slots: slots as usize,
            outputs: outputs.iter().map(|v| place[v.at as usize]).collect(),
            derivatives: outputs
                .iter()
                .map(|v| v.gradient.iter().map(|(c, part)| (*c, entry(part))).collect())
                .collect(),
            uses: needed[..self.first].to_vec(),
            instructions,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use parallax_model::lanes::F64x16;
    use parallax_model::trace::{Traced, trace_fn};

    #[test]
    fn derivatives_are_those_of_the_program() {
        let program = trace_fn("all", &["a", "b", "c"], &["y", "z"], |v: &[Traced]| {
            let [a, b, c] = [v[0], v[1], v[2]];
            let t = (a * b).sin() / (c * c + 1.0) + (a - b).tanh() * c.exp() - b.sqrt();
            let z = Traced::select(a.lt(b), a.powf(c), b.atan2(a)) + (c.abs() * 0.3).atan() + b.powi(3).ln();
            vec![t, z.max(t) * b.cos()]
        });
        let tape =
            Tape::new(&program, &[Rhythm::Fixed, Rhythm::Held, Rhythm::Moving], &[Some(0), Some(1), Some(2)]);
        for inputs in [[0.3, 1.2, 0.7], [1.4, 0.6, -0.4]] {
            let mut slots = vec![F64x16::splat(0.0); tape.slots];
            for (slot, value) in slots.iter_mut().zip(inputs) {
                *slot = F64x16::splat(value);
            }
            for rhythm in [Rhythm::Fixed, Rhythm::Held, Rhythm::Moving] {
                tape.run(rhythm, &mut slots);
            }
            let expected = program.jacobian(&inputs, &[0, 1, 2]);
            for (row, derivatives) in tape.derivatives.iter().enumerate() {
                assert_eq!(derivatives.len(), 3);
                for (column, entry) in derivatives {
                    let value = match entry {
                        Entry::One => 1.0,
                        Entry::Slot(slot) => slots[*slot as usize][5],
                    };
                    let expected = expected[(row, *column as usize)];
                    assert!((value - expected).abs() < 1e-12 * expected.abs().max(1.0), "{row} {column}");
                }
            }
        }
    }
}
