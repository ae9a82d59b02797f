//! Messages of any type as numbers with names.

use std::collections::HashMap;
use std::rc::Rc;

/// Part of a message.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Value {
    Number(f64),
    Text(String),
    /// A moment, in nanoseconds.
    Moment(i64),
    /// Bytes, and anything else that is no number over time.
    Opaque,
    List(Vec<Value>),
    Fields(Vec<(Rc<str>, Value)>),
}

/// Lists of more elements are pictures, clouds or scans, not signals.
const LONGEST: usize = 64;

/// The numbers of the messages on one topic: a column for each path.
#[derive(Default)]
pub(super) struct Numbers {
    /// Paths within the message, in the order in which they came.
    pub(super) paths: Vec<String>,
    /// As many as paths; NaN where a message had none.
    pub(super) columns: Vec<Vec<f64>>,
    pub(super) rows: usize,
    /// Where something was too long.
    pub(super) long: Vec<String>,
    index: HashMap<String, usize>,
}

impl Numbers {
    /// Adds a message.
    pub(super) fn push(&mut self, message: &Value) {
        let mut path = String::new();
        self.walk(message, &mut path);
        self.rows += 1;
        for column in &mut self.columns {
            column.resize(self.rows, f64::NAN);
        }
    }

    fn walk(&mut self, value: &Value, path: &mut String) {
        match value {
            Value::Number(number) => self.set(path, *number),
            Value::Text(_) | Value::Moment(_) | Value::Opaque => {}
            Value::List(items) => self.list(items, None, path),
            Value::Fields(fields) => {
                for (name, value) in fields {
                    // The stamp is the clock's, and a layout says how data lie.
                    if matches!(&**name, "header" | "layout") && !matches!(value, Value::Number(_)) {
                        continue;
                    }
                    if let Value::List(items) = value
                        && let Some(labels) = labels(fields, items.len())
                    {
                        let field = if matches!(&**name, "values" | "value" | "data") { "" } else { name };
                        self.list(items, Some((labels, field)), path);
                        continue;
                    }
                    let length = path.len();
                    join(path, name);
                    self.walk(value, path);
                    path.truncate(length);
                }
            }
        }
    }

    /// Elements, by their labels or their numbers.
    fn list(&mut self, items: &[Value], labels: Option<(Vec<&str>, &str)>, path: &mut String) {
        if items.len() > LONGEST {
            if !self.long.iter().any(|long| long == path) {
                self.long.push(path.clone());
            }
            return;
        }
        let length = path.len();
        for (number, item) in items.iter().enumerate() {
            match (&labels, item) {
                (_, Value::Text(_) | Value::Opaque | Value::Moment(_)) => continue,
                // `elbow.position`, of the lists `name` and `position`.
                (Some((labels, field)), item) => {
                    join(path, labels[number]);
                    if matches!(item, Value::Number(_)) {
                        join(path, field);
                    }
                }
                (None, Value::Fields(fields)) => match own_label(fields) {
                    Some(label) => join(path, label),
                    None => path.push_str(&format!("[{number}]")),
                },
                (None, _) => path.push_str(&format!("[{number}]")),
            }
            self.walk(item, path);
            path.truncate(length);
        }
    }

    fn set(&mut self, path: &str, number: f64) {
        let column = match self.index.get(path) {
            Some(column) => *column,
            None => {
                self.index.insert(path.to_owned(), self.paths.len());
                self.paths.push(path.to_owned());
                self.columns.push(Vec::new());
                self.columns.len() - 1
            }
        };
        let column = &mut self.columns[column];
        column.resize(self.rows, f64::NAN);
        column.push(number);
    }
}

fn join(path: &mut String, name: &str) {
    if !path.is_empty() && !name.is_empty() {
        path.push('.');
    }
    path.push_str(name);
}

/// The names that a message gives the elements of its lists of this length.
fn labels(fields: &[(Rc<str>, Value)], length: usize) -> Option<Vec<&str>> {
    fields.iter().find_map(|(_, value)| {
        let Value::List(items) = value else { return None };
        let texts: Option<Vec<&str>> = items
            .iter()
            .map(|item| match item {
                Value::Text(text) => Some(text.as_str()),
                _ => None,
            })
            .collect();
        texts.filter(|texts| texts.len() == length && length > 0)
    })
}

