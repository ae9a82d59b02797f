//! Schemas in the language of ROS 2 message definitions, so that its tools show our recordings.

use std::collections::BTreeSet;
use std::fmt::Write;

/// Package under which our message types appear.
pub const PACKAGE: &str = "parallax_msgs";

/// Line between a message definition and those that it refers to.
const SEPARATOR: &str = "================================================================================";

/// ROS 2 has no message without a member; this one stands in, as its own generators have it.
pub const EMPTY_MEMBER: &str = "structure_needs_at_least_one_member";

/// A message type: its full name and its definition.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Schema {
    /// `package/msg/Name`.
    pub name: String,
    /// The definition, followed by those of the types in it.
    pub text: String,
}

/// The schema of a message whose leaves are all `float64`, and which may have data.
///
/// The field names are [`field_names`]; the names as the program has them stand in the comments of the text
/// and, for reading back, in the channel's metadata.
pub fn message(type_name: &str, leaves: &[String], data: bool) -> Schema {
    let mut text = String::new();
    let fields = field_names(leaves);
    for (field, leaf) in fields.iter().zip(leaves) {
        // A comment ends with its line, whatever the name holds.
        let comment: String = leaf.chars().filter(|c| !c.is_control()).collect();
        let _ = writeln!(
            text,
            "float64 {field}{}",
            if *field == comment { String::new() } else { format!("  # {comment}") }
        );
    }
    if data {
        // Distinct from the leaves' names, which come first.
        let mut taken = fields.into_iter().collect();
        let _ = writeln!(text, "uint8[] {}", distinct("data".into(), &mut taken));
    } else if leaves.is_empty() {
        let _ = writeln!(text, "uint8 {EMPTY_MEMBER}");
    }
    Schema { name: format!("{PACKAGE}/msg/{}", type_name_of(type_name)), text }
}

/// The types that a header is made of.
fn header() -> String {
    format!(
        "{SEPARATOR}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n\
         {SEPARATOR}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    )
}

/// The schema of an image, as ROS 2 has it.
pub fn image() -> Schema {
    let text = format!(
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\n\
         uint8[] data\n{}",
        header()
    );
    Schema { name: "sensor_msgs/msg/Image".into(), text }
}

/// The schema of a compressed image, as ROS 2 has it.
pub fn compressed_image() -> Schema {
    let text = format!("std_msgs/Header header\nstring format\nuint8[] data\n{}", header());
    Schema { name: "sensor_msgs/msg/CompressedImage".into(), text }
}

/// The schema of a node's steps.
pub fn step() -> Schema {
    let text = format!(
        "# One step of a node. All times are nanoseconds since the start of the run.\n\
         uint64 seq\n\
         int64 due  # when the schedule wanted it\n\
         int64 start\n\
         int64 end\n\
         StepInput[] inputs\n\
         {SEPARATOR}\n\
         MSG: {PACKAGE}/StepInput\n\
         # What one input port gave the step.\n\
         string port\n\
         Consumed[] consumed  # oldest first\n\
         uint64 superseded  # messages that left the window unseen since the last step\n\
         {SEPARATOR}\n\
         MSG: {PACKAGE}/Consumed\n\
         bool initial  # the initial message, before any has come; the other fields are then 0\n\
         uint64 seq\n\
         int64 sent\n\
         int64 received\n"
    );
    Schema { name: format!("{PACKAGE}/msg/Step"), text }
}

/// The schema of anything that is kept as text: losses and faults.
pub fn note() -> Schema {
    Schema { name: format!("{PACKAGE}/msg/Note"), text: "string json\n".into() }
}

/// Valid ROS 2 field names for these leaves, distinct, in the same order.
///
/// A field name is lower-case letters, digits and single underscores, begins with a letter and does not end
/// with an underscore.
///
/// ```
/// use parallax_runtime::recording::ros2msg::field_names;
/// let leaves = ["state.Angle", "gain[0]", "gain[1]", "2nd", "state_angle"].map(String::from);
/// assert_eq!(field_names(&leaves), ["state_angle", "gain_0", "gain_1", "x2nd", "state_angle_2"]);
/// ```
pub fn field_names(leaves: &[String]) -> Vec<String> {
    let mut taken = BTreeSet::new();
    leaves.iter().map(|leaf| distinct(field_name(leaf), &mut taken)).collect()
}

/// `name`, or the first of `name_2`, `name_3`, … that is free.
pub(crate) fn distinct(name: String, taken: &mut BTreeSet<String>) -> String {
    let mut candidate = name.clone();
    let mut number = 2;
    while !taken.insert(candidate.clone()) {
        candidate = format!("{name}_{number}");
        number += 1;
    }
    candidate
}

fn field_name(leaf: &str) -> String {
    let mut name = String::with_capacity(leaf.len());
    for c in leaf.chars() {
        if c.is_ascii_alphanumeric() {
            name.push(c.to_ascii_lowercase());
        } else if !name.is_empty() && !name.ends_with('_') {
            name.push('_');
        }
    }
    while name.ends_with('_') {
        name.pop();
    }
    match name.chars().next() {
        None => "x".into(),
        Some(c) if c.is_ascii_digit() => format!("x{name}"),
        Some(_) => name,
    }
}

/// A valid ROS 2 type name: letters and digits, beginning with a capital.
fn type_name_of(name: &str) -> String {
    let mut camel = String::with_capacity(name.len());
    let mut capital = true;
    for c in name.chars() {
        if c.is_ascii_alphanumeric() {
            camel.push(if capital { c.to_ascii_uppercase() } else { c });
            capital = false;
        } else {
            capital = true;
        }
    }
    match camel.chars().next() {
        None => "Message".into(),
        Some(c) if c.is_ascii_digit() => format!("M{camel}"),
        Some(_) => camel,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn valid_field(name: &str) -> bool {
        name.starts_with(|c: char| c.is_ascii_lowercase())
            && !name.ends_with('_')
            && !name.contains("__")
            && name.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_')
    }

    proptest! {
        #[test]
        fn every_leaf_gets_a_valid_name_of_its_own(leaves in prop::collection::vec(".{0,8}|[a-b_.]{0,4}", 0..12)) {
            let names = field_names(&leaves);
            prop_assert!(names.iter().all(|name| valid_field(name)), "{names:?}");
            prop_assert_eq!(names.iter().collect::<BTreeSet<_>>().len(), leaves.len());
        }

        #[test]
        fn every_type_gets_a_valid_name(name in ".{0,12}") {
            let name = type_name_of(&name);
            prop_assert!(name.starts_with(|c: char| c.is_ascii_uppercase()));
            prop_assert!(name.chars().all(|c| c.is_ascii_alphanumeric()));
        }

        #[test]
        fn a_strange_leaf_stays_on_its_line(leaf in "\\PC{0,6}[\n\r]{0,2}\\PC{0,6}") {
            let schema = message("m", &[leaf], false);
            prop_assert_eq!(schema.text.lines().count(), 1);
        }
    }
}
