//! What says when a row was true.

use std::fmt;

use chrono::{DateTime, NaiveDate, NaiveDateTime, NaiveTime, Timelike};

use crate::import::seconds::scaled;

/// The unit in which a clock counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum TimeUnit {
    /// Seconds.
    S,
    /// Milliseconds.
    Ms,
    /// Microseconds.
    Us,
    /// Nanoseconds.
    Ns,
}

impl TimeUnit {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::S, Self::Ms, Self::Us, Self::Ns];

    /// Its symbol.
    pub fn symbol(self) -> &'static str {
        match self {
            Self::S => "s",
            Self::Ms => "ms",
            Self::Us => "us",
            Self::Ns => "ns",
        }
    }

    /// Nanoseconds are so many powers of ten smaller.
    fn power(self) -> i32 {
        match self {
            Self::S => 9,
            Self::Ms => 6,
            Self::Us => 3,
            Self::Ns => 0,
        }
    }
}

impl fmt::Display for TimeUnit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.symbol())
    }
}

impl std::str::FromStr for TimeUnit {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let all = || Self::ALL.into_iter();
        all().find(|unit| unit.symbol() == text).ok_or_else(|| "a time is in s, ms, us or ns".into())
    }
}

/// How a clock's unit is known.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum UnitFrom {
    /// The header says it, or the form of the file.
    Stated,
    /// The stamps are dates and times of day.
    Dates,
    /// The numbers are of the size that the time since 1970 has in this unit.
    Epoch,
    /// The steps leave no other unit that a logger would have.
    Steps,
}

/// What says when the rows of a group were true.
#[derive(Clone, Debug, PartialEq)]
pub struct Clock {
    /// The header of its column, or `header.stamp`, `publish` and `log` in a bag.
    pub name: String,
    /// Its unit, and how that is known; `None` when nothing tells.
    pub unit: Option<(TimeUnit, UnitFrom)>,
    stamps: Stamps,
}

#[derive(Clone, Debug, PartialEq)]
enum Stamps {
    /// Numbers as they were written; empty where there is none.
    Texts(Vec<Box<str>>),
    /// Nanoseconds.
    Nanos(Vec<Option<i64>>),
}

impl Clock {
    /// Stamps whose meaning is known: nanoseconds.
    pub(super) fn nanos(name: impl Into<String>, stamps: Vec<Option<i64>>, from: UnitFrom) -> Self {
        Self { name: name.into(), unit: Some((TimeUnit::Ns, from)), stamps: Stamps::Nanos(stamps) }
    }

    /// Stamps as they were written: dates, or numbers, whose unit is `stated` or found out. `None` when they are neither,
    /// or do not run like a clock.
    pub(super) fn of_texts(name: &str, stated: Option<TimeUnit>, texts: Vec<Box<str>>) -> Option<Self> {
        let first = texts.iter().find(|text| !text.is_empty())?;
        if first.parse::<f64>().is_err() {
            let stamps: Vec<Option<i64>> = with_midnights(texts.iter().map(|text| date(text)));
            let unread = stamps.iter().zip(&texts).any(|(stamp, text)| stamp.is_none() && !text.is_empty());
            return (!unread && runs(&stamps)).then(|| Self::nanos(name, stamps, UnitFrom::Dates));
        }
        let numbers: Vec<Option<f64>> = texts.iter().map(|text| text.parse().ok()).collect();
        // A float is too coarse for nanoseconds since 1970.
        let whole: Vec<Option<i64>> = texts.iter().map(|text| text.parse().ok()).collect();
        let is_whole = whole.iter().zip(&texts).all(|(whole, text)| whole.is_some() || text.is_empty());
        if !(if is_whole { runs(&whole) } else { runs(&numbers) }) {
            return None;
        }
        let unit = stated.map(|unit| (unit, UnitFrom::Stated)).or_else(|| guess(&numbers));
        Some(Self { name: name.into(), unit, stamps: Stamps::Texts(texts) })
    }

    /// Whether its stamps are numbers, so that their unit may be said.
    pub fn is_numeric(&self) -> bool {
        matches!(self.stamps, Stamps::Texts(_))
    }

    /// The median step, in its own unit: what somebody who is asked for the unit has to see.
    pub fn step(&self) -> f64 {
        match &self.stamps {
            Stamps::Texts(texts) => {
                median_step(&texts.iter().map(|text| text.parse().ok()).collect::<Vec<_>>()).unwrap_or(0.0)
            }
            Stamps::Nanos(stamps) => {
                let seconds: Vec<_> = stamps.iter().map(|stamp| stamp.map(|stamp| stamp as f64)).collect();
                median_step(&seconds).unwrap_or(0.0)
            }
        }
    }

