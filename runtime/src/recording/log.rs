//! What the diagnosis reads: named signals over time, whoever recorded them.

use std::fmt;
use std::str::FromStr;

use parallax_model::system::Suggestion;

/// What a signal says about the machine.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// What the machine was told to do: drives inputs.
    Command,
    /// A measured circumstance, such as a battery voltage: may drive inputs.
    Context,
    /// What a sensor read: compared with outputs.
    Measurement,
    /// What a controller was aiming at: an input only of a system that binds it as one.
    Reference,
}

impl Role {
    /// All roles.
    pub const ALL: [Role; 4] = [Role::Command, Role::Context, Role::Measurement, Role::Reference];

    /// Its name in a `recording.toml`.
    pub fn name(self) -> &'static str {
        match self {
            Role::Command => "command",
            Role::Context => "context",
            Role::Measurement => "measurement",
            Role::Reference => "reference",
        }
    }
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// A role that does not exist.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("unknown role `{role}`{suggestion} (a role is command, context, measurement or reference)")]
pub struct UnknownRole {
    /// What was written.
    pub role: String,
    /// The nearest role.
    pub suggestion: Suggestion,
}

impl FromStr for Role {
    type Err = UnknownRole;

    fn from_str(text: &str) -> Result<Self, UnknownRole> {
        Role::ALL.into_iter().find(|role| role.name() == text).ok_or_else(|| UnknownRole {
            role: text.into(),
            suggestion: Suggestion::nearest(text, Role::ALL.iter().map(|role| role.name())),
        })
    }
}

/// Where a signal was read from.
#[derive(Clone, Debug, PartialEq, Eq, Default)]
pub struct Source {
    /// The file's path as it was given.
    pub file: String,
    /// The column of a CSV file, or `NODE.LEAF` of a recording.
    pub column: String,
}

impl fmt::Display for Source {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "column `{}` of {}", self.column, self.file)
    }
}

/// One quantity over time.
#[derive(Clone, Debug, PartialEq)]
pub struct Signal {
    /// Its name, unique within the log.
    pub name: String,
    /// What it says about the machine.
    pub role: Role,
    /// A label such as `rad/s`; empty when none is stated.
    pub unit: String,
    /// When each value was true, in nanoseconds; strictly increasing.
    pub times: Vec<i64>,
    /// The values, in `unit`; finite, as many as `times`.
    pub values: Vec<f64>,
    /// Where it was read from.
    pub source: Source,
}

impl Signal {
    /// A signal that was read from no file.
    pub fn new(
        name: impl Into<String>,
        role: Role,
        unit: impl Into<String>,
        times: Vec<i64>,
        values: Vec<f64>,
    ) -> Self {
        Signal { name: name.into(), role, unit: unit.into(), times, values, source: Source::default() }
    }

    /// The first and last stamp, in nanoseconds; `None` without samples.
    pub fn span(&self) -> Option<(i64, i64)> {
        Some((*self.times.first()?, *self.times.last()?))
    }

    /// Mean rate in Hz; `None` with fewer than two samples.
    pub fn rate(&self) -> Option<f64> {
        let (first, last) = self.span()?;
        (last > first).then(|| (self.times.len() - 1) as f64 / (last as f64 - first as f64) * 1e9)
    }

    /// Index of the last sample stamped at or before `time` (nanoseconds); `None` before the first.
    pub fn index_at(&self, time: i64) -> Option<usize> {
        self.times.partition_point(|stamp| *stamp <= time).checked_sub(1)
    }

    /// The value that holds at `time` (nanoseconds): the last one stamped at or before it.
    pub fn held(&self, time: i64) -> Option<f64> {
        self.index_at(time).map(|index| self.values[index])
    }
}

/// The signals of one run.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct Log {
    /// What was recorded, for people.
    pub title: String,
    /// Under which terms it may be used; empty when none are stated.
    pub license: String,
    /// Values that were fixed during the run; they override or add parameters of a system.
    pub constants: Vec<(String, f64)>,
    /// In the order of the file.
    pub signals: Vec<Signal>,
    /// What a reader of the log should know, such as samples that were left out.
    pub notes: Vec<String>,
}

/// A signal that is not there.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the recording `{title}` has no signal `{name}`{suggestion} (it has: {available})")]
pub struct UnknownSignal {
    /// The recording's title.
    pub title: Box<str>,
    /// The name asked for.
    pub name: Box<str>,
    /// The nearest name.
    pub suggestion: Suggestion,
    /// All names.
    pub available: Box<str>,
}

