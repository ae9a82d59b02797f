//! From the text of a `system.toml` to a [`System`].

use std::collections::BTreeMap;

use toml_edit::Document;

use super::error::{Suggestion, SystemError};
use super::expression::{Expression, is_reserved};
use super::lexer::{is_name_part, is_name_start};
use super::parts::{EffectEntry, Initial, Input, Joint, Let, Output, Parameter, State, Supply};
use super::table::{Field, Source, Table};
use super::{System, order, own};
use crate::effect::{Effect, Place, PlaceKind};

const SECTIONS: [&str; 10] =
    ["format", "name", "parameters", "inputs", "let", "state", "outputs", "joints", "effect", "effects"];

/// The version of the format that this reads.
const FORMAT: i64 = 1;

pub(super) fn system(text: &str, file: &str) -> Result<System, SystemError> {
    document(text, file, "the system", |root| {
        root.only(&SECTIONS)?;
        let system = described(root, &["derivative"])?;
        if system.outputs.is_empty() {
            let remedy = "name at least one quantity that a sensor measures, such as \
                          `[outputs]` and below it `position = { value = \"q\", unit = \"rad\" }`";
            return Err(SystemError::MissingField {
                at: root.field("outputs").map_or(root.at.clone(), |field| field.at),
                field: "outputs".into(),
                within: "the system".into(),
                remedy: remedy.into(),
            });
        }
        Ok(system)
    })
}

/// Reads a file of this format, which is `what`, by its tables.
pub(super) fn document<T>(
    text: &str,
    file: &str,
    what: &str,
    read: impl FnOnce(&Table<'_>) -> Result<T, SystemError>,
) -> Result<T, SystemError> {
    let source = Source { text, file };
    let document = Document::parse(text).map_err(|error| SystemError::Toml {
        at: source.at(error.span().map(|span| span.start)),
        message: error.message().into(),
    })?;
    let root =
        Table { source: &source, entries: document.as_table(), what: what.into(), at: source.at(None) };
    if root.entries.is_empty() {
        return Err(SystemError::Empty { at: source.at(None) });
    }
    check_format(&root)?;
    read(&root)
}

/// The equations that a file's tables describe; a state's rule is under one of the keys `rules`.
pub(super) fn described(root: &Table<'_>, rules: &[&'static str]) -> Result<System, SystemError> {
    let file = root.source.file;
    let mut names = Names(BTreeMap::new());
    let parameters = section(root, "parameters", "parameter", |name, table| {
        names.take(name, "a parameter", table)?;
        parameter(name, &table.table()?)
    })?;
    let inputs = section(root, "inputs", "input", |name, table| {
        names.take(name, "an input", table)?;
        input(name, &table.table()?)
    })?;
    let lets = section(root, "let", "let", |name, field| {
        names.take(name, "a named expression", field)?;
        Ok(Let { name: name.into(), expression: field.expression()?, line: field.at.line })
    })?;
    let states = section(root, "state", "state", |name, table| {
        names.take(name, "a state", table)?;
        state(name, &table.table()?, rules)
    })?;
    let outputs = section(root, "outputs", "output", |name, table| output(name, &table.table()?))?;
    let lets = order::by_need(lets, file)?;
    let mut system = System {
        name: root.needed("name", "write `name = \"...\"` at the top")?.string()?.into(),
        file: file.into(),
        parameters,
        inputs,
        lets,
        states,
        outputs,
        joints: Vec::new(),
        effects: Vec::new(),
        own: Vec::new(),
        unused: Vec::new(),
    };
    system.joints = section(root, "joints", "joint", |name, table| joint(name, &table.table()?, &system))?;
    let own = section(root, "effects", "effect", |name, field| {
        own::read(name, &field.table()?, &mut system, |name, field| names.take(name, "a parameter", field))
    })?;
    if !own.is_empty() {
        for effect in &own {
            own::add(&mut system, effect)?;
        }
        system.own = own;
        system.lets = order::by_need(std::mem::take(&mut system.lets), file)?;
        // The order of the named expressions may be another one now.
        system.joints =
            section(root, "joints", "joint", |name, table| joint(name, &table.table()?, &system))?;
    }
    if let Some(field) = root.field("effect") {
        system.effects =
            field.tables()?.iter().map(|table| effect(table, &system)).collect::<Result<_, _>>()?;
    }
    Ok(system)
}

