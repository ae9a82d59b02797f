//! What happens while a computation is traced: functions under construction, shared values, captures.
//!
//! Each function under construction is a [`Frame`] on a stack; the body of a loop is traced in a frame of its own. A
//! value of an outer frame that an inner one uses becomes a capture: one more input of the inner function, which the
//! structured operation in the outer frame provides.

mod key;

use std::cell::RefCell;
use std::collections::{BTreeMap, HashMap};

use crate::program::{Compare, Function, Op, Program, ProgramError, Unary, Value};
use crate::scalar::share;
use crate::trace::{Known, Traced};
use key::Key;

thread_local! {
    static TRACER: RefCell<Tracer> = const { RefCell::new(Tracer::new()) };
}

/// A value of a frame: which frame, and which of its nodes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) struct Place {
    frame: u64,
    node: u32,
}

/// One value of a frame. Operands of operations are places of nodes in the same frame.
enum Node {
    Input,
    /// A number of an enclosing frame.
    Capture(Place),
    Op(Op),
    /// One result of a structured operation.
    Result {
        of: u32,
        index: u32,
    },
}

/// A function under construction.
struct Frame {
    id: u64,
    inputs: u32,
    nodes: Vec<Node>,
    known: HashMap<Key, u32>,
    captured: HashMap<Place, u32>,
}

impl Frame {
    fn push(&mut self, node: Node) -> u32 {
        self.nodes.push(node);
        self.nodes.len() as u32 - 1
    }

    /// The node of an operation whose operands are nodes of this frame; the same operation is written once.
    fn emit(&mut self, op: Op) -> u32 {
        let key = Key::of(&op);
        if let Some(node) = self.known.get(&key) {
            return *node;
        }
        let node = self.push(Node::Op(op));
        self.known.insert(key, node);
        node
    }
}

/// All functions under construction on this thread, and those already finished in the present trace.
struct Tracer {
    frames: Vec<Frame>,
    functions: Vec<Function>,
    /// Finished functions by their text, so that equal bodies are kept once.
    finished: BTreeMap<String, u32>,
    /// Frames are numbered through the thread's life, so that a value that outlives its frame is noticed.
    next_frame: u64,
}

impl Tracer {
    const fn new() -> Self {
        Self { frames: Vec::new(), functions: Vec::new(), finished: BTreeMap::new(), next_frame: 0 }
    }

    fn open(&mut self, inputs: usize) -> Vec<Traced> {
        let id = self.next_frame;
        self.next_frame += 1;
        let nodes = (0..inputs).map(|_| Node::Input).collect();
        self.frames.push(Frame {
            id,
            inputs: inputs as u32,
            nodes,
            known: HashMap::new(),
            captured: HashMap::new(),
        });
        (0..inputs as u32).map(|node| Traced::at(Place { frame: id, node })).collect()
    }

    /// The node of a number in frame `depth`; a capture when it belongs to an enclosing frame.
    fn number(&mut self, depth: usize, number: Traced) -> u32 {
        let place = match number.place() {
            Ok(place) => place,
            Err(constant) => return self.frames[depth].emit(Op::Constant(constant)),
        };
        if self.home(depth, place) == depth {
            return place.node;
        }
        let frame = &mut self.frames[depth];
        if let Some(node) = frame.captured.get(&place) {
            return *node;
        }
        let node = frame.push(Node::Capture(place));
        frame.captured.insert(place, node);
        node
    }

    /// The node of a mask in frame `depth`. Functions take numbers only, so a captured mask travels as 1 or 0.
    fn mask(&mut self, depth: usize, place: Place) -> u32 {
        let home = self.home(depth, place);
        if home == depth {
            return place.node;
        }
        let outer = &mut self.frames[home];
        let (one, zero) = (outer.emit(Op::Constant(1.0)), outer.emit(Op::Constant(0.0)));
        let node = outer.emit(Op::Select(place.node, one, zero));
        let number = self.number(depth, Traced::at(Place { frame: place.frame, node }));
        let frame = &mut self.frames[depth];
        let zero = frame.emit(Op::Constant(0.0));
        frame.emit(Op::Compare(Compare::Lt, zero, number))
    }

