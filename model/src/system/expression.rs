//! Expressions of a `system.toml`: their grammar, and their form before names have a meaning.
//!
//! From loosest to tightest: one comparison `< <= > >= ==`, then `+ -`, then `* /`, then the signs `-x`
//! and `+x`, then `^`, which groups to the right: `-x^2` is `-(x^2)`, `2^3^2` is `2^9`, `2^-x` is allowed.
//! A comparison is 1 where it holds and 0 elsewhere, so conditions are combined by `*`; the first argument
//! of `select(condition, then, otherwise)` may be a comparison or a number, which holds where it is not 0.
//! `pi` is the constant and `time` the seconds since the recording's start.
//!
//! An expression is kept as a flat list of operations, each naming earlier ones. So neither evaluating
//! nor dropping it recurses, however many terms it has; only nesting is limited, by the reader.

use super::error::{Excerpt, Location, Suggestion, SystemError};
use super::lexer::{self, Placed, Token};

/// How deep parentheses, signs and powers may nest.
const MAX_DEPTH: usize = 100;

/// A function that expressions may call.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Function {
    Sin,
    Cos,
    Tan,
    Asin,
    Acos,
    Atan,
    Atan2,
    Exp,
    Log,
    Sqrt,
    Abs,
    Sign,
    Tanh,
    Min,
    Max,
    Clamp,
    Floor,
    Select,
}

impl Function {
    /// Name and number of arguments.
    const ALL: [(Function, &'static str, usize); 18] = [
        (Function::Sin, "sin", 1),
        (Function::Cos, "cos", 1),
        (Function::Tan, "tan", 1),
        (Function::Asin, "asin", 1),
        (Function::Acos, "acos", 1),
        (Function::Atan, "atan", 1),
        (Function::Atan2, "atan2", 2),
        (Function::Exp, "exp", 1),
        (Function::Log, "log", 1),
        (Function::Sqrt, "sqrt", 1),
        (Function::Abs, "abs", 1),
        (Function::Sign, "sign", 1),
        (Function::Tanh, "tanh", 1),
        (Function::Min, "min", 2),
        (Function::Max, "max", 2),
        (Function::Clamp, "clamp", 3),
        (Function::Floor, "floor", 1),
        (Function::Select, "select", 3),
    ];
}

/// Whether `name` is a function, a constant or the time, and so cannot name anything else.
pub(super) fn is_reserved(name: &str) -> bool {
    name == "pi" || name == "time" || Function::ALL.iter().any(|(_, function, _)| *function == name)
}

/// One operation; operands are indices of earlier operations.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Operation {
    Number(f64),
    /// Index into the expression's names.
    Name(usize),
    Negate(usize),
    Add(usize, usize),
    Subtract(usize, usize),
    Multiply(usize, usize),
    Divide(usize, usize),
    Power(usize, usize),
    /// To a whole power, whose derivative stays finite where the base is not positive.
    WholePower(usize, i32),
    Less(usize, usize),
    LessOrEqual(usize, usize),
    Equal(usize, usize),
    /// Unused operands are 0.
    Call(Function, [usize; 3]),
}

/// A use of a name in an expression.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct NameUse {
    pub(super) name: Box<str>,
    /// In characters from the start of the expression.
    pub(super) position: usize,
}

/// An expression whose syntax is right and whose names have no meaning yet.
#[derive(Clone, Debug, PartialEq)]
pub struct Expression {
    text: Box<str>,
    at: Location,
    of: Box<str>,
    pub(super) operations: Vec<Operation>,
    pub(super) names: Vec<NameUse>,
}

impl Expression {
    /// Reads `text`, which stands at line `line` of `file` and belongs to `of` (such as "let `J`").
    ///
    /// # Errors
    ///
    /// [`SystemError::Syntax`], [`SystemError::UnknownFunction`] or [`SystemError::WrongArity`], each with
    /// the expression and a caret.
    pub fn parse(text: &str, file: &str, line: usize, of: &str) -> Result<Self, SystemError> {
        let mut expression = Self {
            text: text.into(),
            at: Location::new(file, line),
            of: of.into(),
            operations: Vec::new(),
            names: Vec::new(),
        };
        let tokens = lexer::tokens(text).map_err(|m| expression.syntax(m.position, &m.problem))?;
        let mut reader = Reader { tokens: &tokens, next: 0, depth: 0, expression: &mut expression };
        let last = reader.comparison()?;
        if let Some(extra) = reader.peek() {
            let problem = match &extra.token {
                Token::Symbol(")") => "this parenthesis closes nothing",
                Token::Symbol("<" | "<=" | ">" | ">=" | "==") => {
                    "comparisons do not chain; write `(a < b)*(b < c)`"
                }
                Token::Symbol(";") => "an expression has no `;`",
                _ => "an operator is missing before this",
            };
            return Err(reader.expression.syntax(extra.position, problem));
        }
        debug_assert_eq!(last + 1, expression.operations.len());
        Ok(expression)
    }