fn check_format(root: &Table<'_>) -> Result<(), SystemError> {
    let Some(field) = root.field("format") else {
        return Err(SystemError::MissingFormat { at: root.at.clone() });
    };
    match field.item.as_integer() {
        Some(FORMAT) => Ok(()),
        Some(found) => Err(SystemError::UnsupportedFormat { at: field.at, found }),
        None => Err(field.wrong("the whole number 1")),
    }
}

/// Reads every entry of a section that may be absent.
fn section<'a, T>(
    root: &Table<'a>,
    key: &str,
    kind: &str,
    mut read: impl FnMut(&str, &Field<'a>) -> Result<T, SystemError>,
) -> Result<Vec<T>, SystemError> {
    let Some(field) = root.field(key) else { return Ok(Vec::new()) };
    let table = field.called(format!("[{key}]")).table()?;
    let named = |field: Field<'a>| {
        let what = format!("{kind} `{}`", field.key);
        field.called(what)
    };
    table.fields().into_iter().map(named).map(|field| read(field.key, &field)).collect()
}

/// The names that expressions may use: what each is, and its line.
struct Names(BTreeMap<String, (&'static str, usize)>);

impl Names {
    fn take(&mut self, name: &str, kind: &'static str, field: &Field<'_>) -> Result<(), SystemError> {
        let bad = |problem: &str| {
            Err(SystemError::BadName { at: field.at.clone(), name: name.into(), problem: problem.into() })
        };
        if !name.starts_with(is_name_start) || !name.chars().all(is_name_part) {
            return bad(
                "expressions use it, so it must be letters, digits and `_`, not starting with a digit",
            );
        }
        if is_reserved(name) {
            return bad("expressions have a function or constant of that name");
        }
        match self.0.insert(name.into(), (kind, field.at.line)) {
            None => Ok(()),
            Some((first_kind, first_line)) => Err(SystemError::DuplicateName {
                at: field.at.clone(),
                name: name.into(),
                first_kind,
                first_line,
            }),
        }
    }
}

fn parameter(name: &str, table: &Table<'_>) -> Result<Parameter, SystemError> {
    table.only(&["value", "unit", "calibrate", "std"])?;
    let value = table.needed("value", "write its nominal value as `value = ...`")?.number()?;
    let calibrate = table.field("calibrate").map(|field| within(value, &field)).transpose()?;
    let std = table.positive("std")?;
    if let (Some(field), None) = (table.field("std"), calibrate) {
        return Err(
            field.bad("a prior is only used with `calibrate = [low, high]`; add the bounds or leave it out")
        );
    }
    let unit = table.field("unit").map(|field| unit(&field)).transpose()?.unwrap_or_default();
    Ok(Parameter { name: name.into(), value, unit, calibrate, std, line: table.at.line })
}

/// The bounds, which must hold `value`.
fn within(value: f64, field: &Field<'_>) -> Result<[f64; 2], SystemError> {
    let [low, high] = field.bounds()?;
    if (low..=high).contains(&value) {
        Ok([low, high])
    } else {
        Err(field.bad(&format!("the bounds [{low}, {high}] do not hold the value {value}")))
    }
}

/// A unit may be empty, unlike other strings.
fn unit(field: &Field<'_>) -> Result<String, SystemError> {
    field.item.as_str().map(str::to_owned).ok_or_else(|| field.wrong("a string"))
}

fn input(name: &str, table: &Table<'_>) -> Result<Input, SystemError> {
    table.only(&["signal", "mean_of", "supply"])?;
    let supply = match table.field("supply") {
        None => None,
        Some(field) => {
            let table = field.table()?;
            table.only(&["signal", "nominal"])?;
            let remedy = "a supply is written `supply = { signal = \"battery\", nominal = 12.0 }`";
            let signal = table.needed("signal", remedy)?.string()?.into();
            table.needed("nominal", remedy)?;
            table.positive("nominal")?.map(|nominal| Supply { signal, nominal })
        }
    };
    let (signal, others) = match (table.string("signal")?, table.field("mean_of")) {
        (Some(_), Some(field)) => {
            return Err(field.bad("an input is bound by `signal` or by `mean_of`, not by both"));
        }
        (None, Some(field)) => {
            let mut signals = field.strings()?.into_iter();
            let first = signals.next().ok_or_else(|| field.bad("the list is empty; name the signals"))?;
            (first, signals.collect())
        }
        (signal, None) => (signal.unwrap_or(name).into(), Vec::new()),
    };
    Ok(Input { name: name.into(), signal, others, supply, line: table.at.line })
}

fn state(name: &str, table: &Table<'_>, rules: &[&'static str]) -> Result<State, SystemError> {
    let known: Vec<&str> = rules.iter().copied().chain(["initial"]).collect();
    table.only(&known)?;
    let mut given = rules.iter().filter_map(|rule| table.field(rule));
    let derivative = match given.next() {
        Some(rule) => rule,
        None => table.needed("derivative", "write its rate of change as `derivative = \"...\"`")?,
    };
    if let Some(second) = given.next() {
        return Err(second.bad(&format!("the state has a `{}` already", derivative.key)));
    }
    let initial = match table.field("initial") {
        None => Initial::Free,
        Some(field) => initial(&field)?,
    };
    Ok(State { name: name.into(), derivative: derivative.expression()?, initial, line: table.at.line })
}

fn initial(field: &Field<'_>) -> Result<Initial, SystemError> {
    if field.item.is_str() {
        return field.string().map(|signal| Initial::Signal(signal.into()));
    }
    if !field.item.is_table_like() {
        let expected = "a signal's name, a number, or `{ value = ..., calibrate = [low, high] }`";
        return field.number().map(Initial::Fixed).map_err(|error| match error {
            SystemError::WrongType { .. } => field.wrong(expected),
            other => other,
        });
    }
    let table = field.table()?;
    table.only(&["value", "calibrate"])?;
    let value = table.needed("value", "write the first guess as `value = ...`")?.number()?;
    Ok(match table.field("calibrate") {
        None => Initial::Fixed(value),
        Some(field) => {
            let [low, high] = within(value, &field)?;
            Initial::Calibrated { value, low, high }
        }
    })
}

fn output(name: &str, table: &Table<'_>) -> Result<Output, SystemError> {
    table.only(&["value", "signal", "unit", "noise", "wrap"])?;
    Ok(Output {
        name: name.into(),
        signal: table.string("signal")?.unwrap_or(name).into(),
        value: table.needed("value", "write what the sensor reads as `value = \"...\"`")?.expression()?,
        unit: table.field("unit").map(|field| unit(&field)).transpose()?.unwrap_or_default(),
        noise: table.positive("noise")?,
        wrap: table.positive("wrap")?,
        line: table.at.line,
    })
}

fn joint(name: &str, table: &Table<'_>, system: &System) -> Result<Joint, SystemError> {
    table.only(&["position", "velocity", "force", "inertia", "drive", "load", "lever", "payload", "air"])?;
    let position =
        table.needed("position", "write the joint's position as `position = \"q\"`")?.expression()?;
    let velocity =
        table.needed("velocity", "write the joint's velocity as `velocity = \"v\"`")?.expression()?;
    let lets = || system.lets.iter().map(|entry| entry.name.as_str());
    let states = || system.states.iter().map(|state| state.name.as_str());
    let force = table.field("force").map(|field| index_of(&field, "the named expression", table, lets()));
    let air = table.field("air").map(|field| index_of(&field, "the state", table, states()));
    let mut payload = BTreeMap::new();
    if let Some(field) = table.field("payload") {
        for field in field.table()?.fields() {
            payload.insert(field.key.to_owned(), field.expression()?);
        }
    }
    let state_of = |expression: &Expression| expression.as_name().and_then(|name| system.state(name));
    Ok(Joint {
        name: name.into(),
        position_state: state_of(&position),
        velocity_state: state_of(&velocity),
        position,
        velocity,
        force: force.transpose()?,
        inertia: table.expression("inertia")?,
        drive: table.expression("drive")?,
        load: table.expression("load")?,
        lever: table.expression("lever")?,
        payload,
        air: air.transpose()?,
        line: table.at.line,
    })
}

/// The place in a list of what a field names.
fn index_of<'a>(
    field: &Field<'_>,
    kind: &'static str,
    within: &Table<'_>,
    mut among: impl Iterator<Item = &'a str> + Clone,
) -> Result<usize, SystemError> {
    let name = field.string()?;
    among.clone().position(|candidate| candidate == name).ok_or_else(|| SystemError::Absent {
        at: field.value_at(),
        within: within.what.as_str().into(),
        kind,
        name: name.into(),
        suggestion: Suggestion::nearest(name, &mut among),
    })
}

