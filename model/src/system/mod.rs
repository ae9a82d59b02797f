//! A plant described by equations: the contents of a `system.toml`; and what it is there to do, a [`Task`].
//!
//! There are two stages. [`System::parse`] reads the text: structure, bounds and the syntax of every
//! expression are right, but a name may still be open, because a recording's `[constants]` can supply it.
//! [`System::with_constants`] adds those, and [`System::equations`] gives every name its meaning:
//! [`Equations`] are evaluated with any [`Scalar`](crate::Scalar).
//!
//! ```
//! use parallax_model::system::{Point, System};
//!
//! let text = r#"
//! format = 1
//! name = "pendulum"
//!
//! [parameters]
//! g = { value = 9.81, unit = "m/s^2" }
//!
//! [inputs]
//! torque = { signal = "torque_command" }
//!
//! [let]
//! J = "mass*length^2"
//!
//! [state]
//! q = { derivative = "v", initial = "angle" }
//! v = { derivative = "torque/J - g/length*sin(q)" }
//!
//! [outputs]
//! angle = { value = "q", unit = "rad" }
//!
//! [joints]
//! pivot = { position = "q", velocity = "v", inertia = "J", drive = "torque" }
//! "#;
//! let system = System::parse(text, "system.toml")?;
//! let constants = [("mass".to_owned(), 0.5), ("length".to_owned(), 1.0)];
//! let equations = system.with_constants(&constants)?.equations()?;
//!
//! let point = Point { parameters: &equations.nominal(), states: &[0.0, 0.0], inputs: &[1.0], time: 0.0 };
//! let free = equations.values(&point, &[]);
//! assert_eq!(free.derivatives, [0.0, 2.0]);
//! let held_back = equations.values(&point, &[(0, -0.25)]); // a force of -0.25 N m on the first joint
//! assert_eq!(held_back.derivatives, [0.0, 1.5]);
//! # Ok::<(), parallax_model::system::SystemError>(())
//! ```

mod correct;
mod depends;
mod equations;
mod error;
mod expression;
mod independent;
mod lexer;
mod order;
mod own;
mod parts;
mod program;
mod read;
mod signals;
mod table;
mod task;

pub use equations::{Equations, JointValues, OwnEffect, Point, Values};
pub use error::{Excerpt, Location, Suggestion, SystemError, nearest};
pub use expression::Expression;
pub use own::{OwnEffect as StatedEffect, OwnParameter};
pub use parts::{EffectEntry, Entry, Initial, Input, Joint, Let, Output, Parameter, State, Supply};
pub use task::{BoundTask, Policy, Task};

/// A parsed `system.toml`. Its expressions may use names that only a recording's constants define.
#[derive(Clone, Debug, PartialEq)]
pub struct System {
    /// The system's own name.
    pub name: String,
    /// The file's name, for messages.
    pub file: String,
    /// In the order of the file, then those that [`System::with_constants`] added.
    pub parameters: Vec<Parameter>,
    /// In the order of the file.
    pub inputs: Vec<Input>,
    /// Ordered so that each needs only earlier ones.
    pub lets: Vec<Let>,
    /// In the order of the file.
    pub states: Vec<State>,
    /// In the order of the file.
    pub outputs: Vec<Output>,
    /// In the order of the file.
    pub joints: Vec<Joint>,
    /// In the order of the file.
    pub effects: Vec<EffectEntry>,
    /// Effects that the file adds to the library, in its order.
    pub own: Vec<StatedEffect>,
    /// Names of constants that nothing uses: what a misspelt name may have meant.
    unused: Vec<String>,
}

impl System {
    /// Reads the text of a `system.toml`; `file` is its name for messages.
    ///
    /// # Errors
    ///
    /// A [`SystemError`] for the first thing that is wrong, with file, line and, where it applies, the expression.
    pub fn parse(text: &str, file: &str) -> Result<Self, SystemError> {
        read::system(text, file)
    }