/// What an element of a list calls itself.
fn own_label(fields: &[(Rc<str>, Value)]) -> Option<&str> {
    ["name", "child_frame_id", "joint_name", "id"].into_iter().find_map(|key| {
        fields.iter().find_map(|(name, value)| match value {
            Value::Text(text) if **name == *key && !text.is_empty() => Some(text.as_str()),
            _ => None,
        })
    })
}

/// When a message was true, by itself: the stamp in its header, or its own.
pub(super) fn stamp(message: &Value) -> Option<i64> {
    let Value::Fields(fields) = message else { return None };
    let find = |fields: &[(Rc<str>, Value)], key: &str| {
        fields.iter().find(|(name, _)| **name == *key).map(|(_, value)| value.clone())
    };
    let stamp = match find(fields, "header") {
        Some(Value::Fields(header)) => find(&header, "stamp"),
        _ => find(fields, "stamp").or_else(|| find(fields, "timestamp")),
    };
    match stamp {
        // Zero is a stamp that nobody set.
        Some(Value::Moment(stamp)) if stamp != 0 => Some(stamp),
        _ => None,
    }
}

/// A JSON message.
pub(super) fn of_json(json: &serde_json::Value) -> Value {
    match json {
        serde_json::Value::Null => Value::Opaque,
        serde_json::Value::Bool(flag) => Value::Number(f64::from(*flag)),
        serde_json::Value::Number(number) => Value::Number(number.as_f64().unwrap_or(f64::NAN)),
        serde_json::Value::String(text) => Value::Text(text.clone()),
        serde_json::Value::Array(items) => Value::List(items.iter().map(of_json).collect()),
        serde_json::Value::Object(fields) => {
            let number = |key: &str| fields.get(key).and_then(serde_json::Value::as_i64);
            let nanoseconds = number("nanosec").or_else(|| number("nsec"));
            match (number("sec"), nanoseconds, fields.len()) {
                (Some(seconds), Some(nanoseconds), 2) => {
                    Value::Moment(seconds.saturating_mul(1_000_000_000).saturating_add(nanoseconds))
                }
                _ => Value::Fields(
                    fields.iter().map(|(name, value)| (name.as_str().into(), of_json(value))).collect(),
                ),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn numbers(messages: &[serde_json::Value]) -> Vec<(String, Vec<f64>)> {
        let mut numbers = Numbers::default();
        for message in messages {
            numbers.push(&of_json(message));
        }
        numbers.paths.into_iter().zip(numbers.columns).collect()
    }

    #[test]
    fn lists_go_by_the_names_beside_them() {
        let state = json!({
            "header": {"stamp": {"sec": 1, "nanosec": 5}, "frame_id": "base"},
            "name": ["elbow", "wrist"], "position": [0.5, 1.5], "velocity": [], "effort": [2.0, 3.0],
        });
        assert_eq!(stamp(&of_json(&state)), Some(1_000_000_005));
        // JSON's fields come in the order of their names.
        let expected =
            [("elbow.effort", 2.0), ("wrist.effort", 3.0), ("elbow.position", 0.5), ("wrist.position", 1.5)];
        assert_eq!(numbers(&[state]), expected.map(|(path, value)| (path.to_owned(), vec![value])));
        let dynamic = json!({"joint_names": ["j"], "interface_values": [
            {"interface_names": ["position", "effort"], "values": [0.5, 2.0]}]});
        assert_eq!(numbers(&[dynamic]), [("j.position".into(), vec![0.5]), ("j.effort".into(), vec![2.0])]);
        let transforms = json!({"transforms": [{"child_frame_id": "arm", "x": 1.0}, {"x": 2.0}]});
        assert_eq!(
            numbers(&[transforms]),
            [("transforms.arm.x".into(), vec![1.0]), ("transforms[1].x".into(), vec![2.0])]
        );
    }

    #[test]
    fn a_message_without_a_number_leaves_a_hole() {
        let got = numbers(&[json!({"a": 1}), json!({"b": true}), json!({"a": 3, "b": false})]);
        assert_eq!((got[0].0.as_str(), got[1].0.as_str()), ("a", "b"));
        assert!(got[0].1[1].is_nan() && got[1].1[0].is_nan());
        assert_eq!((got[0].1[2], got[1].1[1], got[1].1[2]), (3.0, 1.0, 0.0));
    }

    #[test]
    fn pictures_are_no_signals() {
        let mut numbers = Numbers::default();
        numbers.push(&of_json(&json!({"ranges": vec![1.0; 65], "x": 1.0, "text": "no"})));
        assert_eq!((numbers.paths, numbers.long), (vec!["x".to_owned()], vec!["ranges".to_owned()]));
    }
}