fn effect(table: &Table<'_>, system: &System) -> Result<EffectEntry, SystemError> {
    table.only(&["name", "place", "parameters", "smoothing"])?;
    let named = table.needed("name", "name the effect, such as `name = \"delay\"`")?;
    let name = named.string()?;
    let place = table.needed("place", "say where it acts, such as `place = \"input:u\"`")?;
    check_place(&place, table, system)?;
    let Some(effect) = Effect::from_name(name) else {
        return Err(SystemError::Absent {
            at: named.value_at(),
            within: table.what.as_str().into(),
            kind: "the effect",
            name: name.into(),
            suggestion: Suggestion::nearest(name, Effect::ALL.into_iter().map(Effect::name)),
        });
    };
    let mut parameters = Vec::new();
    if let Some(field) = table.field("parameters") {
        for field in field.table()?.fields() {
            parameters.push((field.key.to_owned(), field.number()?));
        }
    }
    let entry = EffectEntry {
        name: name.into(),
        place: place.string()?.into(),
        parameters,
        smoothing: table.positive("smoothing")?,
        line: table.at.line,
    };
    check_effect(&entry, effect, &place, &named)?;
    Ok(entry)
}

/// The effect's parameters must be those of one of its forms, and it must be able to act where it is put.
fn check_effect(
    entry: &EffectEntry,
    named: Effect,
    place: &Field<'_>,
    name: &Field<'_>,
) -> Result<(), SystemError> {
    let effect = match entry.resolve() {
        Ok((effect, _)) => effect,
        Err(problem) => return Err(name.bad(&problem)),
    };
    let Ok(at) = entry.place.parse::<Place>() else { return Ok(()) };
    let graph = matches!(at.kind, PlaceKind::Connection | PlaceKind::Node);
    if !graph && !effect.places().contains(&at.kind) {
        let kinds: Vec<&str> = named.places().iter().map(|kind| kind.name()).collect();
        return Err(place.bad(&format!(
            "`{}` cannot act at {}; it acts at {}",
            entry.name,
            entry.place,
            kinds.join(" or ")
        )));
    }
    Ok(())
}