    /// The depth of the frame that a value belongs to.
    fn home(&self, depth: usize, place: Place) -> usize {
        self.frames[..=depth].iter().rposition(|frame| frame.id == place.frame).expect(
            "a traced value is used outside the function that it belongs to; \
             a loop's body must hand values out through its carry or its results",
        )
    }

    /// The innermost frame.
    fn top(&self) -> usize {
        self.frames.len().checked_sub(1).expect("traced values exist only inside trace_fn and trace_model")
    }

    /// Closes the innermost frame: its function, with dead operations left out, and the values it captured.
    fn close(&mut self, name: &str, outputs: &[Traced]) -> (Function, Vec<Traced>) {
        let depth = self.top();
        let outputs: Vec<u32> = outputs.iter().map(|output| self.number(depth, *output)).collect();
        let frame = self.frames.pop().expect("`top` has seen it");

        let mut live = vec![false; frame.nodes.len()];
        outputs.iter().for_each(|node| live[*node as usize] = true);
        for node in (0..frame.nodes.len()).rev().filter(|node| *node >= frame.inputs as usize) {
            if live[node] {
                match &frame.nodes[node] {
                    Node::Op(op) => op.for_each_operand(|operand| live[operand as usize] = true),
                    Node::Result { of, .. } => live[*of as usize] = true,
                    Node::Input | Node::Capture(_) => {}
                }
            }
        }

        let mut numbers = vec![Value::MAX; frame.nodes.len()];
        let mut next: Value = 0;
        let mut captures = Vec::new();
        for (node, content) in frame.nodes.iter().enumerate() {
            match content {
                Node::Input => {}
                Node::Capture(place) if live[node] => captures.push(Traced::at(*place)),
                _ => continue,
            }
            numbers[node] = next;
            next += 1;
        }
        let inputs = next;
        let mut ops = Vec::new();
        for (node, content) in frame.nodes.into_iter().enumerate() {
            match content {
                Node::Op(mut op) if live[node] => {
                    op.map_operands(|operand| numbers[operand as usize]);
                    numbers[node] = next;
                    next += self.results(&op);
                    ops.push(op);
                }
                Node::Result { of, index } if live[node] => numbers[node] = numbers[of as usize] + index,
                _ => {}
            }
        }
        let outputs = outputs.iter().map(|node| numbers[*node as usize]).collect();
        (Function { name: name.to_owned(), inputs, ops, outputs }, captures)
    }

    fn results(&self, op: &Op) -> u32 {
        let outputs = |function: &u32| self.functions[*function as usize].outputs.len() as u32;
        match op {
            Op::Call { function, .. } => outputs(function),
            Op::Scan { function, length, carry, .. } => {
                let carry = carry.len() as u32;
                carry + (outputs(function) - carry) * length
            }
            Op::Map { function, length, .. } => outputs(function) * length,
            _ => 1,
        }
    }

    /// Keeps a finished function, or finds an equal one.
    fn keep(&mut self, function: Function) -> u32 {
        // The text tells −0.0 from 0.0, which `==` does not.
        let text = format!("{function:?}");
        if let Some(index) = self.finished.get(&text) {
            return *index;
        }
        self.functions.push(function);
        let index = self.functions.len() as u32 - 1;
        self.finished.insert(text, index);
        index
    }

    /// Appends a structured operation to the innermost frame; gives its results.
    fn emit_structured(&mut self, op: Op) -> Vec<Traced> {
        let depth = self.top();
        let count = self.results(&op);
        let frame = &mut self.frames[depth];
        let of = frame.emit(op);
        (0..count)
            .map(|index| Traced::at(Place { frame: frame.id, node: frame.push(Node::Result { of, index }) }))
            .collect()
    }
}

/// Closes what a panic left open, so that a caught panic does not spoil later traces.
struct Scope {
    depth: usize,
}

