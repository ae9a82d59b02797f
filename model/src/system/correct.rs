//! Writes what a diagnosis found back into the text of a `system.toml`.

use toml_edit::{ArrayOfTables, DocumentMut, InlineTable, Item, Table, TableLike, Value};

use super::System;
use super::error::{Location, Suggestion, SystemError};
use super::parts::EffectEntry;

impl System {
    /// The text of this system's file with calibrated values set and effects appended; comments, order and
    /// everything else stay. `original` is the text that the system was parsed from.
    ///
    /// # Errors
    ///
    /// [`SystemError::Absent`] for a value of a parameter that the file does not state, and whatever
    /// [`System::parse`] finds wrong with the result, such as a value outside its bounds.
    pub fn corrected(
        &self,
        original: &str,
        calibrated: &[(String, f64)],
        effects: &[EffectEntry],
    ) -> Result<String, SystemError> {
        // The original has been parsed before, so that this finds its errors with their lines.
        System::parse(original, &self.file)?;
        let mut document: DocumentMut = original.parse().map_err(|error: toml_edit::TomlError| {
            SystemError::Toml { at: Location::new(&self.file, 0), message: error.message().into() }
        })?;
        for (name, value) in calibrated {
            let stated = self.value_of(&mut document, name)?;
            let decor = stated.decor().clone();
            *stated = (*value).into();
            *stated.decor_mut() = decor;
        }
        if !effects.is_empty() {
            append(&mut document, effects);
        }
        let text = document.to_string();
        System::parse(&text, &self.file)?;
        Ok(text)
    }

    /// The system with these values of parameters that it has, and with these effects beside its own.
    #[must_use]
    pub fn with_corrections(&self, values: &[(String, f64)], effects: &[EffectEntry]) -> Self {
        let mut system = self.clone();
        for (name, value) in values {
            if let Some(index) = system.parameter(name) {
                system.parameters[index].value = *value;
            }
        }
        system.effects.extend(effects.iter().cloned());
        system
    }

    /// Where the document states a parameter's value.
    fn value_of<'a>(&self, document: &'a mut DocumentMut, name: &str) -> Result<&'a mut Value, SystemError> {
        // An effect that the file adds has parameters of its own.
        let effect = self.own.iter().find(|own| {
            own.parameters.iter().any(|parameter| self.parameters[parameter.index].name == *name)
        });
        let section = match effect {
            Some(own) => document
                .get_mut("effects")
                .and_then(Item::as_table_like_mut)
                .and_then(|effects| effects.get_mut(own.effect.name()))
                .and_then(Item::as_table_like_mut)
                .and_then(|effect| effect.get_mut("parameters")),
            None => document.get_mut("parameters"),
        };
        section
            .and_then(Item::as_table_like_mut)
            .and_then(|parameters| parameters.get_mut(name))
            .and_then(Item::as_table_like_mut)
            .and_then(|parameter| parameter.get_mut("value"))
            .and_then(Item::as_value_mut)
            .ok_or_else(|| SystemError::Absent {
                at: Location::new(&self.file, 0),
                within: "the correction".into(),
                kind: "the parameter",
                name: name.into(),
                suggestion: Suggestion::nearest(name, self.parameters.iter().map(|p| p.name.as_str())),
            })
    }
}

fn append(document: &mut DocumentMut, effects: &[EffectEntry]) {
    // An array written inline can only be continued inline.
    if let Some(array) = document.get_mut("effect").and_then(Item::as_array_mut) {
        for effect in effects {
            let mut table = InlineTable::new();
            fill(&mut table, effect);
            array.push(table);
        }
        return;
    }
    let item = document.entry("effect").or_insert_with(|| Item::ArrayOfTables(ArrayOfTables::new()));
    if let Some(array) = item.as_array_of_tables_mut() {
        for effect in effects {
            let mut table = Table::new();
            table.decor_mut().set_prefix("\n");
            fill(&mut table, effect);
            array.push(table);
        }
    }
}

fn fill(table: &mut dyn TableLike, effect: &EffectEntry) {
    let mut parameters = InlineTable::new();
    for (name, value) in &effect.parameters {
        parameters.insert(name, (*value).into());
    }
    table.insert("name", toml_edit::value(&effect.name));
    table.insert("place", toml_edit::value(&effect.place));
    table.insert("parameters", toml_edit::value(parameters));
    if let Some(smoothing) = effect.smoothing {
        table.insert("smoothing", toml_edit::value(smoothing));
    }
}
