//! The parts of a parsed `system.toml`, as the file states them.

use std::collections::BTreeMap;

use super::expression::Expression;
use crate::effect::Effect;

/// A number that the equations may name.
#[derive(Clone, Debug, PartialEq)]
pub struct Parameter {
    /// The name that expressions use.
    pub name: String,
    /// The nominal value, in `unit`.
    pub value: f64,
    /// A label such as `N s/m`; empty when the file states none.
    pub unit: String,
    /// The bounds within which a fit may move the value; absent for a parameter that is known.
    pub calibrate: Option<[f64; 2]>,
    /// Standard deviation of the prior around `value`, in `unit`.
    pub std: Option<f64>,
    /// Line of the entry in `system.toml`; 0 when a recording's `[constants]` supplied the parameter.
    pub line: usize,
}

/// A voltage that drives an input's actuator.
#[derive(Clone, Debug, PartialEq)]
pub struct Supply {
    /// The recorded signal.
    pub signal: String,
    /// The voltage at which the input acts as the equations say.
    pub nominal: f64,
}

/// A quantity from outside, held from its stamp until the next.
#[derive(Clone, Debug, PartialEq)]
pub struct Input {
    /// The name that expressions use.
    pub name: String,
    /// The recorded signal it is bound to.
    pub signal: String,
    /// Further signals, if the input is the mean of several.
    pub others: Vec<String>,
    /// The battery behind it, if the file names one.
    pub supply: Option<Supply>,
    /// Line of the entry in `system.toml`.
    pub line: usize,
}

/// A named expression.
#[derive(Clone, Debug, PartialEq)]
pub struct Let {
    /// The name that other expressions use.
    pub name: String,
    /// Its value.
    pub expression: Expression,
    /// Line of the entry in `system.toml`.
    pub line: usize,
}

/// Where a state starts.
#[derive(Clone, Debug, PartialEq)]
pub enum Initial {
    /// At the first sample of this signal.
    Signal(String),
    /// At this value.
    Fixed(f64),
    /// At a value that the fit finds for each recording.
    Calibrated {
        /// The first guess.
        value: f64,
        /// Lower bound.
        low: f64,
        /// Upper bound.
        high: f64,
    },
    /// Unknown.
    Free,
}

/// A quantity that the system integrates over time.
#[derive(Clone, Debug, PartialEq)]
pub struct State {
    /// The name that expressions use.
    pub name: String,
    /// Its rate of change per second.
    pub derivative: Expression,
    /// Where it starts.
    pub initial: Initial,
    /// Line of the entry in `system.toml`.
    pub line: usize,
}

/// A quantity that a sensor measures.
#[derive(Clone, Debug, PartialEq)]
pub struct Output {
    /// The key in `[outputs]`.
    pub name: String,
    /// The recorded signal it is compared with: by default the one of its own name.
    pub signal: String,
    /// What the sensor should read.
    pub value: Expression,
    /// A label, compared with the signal's; empty when the file states none.
    pub unit: String,
    /// Standard deviation of the measurement noise, in `unit`; absent when it is to be estimated.
    pub noise: Option<f64>,
    /// The period of a circular quantity, such as 2π for an angle, in `unit`.
    pub wrap: Option<f64>,
    /// Line of the entry in `system.toml`.
    pub line: usize,
}

/// A place where a generalised force may enter.
#[derive(Clone, Debug, PartialEq)]
pub struct Joint {
    /// The key in `[joints]`.
    pub name: String,
    /// Position of the joint (rad or m).
    pub position: Expression,
    /// The state that `position` is, when it names one plainly; a tilt shifts it.
    pub position_state: Option<usize>,
    /// Velocity of the joint (rad/s or m/s).
    pub velocity: Expression,
    /// The state that `velocity` is, when it names one plainly; a force enters its derivative.
    pub velocity_state: Option<usize>,
    /// Index into [`System::lets`](super::System::lets) of the force to which others are added.
    pub force: Option<usize>,
    /// What the force works against (kg m² or kg), used when there is no `force`.
    pub inertia: Option<Expression>,
    /// The driving force as it enters the equation (N m or N).
    pub drive: Option<Expression>,
    /// The load's force as it enters the equation (N m or N): gear torque is |drive − load|.
    pub load: Option<Expression>,
    /// Length of the arm at whose end added mass sits (m).
    pub lever: Option<Expression>,
    /// Parameters that added mass changes: name to new value, an expression of parameters and `mass`.
    pub payload: BTreeMap<String, Expression>,
    /// The state that holds the surrounding air's velocity, as an index into the states.
    pub air: Option<usize>,
    /// Line of the entry in `system.toml`.
    pub line: usize,
}

