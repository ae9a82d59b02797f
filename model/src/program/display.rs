//! Programs as text for people.

use std::fmt::{Display, Formatter, Result};

use super::{Function, Op, Program, Value};

impl Display for Program {
    /// One function after another, the body last; constants are written where they are used.
    fn fmt(&self, f: &mut Formatter<'_>) -> Result {
        let (body, earlier) = (self.functions.len() - 1, &self.functions[..self.functions.len() - 1]);
        for (index, function) in earlier.iter().enumerate() {
            let names: Vec<String> = (0..function.inputs).map(|input| format!("a{input}")).collect();
            writeln!(f, "fn {}#{index}({}) {{", function.name, names.join(", "))?;
            let values = self.write_ops(f, function, names)?;
            writeln!(f, "  return {}\n}}\n", list(&values, &function.outputs))?;
        }
        let function = &self.functions[body];
        writeln!(f, "program {}({}) {{", function.name, self.inputs.join(", "))?;
        let values = self.write_ops(f, function, self.inputs.clone())?;
        for (name, value) in self.outputs.iter().zip(&function.outputs) {
            writeln!(f, "  return {name} = {}", values[*value as usize])?;
        }
        write!(f, "}}")
    }
}

impl Program {
    /// Writes one line for each operation, and gives what each value is called.
    fn write_ops(
        &self,
        f: &mut Formatter<'_>,
        function: &Function,
        mut values: Vec<String>,
    ) -> std::result::Result<Vec<String>, std::fmt::Error> {
        for op in &function.ops {
            if let Op::Constant(value) = op {
                values.push(if value.is_sign_negative() {
                    format!("({value:?})")
                } else {
                    format!("{value:?}")
                });
                continue;
            }
            let first = values.len();
            let names: Vec<String> =
                (first..first + self.results(op)).map(|number| format!("v{number}")).collect();
            writeln!(f, "  {} = {}", names.join(", "), self.expression(op, &values))?;
            values.extend(names);
        }
        Ok(values)
    }

    fn expression(&self, op: &Op, values: &[String]) -> String {
        let v = |value: &Value| &values[*value as usize];
        let called = |function: &u32| format!("{}#{function}", self.functions[*function as usize].name);
        match op {
            Op::Constant(value) => format!("{value:?}"),
            Op::Unary(unary, a) => format!("{}({})", unary.name(), v(a)),
            Op::Binary(binary, a, b) if binary.is_infix() => format!("{} {} {}", v(a), binary.name(), v(b)),
            Op::Binary(binary, a, b) => format!("{}({}, {})", binary.name(), v(a), v(b)),
            Op::Powi(a, exponent) => format!("{} ^ {exponent}", v(a)),
            Op::Compare(compare, a, b) => format!("{} {} {}", v(a), compare.name(), v(b)),
            Op::And(a, b) => format!("{} and {}", v(a), v(b)),
            Op::Or(a, b) => format!("{} or {}", v(a), v(b)),
            Op::Not(a) => format!("not {}", v(a)),
            Op::Select(mask, then, otherwise) => {
                format!("if {} then {} else {}", v(mask), v(then), v(otherwise))
            }
            Op::Call { function, inputs } => format!("{}({})", called(function), list(values, inputs)),
            Op::Scan { function, length, carry, xs, captures } => {
                let parts = parts(values, &[("carry", carry), ("xs", xs), ("with", captures)]);
                format!("scan {} x {length} ({parts})", called(function))
            }
            Op::Map { function, length, xs, captures } => {
                let parts = parts(values, &[("xs", xs), ("with", captures)]);
                format!("map {} x {length} ({parts})", called(function))
            }
        }
    }
}

fn list(values: &[String], which: &[Value]) -> String {
    which.iter().map(|value| values[*value as usize].as_str()).collect::<Vec<_>>().join(", ")
}

/// The operands of a loop, each group behind what it is.
fn parts(values: &[String], groups: &[(&str, &Vec<Value>)]) -> String {
    let used = groups.iter().filter(|(_, group)| !group.is_empty());
    used.map(|(name, group)| format!("{name} {}", list(values, group))).collect::<Vec<_>>().join("; ")
}
