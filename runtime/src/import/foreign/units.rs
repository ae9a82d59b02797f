//! Units as people write them, and those that are converted into each other.

/// `value * factor + offset`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Conversion {
    /// What a value is multiplied by.
    pub factor: f64,
    /// What is added then.
    pub offset: f64,
}

/// A unit: its symbol, what it measures, and how many of the first of its kind it is.
struct Unit(&'static str, &'static str, f64, f64);

const PI: f64 = std::f64::consts::PI;

/// Standard gravity, in m/s^2.
const GRAVITY: f64 = 9.806_65;

/// The first of a kind is the one that systems are written in.
const UNITS: [Unit; 44] = [
    Unit("rad", "angle", 1.0, 0.0),
    Unit("deg", "angle", PI / 180.0, 0.0),
    Unit("turn", "angle", 2.0 * PI, 0.0),
    Unit("rad/s", "angular speed", 1.0, 0.0),
    Unit("deg/s", "angular speed", PI / 180.0, 0.0),
    Unit("rpm", "angular speed", PI / 30.0, 0.0),
    Unit("turn/s", "angular speed", 2.0 * PI, 0.0),
    Unit("rad/s^2", "angular acceleration", 1.0, 0.0),
    Unit("deg/s^2", "angular acceleration", PI / 180.0, 0.0),
    Unit("m", "length", 1.0, 0.0),
    Unit("cm", "length", 1e-2, 0.0),
    Unit("mm", "length", 1e-3, 0.0),
    Unit("um", "length", 1e-6, 0.0),
    Unit("m/s", "speed", 1.0, 0.0),
    Unit("cm/s", "speed", 1e-2, 0.0),
    Unit("mm/s", "speed", 1e-3, 0.0),
    Unit("km/h", "speed", 1.0 / 3.6, 0.0),
    Unit("m/s^2", "acceleration", 1.0, 0.0),
    Unit("mm/s^2", "acceleration", 1e-3, 0.0),
    Unit("g0", "acceleration", GRAVITY, 0.0),
    Unit("V", "voltage", 1.0, 0.0),
    Unit("mV", "voltage", 1e-3, 0.0),
    Unit("A", "current", 1.0, 0.0),
    Unit("mA", "current", 1e-3, 0.0),
    Unit("N", "force", 1.0, 0.0),
    Unit("mN", "force", 1e-3, 0.0),
    Unit("kN", "force", 1e3, 0.0),
    Unit("N m", "torque", 1.0, 0.0),
    Unit("mN m", "torque", 1e-3, 0.0),
    Unit("N cm", "torque", 1e-2, 0.0),
    Unit("N mm", "torque", 1e-3, 0.0),
    Unit("kg", "mass", 1.0, 0.0),
    Unit("K", "temperature", 1.0, 0.0),
    Unit("degC", "temperature", 1.0, 273.15),
    Unit("Pa", "pressure", 1.0, 0.0),
    Unit("kPa", "pressure", 1e3, 0.0),
    Unit("bar", "pressure", 1e5, 0.0),
    Unit("Hz", "frequency", 1.0, 0.0),
    Unit("W", "power", 1.0, 0.0),
    Unit("s", "time", 1.0, 0.0),
    Unit("ms", "time", 1e-3, 0.0),
    Unit("us", "time", 1e-6, 0.0),
    Unit("ns", "time", 1e-9, 0.0),
    Unit("%", "share", 0.01, 0.0),
];

/// Other ways to write them.
const SPELLINGS: [(&str, &str); 61] = [
    ("nm", "N m"),
    ("n·m", "N m"),
    ("n*m", "N m"),
    ("n.m", "N m"),
    ("newton meter", "N m"),
    ("mnm", "mN m"),
    ("ncm", "N cm"),
    ("nmm", "N mm"),
    ("rad/sec", "rad/s"),
    ("radps", "rad/s"),
    ("rad.s-1", "rad/s"),
    ("rad s^-1", "rad/s"),
    ("deg/sec", "deg/s"),
    ("dps", "deg/s"),
    ("°/s", "deg/s"),
    ("degps", "deg/s"),
    ("rad/s²", "rad/s^2"),
    ("rad/s2", "rad/s^2"),
    ("deg/s²", "deg/s^2"),
    ("deg/s2", "deg/s^2"),
    ("°", "deg"),
    ("degree", "deg"),
    ("degrees", "deg"),
    ("radian", "rad"),
    ("radians", "rad"),
    ("rev", "turn"),
    ("turns", "turn"),
    ("rps", "turn/s"),
    ("rev/s", "turn/s"),
    ("rev/min", "rpm"),
    ("1/min", "rpm"),
    ("min-1", "rpm"),
    ("u/min", "rpm"),
    ("m/sec", "m/s"),
    ("mps", "m/s"),
    ("m.s-1", "m/s"),
    ("m s^-1", "m/s"),
    ("kmh", "km/h"),
    ("kph", "km/h"),
    ("m/s²", "m/s^2"),
    ("m/s2", "m/s^2"),
    ("m/s/s", "m/s^2"),
    ("m/sec^2", "m/s^2"),
    ("mps2", "m/s^2"),
    ("volt", "V"),
    ("volts", "V"),
    ("amp", "A"),
    ("amps", "A"),
    ("ampere", "A"),
    ("newton", "N"),
    ("newtons", "N"),
    ("°c", "degC"),
    ("celsius", "degC"),
    ("µs", "us"),
    ("μs", "us"),
    ("usec", "us"),
    ("msec", "ms"),
    ("sec", "s"),
    ("seconds", "s"),
    ("percent", "%"),
    ("hz", "Hz"),
];

