//! Definitions of the messages that come with ROS 2 and hold numbers, for bags that have none of their own.
//!
//! Their fields, as docs.ros.org has them for ROS 2 Humble, the last release whose bags in SQLite hold no definitions.

/// One after the other, each after a line of `=` and one with its name.
const KNOWN: &str = include_str!("ros2_messages.txt");

/// The definition of a type such as `sensor_msgs/msg/Imu` and of all that may be in it, if it is one of these.
pub(super) fn known(name: &str) -> Option<String> {
    let heading = format!("MSG: {}\n", name.replace("/msg/", "/"));
    let at = KNOWN.find(&heading)? + heading.len();
    let own = &KNOWN[at..];
    let own = own.find("====").map_or(own, |end| &own[..end]);
    Some(format!("{own}{KNOWN}"))
}

#[cfg(test)]
mod tests {
    use super::super::ros::Definition;
    use super::*;

    #[test]
    fn every_one_can_be_followed() {
        let names: Vec<&str> = KNOWN.lines().filter_map(|line| line.strip_prefix("MSG: ")).collect();
        assert!(names.len() > 50, "{}", names.len());
        for name in names {
            let text = known(&name.replacen('/', "/msg/", 1)).unwrap();
            Definition::parse(name, &text).unwrap_or_else(|why| panic!("{name}: {why}"));
        }
        assert_eq!(known("my_msgs/msg/Imu"), None);
        assert_eq!(known("sensor_msgs/msg/I"), None);
    }
}
