//! A task file: what a closed loop costs and, where no recorded graph holds it, the controller that closes it.

use super::error::SystemError;
use super::expression::{Expression, NameUse};
use super::parts::{Input, Output, State};
use super::read::{described, document};
use super::table::Table;
use super::{Equations, System};

const SECTIONS: [&str; 9] =
    ["format", "name", "task", "policy", "parameters", "inputs", "let", "state", "outputs"];

/// What a machine under a controller is there to do, and what that costs.
///
/// The file has the tables of a `system.toml` without a machine: `[parameters]`, `[let]`, `[inputs]` (other names for
/// recorded signals), and, for a controller that no recorded graph holds, `[state]` and `[outputs]`, one output for each
/// signal that it commands. A state has a `derivative`, its inputs being held from one step of the controller to the next,
/// or a `next`, its value at the next step. Names that the file does not define are outputs, inputs or signals of the machine
/// ([`Task::bind`]).
///
/// ```
/// use parallax_model::system::Task;
///
/// let task = Task::parse(r#"
/// format = 1
/// name = "follow the course"
///
/// [task]
/// cost = "error^2 + 1e-4*force^2" # averaged over time
/// horizon = 2.0                   # s: an episode; the recording is cut into as many as it holds
///
/// [policy]
/// rate = 100.0                    # Hz
///
/// [let]
/// error = "course - position"
///
/// [state]
/// sum  = { derivative = "error", initial = 0.0 }
/// last = { next = "position", initial = "position" } # the position of the step before
///
/// [outputs]
/// force = { value = "clamp(80*error + 5*sum - 9*(position - last)/0.01, -20, 20)" }
/// "#, "task.toml")?;
/// // The machine has signals of these names.
/// let bound = task.bind(&["course", "position"], |name| Some(name.to_owned()))?;
/// let names: Vec<&str> = bound.controller.system().inputs.iter().map(|input| input.name.as_str()).collect();
/// assert_eq!(names, ["course", "force", "position", "last"]);
/// # Ok::<(), parallax_model::system::SystemError>(())
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct Task {
    /// The cost at an instant.
    pub cost: Expression,
    /// What the end of an episode adds to the mean cost.
    pub terminal: Option<Expression>,
    /// Unit of the cost, a label; empty when the file states none.
    pub unit: String,
    /// Where in the recording the task begins (s from its first stamp).
    pub from: f64,
    /// Where it ends; the recording's end when it is absent.
    pub to: Option<f64>,
    /// Length of an episode (s); all of that part when it is absent.
    pub horizon: Option<f64>,
    /// When the controller of this file runs.
    pub policy: Policy,
    /// The controller: its outputs are the commands; none where the file describes no controller.
    pub system: System,
    /// What the controller keeps from one step to the next: states whose rule is their next value.
    pub memory: Vec<State>,
}

/// When a controller runs.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Policy {
    /// Steps a second (Hz); when the recorded commands are stamped, if it is absent.
    pub rate: Option<f64>,
    /// How old a value has to be for the controller to know it (s).
    pub latency: f64,
    /// Line of `[policy]`; 0 where the file has none.
    pub line: usize,
}

impl Task {
    /// Reads the text of a task file; `file` is its name for messages.
    ///
    /// # Errors
    ///
    /// A [`SystemError`] for the first thing that is wrong, with file, line and, where it applies, the expression.
    pub fn parse(text: &str, file: &str) -> Result<Self, SystemError> {
        document(text, file, "the task file", |root| {
            root.only(&SECTIONS)?;
            let remedy =
                "say what the closed loop costs: `[task]` and below it `cost = \"(position - goal)^2\"`";
            let task = root.needed("task", remedy)?.called("[task]".into()).table()?;
            task.only(&["cost", "terminal", "unit", "from", "to", "horizon"])?;
            for table in ["parameters", "inputs", "outputs"] {
                let known: &[&str] = match table {
                    "parameters" => &["value", "unit"],
                    "inputs" => &["signal"],
                    _ => &["value", "unit", "signal"],
                };
                let Some(section) = root.field(table) else { continue };
                for entry in section.called(format!("[{table}]")).table()?.fields() {
                    let what = format!("`{}` of [{table}]", entry.key);
                    entry.called(what).table()?.only(known)?;
                }
            }
            let mut system = described(root, &["derivative", "next"])?;
            let steps = |state: &State| {
                let entries =
                    root.field("state").and_then(|field| field.item.as_table_like()?.get(&state.name));
                entries.and_then(|entry| entry.as_table_like()?.get("next")).is_some()
            };
            let (memory, states) = std::mem::take(&mut system.states).into_iter().partition(steps);
            system.states = states;
            let policy = policy(root, &system)?;
            let cost =
                task.needed("cost", "an expression of outputs, inputs and time, such as \"angle^2\"")?;
            let from = task.field("from").map(|field| match field.number()? {
                value if value >= 0.0 => Ok(value),
                value => Err(field.bad(&format!("{value} lies before the recording's first stamp"))),
            });
            let from = from.transpose()?.unwrap_or(0.0);
            let to = task.field("to").map(|field| match field.number()? {
                value if value > from => Ok(value),
                value => Err(field.bad(&format!("the task ends at {value} s and begins at {from} s"))),
            });
            Ok(Task {
                cost: cost.expression()?,
                terminal: task.expression("terminal")?,
                unit: task.string("unit")?.unwrap_or_default().into(),
                from,
                to: to.transpose()?,
                horizon: task.positive("horizon")?,
                policy,
                system,
                memory,
            })
        })
    }

    /// Whether the file describes a controller.
    #[must_use]
    pub fn has_policy(&self) -> bool {
        !self.system.outputs.is_empty()
    }