/// How a force enters the equations of motion of a joint.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Entry {
    /// It is added to the named expression of this index.
    Let(usize),
    /// It is divided by the joint's inertia and added to the derivative of the state of this index.
    Derivative(usize),
}

impl Joint {
    /// How a force enters, or why none can: the reason completes the sentence "not testable: …".
    pub fn entry(&self) -> Result<Entry, &'static str> {
        match (self.force, &self.inertia, self.velocity_state) {
            (Some(index), _, _) => Ok(Entry::Let(index)),
            (None, Some(_), Some(state)) => Ok(Entry::Derivative(state)),
            (None, Some(_), None) => Err("the joint's `velocity` is not a state and it names no `force`"),
            (None, None, _) => Err("the joint names neither `force` nor `inertia`"),
        }
    }
}

impl Joint {
    /// Whether the joint states what an effect needs, or why not: the reason completes the sentence "not testable: …".
    pub fn supports(&self, effect: Effect) -> Result<(), &'static str> {
        if effect == Effect::WindSpeed {
            return if self.air.is_some() { Ok(()) } else { Err("the joint names no `air`") };
        }
        if effect == Effect::Payload && !self.payload.is_empty() {
            return Ok(());
        }
        self.entry()?;
        let needs = |present: bool, reason| if present { Ok(()) } else { Err(reason) };
        match effect {
            // Where there is no load, the gear transmits the drive.
            Effect::LoadFriction => needs(self.drive.is_some(), "the joint names no `drive`"),
            Effect::GravityTilt => {
                needs(self.load.is_some(), "the joint names no `load`")?;
                needs(self.position_state.is_some(), "the joint's `position` is not a state")
            }
            Effect::Payload => {
                needs(self.lever.is_some(), "the joint names neither `lever` nor `payload`")?;
                needs(self.velocity_state.is_some(), "the joint's `velocity` is not a state")
            }
            Effect::Inertia | Effect::FlexibilityFar => {
                needs(self.velocity_state.is_some(), "the joint's `velocity` is not a state")
            }
            Effect::Flexibility => {
                needs(self.velocity_state.is_some(), "the joint's `velocity` is not a state")?;
                needs(self.drive.is_some(), "the joint names no `drive`")
            }
            _ => Ok(()),
        }
    }
}

/// A departure from the equations that is part of the system: an `[[effect]]` of the file.
#[derive(Clone, Debug, PartialEq)]
pub struct EffectEntry {
    /// Name of the effect, such as `delay`.
    pub name: String,
    /// Where it acts, such as `input:goal`.
    pub place: String,
    /// Its parameters by name, in the order of the file.
    pub parameters: Vec<(String, f64)>,
    /// The speed (rad/s or m/s) within which the direction of dry friction is smoothed around rest; a diagnosis chooses it
    /// from its data, and what simulates the system without any needs it.
    pub smoothing: Option<f64>,
    /// Line of the entry in `system.toml`; 0 for one that is not from a file.
    pub line: usize,
}

impl EffectEntry {
    /// The effect that the entry means, in the form that has its parameters, and their values in the effect's order.
    ///
    /// # Errors
    ///
    /// Why there is none, as the end of a sentence.
    pub fn resolve(&self) -> Result<(Effect, Vec<f64>), String> {
        let given: Vec<&str> = self.parameters.iter().map(|(name, _)| name.as_str()).collect();
        let Some(effect) = Effect::with_parameters(&self.name, &given) else {
            let forms: Vec<String> = Effect::forms(&self.name)
                .map(|form| {
                    let names: Vec<&str> = form.parameters().iter().map(|p| p.name).collect();
                    format!("{{{}}}", names.join(", "))
                })
                .collect();
            return Err(if forms.is_empty() {
                format!("there is no effect `{}`", self.name)
            } else {
                format!(
                    "`{}` takes the parameters {}, and the entry gives {{{}}}",
                    self.name,
                    forms.join(" or "),
                    given.join(", ")
                )
            });
        };
        let mut values = Vec::with_capacity(given.len());
        for parameter in effect.parameters() {
            let value =
                self.parameters.iter().find(|(name, _)| name == parameter.name).map_or(0.0, |(_, v)| *v);
            if value < parameter.low || value > parameter.high {
                return Err(format!(
                    "`{}` is {value}, and can only lie between {} and {}",
                    parameter.name, parameter.low, parameter.high
                ));
            }
            values.push(value);
        }
        Ok((effect, values))
    }
}
