//! Whether a program is valid, and what evaluating it needs.

use thiserror::Error;

use super::{Function, Op, Value};

/// More values than this at once are a mistake or an attack, not a model: 16 million, 128 MB of `f64`.
const MOST_VALUES: usize = 1 << 24;
/// Calls nested deeper than this would endanger the stack.
const MOST_DEPTH: usize = 200;

/// Why a program is invalid.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum ProgramError {
    /// The program has no functions; its last function must be its body.
    #[error("the program has no functions; the last one must be its body")]
    Empty,
    /// Names and values differ in number.
    #[error("the program names {named} {what} but its body has {count}; give each one a name")]
    Names {
        /// Inputs or outputs.
        what: &'static str,
        /// How many names there are.
        named: usize,
        /// How many values there are.
        count: usize,
    },
    /// Two inputs or two outputs share a name.
    #[error("two {what} of the program are called `{name}`; rename one")]
    Duplicate {
        /// Inputs or outputs.
        what: &'static str,
        /// The name.
        name: String,
    },
    /// An operand is not defined yet.
    #[error("function `{function}`, operation {op}: value {value} is not defined before it")]
    Undefined {
        /// The function's name.
        function: String,
        /// The operation's place; for outputs, the number of operations.
        op: usize,
        /// The operand.
        value: Value,
    },
    /// A mask stands where a number is needed, or a number where a mask is.
    #[error("function `{function}`, operation {op}: value {value} should be a {expected}")]
    Kind {
        /// The function's name.
        function: String,
        /// The operation's place; for outputs, the number of operations.
        op: usize,
        /// The operand.
        value: Value,
        /// Number or mask.
        expected: &'static str,
    },
    /// A structured operation runs a function that does not come before its own.
    #[error(
        "function `{function}`, operation {op}: it runs function {callee}, which does not come before it"
    )]
    Callee {
        /// The function's name.
        function: String,
        /// The operation's place.
        op: usize,
        /// The function that it runs.
        callee: u32,
    },
    /// A structured operation gives its function the wrong number of inputs, or cannot use its outputs.
    #[error("function `{function}`, operation {op}: it does not fit function `{callee}`: {reason}")]
    Arity {
        /// The function's name.
        function: String,
        /// The operation's place.
        op: usize,
        /// The name of the function that it runs.
        callee: String,
        /// What does not fit.
        reason: String,
    },
    /// The program would need too much memory or too deep a stack.
    #[error("the program is too large: {reason}")]
    TooLarge {
        /// Which limit it passes.
        reason: String,
    },
    /// The text is no serialized program.
    #[error("not a program: {message}")]
    Json {
        /// What the parser says.
        message: String,
    },
}

/// What evaluating a function needs.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Plan {
    /// How many values its own frame has.
    pub(crate) frame: usize,
    /// How many values its frame and those of everything it runs have at most at once.
    pub(crate) stack: usize,
    /// How deep its calls are nested.
    depth: usize,
}

/// How many results an operation has, or nothing when it refers to a function that is not there.
pub(crate) fn results(functions: &[Function], op: &Op) -> Option<usize> {
    match op {
        Op::Call { function, .. } => Some(functions.get(*function as usize)?.outputs.len()),
        Op::Scan { function, length, carry, .. } => {
            let ys = functions.get(*function as usize)?.outputs.len().checked_sub(carry.len())?;
            ys.checked_mul(*length as usize)?.checked_add(carry.len())
        }
        Op::Map { function, length, .. } => {
            functions.get(*function as usize)?.outputs.len().checked_mul(*length as usize)
        }
        _ => Some(1),
    }
}

pub(crate) fn check(
    inputs: &[String],
    outputs: &[String],
    functions: &[Function],
) -> Result<Vec<Plan>, ProgramError> {
    let body = functions.last().ok_or(ProgramError::Empty)?;
    for (what, names, count) in
        [("inputs", inputs, body.inputs as usize), ("outputs", outputs, body.outputs.len())]
    {
        if names.len() != count {
            return Err(ProgramError::Names { what, named: names.len(), count });
        }
        let mut sorted: Vec<&String> = names.iter().collect();
        sorted.sort();
        if let Some(pair) = sorted.windows(2).find(|pair| pair[0] == pair[1]) {
            return Err(ProgramError::Duplicate { what, name: pair[0].clone() });
        }
    }
    let mut plans: Vec<Plan> = Vec::with_capacity(functions.len());
    for index in 0..functions.len() {
        let plan = check_function(functions, index, &plans)?;
        plans.push(plan);
    }
    Ok(plans)
}

