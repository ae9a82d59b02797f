//! Programs: a model's computation, written down.
//!
//! A [`Program`] has named inputs and outputs and a list of [`Function`]s, the last of which is its body. A function
//! is a list of operations in single-assignment form; structured operations (`call`, `scan`, `map`) run an earlier
//! function, so that loops stay small and no recursion is possible.
//!
//! Programs come from [`trace`](crate::trace), from a `system.toml`, or from a file. They are evaluated on any
//! [`Scalar`](crate::Scalar): on `f64` they compute, on [`Dual`](crate::Dual) they differentiate, on
//! [`Traced`](crate::trace::Traced) they become part of a larger program. A program that exists is valid: all of its
//! numbers are in range, so that evaluation cannot fail.
//!
//! ```
//! use parallax_model::program::Workspace;
//! use parallax_model::trace::trace_fn;
//! use parallax_model::Scalar;
//!
//! let program = trace_fn("distance", &["x", "y"], &["r"], |xy| vec![(xy[0] * xy[0] + xy[1] * xy[1]).sqrt()]);
//! let (mut workspace, mut r) = (Workspace::new(), [0.0]);
//! program.evaluate(&[3.0, 4.0], &mut workspace, &mut r);
//! assert_eq!(r, [5.0]);
//! assert_eq!(program.jacobian(&[3.0, 4.0], &[0, 1])[(0, 1)], 0.8);
//! ```

mod check;
mod display;
mod evaluate;
mod jacobian;
mod ops;

use serde::{Deserialize, Serialize};

pub use check::ProgramError;
pub use evaluate::Workspace;
pub use ops::{Binary, Compare, Op, Unary, Value};

/// A list of operations with numbered inputs and outputs.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Function {
    /// A name for people; several functions may share one.
    pub name: String,
    /// How many inputs there are: the values 0 to `inputs` − 1.
    pub inputs: u32,
    /// The operations, in the order in which they run.
    pub ops: Vec<Op>,
    /// The values that the function returns, all of them numbers.
    pub outputs: Vec<Value>,
}

/// A computation with named inputs and outputs.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Parts")]
pub struct Program {
    inputs: Vec<String>,
    outputs: Vec<String>,
    functions: Vec<Function>,
    /// What each function needs to be evaluated; made from `functions` when the program is checked.
    #[serde(skip)]
    plans: Vec<check::Plan>,
}

/// What a file holds of a program, not yet checked.
#[derive(Deserialize)]
struct Parts {
    inputs: Vec<String>,
    outputs: Vec<String>,
    functions: Vec<Function>,
}

impl TryFrom<Parts> for Program {
    type Error = ProgramError;

    fn try_from(parts: Parts) -> Result<Self, ProgramError> {
        Self::new(parts.inputs, parts.outputs, parts.functions)
    }
}

impl Program {
    /// A program from its functions, the last of which is the body.
    ///
    /// # Errors
    ///
    /// When an operation refers to a value or function that does not come before it, confuses a mask with a number or
    /// gives a function the wrong number of inputs, and when names and values differ in number.
    pub fn new(
        inputs: Vec<String>,
        outputs: Vec<String>,
        functions: Vec<Function>,
    ) -> Result<Self, ProgramError> {
        let plans = check::check(&inputs, &outputs, &functions)?;
        Ok(Self { inputs, outputs, functions, plans })
    }

    /// The body's name.
    pub fn name(&self) -> &str {
        &self.body().name
    }

    /// The names of the inputs, in order.
    pub fn inputs(&self) -> &[String] {
        &self.inputs
    }

    /// The names of the outputs, in order.
    pub fn outputs(&self) -> &[String] {
        &self.outputs
    }

    /// Where the input of this name is.
    pub fn input(&self, name: &str) -> Option<usize> {
        self.inputs.iter().position(|input| input == name)
    }

    /// Where the output of this name is.
    pub fn output(&self, name: &str) -> Option<usize> {
        self.outputs.iter().position(|output| output == name)
    }

    /// All functions; structured operations refer to them by their place here, and the last is the body.
    pub fn functions(&self) -> &[Function] {
        &self.functions
    }

    /// The function that the program runs.
    pub fn body(&self) -> &Function {
        self.functions.last().expect("a checked program has a body")
    }

    /// How many operations are written down, over all functions.
    pub fn size(&self) -> usize {
        self.functions.iter().map(|function| function.ops.len()).sum()
    }

    /// How many results an operation of this program has.
    pub fn results(&self, op: &Op) -> usize {
        check::results(&self.functions, op).unwrap_or(1)
    }

    /// As JSON: `{"inputs": [...], "outputs": [...], "functions": [{"name", "inputs", "ops", "outputs"}]}`.
    pub fn to_json(&self) -> String {
        serde_json::to_string(self).expect("a program has only lists, text and numbers")
    }

    /// From JSON, bit for bit what [`Program::to_json`] wrote.
    ///
    /// # Errors
    ///
    /// When the text is not JSON of that form, or describes an invalid program.
    pub fn from_json(text: &str) -> Result<Self, ProgramError> {
        serde_json::from_str(text).map_err(|error| ProgramError::Json { message: error.to_string() })
    }
}