    /// Gives every name that the file leaves open a signal of the machine: `signal` says which one, if there is one of that
    /// name. The task's equations then have an input for each.
    ///
    /// # Errors
    ///
    /// [`SystemError::UnknownName`] for a name that neither the file nor the machine has; `known` are those of the
    /// machine.
    pub fn bind(
        &self,
        known: &[&str],
        signal: impl Fn(&str) -> Option<String>,
    ) -> Result<BoundTask, SystemError> {
        let mut system = self.system.clone();
        let rules: Vec<&Expression> = self.memory.iter().map(|state| &state.derivative).collect();
        let costs = [Some(&self.cost), self.terminal.as_ref()];
        let apart: Vec<&Expression> = rules.iter().copied().chain(costs.into_iter().flatten()).collect();
        let kept = |name: &str| self.memory.iter().any(|state| state.name == name);
        let names = system.expressions().chain(apart.iter().copied()).flat_map(Expression::names);
        let open = names.filter(|name| system.kind_of(name).is_none() && system.parameter(name).is_none());
        let open: std::collections::BTreeSet<String> =
            open.filter(|name| !kept(name)).map(str::to_owned).collect();
        for name in open {
            if let Some(signal) = signal(&name) {
                system.inputs.push(Input { name, signal, others: Vec::new(), supply: None, line: 0 });
            }
        }
        // Where a name is still open, say what the machine would have offered.
        let unknown = |expression: &Expression| {
            let used = expression.names.iter().find(|used| {
                !matches!(&*used.name, "pi" | "time")
                    && system.kind_of(&used.name).is_none()
                    && system.parameter(&used.name).is_none()
                    && !kept(&used.name)
            })?;
            Some(expression.unknown_name(
                used,
                known.iter().copied(),
                "; it is neither defined in the task file nor an output, an input or a signal of the machine",
            ))
        };
        if let Some(error) = system.expressions().chain(apart).find_map(unknown) {
            return Err(error);
        }
        let signals = system.inputs.len();
        let mut controller = system.clone();
        controller.inputs.extend(self.memory.iter().map(|state| Input {
            name: state.name.clone(),
            signal: state.name.clone(),
            others: Vec::new(),
            supply: None,
            line: state.line,
        }));
        let cost = costs_alone(&controller, signals, &self.cost, self.terminal.as_ref())?.equations()?;
        controller.outputs.extend(self.memory.iter().map(|state| output(&state.name, &state.derivative)));
        Ok(BoundTask { controller: controller.equations()?, cost, signals, memory: self.memory.clone() })
    }
}

/// A task whose names all have a meaning.
#[derive(Clone, Debug)]
pub struct BoundTask {
    /// The controller. Its inputs are signals, then its memory; its outputs the commands, then what it keeps for its next
    /// step.
    pub controller: Equations,
    /// How many of the inputs are signals. Those of the cost are the same.
    pub signals: usize,
    /// Its memory.
    pub memory: Vec<State>,
    /// The cost at an instant, and what the end of an episode adds, if anything: one or two outputs, no states.
    pub cost: Equations,
}

fn output(name: &str, value: &Expression) -> Output {
    Output {
        name: name.into(),
        signal: name.into(),
        value: value.clone(),
        unit: String::new(),
        noise: None,
        wrap: None,
        line: value.location().line,
    }
}

/// The equations of the cost: what depends on a state of the controller, which no recording holds, is left out. Of the
/// controller's inputs, so many are signals.
fn costs_alone(
    system: &System,
    signals: usize,
    cost: &Expression,
    terminal: Option<&Expression>,
) -> Result<System, SystemError> {
    let mut alone = system.clone();
    alone.states.clear();
    alone.inputs.truncate(signals);
    loop {
        let before = alone.lets.len();
        let lets = alone.lets.clone();
        let names = alone.clone();
        alone.lets = lets
            .into_iter()
            .filter(|entry| {
                let known = |name: &str| names.kind_of(name).is_some() || names.parameter(name).is_some();
                entry.expression.names().all(known)
            })
            .collect();
        if alone.lets.len() == before {
            break;
        }
    }
    for expression in [Some(cost), terminal].into_iter().flatten() {
        let hidden =
            |used: &&NameUse| system.kind_of(&used.name).is_some() && alone.kind_of(&used.name).is_none();
        if let Some(used) = expression.names.iter().find(hidden) {
            return Err(expression.unknown_name(
                used,
                [],
                "; it depends on a state of the controller, which a recording does not hold",
            ));
        }
    }
    alone.outputs = vec![output("cost", cost)];
    alone.outputs.extend(terminal.map(|value| output("terminal", value)));
    Ok(alone)
}

fn policy(root: &Table<'_>, system: &System) -> Result<Policy, SystemError> {
    let Some(field) = root.field("policy") else { return Ok(Policy::default()) };
    let line = field.at.line;
    let table = field.called("[policy]".into()).table()?;
    table.only(&["rate", "latency"])?;
    if system.outputs.is_empty() {
        let remedy = "say what the policy commands: `[outputs]` and below it `u = { value = \"...\" }`";
        return Err(SystemError::MissingField {
            at: table.at.clone(),
            field: "outputs".into(),
            within: "the task file, which has a [policy]".into(),
            remedy: remedy.into(),
        });
    }
    let latency = table.field("latency").map(|field| match field.number()? {
        value if value >= 0.0 => Ok(value),
        value => Err(field.bad(&format!("{value} is below zero"))),
    });
    Ok(Policy { rate: table.positive("rate")?, latency: latency.transpose()?.unwrap_or(0.0), line })
}
