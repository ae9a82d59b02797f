//! What series look like: their roles, and the units that ROS has for its messages.

use super::header::words;
use super::{Found, Series};
use crate::recording::log::Role;

const REFERENCE: [&str; 16] = [
    "ref",
    "reference",
    "desired",
    "des",
    "goal",
    "target",
    "setpoint",
    "sp",
    "soll",
    "plan",
    "planned",
    "demanded",
    "demand",
    "trajectory",
    "traj",
    "want",
];
const COMMAND: [&str; 22] = [
    "cmd",
    "cmds",
    "command",
    "commands",
    "commanded",
    "ctrl",
    "control",
    "controls",
    "u",
    "pwm",
    "duty",
    "throttle",
    "input",
    "inputs",
    "action",
    "actions",
    "vir",
    "drive",
    "valve",
    "pump",
    "thrust",
    "stell",
];
const CONTEXT: [&str; 20] = [
    "battery",
    "bat",
    "vbat",
    "batt",
    "supply",
    "vsupply",
    "volts",
    "temp",
    "temperature",
    "humidity",
    "enable",
    "enabled",
    "mode",
    "wind",
    "ambient",
    "load",
    "payload",
    "vbus",
    "bus",
    "percentage",
];
const MEASURED: [&str; 24] = [
    "measured",
    "meas",
    "actual",
    "act",
    "ist",
    "feedback",
    "fb",
    "enc",
    "encoder",
    "sensor",
    "imu",
    "gyro",
    "acc",
    "accel",
    "odom",
    "position",
    "pos",
    "velocity",
    "vel",
    "angle",
    "state",
    "speed",
    "level",
    "observation",
];
/// What drives a machine, where nothing says that it was measured.
const DRIVING: [&str; 9] =
    ["torque", "torques", "tau", "effort", "force", "voltage", "current", "power", "motor"];
/// What is said of nothing but a reading.
const PROVED: [&str; 7] = ["measured", "meas", "actual", "ist", "feedback", "fb", "observation"];
/// What is written beside signals and is none.
const BESIDE: [&str; 18] = [
    "covariance",
    "index",
    "idx",
    "frame",
    "seq",
    "sequence",
    "id",
    "counter",
    "count",
    "episode",
    "task",
    "checksum",
    "crc",
    "status",
    "error",
    "valid",
    "secs",
    "nsecs",
];

/// Says of every series which role it seems to have.
pub(super) fn roles(found: &mut Found) {
    for group in &mut found.groups {
        let kind = group.kind.clone();
        for series in &mut group.series {
            series.role = role(&kind, series);
        }
    }
    let has = |found: &Found, role: Role| found.series().any(|(_, series)| series.role == Some(role));
    // A machine that is told where to be has its references for commands.
    let aims = !has(found, Role::Command) && has(found, Role::Reference);
    let drives = !has(found, Role::Command) && !aims;
    for series in found.groups.iter_mut().flat_map(|group| &mut group.series) {
        if aims && series.role == Some(Role::Reference) {
            series.role = Some(Role::Command);
        }
        // What an amplifier gives, where nothing says that it was measured.
        let given = matches!(series.unit.as_str(), "V" | "A" | "N m" | "N" | "mA" | "mV" | "%")
            || (series.unit.is_empty() && has_word(&series.column, &DRIVING));
        let proved = words(&series.name).iter().any(|word| PROVED.contains(&word.as_str()));
        if drives
            && given
            && !proved
            && series.role == Some(Role::Measurement)
            && !has_word(&series.column, &MEASURED)
        {
            series.role = Some(Role::Command);
        }
    }
}

fn has_word(name: &str, list: &[&str]) -> bool {
    // `temp_2`, `u1`
    words(name).iter().any(|word| list.contains(&word.trim_end_matches(|c: char| c.is_ascii_digit())))
}

fn role(kind: &str, series: &Series) -> Option<Role> {
    // The name begins with that of the topic, and of the file where there are several.
    let (name, own) = (words(&series.name), words(&series.column));
    // `Unnamed: 0` is the number of a row, which tables write beside the rest.
    let beside = own.first().is_some_and(|word| BESIDE.contains(&word.as_str()) || word == "unnamed")
        || own.iter().any(|word| word == "covariance" || word == "seq");
    if beside || is_still(series) || is_counter(series) {
        return None;
    }
    let battery = kind.ends_with("BatteryState") || kind.ends_with("Temperature");
    let told =
        kind.ends_with("/Twist") || kind.ends_with("/TwistStamped") && name.iter().any(|word| word == "cmd");
    Some(if name.iter().any(|word| PROVED.contains(&word.as_str())) {
        Role::Measurement
    } else if has_word(&series.name, &COMMAND) || told {
        Role::Command
    } else if has_word(&series.name, &REFERENCE) {
        Role::Reference
    } else if battery || has_word(&series.name, &CONTEXT) {
        Role::Context
    } else {
        Role::Measurement
    })
}

