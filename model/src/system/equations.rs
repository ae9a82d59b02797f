//! A system whose names all have a meaning, evaluated with any scalar.

use super::System;
use super::error::{Location, Suggestion, SystemError};
use super::expression::{Expression, Function, Operation};
use super::parts::Entry;
use crate::Scalar;
use crate::effect::{Effect, Place, PlaceError, PlaceKind};

/// Where a system is evaluated.
#[derive(Clone, Copy, Debug)]
pub struct Point<'a, T> {
    /// One value for each of [`System::parameters`].
    pub parameters: &'a [T],
    /// One value for each of [`System::states`].
    pub states: &'a [T],
    /// One value for each of [`System::inputs`].
    pub inputs: &'a [T],
    /// Seconds since the recording's start.
    pub time: T,
}

/// What the equations give at a point.
#[derive(Clone, Debug, PartialEq)]
pub struct Values<T> {
    /// One value for each of [`System::lets`], forces included.
    pub lets: Vec<T>,
    /// Rate of change of each of [`System::states`], per second, forces included.
    pub derivatives: Vec<T>,
    /// One value for each of [`System::outputs`].
    pub outputs: Vec<T>,
}

/// What a joint's expressions give at a point. A field that the file leaves out is `None`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JointValues<T> {
    /// Position (rad or m).
    pub position: T,
    /// Velocity (rad/s or m/s).
    pub velocity: T,
    /// The force that others are added to (N m or N).
    pub force: Option<T>,
    /// What a force works against (kg m² or kg).
    pub inertia: Option<T>,
    /// The driving force (N m or N).
    pub drive: Option<T>,
    /// The load's force (N m or N).
    pub load: Option<T>,
    /// Length of the arm at whose end added mass sits (m).
    pub lever: Option<T>,
    /// Velocity of the surrounding air.
    pub air: Option<T>,
}

/// A system whose names all have a meaning.
#[derive(Clone, Debug)]
pub struct Equations {
    system: System,
    lets: Vec<Bound>,
    derivatives: Vec<Bound>,
    outputs: Vec<Bound>,
    joints: Vec<BoundJoint>,
    effects: Vec<OwnEffect>,
}

/// An effect that is part of the system: an `[[effect]]` inside the plant, bound to its place.
#[derive(Clone, Debug, PartialEq)]
pub struct OwnEffect {
    /// The effect, in the form that the entry's parameters decide.
    pub effect: Effect,
    /// What the index counts.
    pub kind: PlaceKind,
    /// Index of the place among the system's inputs, outputs, joints, states or parameters.
    pub index: usize,
    /// Its parameters, in the effect's order.
    pub values: Vec<f64>,
}

/// What a name stands for.
#[derive(Clone, Copy, Debug)]
enum Slot {
    Parameter(usize),
    Input(usize),
    Let(usize),
    State(usize),
    Time,
    Pi,
    AddedMass,
}

/// An expression with a slot for each use of a name.
#[derive(Clone, Debug)]
struct Bound {
    operations: Vec<Operation>,
    slots: Vec<Slot>,
}

#[derive(Clone, Debug)]
struct BoundJoint {
    position: Bound,
    velocity: Bound,
    inertia: Option<Bound>,
    drive: Option<Bound>,
    load: Option<Bound>,
    lever: Option<Bound>,
    payload: Vec<(usize, Bound)>,
}

/// The name that stands for the added mass in a joint's `payload`.
const ADDED_MASS: &str = "mass";

impl Equations {
    pub(super) fn new(system: System) -> Result<Self, SystemError> {
        let bind = |expression: &Expression| bind(&system, expression);
        let optional = |expression: &Option<Expression>| expression.as_ref().map(bind).transpose();
        let lets = system.lets.iter().map(|entry| bind(&entry.expression)).collect::<Result<_, _>>()?;
        let derivatives =
            system.states.iter().map(|state| bind(&state.derivative)).collect::<Result<_, _>>()?;
        let outputs = system.outputs.iter().map(|output| bind(&output.value)).collect::<Result<_, _>>()?;
        let mut joints = Vec::with_capacity(system.joints.len());
        for joint in &system.joints {
            joints.push(BoundJoint {
                position: bind(&joint.position)?,
                velocity: bind(&joint.velocity)?,
                inertia: optional(&joint.inertia)?,
                drive: optional(&joint.drive)?,
                load: optional(&joint.load)?,
                lever: optional(&joint.lever)?,
                payload: bind_payload(&system, joint)?,
            });
        }
        let effects = own_effects(&system)?;
        Ok(Self { lets, derivatives, outputs, joints, effects, system })
    }

