//! What the header of a column says: its name, its unit, whether it is a time.

use super::clock::TimeUnit;
use super::units;

/// The name and the unit of a header such as `pos [rad]`, `u (V)`, `t / s` or `time_us`.
pub(super) fn split(header: &str) -> (String, String) {
    let header = header.trim().trim_start_matches('#').trim();
    for (open, close) in [('[', ']'), ('(', ')'), ('{', '}'), ('<', '>')] {
        if let Some((name, unit)) = header.strip_suffix(close).and_then(|rest| rest.rsplit_once(open)) {
            let unit = unit.trim();
            // `q[0]` is an element.
            if unit.parse::<u64>().is_err() && !name.trim().is_empty() && unit.chars().count() <= 16 {
                return (name.trim().to_owned(), units::plain(unit));
            }
        }
    }
    for slash in [" / ", "/"] {
        if let Some((name, unit)) = header.rsplit_once(slash).filter(|(name, _)| !name.trim().is_empty())
            && units::is_known(unit.trim())
        {
            return (name.trim().to_owned(), units::plain(unit.trim()));
        }
    }
    let tail = header.rsplit(['_', '.', ' ', '-']).next().unwrap_or("");
    let unit = (tail.len() < header.len()).then(|| units::suffix(tail)).flatten();
    (header.to_owned(), unit.unwrap_or_default().to_owned())
}

/// The words of a name, in lower case.
pub(super) fn words(name: &str) -> Vec<String> {
    let mut words = vec![String::new()];
    let mut before_lower = false;
    for c in name.chars() {
        if !c.is_alphanumeric() || (c.is_uppercase() && before_lower) {
            words.push(String::new());
        }
        before_lower = c.is_lowercase() || c.is_numeric();
        if let (true, Some(word)) = (c.is_alphanumeric(), words.last_mut()) {
            word.extend(c.to_lowercase());
        }
    }
    words.retain(|word| !word.is_empty());
    words
}

/// Words that a column of times has in its name.
const TIMES: [&str; 26] = [
    "t",
    "time",
    "times",
    "timestamp",
    "timestamps",
    "stamp",
    "stamps",
    "ts",
    "date",
    "datetime",
    "clock",
    "zeit",
    "zeitstempel",
    "temps",
    "tiempo",
    "epoch",
    "elapsed",
    "uptime",
    "sec",
    "secs",
    "nsec",
    "nsecs",
    "nanosec",
    "tsec",
    "rostime",
    "unixtime",
];

/// Whether a column's name is that of a time.
pub(super) fn is_time(name: &str) -> bool {
    let squeezed = |word: &str| word.trim_end_matches(|c: char| c.is_ascii_digit()).to_owned();
    words(name).iter().any(|word| TIMES.contains(&squeezed(word).as_str()))
}

/// The unit of a time, where the header says it.
pub(super) fn time_unit(header: &str) -> Option<TimeUnit> {
    let (name, unit) = split(header);
    let from = |unit: &str| match unit {
        "s" => Some(TimeUnit::S),
        "ms" => Some(TimeUnit::Ms),
        "us" => Some(TimeUnit::Us),
        "ns" => Some(TimeUnit::Ns),
        _ => None,
    };
    // `time_s` is seconds, though `v_s` need not be.
    let tail = words(&name).pop().unwrap_or_default();
    from(&unit).or(match tail.as_str() {
        "s" | "sec" | "secs" | "seconds" | "tsec" => Some(TimeUnit::S),
        _ => None,
    })
}

/// A name without what would have to be quoted in other files.
pub(super) fn clean(name: &str) -> String {
    let mut clean = String::with_capacity(name.len());
    for c in name.chars() {
        match c {
            c if c.is_alphanumeric() || c == '_' => clean.push(c),
            '.' | '/' => clean.push('.'),
            '[' => clean.push('_'),
            ']' => {}
            _ => clean.push('_'),
        }
    }
    while clean.contains("__") || clean.contains("..") {
        clean = clean.replace("__", "_").replace("..", ".");
    }
    let clean = clean.trim_matches(['_', '.']);
    if clean.is_empty() { "signal".into() } else { clean.into() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn headers_have_units() {
        for (header, name, unit) in [
            ("pos [rad]", "pos", "rad"),
            ("u (V)", "u", "V"),
            ("t / s", "t", "s"),
            ("U/V", "U", "V"),
            ("torque [Nm]", "torque", "N m"),
            ("acc{m/s²}", "acc", "m/s^2"),
            ("angle [°]", "angle", "deg"),
            ("time_us", "time_us", "us"),
            ("q[0]", "q[0]", ""),
            ("state/elbow", "state/elbow", ""),
            ("motor.temp_degC", "motor.temp_degC", "degC"),
            ("# t", "t", ""),
            ("x_m", "x_m", ""),
        ] {
            assert_eq!(split(header), (name.to_owned(), unit.to_owned()), "{header}");
        }
    }

    #[test]
    fn times_are_known_by_their_names() {
        for name in
            ["t", "Time", "timestamp_ns", "header.stamp", "cmdTime", "time2", "Zeit", "t_meas", "__time"]
        {
            assert!(is_time(name), "{name}");
        }
        for name in ["temperature", "torque", "at", "ticks", "u", "position"] {
            assert!(!is_time(name), "{name}");
        }
        assert_eq!(time_unit("Time (ms)"), Some(TimeUnit::Ms));
        assert_eq!(time_unit("t_s"), Some(TimeUnit::S));
        assert_eq!(time_unit("stamp [µs]"), Some(TimeUnit::Us));
        assert_eq!(time_unit("t"), None);
    }

    #[test]
    fn names_are_cleaned() {
        assert_eq!(clean("/joint_states/elbow"), "joint_states.elbow");
        assert_eq!(clean("q[0]"), "q_0");
        assert_eq!(clean("Motor speed %"), "Motor_speed");
        assert_eq!(clean("°"), "signal");
        assert_eq!(words("joint2CmdVel.x_dot"), ["joint2", "cmd", "vel", "x", "dot"]);
    }
}