    /// The same expression, shown as another one is.
    pub(super) fn shown_as(mut self, other: &Self) -> Self {
        self.text.clone_from(&other.text);
        self
    }

    /// The expression as the file states it.
    pub fn text(&self) -> &str {
        &self.text
    }

    /// The file and line of its string.
    pub fn location(&self) -> &Location {
        &self.at
    }

    /// The names it uses, in order of appearance, repeated as often as they are used; without `pi` and `time`.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.names.iter().map(|used| &*used.name).filter(|name| *name != "pi" && *name != "time")
    }

    /// The name that the whole expression is, if it is one.
    pub fn as_name(&self) -> Option<&str> {
        match self.operations[..] {
            [Operation::Name(index)] => Some(&self.names[index].name),
            _ => None,
        }
    }

    pub(super) fn unknown_name<'a>(
        &self,
        used: &NameUse,
        known: impl IntoIterator<Item = &'a str>,
        hint: &'static str,
    ) -> SystemError {
        SystemError::UnknownName {
            at: self.at.clone(),
            of: self.of.clone(),
            name: used.name.clone(),
            suggestion: Suggestion::nearest(&used.name, known),
            hint,
            excerpt: self.excerpt(used.position),
        }
    }

    fn excerpt(&self, position: usize) -> Excerpt {
        Excerpt { text: self.text.clone(), position }
    }

    fn syntax(&self, position: usize, problem: &str) -> SystemError {
        SystemError::Syntax {
            at: self.at.clone(),
            of: self.of.clone(),
            problem: problem.into(),
            excerpt: self.excerpt(position),
        }
    }
}

/// Recursive descent, one method for each level of binding. Each returns the index of its result, which is
/// always the last operation.
struct Reader<'a> {
    tokens: &'a [Placed],
    next: usize,
    depth: usize,
    expression: &'a mut Expression,
}