fn check_function(functions: &[Function], index: usize, plans: &[Plan]) -> Result<Plan, ProgramError> {
    let function = &functions[index];
    limit(function.inputs as usize)?;
    // For every value defined so far, whether it is a mask.
    let mut masks = vec![false; function.inputs as usize];
    let mut plan = Plan::default();
    let mut inner = 0;
    for (place, op) in function.ops.iter().enumerate() {
        let operand = |value: Value, mask: bool| match masks.get(value as usize) {
            None => Err(ProgramError::Undefined { function: function.name.clone(), op: place, value }),
            Some(is_mask) if *is_mask != mask => Err(ProgramError::Kind {
                function: function.name.clone(),
                op: place,
                value,
                expected: if mask { "mask" } else { "number" },
            }),
            Some(_) => Ok(()),
        };
        match op {
            Op::And(a, b) | Op::Or(a, b) => operand(*a, true).and(operand(*b, true))?,
            Op::Not(a) => operand(*a, true)?,
            Op::Select(mask, a, b) => operand(*mask, true).and(operand(*a, false)).and(operand(*b, false))?,
            _ => {
                let mut outcome = Ok(());
                op.for_each_operand(|value| {
                    if outcome.is_ok() {
                        outcome = operand(value, false);
                    }
                });
                outcome?;
            }
        }
        if let Some(callee) = op.function() {
            if callee as usize >= index {
                return Err(ProgramError::Callee { function: function.name.clone(), op: place, callee });
            }
            let target = &functions[callee as usize];
            fits(op, target).map_err(|reason| ProgramError::Arity {
                function: function.name.clone(),
                op: place,
                callee: target.name.clone(),
                reason,
            })?;
            inner = inner.max(plans[callee as usize].stack);
            plan.depth = plan.depth.max(plans[callee as usize].depth + 1);
        }
        let count = results(functions, op).ok_or_else(|| ProgramError::TooLarge {
            reason: "the results of a loop cannot be counted".into(),
        })?;
        limit(masks.len().saturating_add(count))?;
        let is_mask = matches!(op, Op::Compare(..) | Op::And(..) | Op::Or(..) | Op::Not(_));
        masks.resize(masks.len() + count, is_mask);
    }
    for value in &function.outputs {
        match masks.get(*value as usize) {
            None => {
                let function = function.name.clone();
                return Err(ProgramError::Undefined {
                    function,
                    op: functions[index].ops.len(),
                    value: *value,
                });
            }
            Some(true) => {
                return Err(ProgramError::Kind {
                    function: function.name.clone(),
                    op: function.ops.len(),
                    value: *value,
                    expected: "number",
                });
            }
            Some(false) => {}
        }
    }
    plan.frame = masks.len();
    plan.stack = plan.frame + inner;
    limit(plan.stack)?;
    if plan.depth > MOST_DEPTH {
        return Err(ProgramError::TooLarge { reason: format!("calls are nested deeper than {MOST_DEPTH}") });
    }
    Ok(plan)
}

fn limit(values: usize) -> Result<(), ProgramError> {
    if values > MOST_VALUES {
        return Err(ProgramError::TooLarge { reason: format!("more than {MOST_VALUES} values at once") });
    }
    Ok(())
}

/// Whether a structured operation gives its function what it takes and uses what it gives.
fn fits(op: &Op, target: &Function) -> Result<(), String> {
    let (given, least_outputs) = match op {
        Op::Call { inputs, .. } => (inputs.len(), 0),
        Op::Scan { length, carry, xs, captures, .. } => {
            (carry.len() + per_step(xs.len(), *length)? + captures.len(), carry.len())
        }
        Op::Map { length, xs, captures, .. } => (per_step(xs.len(), *length)? + captures.len(), 0),
        _ => return Ok(()),
    };
    // A loop of no steps has no numbers, so the size of its step cannot be known and does not matter.
    let no_steps = matches!(op, Op::Scan { length: 0, .. } | Op::Map { length: 0, .. });
    if given != target.inputs as usize && !no_steps {
        return Err(format!("it takes {} inputs and is given {given}", target.inputs));
    }
    if target.outputs.len() < least_outputs {
        return Err(format!("it returns {} values and the carry has {least_outputs}", target.outputs.len()));
    }
    Ok(())
}

fn per_step(count: usize, length: u32) -> Result<usize, String> {
    match (count, length as usize) {
        (0, _) => Ok(0),
        (_, length) if length > 0 && count.is_multiple_of(length) => Ok(count / length),
        (_, length) => Err(format!("{count} numbers cannot be divided evenly among {length} steps")),
    }
}
