//! Nodes in Python under the simulated clock: each in an interpreter of its own, which makes a step when it is told to.
//!
//! One line of JSON asks for a step, one answers it. Floating-point numbers travel as their bits, so that what arrives is what was
//! sent. The clock waits for each answer: a seed gives the same run again, as far as the node itself does.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Write};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use parallax_runtime::data::DataSpace;
use parallax_runtime::node::{ErasedNode, InputWindow, Layout, NodeContext, NodeError, Step};
use parallax_runtime::registry::{ExternalInput, NodeKind};
use serde::{Deserialize, Serialize};
use serde_json::json;

/// The argument under which `parallax.worker` waits for such lines.
const LOCKSTEP: &str = "--lockstep";

/// The kind of these nodes, where `programs` has the command that runs each of them in real time.
pub(super) fn kind(programs: BTreeMap<String, Vec<String>>) -> NodeKind {
    NodeKind::external(move |context, inputs, output| {
        let command = programs.get(&context.name).ok_or_else(|| {
            NodeError::failed(format!("no interpreter is known for node `{}`", context.name))
        })?;
        Ok(Box::new(Interpreter::start(command, context, inputs, output)?))
    })
}

/// A node in its interpreter.
struct Interpreter {
    name: String,
    child: Child,
    /// `None` once it is told to end.
    to: Option<ChildStdin>,
    from: BufReader<ChildStdout>,
    line: String,
}

/// What it answers.
#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Answer {
    /// The bits of the leaves of its output.
    leaves: Vec<u64>,
    /// Its data, as hexadecimal digits.
    data: String,
    error: Option<String>,
}

/// What a step sees at one input.
#[derive(Serialize)]
struct Seen {
    /// Of each message: its number (-1 for none), when it was sent and received, ns.
    stamps: Vec<[i64; 3]>,
    /// Of each message: the bits of its leaves.
    leaves: Vec<Vec<u64>>,
    /// Of each message: its data, as hexadecimal digits.
    data: Vec<String>,
}

impl Interpreter {
    fn start(
        command: &[String],
        context: &NodeContext,
        inputs: &[ExternalInput],
        output: &Layout,
    ) -> Result<Self, NodeError> {
        let name = context.name.clone();
        let failed =
            |problem: String| NodeError::failed(format!("its interpreter cannot be started: {problem}"));
        let (program, arguments) = command.split_first().ok_or_else(|| failed("it has no name".into()))?;
        let mut child = Command::new(program)
            .args(arguments)
            .arg(LOCKSTEP)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .map_err(|error| failed(error.to_string()))?;
        let (Some(to), Some(from)) = (child.stdin.take(), child.stdout.take()) else {
            return Err(failed("it has no standard input and output".into()));
        };
        let mut node = Self { name, child, to: Some(to), from: BufReader::new(from), line: String::new() };
        let inputs: Vec<_> = inputs
            .iter()
            .map(|input| json!([input.port.name, input.window, input.port.layout.leaves]))
            .collect();
        node.ask(&json!({
            "name": context.name,
            "rate": context.rate,
            "seed": context.seed,
            "parameters": serde_json::Value::Object(context.parameters.clone()).to_string(),
            "inputs": inputs,
            "output": [output.name, output.leaves],
        }))?;
        Ok(node)
    }

    /// Says a line, and waits for the answer.
    fn ask(&mut self, question: &impl Serialize) -> Result<Answer, NodeError> {
        let mut text =
            serde_json::to_string(question).map_err(|error| NodeError::failed(error.to_string()))?;
        text.push('\n');
        let name = self.name.clone();
        let gone = |error: &dyn std::fmt::Display| {
            NodeError::failed(format!(
                "the interpreter of `{name}` is gone ({error}); what it printed above may say why"
            ))
        };
        let to = self.to.as_mut().ok_or_else(|| gone(&"it was told to end"))?;
        to.write_all(text.as_bytes()).and_then(|()| to.flush()).map_err(|error| gone(&error))?;
        self.line.clear();
        if self.from.read_line(&mut self.line).map_err(|error| gone(&error))? == 0 {
            let status =
                self.child.wait().map_or_else(|error| error.to_string(), |status| status.to_string());
            return Err(gone(&status));
        }
        let answer: Answer = serde_json::from_str(&self.line).map_err(|error| {
            NodeError::failed(format!("node `{}` answers something else: {error}", self.name))
        })?;
        match answer.error {
            Some(error) => Err(NodeError::failed(error)),
            None => Ok(answer),
        }
    }
}

impl Drop for Interpreter {
    fn drop(&mut self) {
        // It ends when nothing more can be asked, after it has called the node's own `stop`.
        self.to = None;
        let _ = self.child.wait();
    }
}

impl ErasedNode for Interpreter {
    fn step_into(&mut self, step: &Step<'_>, output: &mut [f64]) -> Result<(), NodeError> {
        self.step_with_data(step, output, &mut DataSpace::new(&mut []))
    }

    fn step_with_data(
        &mut self,
        step: &Step<'_>,
        output: &mut [f64],
        data: &mut DataSpace<'_>,
    ) -> Result<(), NodeError> {
        let inputs: Vec<Seen> = step.inputs().iter().map(seen).collect();
        let answer =
            self.ask(&json!({ "step": [step.seq as i64, step.due, step.start], "inputs": inputs }))?;
        if answer.leaves.len() != output.len() {
            let (got, wanted) = (answer.leaves.len(), output.len());
            return Err(NodeError::failed(format!("its output has {got} leaves in place of {wanted}")));
        }
        for (leaf, bits) in output.iter_mut().zip(answer.leaves) {
            *leaf = f64::from_bits(bits);
        }
        let bytes =
            bytes(&answer.data).ok_or_else(|| NodeError::failed("its data are no hexadecimal digits"))?;
        if !bytes.is_empty() {
            data.take(bytes.len())?.copy_from_slice(&bytes);
        }
        Ok(())
    }
}

fn seen(input: &InputWindow) -> Seen {
    let count = input.stamps().len();
    let stamp = |stamp: &parallax_runtime::node::Consumed| {
        [stamp.seq.map_or(-1, |seq| seq as i64), stamp.sent, stamp.received]
    };
    let digits = |data: &[u8]| data.iter().map(|byte| format!("{byte:02x}")).collect::<String>();
    Seen {
        stamps: input.stamps().iter().map(stamp).collect(),
        leaves: (0..count).map(|at| input.payload(at).iter().map(|leaf| leaf.to_bits()).collect()).collect(),
        data: (0..count).map(|at| digits(input.data(at))).collect(),
    }
}

/// The bytes of hexadecimal digits.
fn bytes(digits: &str) -> Option<Vec<u8>> {
    let (pairs, rest) = digits.as_bytes().as_chunks::<2>();
    let byte = |pair: &[u8; 2]| u8::from_str_radix(std::str::from_utf8(pair).ok()?, 16).ok();
    if rest.is_empty() { pairs.iter().map(byte).collect() } else { None }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hexadecimal_digits_are_bytes() {
        assert_eq!(bytes("00ff10"), Some(vec![0, 255, 16]));
        assert_eq!(bytes(""), Some(vec![]));
        assert_eq!((bytes("0"), bytes("zz")), (None, None));
    }
}