impl Drop for Scope {
    fn drop(&mut self) {
        // During a panic inside the tracer itself the cell may still be borrowed; then the thread is lost anyway.
        TRACER.with(|tracer| {
            if let Ok(mut tracer) = tracer.try_borrow_mut() {
                tracer.frames.truncate(self.depth);
            }
        });
    }
}

fn with<R>(run: impl FnOnce(&mut Tracer) -> R) -> R {
    TRACER.with(|tracer| run(&mut tracer.borrow_mut()))
}

/// Traces `body` as a function of its own and gives its place and captures.
fn function(name: &str, inputs: usize, body: impl FnOnce(Vec<Traced>) -> Vec<Traced>) -> (u32, Vec<Traced>) {
    let (arguments, depth) = with(|tracer| (tracer.open(inputs), tracer.top()));
    let scope = Scope { depth };
    let outputs = body(arguments);
    let result = with(|tracer| {
        let (function, captures) = tracer.close(name, &outputs);
        (tracer.keep(function), captures)
    });
    drop(scope);
    result
}

/// An operation on numbers.
pub(crate) fn emit(operands: &[Traced], op: impl FnOnce(&[Value]) -> Op) -> Place {
    with(|tracer| {
        let depth = tracer.top();
        let nodes: Vec<Value> = operands.iter().map(|operand| tracer.number(depth, *operand)).collect();
        let frame = &mut tracer.frames[depth];
        Place { node: frame.emit(op(&nodes)), frame: frame.id }
    })
}

/// An operation on masks, and on numbers after them.
pub(crate) fn emit_masked(
    masks: &[Place],
    operands: &[Traced],
    op: impl FnOnce(&[Value], &[Value]) -> Op,
) -> Place {
    with(|tracer| {
        let depth = tracer.top();
        let masks: Vec<Value> = masks.iter().map(|mask| tracer.mask(depth, *mask)).collect();
        let nodes: Vec<Value> = operands.iter().map(|operand| tracer.number(depth, *operand)).collect();
        let frame = &mut tracer.frames[depth];
        Place { node: frame.emit(op(&masks, &nodes)), frame: frame.id }
    })
}

/// Whether a value is the inversion of another, and of which.
pub(crate) fn inverted(place: Place, mask: bool) -> Option<Place> {
    with(|tracer| {
        let frame = tracer.frames.iter().rev().find(|frame| frame.id == place.frame)?;
        match &frame.nodes[place.node as usize] {
            Node::Op(Op::Unary(Unary::Neg, node)) if !mask => Some(Place { frame: place.frame, node: *node }),
            Node::Op(Op::Not(node)) if mask => Some(Place { frame: place.frame, node: *node }),
            _ => None,
        }
    })
}

fn nodes(tracer: &mut Tracer, values: &[Traced]) -> Vec<Value> {
    let depth = tracer.top();
    values.iter().map(|value| tracer.number(depth, *value)).collect()
}

pub(crate) fn call(
    name: &str,
    xs: &[Traced],
    ys: &mut [Traced],
    body: impl FnOnce(&[Traced], &mut [Traced]),
) {
    let count = ys.len();
    let (function, captures) = function(name, xs.len(), |inputs| {
        let mut outputs = vec![Traced::ZERO; count];
        body(&inputs, &mut outputs);
        outputs
    });
    let results = with(|tracer| {
        let mut inputs = nodes(tracer, xs);
        inputs.extend(nodes(tracer, &captures));
        tracer.emit_structured(Op::Call { function, inputs })
    });
    ys.copy_from_slice(&results);
}

