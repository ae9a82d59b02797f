//! Where an effect acts, written `joint:axis`, `input:u`, `connection:motor->world`.

use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;

/// A place: a key of a `system.toml`, a node or a connection.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(into = "String", try_from = "String")]
pub struct Place {
    /// What kind of place it is.
    pub kind: PlaceKind,
    /// The key after the colon.
    pub key: String,
}

/// The kinds of places.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum PlaceKind {
    /// A command on its way to the plant.
    Input,
    /// A reading.
    Output,
    /// A degree of freedom, where forces act.
    Joint,
    /// A state of the plant.
    State,
    /// A parameter of the nominal model.
    Parameter,
    /// A connection between two nodes, `A->B`.
    Connection,
    /// A node.
    Node,
}

impl PlaceKind {
    const ALL: [(PlaceKind, &'static str); 7] = [
        (PlaceKind::Input, "input"),
        (PlaceKind::Output, "output"),
        (PlaceKind::Joint, "joint"),
        (PlaceKind::State, "state"),
        (PlaceKind::Parameter, "parameter"),
        (PlaceKind::Connection, "connection"),
        (PlaceKind::Node, "node"),
    ];

    /// The word before the colon.
    #[must_use]
    pub fn name(self) -> &'static str {
        Self::ALL.iter().find(|(kind, _)| *kind == self).map_or("", |(_, name)| name)
    }
}

/// A place that cannot be read.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "`{0}` is no place: write one of input, output, joint, state, parameter, connection or node, a colon and a name, such as `joint:axis`"
)]
pub struct PlaceError(pub String);

impl Place {
    /// The place `kind:key`.
    #[must_use]
    pub fn new(kind: PlaceKind, key: impl Into<String>) -> Self {
        Place { kind, key: key.into() }
    }
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}", self.kind.name(), self.key)
    }
}

impl FromStr for Place {
    type Err = PlaceError;

    fn from_str(text: &str) -> Result<Self, PlaceError> {
        let (kind, key) = text.split_once(':').ok_or_else(|| PlaceError(text.into()))?;
        let kind = PlaceKind::ALL.iter().find(|(_, name)| *name == kind).map(|(kind, _)| *kind);
        match kind {
            Some(kind) if !key.is_empty() => Ok(Place::new(kind, key)),
            _ => Err(PlaceError(text.into())),
        }
    }
}

impl From<Place> for String {
    fn from(place: Place) -> String {
        place.to_string()
    }
}

impl TryFrom<String> for Place {
    type Error = PlaceError;

    fn try_from(text: String) -> Result<Self, PlaceError> {
        text.parse()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_what_it_writes() {
        for text in ["joint:axis", "input:u", "connection:motor->world", "output:angle"] {
            assert_eq!(text.parse::<Place>().unwrap().to_string(), text);
        }
        for text in ["axis", "joint:", "limb:axis", ""] {
            assert_eq!(text.parse::<Place>(), Err(PlaceError(text.into())));
        }
    }
}