    /// The stamps in nanoseconds; `None` in a row without one.
    ///
    /// # Errors
    ///
    /// The row, from 0, and the text that is no time.
    pub(super) fn stamps(&self, unit: TimeUnit) -> Result<Vec<Option<i64>>, (usize, String)> {
        match &self.stamps {
            Stamps::Nanos(stamps) => Ok(stamps.clone()),
            Stamps::Texts(texts) => texts
                .iter()
                .enumerate()
                .map(|(row, text)| match &**text {
                    "" => Ok(None),
                    text => scaled(text, unit.power()).map(Some).map_err(|_| (row, text.to_owned())),
                })
                .collect(),
        }
    }
}

/// Whether stamps are those of a clock: most steps go forwards, and one in twenty goes back at most.
fn runs<T: PartialOrd + Copy>(stamps: &[Option<T>]) -> bool {
    let known: Vec<T> = stamps.iter().copied().flatten().collect();
    let count = |is: fn(T, T) -> bool| known.windows(2).filter(|pair| is(pair[0], pair[1])).count();
    let (forwards, backwards) = (count(|a, b| b > a), count(|a, b| b < a));
    forwards > backwards && backwards <= (known.len() / 20).max(1)
}

fn median_step(numbers: &[Option<f64>]) -> Option<f64> {
    let known: Vec<f64> = numbers.iter().copied().flatten().collect();
    let mut steps: Vec<f64> =
        known.windows(2).map(|pair| pair[1] - pair[0]).filter(|step| *step > 0.0).collect();
    let middle = steps.len() / 2;
    (!steps.is_empty()).then(|| *steps.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// The unit of numbers that nothing is said of, where only one makes sense.
fn guess(numbers: &[Option<f64>]) -> Option<(TimeUnit, UnitFrom)> {
    let first = numbers.iter().copied().flatten().next()?;
    let step = median_step(numbers)?;
    for (unit, second) in TimeUnit::ALL.into_iter().zip([1.0, 1e3, 1e6, 1e9]) {
        // From 1990 to 2100, in steps of a minute at most.
        if (0.63e9..4.1e9).contains(&(first / second)) && step / second < 60.0 {
            return Some((unit, UnitFrom::Epoch));
        }
    }
    // In milliseconds these would be 10 kHz and more.
    let whole = numbers.iter().flatten().all(|number| number.fract() == 0.0);
    (!whole && step <= 0.1).then_some((TimeUnit::S, UnitFrom::Steps))
}

/// A date with a time of day, or a time of day, in nanoseconds; the latter within its day.
fn date(text: &str) -> Option<Moment> {
    let text = text.replace(',', ".");
    let text = text.trim();
    if let Ok(moment) = DateTime::parse_from_rfc3339(text) {
        return Some(Moment::Absolute(moment.timestamp_nanos_opt()?));
    }
    for form in ["%Y-%m-%dT%H:%M:%S%.f%#z", "%Y-%m-%d %H:%M:%S%.f%#z", "%Y-%m-%d %H:%M:%S%.f %#z"] {
        if let Ok(moment) = DateTime::parse_from_str(text, form) {
            return Some(Moment::Absolute(moment.timestamp_nanos_opt()?));
        }
    }
    // Year first, or day and month with points: forms that can be read in one way only.
    let forms = [
        "%Y-%m-%dT%H:%M:%S%.f",
        "%Y-%m-%d %H:%M:%S%.f",
        "%Y/%m/%d %H:%M:%S%.f",
        "%Y%m%dT%H%M%S%.f",
        "%d.%m.%Y %H:%M:%S%.f",
        "%Y-%m-%d %H:%M",
        "%d-%b-%Y %H:%M:%S%.f",
    ];
    for form in forms {
        if let Ok(moment) = NaiveDateTime::parse_from_str(text, form) {
            return Some(Moment::Absolute(moment.and_utc().timestamp_nanos_opt()?));
        }
    }
    let time = NaiveTime::parse_from_str(text, "%H:%M:%S%.f").ok()?;
    let seconds = i64::from(time.num_seconds_from_midnight());
    Some(Moment::OfDay(seconds * 1_000_000_000 + i64::from(time.nanosecond())))
}

/// Whether a text is a date without a time.
pub(super) fn is_day(text: &str) -> bool {
    ["%Y-%m-%d", "%Y/%m/%d", "%d.%m.%Y"].iter().any(|form| NaiveDate::parse_from_str(text, form).is_ok())
}

/// Whether a text is a date with a time, or a time of day.
pub(super) fn is_date(text: &str) -> bool {
    date(text).is_some()
}

enum Moment {
    Absolute(i64),
    OfDay(i64),
}

/// Times of day that pass midnight go on into the next day.
fn with_midnights(moments: impl Iterator<Item = Option<Moment>>) -> Vec<Option<i64>> {
    const DAY: i64 = 86_400_000_000_000;
    let (mut days, mut last) = (0, None);
    moments
        .map(|moment| match moment? {
            Moment::Absolute(stamp) => Some(stamp),
            Moment::OfDay(time) => {
                // Half a day back is midnight; less is a clock that runs backwards.
                if last.is_some_and(|last| time < last - DAY / 2) {
                    days += 1;
                }
                last = Some(time);
                Some(time + days * DAY)
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn clock(texts: &[&str]) -> Option<Clock> {
        Clock::of_texts("t", None, texts.iter().map(|text| (*text).into()).collect())
    }

    #[track_caller]
    fn seconds(texts: &[&str], unit: TimeUnit) -> Vec<f64> {
        let stamps = clock(texts).unwrap().stamps(unit).unwrap();
        stamps.into_iter().map(|stamp| stamp.map_or(f64::NAN, |stamp| stamp as f64 * 1e-9)).collect()
    }

    #[test]
    fn a_unit_is_guessed_only_where_one_makes_sense() {
        let guess = |texts: &[&str]| clock(texts).unwrap().unit;
        assert_eq!(guess(&["0", "0.01", "0.02"]), Some((TimeUnit::S, UnitFrom::Steps)));
        assert_eq!(guess(&["1700000000.1", "1700000000.2"]), Some((TimeUnit::S, UnitFrom::Epoch)));
        assert_eq!(guess(&["1700000000100", "1700000000200"]), Some((TimeUnit::Ms, UnitFrom::Epoch)));
        assert_eq!(guess(&["1700000000000100", "1700000000000200"]), Some((TimeUnit::Us, UnitFrom::Epoch)));
        assert_eq!(
            guess(&["1700000000000000100", "1700000000000000200"]),
            Some((TimeUnit::Ns, UnitFrom::Epoch))
        );
        // Any of these may be milliseconds as well as seconds.
        for texts in [["0", "4", "8"], ["0", "20", "40"], ["0", "1.002", "2.001"], ["0.5", "1.0", "1.5"]] {
            assert_eq!(guess(&texts), None, "{texts:?}");
        }
    }

    #[test]
    fn dates_are_read() {
        let whole = ["2024-05-01T12:00:00Z", "2024-05-01T12:00:00.5Z"];
        assert_eq!(clock(&whole).unwrap().unit, Some((TimeUnit::Ns, UnitFrom::Dates)));
        for texts in [
            whole,
            ["2024-05-01 14:00:00+02:00", "2024-05-01 14:00:00.500+02:00"],
            ["2024-05-01 12:00:00", "2024-05-01 12:00:00,500"],
            ["01.05.2024 12:00:00", "01.05.2024 12:00:00.5"],
        ] {
            assert_eq!(seconds(&texts, TimeUnit::S), [1_714_564_800.0, 1_714_564_800.5], "{texts:?}");
        }
        assert_eq!(seconds(&["23:59:59.5", "00:00:00.5"], TimeUnit::S), [86_399.5, 86_400.5]);
        // Which is the month?
        assert_eq!(clock(&["05/01/2024 12:00:00", "05/01/2024 12:00:01"]), None);
    }

    #[test]
    fn nanoseconds_are_kept() {
        let clock = clock(&["1700000000123456789", "", "1700000000123456790"]).unwrap();
        assert_eq!(
            clock.stamps(TimeUnit::Ns).unwrap(),
            [Some(1_700_000_000_123_456_789), None, Some(1_700_000_000_123_456_790)]
        );
        assert_eq!(clock.stamps(TimeUnit::S).unwrap_err().0, 0);
    }

    #[test]
    fn what_does_not_run_is_no_clock() {
        assert_eq!(clock(&["1", "1", "1"]), None);
        assert_eq!(clock(&["1", "0", "1", "0", "1", "0"]), None);
        assert_eq!(clock(&["a", "b"]), None);
        assert_eq!(clock(&[""]), None);
    }
}