pub(crate) fn scan(
    length: usize,
    carry: &mut [Traced],
    xs: &[Traced],
    ys: &mut [Traced],
    mut body: impl FnMut(&mut [Traced], &[Traced], &mut [Traced]),
) {
    let (nc, nx, ny) = (carry.len(), share(xs.len(), length), share(ys.len(), length));
    if length <= 1 {
        if length == 1 {
            body(carry, xs, ys);
        }
        return;
    }
    let (function, captures) = function("scan_body", nc + nx, |mut inputs| {
        let mut outputs = vec![Traced::ZERO; ny];
        let (carry, x) = inputs.split_at_mut(nc);
        body(carry, x, &mut outputs);
        [&*carry, &outputs].concat()
    });
    let results = with(|tracer| {
        let (carry, xs) = (nodes(tracer, carry), nodes(tracer, xs));
        let captures = nodes(tracer, &captures);
        tracer.emit_structured(Op::Scan { function, length: length as u32, carry, xs, captures })
    });
    carry.copy_from_slice(&results[..nc]);
    ys.copy_from_slice(&results[nc..]);
}

pub(crate) fn map(
    length: usize,
    xs: &[Traced],
    ys: &mut [Traced],
    mut body: impl FnMut(&[Traced], &mut [Traced]),
) {
    let (nx, ny) = (share(xs.len(), length), share(ys.len(), length));
    if length <= 1 {
        if length == 1 {
            body(xs, ys);
        }
        return;
    }
    let (function, captures) = function("map_body", nx, |inputs| {
        let mut outputs = vec![Traced::ZERO; ny];
        body(&inputs, &mut outputs);
        outputs
    });
    let results = with(|tracer| {
        let xs = nodes(tracer, xs);
        let captures = nodes(tracer, &captures);
        tracer.emit_structured(Op::Map { function, length: length as u32, xs, captures })
    });
    ys.copy_from_slice(&results);
}

/// Traces a whole program. Inside another trace it starts from nothing and leaves the other untouched.
pub(crate) fn program(
    name: &str,
    inputs: Vec<String>,
    outputs: Vec<String>,
    body: impl FnOnce(&[Traced]) -> Vec<Traced>,
) -> Result<Program, ProgramError> {
    let outer = with(|tracer| {
        let fresh = Tracer { next_frame: tracer.next_frame, ..Tracer::new() };
        std::mem::replace(tracer, fresh)
    });
    let restore = Restore { outer: Some(outer) };
    let (index, _) = function(name, inputs.len(), |values| body(&values));
    let mut functions = with(|tracer| std::mem::take(&mut tracer.functions));
    drop(restore);
    // An equal function may have been finished earlier; the body is the last one all the same.
    functions.truncate(index as usize + 1);
    Program::new(inputs, outputs, reachable(functions))
}

/// Puts the enclosing trace back, also after a panic.
struct Restore {
    outer: Option<Tracer>,
}

impl Drop for Restore {
    fn drop(&mut self) {
        TRACER.with(|tracer| {
            if let (Some(outer), Ok(mut tracer)) = (self.outer.take(), tracer.try_borrow_mut()) {
                let next_frame = tracer.next_frame;
                *tracer = Tracer { next_frame, ..outer };
            }
        });
    }
}

/// Leaves out functions that nothing runs (their results were dead).
fn reachable(functions: Vec<Function>) -> Vec<Function> {
    let mut used = vec![false; functions.len()];
    if let Some(body) = used.last_mut() {
        *body = true;
    }
    for index in (0..functions.len()).rev().filter(|index| *index < functions.len()) {
        if used[index] {
            functions[index]
                .ops
                .iter()
                .filter_map(Op::function)
                .for_each(|callee| used[callee as usize] = true);
        }
    }
    let mut numbers = Vec::with_capacity(functions.len());
    let mut kept = 0;
    for used in &used {
        numbers.push(kept);
        kept += u32::from(*used);
    }
    let mut out = Vec::new();
    for (mut function, used) in functions.into_iter().zip(used) {
        if used {
            for op in &mut function.ops {
                match op {
                    Op::Call { function, .. } | Op::Scan { function, .. } | Op::Map { function, .. } => {
                        *function = numbers[*function as usize];
                    }
                    _ => {}
                }
            }
            out.push(function);
        }
    }
    out
}

/// What is known of a mask while tracing.
pub(crate) type Mask = Known<bool>;