impl<'a> Reader<'a> {
    fn peek(&self) -> Option<&'a Placed> {
        self.tokens.get(self.next)
    }

    fn take_symbol(&mut self, among: &[&'static str]) -> Option<&'static str> {
        match self.peek()?.token {
            Token::Symbol(symbol) if among.contains(&symbol) => {
                self.next += 1;
                Some(symbol)
            }
            _ => None,
        }
    }

    /// Position of the next token, or of the end.
    fn position(&self) -> usize {
        self.peek().map_or_else(|| self.expression.text.chars().count(), |placed| placed.position)
    }

    fn fail<T>(&self, position: usize, problem: &str) -> Result<T, SystemError> {
        Err(self.expression.syntax(position, problem))
    }

    fn emit(&mut self, operation: Operation) -> usize {
        self.expression.operations.push(operation);
        self.expression.operations.len() - 1
    }

    fn comparison(&mut self) -> Result<usize, SystemError> {
        let left = self.sum()?;
        let Some(symbol) = self.take_symbol(&["<", "<=", ">", ">=", "=="]) else { return Ok(left) };
        let right = self.sum()?;
        Ok(self.emit(match symbol {
            "<" => Operation::Less(left, right),
            "<=" => Operation::LessOrEqual(left, right),
            ">" => Operation::Less(right, left),
            ">=" => Operation::LessOrEqual(right, left),
            _ => Operation::Equal(left, right),
        }))
    }

    fn sum(&mut self) -> Result<usize, SystemError> {
        let mut left = self.product()?;
        while let Some(symbol) = self.take_symbol(&["+", "-"]) {
            let right = self.product()?;
            left = self.emit(match symbol {
                "+" => Operation::Add(left, right),
                _ => Operation::Subtract(left, right),
            });
        }
        Ok(left)
    }

    fn product(&mut self) -> Result<usize, SystemError> {
        let mut left = self.signed()?;
        while let Some(symbol) = self.take_symbol(&["*", "/"]) {
            let right = self.signed()?;
            left = self.emit(match symbol {
                "*" => Operation::Multiply(left, right),
                _ => Operation::Divide(left, right),
            });
        }
        Ok(left)
    }

    /// Every way to nest passes here, so this is where depth is counted.
    fn signed(&mut self) -> Result<usize, SystemError> {
        if self.depth == MAX_DEPTH {
            return self.fail(self.position(), "nested too deeply; name the parts in [let]");
        }
        self.depth += 1;
        let result = match self.take_symbol(&["-", "+"]) {
            Some("-") => self.signed().map(|operand| self.negate(operand)),
            Some(_) => self.signed(),
            None => self.power(),
        };
        self.depth -= 1;
        result
    }

    fn negate(&mut self, operand: usize) -> usize {
        match self.expression.operations.last_mut() {
            // The sign of a number is part of it: exact, and it keeps `x^-2` a whole power.
            Some(Operation::Number(value)) => {
                *value = -*value;
                operand
            }
            _ => self.emit(Operation::Negate(operand)),
        }
    }

    fn power(&mut self) -> Result<usize, SystemError> {
        let base = self.primary()?;
        if self.take_symbol(&["^"]).is_none() {
            return Ok(base);
        }
        let exponent = self.signed()?;
        Ok(match self.expression.operations[exponent] {
            Operation::Number(value) if value.fract() == 0.0 && value.abs() <= 64.0 => {
                self.expression.operations.pop();
                self.emit(Operation::WholePower(base, value as i32))
            }
            _ => self.emit(Operation::Power(base, exponent)),
        })
    }

    fn primary(&mut self) -> Result<usize, SystemError> {
        let Some(placed) = self.peek() else {
            return self.fail(self.position(), "the expression ends where a value should follow");
        };
        self.next += 1;
        match &placed.token {
            Token::Number(value) => Ok(self.emit(Operation::Number(*value))),
            Token::Name(name) => {
                if self.take_symbol(&["("]).is_some() {
                    return self.call(name, placed.position);
                }
                if Function::ALL.iter().any(|(_, function, _)| *function == &**name) {
                    let problem = format!("`{name}` is a function; give it arguments in parentheses");
                    return self.fail(placed.position, &problem);
                }
                let index = self.expression.names.len();
                self.expression.names.push(NameUse { name: name.clone(), position: placed.position });
                Ok(self.emit(Operation::Name(index)))
            }
            Token::Symbol("(") => {
                let value = self.comparison()?;
                self.close(placed.position)?;
                Ok(value)
            }
            Token::Symbol(symbol) => self.fail(
                placed.position,
                &format!("a value (number, name, function or parenthesis) should stand before `{symbol}`"),
            ),
        }
    }

    /// The closing parenthesis of the one at `opened`.
    fn close(&mut self, opened: usize) -> Result<(), SystemError> {
        match self.peek() {
            _ if self.take_symbol(&[")"]).is_some() => Ok(()),
            None => self.fail(opened, "this parenthesis is never closed"),
            Some(placed) if matches!(placed.token, Token::Symbol("<" | "<=" | ">" | ">=" | "==")) => {
                self.fail(placed.position, "comparisons do not chain; write `(a < b)*(b < c)`")
            }
            Some(placed) => self.fail(placed.position, "an operator or `)` is missing before this"),
        }
    }

    /// A call of `name`, whose opening parenthesis has been read.
    fn call(&mut self, name: &str, position: usize) -> Result<usize, SystemError> {
        let opened = self.tokens[self.next - 1].position;
        let Some(&(function, name, expected)) = Function::ALL.iter().find(|(_, known, _)| *known == name)
        else {
            return Err(SystemError::UnknownFunction {
                at: self.expression.at.clone(),
                of: self.expression.of.clone(),
                name: name.into(),
                suggestion: Suggestion::nearest(name, Function::ALL.iter().map(|(_, known, _)| *known)),
                excerpt: self.expression.excerpt(position),
            });
        };
        let mut arguments = [0; 3];
        let mut found = 0;
        if self.take_symbol(&[")"]).is_none() {
            loop {
                let argument = self.comparison()?;
                if let Some(slot) = arguments.get_mut(found) {
                    *slot = argument;
                }
                found += 1;
                if self.take_symbol(&[","]).is_none() {
                    break;
                }
            }
            self.close(opened)?;
        }
        if found != expected {
            return Err(SystemError::WrongArity {
                at: self.expression.at.clone(),
                of: self.expression.of.clone(),
                name,
                expected,
                found,
                excerpt: self.expression.excerpt(position),
            });
        }
        Ok(self.emit(Operation::Call(function, arguments)))
    }
}