/// A place inside the plant must exist; connections and nodes belong to a graph, which is not known here.
fn check_place(place: &Field<'_>, table: &Table<'_>, system: &System) -> Result<(), SystemError> {
    let (text, form) = (
        place.string()?,
        "KIND:NAME with a kind of input, output, joint, state, parameter, \
                                          connection or node, such as \"joint:axis\"",
    );
    let Some((kind, name)) = text.split_once(':').filter(|(_, name)| !name.is_empty()) else {
        return Err(place.bad(&format!("`{text}` is no place; write {form}")));
    };
    let (kind, among): (_, Vec<&str>) = match kind {
        "input" => ("the input", system.inputs.iter().map(|input| input.name.as_str()).collect()),
        "output" => ("the output", system.outputs.iter().map(|output| output.name.as_str()).collect()),
        "joint" => ("the joint", system.joints.iter().map(|joint| joint.name.as_str()).collect()),
        "state" => ("the state", system.states.iter().map(|state| state.name.as_str()).collect()),
        // A recording's constants may supply it: that it exists can only be known with them.
        "parameter" | "connection" | "node" => return Ok(()),
        _ => return Err(place.bad(&format!("`{kind}` is no kind of place; write {form}"))),
    };
    if among.contains(&name) {
        return Ok(());
    }
    Err(SystemError::Absent {
        at: place.value_at(),
        within: table.what.as_str().into(),
        kind,
        name: name.into(),
        suggestion: Suggestion::nearest(name, among),
    })
}