    /// The system with a recording's constants: one that names a parameter replaces its value, which then is
    /// known and no longer calibrated; one that an expression uses becomes a parameter; others have no bearing
    /// on the system and are left out.
    ///
    /// # Errors
    ///
    /// [`SystemError::BadConstant`] for a constant that is not finite, or that shares its name with an input,
    /// a named expression or a state.
    pub fn with_constants(&self, constants: &[(String, f64)]) -> Result<Self, SystemError> {
        let mut system = self.clone();
        for (name, value) in constants {
            let bad = |problem: String| SystemError::BadConstant {
                file: self.file.as_str().into(),
                name: name.as_str().into(),
                problem: problem.into(),
            };
            if !value.is_finite() {
                return Err(bad(format!("{value} is not a finite number")));
            }
            if let Some(kind) = self.kind_of(name) {
                return Err(bad(format!("the system has {kind} of that name; rename one of them")));
            }
            match system.parameters.iter_mut().find(|parameter| parameter.name == *name) {
                Some(parameter) => {
                    parameter.value = *value;
                    parameter.calibrate = None;
                    parameter.std = None;
                }
                None if self.uses(name) => system.parameters.push(Parameter {
                    name: name.clone(),
                    value: *value,
                    unit: String::new(),
                    calibrate: None,
                    std: None,
                    line: 0,
                }),
                None => system.unused.push(name.clone()),
            }
        }
        Ok(system)
    }

    /// Gives every name in every expression its meaning.
    ///
    /// # Errors
    ///
    /// [`SystemError::UnknownName`] for a name that nothing defines; [`SystemError::Absent`] for a payload of a
    /// parameter that does not exist.
    pub fn equations(&self) -> Result<Equations, SystemError> {
        Equations::new(self.clone())
    }

    /// The names that the equations use and nothing defines yet: a recording's constants must supply them.
    pub fn open_names(&self) -> Vec<&str> {
        // A payload's `mass` is the added mass, whose name binding gives a meaning.
        let payloads = self.joints.iter().flat_map(|joint| joint.payload.values());
        let payloads: Vec<&Expression> = payloads.collect();
        let mut open = std::collections::BTreeSet::new();
        for expression in self.expressions() {
            let in_payload = payloads.iter().any(|payload| std::ptr::eq(*payload, expression));
            let undefined = |name: &&str| self.kind_of(name).is_none() && self.parameter(name).is_none();
            open.extend(expression.names().filter(undefined).filter(|name| !(in_payload && *name == "mass")));
        }
        open.into_iter().collect()
    }

    /// Index of the parameter `name`.
    pub fn parameter(&self, name: &str) -> Option<usize> {
        self.parameters.iter().position(|parameter| parameter.name == name)
    }

    /// Index of the input `name`.
    pub fn input(&self, name: &str) -> Option<usize> {
        self.inputs.iter().position(|input| input.name == name)
    }

    /// Index of the state `name`.
    pub fn state(&self, name: &str) -> Option<usize> {
        self.states.iter().position(|state| state.name == name)
    }

    /// Index of the output `name`.
    pub fn output(&self, name: &str) -> Option<usize> {
        self.outputs.iter().position(|output| output.name == name)
    }

    /// Index of the joint `name`.
    pub fn joint(&self, name: &str) -> Option<usize> {
        self.joints.iter().position(|joint| joint.name == name)
    }

    /// Every expression of the system.
    fn expressions(&self) -> impl Iterator<Item = &Expression> {
        let joints = self.joints.iter().flat_map(|joint| {
            let optional = [&joint.inertia, &joint.drive, &joint.load, &joint.lever];
            [&joint.position, &joint.velocity]
                .into_iter()
                .chain(optional.into_iter().flatten())
                .chain(joint.payload.values())
        });
        self.lets
            .iter()
            .map(|entry| &entry.expression)
            .chain(self.states.iter().map(|state| &state.derivative))
            .chain(self.outputs.iter().map(|output| &output.value))
            .chain(joints)
    }

    fn uses(&self, name: &str) -> bool {
        self.expressions().any(|expression| expression.names().any(|used| used == name))
            || self.joints.iter().any(|joint| joint.payload.contains_key(name))
    }

    /// What `name` is, if it is something other than a parameter.
    fn kind_of(&self, name: &str) -> Option<&'static str> {
        if self.input(name).is_some() {
            Some("an input")
        } else if self.state(name).is_some() {
            Some("a state")
        } else if self.lets.iter().any(|entry| entry.name == name) {
            Some("a named expression")
        } else {
            None
        }
    }
}