/// Whether a series never changes: it neither drives anything nor shows anything.
fn is_still(series: &Series) -> bool {
    let mut known = series.values.iter().filter(|value| !value.is_nan());
    known
        .next()
        .is_some_and(|first| known.next().is_some() && series.values.iter().all(|v| v.is_nan() || v == first))
}

/// Whether a series counts rows.
fn is_counter(series: &Series) -> bool {
    series.values.len() > 2 && series.values.windows(2).all(|pair| pair[1] - pair[0] == 1.0)
}

/// The unit that ROS has for a number in a message of this type (REP 103, and the comments of `common_interfaces`); empty
/// where the type does not settle it.
pub(super) fn ros_unit(kind: &str, path: &str) -> &'static str {
    let name = kind.rsplit('/').next().unwrap_or("");
    let ends = |end: &str| path.rsplit('.').next().is_some_and(|last| last == end);
    let has = |part: &str| path.split('.').any(|word| word == part);
    if path.contains("covariance") || has("orientation") || has("rotation") {
        return "";
    }
    match name {
        "Imu" if has("angular_velocity") => "rad/s",
        "Imu" if has("linear_acceleration") => "m/s^2",
        "Twist" | "TwistStamped" | "Odometry" | "TwistWithCovarianceStamped" if has("angular") => "rad/s",
        "Twist" | "TwistStamped" | "Odometry" | "TwistWithCovarianceStamped" if has("linear") => "m/s",
        "Accel" | "AccelStamped" if has("angular") => "rad/s^2",
        "Accel" | "AccelStamped" if has("linear") => "m/s^2",
        "Pose" | "PoseStamped" | "Odometry" | "PoseWithCovarianceStamped" if has("position") => "m",
        "TransformStamped" | "TFMessage" if has("translation") => "m",
        "Point" | "PointStamped" => "m",
        "Wrench" | "WrenchStamped" if has("force") => "N",
        "Wrench" | "WrenchStamped" if has("torque") => "N m",
        "BatteryState" if ends("voltage") => "V",
        "BatteryState" if ends("current") => "A",
        "Temperature" | "BatteryState" if ends("temperature") => "degC",
        "FluidPressure" if ends("fluid_pressure") => "Pa",
        "Range" if ends("range") => "m",
        "MagneticField" if has("magnetic_field") => "T",
        _ => "",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::import::foreign::Group;

    fn of(columns: &[(&str, &str)]) -> Vec<Option<Role>> {
        let series = columns.iter().map(|(column, unit)| Series {
            name: (*column).into(),
            column: (*column).into(),
            unit: (*unit).into(),
            values: vec![0.0, 2.0, 1.0],
            clock: 0,
            role: None,
        });
        let group = Group {
            name: String::new(),
            kind: String::new(),
            clocks: vec![],
            series: series.collect(),
            rows: 1,
            first_line: 1,
        };
        let mut found = Found { path: "x".into(), form: String::new(), groups: vec![group], notes: vec![] };
        roles(&mut found);
        found.series().map(|(_, series)| series.role).collect()
    }

    #[test]
    fn roles_are_suggested() {
        use Role::{Command, Context, Measurement, Reference};
        let some = |roles: &[Role]| roles.iter().map(|role| Some(*role)).collect::<Vec<_>>();
        assert_eq!(
            of(&[("u", "V"), ("pos", "rad"), ("pos_ref", "rad"), ("vbat", "V")]),
            some(&[Command, Measurement, Reference, Context])
        );
        assert_eq!(of(&[("goal", ""), ("position", "")]), some(&[Command, Measurement]));
        assert_eq!(of(&[("position", ""), ("torque", "")]), some(&[Measurement, Command]));
        assert_eq!(of(&[("voltage", "V"), ("angle", "rad")]), some(&[Command, Measurement]));
        assert_eq!(of(&[("tau_cmd", "N m"), ("tau_meas", "N m")]), some(&[Command, Measurement]));
        assert_eq!(of(&[("frame_index", ""), ("x", "m")]), [None, Some(Measurement)]);
    }
}
