//! The safe output of a node: what its receivers are given in place of what it cannot send.

use std::collections::BTreeMap;
use std::fmt;

use parallax_model::system::Suggestion;
use serde::de::{Error, Visitor};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use super::GraphError;
use crate::registry::NodeKind;

/// The key that stands for all leaves without a line of their own.
const REST: &str = "*";
/// How "the last value that was sent" is written.
const HOLD: &str = "hold";

/// One leaf of a safe output.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum SafeValue {
    /// This value, in the unit of the leaf.
    Number(f64),
    /// The last value that was sent, or that of the initial message before there was one. Written `"hold"`.
    Hold,
}

impl Serialize for SafeValue {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Number(value) => serializer.serialize_f64(*value),
            Self::Hold => serializer.serialize_str(HOLD),
        }
    }
}

impl<'de> Deserialize<'de> for SafeValue {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Reader;
        impl Visitor<'_> for Reader {
            type Value = SafeValue;
            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                write!(f, "a number or \"{HOLD}\"")
            }
            fn visit_f64<E: Error>(self, value: f64) -> Result<SafeValue, E> {
                Ok(SafeValue::Number(value))
            }
            fn visit_i64<E: Error>(self, value: i64) -> Result<SafeValue, E> {
                Ok(SafeValue::Number(value as f64))
            }
            fn visit_u64<E: Error>(self, value: u64) -> Result<SafeValue, E> {
                Ok(SafeValue::Number(value as f64))
            }
            fn visit_str<E: Error>(self, value: &str) -> Result<SafeValue, E> {
                if value == HOLD {
                    Ok(SafeValue::Hold)
                } else {
                    Err(E::invalid_value(serde::de::Unexpected::Str(value), &self))
                }
            }
        }
        deserializer.deserialize_any(Reader)
    }
}

/// The safe output of a node, one value for each leaf of its output.
#[derive(Debug, Clone, PartialEq)]
pub struct SafeOutput(Box<[SafeValue]>);

impl SafeOutput {
    /// A safe output with these values.
    pub fn new(values: impl IntoIterator<Item = SafeValue>) -> Self {
        Self(values.into_iter().collect())
    }

    /// The values, one for each leaf.
    pub fn values(&self) -> &[SafeValue] {
        &self.0
    }

    /// Turns the last message into the safe one: leaves that hold stay as they are.
    ///
    /// # Panics
    ///
    /// When `leaves` has fewer leaves than the output.
    #[inline]
    pub fn write_over(&self, leaves: &mut [f64]) {
        for (value, leaf) in self.0.iter().zip(leaves) {
            if let SafeValue::Number(value) = value {
                *leaf = *value;
            }
        }
    }

    /// The safe output of a node that the graph gives these values, or else its kind's.
    pub(super) fn plan(
        node: &str,
        given: Option<&BTreeMap<String, SafeValue>>,
        kind: &NodeKind,
    ) -> Result<Option<Self>, GraphError> {
        let Some(given) = given else { return Ok(kind.safe_output().cloned()) };
        let leaves = &kind.output().leaves;
        let known = || leaves.join(", ");
        if let Some(name) = given.keys().find(|name| *name != REST && !leaves.contains(name)) {
            return Err(GraphError::SafeLeaf {
                node: node.into(),
                leaf: name.clone(),
                suggestion: Suggestion::nearest(name, leaves.iter().map(String::as_str)),
                known: known(),
            });
        }
        let value = |leaf: &String| {
            let value = given.get(leaf).or_else(|| given.get(REST)).copied();
            match value {
                None => Err(GraphError::SafeMissing { node: node.into(), leaf: leaf.clone() }),
                Some(SafeValue::Number(value)) if !value.is_finite() => {
                    Err(GraphError::SafeNotFinite { node: node.into(), leaf: leaf.clone() })
                }
                Some(value) => Ok(value),
            }
        };
        Ok(Some(Self(leaves.iter().map(value).collect::<Result<_, _>>()?)))
    }
}