impl Log {
    /// The signal `name`.
    ///
    /// # Errors
    ///
    /// [`UnknownSignal`], with the names there are.
    pub fn signal(&self, name: &str) -> Result<&Signal, UnknownSignal> {
        let names = || self.signals.iter().map(|signal| signal.name.as_str());
        self.signals.iter().find(|signal| signal.name == name).ok_or_else(|| UnknownSignal {
            title: self.title.as_str().into(),
            name: name.into(),
            suggestion: Suggestion::nearest(name, names()),
            available: names().collect::<Vec<_>>().join(", ").into(),
        })
    }

    /// The earliest and the latest stamp of all signals, in nanoseconds; `None` without samples.
    pub fn span(&self) -> Option<(i64, i64)> {
        self.signals
            .iter()
            .filter_map(Signal::span)
            .reduce(|(first, last), (start, end)| (first.min(start), last.max(end)))
    }

    /// The part of the log from `from` on and before `to`, in seconds from its first stamp. What drives the machine then
    /// is kept: the value that a command or a context holds at `from` is stamped `from`.
    #[must_use]
    pub fn part(&self, from: f64, to: f64) -> Log {
        let mut part = self.clone();
        let Some((first, _)) = self.span() else { return part };
        // A float beyond the range of an integer becomes its bound.
        let stamp = |seconds: f64| first.saturating_add((seconds * 1e9).round() as i64);
        let (from, to) = (stamp(from), stamp(to));
        for signal in &mut part.signals {
            let begin = signal.times.partition_point(|time| *time < from);
            let end = signal.times.partition_point(|time| *time < to).max(begin);
            let held = signal.held(from).filter(|_| signal.times.get(begin) != Some(&from));
            signal.times = signal.times[begin..end].to_vec();
            signal.values = signal.values[begin..end].to_vec();
            if let (Role::Command | Role::Context, Some(held)) = (signal.role, held) {
                signal.times.insert(0, from);
                signal.values.insert(0, held);
            }
        }
        part
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn log() -> Log {
        let signal = |name: &str, times: &[i64]| {
            let values = times.iter().map(|t| *t as f64).collect();
            Signal::new(name, Role::Measurement, "rad", times.into(), values)
        };
        Log {
            title: "two".into(),
            signals: vec![signal("position", &[10, 20, 40]), signal("speed", &[-5, 15])],
            ..Log::default()
        }
    }

    #[test]
    fn a_value_holds_from_its_stamp() {
        let log = log();
        let position = log.signal("position").unwrap();
        assert_eq!(position.held(9), None);
        assert_eq!(position.held(10), Some(10.0));
        assert_eq!(position.held(39), Some(20.0));
        assert_eq!(position.held(1000), Some(40.0));
    }

    #[test]
    fn the_span_covers_all_signals() {
        assert_eq!(log().span(), Some((-5, 40)));
        assert_eq!(Log::default().span(), None);
        assert_eq!(log().signals[1].rate(), Some(5e7));
    }

    #[test]
    fn a_part_begins_with_what_holds_there() {
        let mut log = log();
        log.signals[1].role = Role::Command;
        // The log begins at -5 ns.
        let part = log.part(20e-9, 45e-9);
        assert_eq!((&part.signals[0].times, &part.signals[0].values), (&vec![20], &vec![20.0]));
        assert_eq!((&part.signals[1].times, &part.signals[1].values), (&vec![15], &vec![15.0]));
        let part = log.part(22e-9, f64::INFINITY);
        assert_eq!((&part.signals[0].times, &part.signals[1].times), (&vec![20, 40], &vec![17]));
        assert_eq!(part.signals[1].values, [15.0]);
        assert_eq!(log.part(0.0, f64::INFINITY), log);
    }

    #[test]
    fn an_unknown_signal_names_the_nearest_and_all() {
        let message = log().signal("positon").unwrap_err().to_string();
        assert!(message.contains("did you mean `position`?"), "{message}");
        assert!(message.contains("it has: position, speed"), "{message}");
    }

    #[test]
    fn roles_have_one_spelling() {
        for role in Role::ALL {
            assert_eq!(role.name().parse(), Ok(role));
        }
        let message = "comand".parse::<Role>().unwrap_err().to_string();
        assert!(message.contains("did you mean `command`?"), "{message}");
    }
}