    /// The effects that are part of the system and act inside it. Those on connections and nodes belong to a graph.
    pub fn effects(&self) -> &[OwnEffect] {
        &self.effects
    }

    /// The system that these are the equations of.
    pub fn system(&self) -> &System {
        &self.system
    }

    /// The nominal value of each parameter.
    pub fn nominal(&self) -> Vec<f64> {
        self.system.parameters.iter().map(|parameter| parameter.value).collect()
    }

    /// Named expressions, derivatives and outputs, with forces added: pairs of a joint's index and a force
    /// (N m or N). Several on one joint add up. Where a force enters, [`Joint::entry`](super::Joint::entry) says.
    ///
    /// # Panics
    ///
    /// If the point's slices have other lengths than the system, or a force is on a joint where none can enter.
    pub fn values<T: Scalar>(&self, point: &Point<'_, T>, forces: &[(usize, T)]) -> Values<T> {
        let lets = self.lets(point, forces);
        let mut derivatives: Vec<T> =
            self.derivatives.iter().map(|d| d.evaluate(point, &lets, None)).collect();
        for &(joint, force) in forces {
            let entry = (self.entry(joint), &self.joints[joint].inertia);
            if let (Entry::Derivative(state), Some(inertia)) = entry {
                derivatives[state] += force / inertia.evaluate(point, &lets, None);
            }
        }
        let outputs = self.outputs.iter().map(|output| output.evaluate(point, &lets, None)).collect();
        Values { lets, derivatives, outputs }
    }

    /// The named expressions, in order, with forces added to those that joints name as `force`.
    ///
    /// # Panics
    ///
    /// As [`Equations::values`].
    pub fn lets<T: Scalar>(&self, point: &Point<'_, T>, forces: &[(usize, T)]) -> Vec<T> {
        assert_eq!(point.parameters.len(), self.system.parameters.len(), "one value for each parameter");
        assert_eq!(point.states.len(), self.system.states.len(), "one value for each state");
        assert_eq!(point.inputs.len(), self.system.inputs.len(), "one value for each input");
        let mut lets = Vec::with_capacity(self.lets.len());
        for (index, bound) in self.lets.iter().enumerate() {
            let mut value = bound.evaluate(point, &lets, None);
            for &(joint, force) in forces {
                if self.entry(joint) == Entry::Let(index) {
                    value += force;
                }
            }
            lets.push(value);
        }
        lets
    }

    /// A joint's quantities; `lets` as [`Equations::lets`] gave them at the same point.
    pub fn joint<T: Scalar>(&self, joint: usize, point: &Point<'_, T>, lets: &[T]) -> JointValues<T> {
        let (bound, stated) = (&self.joints[joint], &self.system.joints[joint]);
        let optional =
            |expression: &Option<Bound>| expression.as_ref().map(|e| e.evaluate(point, lets, None));
        JointValues {
            position: bound.position.evaluate(point, lets, None),
            velocity: bound.velocity.evaluate(point, lets, None),
            force: stated.force.map(|index| lets[index]),
            inertia: optional(&bound.inertia),
            drive: optional(&bound.drive),
            load: optional(&bound.load),
            lever: optional(&bound.lever),
            air: stated.air.map(|state| point.states[state]),
        }
    }

    /// The joint's load as it would be with its position moved by `shift`: what a tilt of gravity changes is the
    /// difference to the load at shift 0. `None` where the joint states no load, or its position is no state.
    pub fn load_at<T: Scalar>(&self, joint: usize, point: &Point<'_, T>, shift: T) -> Option<T> {
        let load = self.joints[joint].load.as_ref()?;
        let position = self.system.joints[joint].position_state?;
        let mut states = point.states.to_vec();
        states[position] += shift;
        let moved = Point { states: &states, ..*point };
        Some(load.evaluate(&moved, &self.lets(&moved, &[]), None))
    }