/// The ends of names that are units: longer than a letter, and nothing else.
const SUFFIXES: [&str; 32] = [
    "rad", "deg", "rpm", "dps", "radps", "degps", "mps", "mps2", "mm", "cm", "mv", "ma", "nm", "mnm", "volt",
    "volts", "amp", "amps", "newton", "newtons", "degc", "hz", "percent", "ms", "us", "ns", "usec", "msec",
    "sec", "seconds", "kpa", "nsec",
];

fn find(text: &str) -> Option<&'static Unit> {
    UNITS.iter().find(|unit| unit.0 == text).or_else(|| {
        let lower = text.to_lowercase();
        let spelt = SPELLINGS.iter().find(|(spelling, _)| *spelling == lower).map(|(_, unit)| *unit);
        // `mN` and `MN` are not the same, but `RAD` and `rad` are.
        let folded = || UNITS.iter().find(|unit| unit.0.len() > 2 && unit.0.to_lowercase() == lower);
        UNITS.iter().find(|unit| Some(unit.0) == spelt).or_else(folded)
    })
}

/// A unit as systems write it; one that is not known stays as it is.
pub(super) fn plain(text: &str) -> String {
    match text {
        "-" | "1" | "none" | "None" | "n/a" => String::new(),
        text => find(text).map_or_else(|| text.to_owned(), |unit| unit.0.to_owned()),
    }
}

/// Whether a text is a unit that is known here.
pub(super) fn is_known(text: &str) -> bool {
    find(text).is_some()
}

/// The unit that the last word of a name is.
pub(super) fn suffix(word: &str) -> Option<&'static str> {
    let lower = word.to_lowercase();
    match lower.as_str() {
        "nsec" => Some("ns"),
        "mv" => Some("mV"),
        "ma" => Some("mA"),
        lower if SUFFIXES.contains(&lower) => find(lower).map(|unit| unit.0),
        _ => None,
    }
}

/// How values in `from` become values in `to`; `None` when they measure different things, or one is not known.
///
/// ```
/// use parallax_runtime::import::foreign::conversion;
/// assert_eq!(conversion("mm", "m").unwrap().factor, 1e-3);
/// assert!(conversion("mm", "rad").is_none());
/// ```
pub fn conversion(from: &str, to: &str) -> Option<Conversion> {
    let (from, to) = (find(from)?, find(to)?);
    (from.1 == to.1).then(|| Conversion { factor: from.2 / to.2, offset: (from.3 - to.3) / to.2 })
}

/// What a unit can be converted to.
pub(super) fn alternatives(from: &str) -> Vec<&'static str> {
    let Some(from) = find(from) else { return Vec::new() };
    UNITS.iter().filter(|unit| unit.1 == from.1 && unit.0 != from.0).map(|unit| unit.0).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_spelling_and_suffix_is_of_a_unit() {
        for (spelling, unit) in SPELLINGS {
            assert_eq!(plain(spelling), unit, "{spelling}");
            assert_eq!(plain(unit), unit);
        }
        for word in SUFFIXES {
            assert!(suffix(word).is_some_and(is_known), "{word}");
        }
    }

    #[test]
    fn units_are_converted() {
        let convert = |value: f64, from, to| {
            let Conversion { factor, offset } = conversion(from, to).unwrap();
            value * factor + offset
        };
        assert!((convert(180.0, "deg", "rad") - PI).abs() < 1e-15);
        assert!((convert(60.0, "rpm", "rad/s") - 2.0 * PI).abs() < 1e-14);
        assert_eq!(convert(20.0, "degC", "K"), 293.15);
        assert_eq!(convert(293.15, "K", "°C"), 20.0);
        assert_eq!(convert(50.0, "%", "percent"), 50.0);
        assert_eq!(conversion("V", "A"), None);
        assert_eq!(conversion("furlong", "m"), None);
        assert!(alternatives("deg").contains(&"rad") && alternatives("furlong").is_empty());
    }

    #[test]
    fn case_is_kept_where_it_matters() {
        assert_eq!(
            (plain("mN"), plain("MN"), plain("Nm"), plain("RAD")),
            ("mN".into(), "MN".into(), "N m".into(), "rad".into())
        );
        assert_eq!(plain("-"), "");
    }
}