    /// The parameters with `mass` (kg) added at the joint, by the joint's `payload`; unchanged without one.
    pub fn loaded<T: Scalar>(&self, joint: usize, parameters: &[T], mass: T) -> Vec<T> {
        // A payload's expressions use parameters only, so the rest of the point does not matter.
        let point = Point { parameters, states: &[], inputs: &[], time: T::constant(0.0) };
        let mut changed = parameters.to_vec();
        for (index, bound) in &self.joints[joint].payload {
            changed[*index] = bound.evaluate(&point, &[], Some(mass));
        }
        changed
    }

    fn entry(&self, joint: usize) -> Entry {
        match self.system.joints[joint].entry() {
            Ok(entry) => entry,
            Err(reason) => {
                panic!("no force can enter at joint `{}`: {reason}", self.system.joints[joint].name)
            }
        }
    }
}

fn own_effects(system: &System) -> Result<Vec<OwnEffect>, SystemError> {
    let mut own = Vec::with_capacity(system.effects.len());
    for entry in &system.effects {
        let at = || Location::new(&system.file, entry.line);
        let bad = |problem: String| SystemError::BadValue {
            at: at(),
            field: format!("[[effect]] `{}`", entry.name).into(),
            problem: problem.into(),
        };
        let (effect, values) = entry.resolve().map_err(bad)?;
        let place: Place = entry.place.parse().map_err(|error: PlaceError| bad(error.to_string()))?;
        let index = match place.kind {
            PlaceKind::Input => system.input(&place.key),
            PlaceKind::Output => system.output(&place.key),
            PlaceKind::Joint => system.joint(&place.key),
            PlaceKind::State => system.state(&place.key),
            PlaceKind::Parameter => system.parameter(&place.key),
            PlaceKind::Connection | PlaceKind::Node => continue,
        };
        let Some(index) = index else {
            return Err(bad(format!("there is no {} `{}`", place.kind.name(), place.key)));
        };
        if place.kind == PlaceKind::Joint {
            let supported = system.joints[index].supports(effect);
            supported.map_err(|reason| bad(format!("it cannot act at {place}: {reason}")))?;
        }
        if effect == Effect::SaturationOverflow {
            system.fed_by(index).map_err(|reason| bad(format!("it cannot overflow at {place}: {reason}")))?;
        }
        own.push(OwnEffect { effect, kind: place.kind, index, values });
    }
    Ok(own)
}

fn bind(system: &System, expression: &Expression) -> Result<Bound, SystemError> {
    let mut slots = Vec::with_capacity(expression.names.len());
    for used in &expression.names {
        let name = &*used.name;
        let slot = match name {
            "pi" => Some(Slot::Pi),
            "time" => Some(Slot::Time),
            _ => system
                .state(name)
                .map(Slot::State)
                .or_else(|| system.parameter(name).map(Slot::Parameter))
                .or_else(|| system.input(name).map(Slot::Input))
                .or_else(|| system.lets.iter().position(|entry| entry.name == name).map(Slot::Let)),
        };
        let Some(slot) = slot else {
            let known = system
                .parameters
                .iter()
                .map(|p| p.name.as_str())
                .chain(system.inputs.iter().map(|i| i.name.as_str()))
                .chain(system.lets.iter().map(|l| l.name.as_str()))
                .chain(system.states.iter().map(|s| s.name.as_str()))
                .chain(system.unused.iter().map(String::as_str));
            let hint =
                "; define it in [parameters], [inputs], [let] or [state], or in the recording's [constants]";
            return Err(expression.unknown_name(used, known, hint));
        };
        slots.push(slot);
    }
    Ok(Bound { operations: expression.operations.clone(), slots })
}

fn bind_payload(system: &System, joint: &super::Joint) -> Result<Vec<(usize, Bound)>, SystemError> {
    let parameters = || system.parameters.iter().map(|parameter| parameter.name.as_str());
    let mut payload = Vec::with_capacity(joint.payload.len());
    for (name, expression) in &joint.payload {
        let Some(index) = system.parameter(name) else {
            return Err(SystemError::Absent {
                at: Location::new(&system.file, joint.line),
                within: format!("payload of joint `{}`", joint.name).into(),
                kind: "the parameter",
                name: name.as_str().into(),
                suggestion: Suggestion::nearest(name, parameters()),
            });
        };
        let mut slots = Vec::with_capacity(expression.names.len());
        for used in &expression.names {
            let slot = match &*used.name {
                "pi" => Some(Slot::Pi),
                ADDED_MASS if system.parameter(ADDED_MASS).is_some() => {
                    return Err(SystemError::BadName {
                        at: Location::new(&system.file, joint.line),
                        name: ADDED_MASS.into(),
                        problem: "in a payload it stands for the added mass, and it is a parameter too; \
                                  rename the parameter"
                            .into(),
                    });
                }
                ADDED_MASS => Some(Slot::AddedMass),
                name => system.parameter(name).map(Slot::Parameter),
            };
            let hint = "; a payload may use parameters and `mass`, the added mass";
            slots.push(
                slot.ok_or_else(|| expression.unknown_name(used, parameters().chain([ADDED_MASS]), hint))?,
            );
        }
        payload.push((index, Bound { operations: expression.operations.clone(), slots }));
    }
    Ok(payload)
}

/// A number or the result of a comparison.
#[derive(Clone, Copy)]
enum Item<T: Scalar> {
    Number(T),
    Mask(T::Mask),
}

impl<T: Scalar> Item<T> {
    fn number(self) -> T {
        match self {
            Item::Number(value) => value,
            Item::Mask(mask) => T::select(mask, T::constant(1.0), T::constant(0.0)),
        }
    }

    fn mask(self) -> T::Mask {
        match self {
            Item::Number(value) => !value.eq(T::constant(0.0)),
            Item::Mask(mask) => mask,
        }
    }
}

impl Bound {
    fn evaluate<T: Scalar>(&self, point: &Point<'_, T>, lets: &[T], added_mass: Option<T>) -> T {
        let mut items: Vec<Item<T>> = Vec::with_capacity(self.operations.len());
        for operation in &self.operations {
            let number = |index: usize| items[index].number();
            let item = match *operation {
                Operation::Number(value) => Item::Number(T::constant(value)),
                Operation::Name(index) => Item::Number(match self.slots[index] {
                    Slot::Parameter(index) => point.parameters[index],
                    Slot::Input(index) => point.inputs[index],
                    Slot::Let(index) => lets[index],
                    Slot::State(index) => point.states[index],
                    Slot::Time => point.time,
                    Slot::Pi => T::constant(std::f64::consts::PI),
                    Slot::AddedMass => added_mass.unwrap_or_else(|| T::constant(0.0)),
                }),
                Operation::Negate(a) => Item::Number(-number(a)),
                Operation::Add(a, b) => Item::Number(number(a) + number(b)),
                Operation::Subtract(a, b) => Item::Number(number(a) - number(b)),
                Operation::Multiply(a, b) => Item::Number(number(a) * number(b)),
                Operation::Divide(a, b) => Item::Number(number(a) / number(b)),
                Operation::Power(a, b) => Item::Number(number(a).powf(number(b))),
                Operation::WholePower(a, exponent) => Item::Number(number(a).powi(exponent)),
                Operation::Less(a, b) => Item::Mask(number(a).lt(number(b))),
                Operation::LessOrEqual(a, b) => Item::Mask(number(a).le(number(b))),
                Operation::Equal(a, b) => Item::Mask(Scalar::eq(number(a), number(b))),
                Operation::Call(Function::Select, [condition, then, otherwise]) => {
                    Item::Number(T::select(items[condition].mask(), number(then), number(otherwise)))
                }
                Operation::Call(function, arguments) => Item::Number(call(function, arguments, number)),
            };
            items.push(item);
        }
        items[items.len() - 1].number()
    }
}

/// Every function but `select`, whose first argument is a condition.
fn call<T: Scalar>(function: Function, [a, b, c]: [usize; 3], number: impl Fn(usize) -> T) -> T {
    match function {
        Function::Sin => number(a).sin(),
        Function::Cos => number(a).cos(),
        Function::Tan => number(a).tan(),
        Function::Asin => number(a).asin(),
        Function::Acos => number(a).acos(),
        Function::Atan => number(a).atan(),
        Function::Atan2 => number(a).atan2(number(b)),
        Function::Exp => number(a).exp(),
        Function::Log => number(a).ln(),
        Function::Sqrt => number(a).sqrt(),
        Function::Abs => number(a).abs(),
        Function::Sign => number(a).sign(),
        Function::Tanh => number(a).tanh(),
        Function::Min => number(a).min(number(b)),
        Function::Max => number(a).max(number(b)),
        Function::Clamp => number(a).clamp(number(b), number(c)),
        Function::Floor => number(a).floor(),
        Function::Select => T::select(!Scalar::eq(number(a), T::constant(0.0)), number(b), number(c)),
    }
}
