//! What the measurements are held against.

use serde::Serialize;

use super::turns::interval;
use super::{Carrier, Case, Delays, Report, Row, Wait};

/// One comparison.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Aim {
    /// What is compared, in words.
    pub what: String,
    /// What was measured, in nanoseconds.
    pub measured_ns: f64,
    /// What it may be, in nanoseconds, as it follows from the floor measured beside it.
    pub limit_ns: f64,
    /// Measured by limit: at most 1 when the aim is reached.
    pub ratio: f64,
    /// Where the ratio lies, as far as the turns can tell (95 %); `None` where there were too few turns, or where the limit
    /// was not measured.
    pub interval: Option<(f64, f64)>,
    /// Whether it is reached.
    pub verdict: Verdict,
}

/// Whether an aim is reached.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Verdict {
    /// It is.
    Reached,
    /// It is not.
    Missed,
    /// The interval of the ratio holds 1: these turns cannot tell.
    Undecided,
}

impl Aim {
    fn new(what: impl Into<String>, measured: Option<u64>, limit: Option<f64>) -> Option<Self> {
        let (measured, limit) = (measured? as f64, limit?);
        Some(Self {
            what: what.into(),
            measured_ns: measured,
            limit_ns: limit,
            ratio: measured / limit,
            interval: None,
            verdict: if measured <= limit { Verdict::Reached } else { Verdict::Missed },
        })
    }

    /// A percentile held against what follows from the same one of a floor.
    fn beside(
        what: impl Into<String>,
        measured: &Delays,
        floor: Option<&Delays>,
        percent: f64,
        limit: impl Fn(f64) -> f64,
    ) -> Option<Self> {
        let floor = floor?;
        let aim = Self::new(what, measured.at(percent), Some(limit(floor.at(percent)? as f64)))?;
        let interval = interval(measured, floor, percent, limit);
        let verdict = match interval {
            Some((_, high)) if high <= 1.0 => Verdict::Reached,
            Some((low, _)) if low > 1.0 => Verdict::Missed,
            Some(_) => Verdict::Undecided,
            None => aim.verdict,
        };
        Some(Self { interval, verdict, ..aim })
    }
}

/// All comparisons that the measured cases allow, in order.
pub fn aims(report: &Report) -> Vec<Aim> {
    let mut aims = Vec::new();
    let find = |carrier: Carrier, like: &Case| {
        let wanted = Case { carrier, ..*like };
        report.rows.iter().find(|row| row.case == wanted)
    };
    let small = report.rows.iter().filter(|row| row.case.carrier == Carrier::Graph && row.case.payload <= 64);
    for row in small {
        let place = place(&row.case);
        match row.case.wait {
            Wait::Spin => {
                let floor = find(Carrier::Iceoryx2, &row.case).map(|row| &row.one_way);
                for percent in [50.0, 99.0] {
                    aims.extend(Aim::beside(
                        format!("node to node, {place}, p{percent}: 1.3 x raw iceoryx2"),
                        &row.one_way,
                        floor,
                        percent,
                        |floor| floor * 1.3,
                    ));
                }
            }
            Wait::Block => {
                let floor = find(Carrier::Futex, &row.case).map(|row| &row.one_way);
                aims.extend(Aim::beside(
                    format!("node to node, {place}, p50: 1.15 x a raw futex wake + 2 us"),
                    &row.one_way,
                    floor,
                    50.0,
                    |floor| floor * 1.15 + 2000.0,
                ));
            }
            Wait::SpinThenBlock => {}
        }
        if let Some(recorded) = find(Carrier::RecordedGraph, &row.case) {
            aims.extend(Aim::beside(
                format!("recorded, {place}, p99: 1.1 x not recorded"),
                &recorded.one_way,
                Some(&row.one_way),
                99.0,
                |unrecorded| unrecorded * 1.1,
            ));
        }
    }
    // The largest message beside the smallest, for what is in place.
    for carrier in [Carrier::Graph, Carrier::Channel] {
        let rows = || report.rows.iter().filter(move |row| row.case.carrier == carrier);
        let Some(most) = rows().max_by_key(|row| row.case.payload) else { continue };
        let like = |row: &&Row| Case { payload: 0, ..row.case } == Case { payload: 0, ..most.case };
        let Some(least) = rows().filter(like).min_by_key(|row| row.case.payload) else { continue };
        if most.case.payload > least.case.payload {
            let (large, small) = (most.case.payload, least.case.payload);
            aims.extend(Aim::beside(
                format!("{carrier}, {large} bytes, p50: 1.1 x {small} bytes"),
                &most.one_way,
                Some(&least.one_way),
                50.0,
                |small| small * 1.1,
            ));
        }
    }
    aims.extend(Aim::new("around a step, recorded, p50: 1 us", report.step.at(50.0), Some(1000.0)));
    aims.extend(Aim::beside(
        "start of a step at 1 kHz, p99: 1.2 x bare clock_nanosleep",
        &report.lateness,
        Some(&report.bare_lateness),
        99.0,
        |bare| bare * 1.2,
    ));
    aims
}

/// What a case is like, beyond carrier and payload.
fn place(case: &Case) -> String {
    let mut text = format!("{} bytes, {}", case.payload, case.wait);
    if !case.pinned {
        text.push_str(", not pinned");
    }
    if case.fifo {
        text.push_str(", FIFO");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(carrier: Carrier, payload: usize, wait: Wait, delay: i64) -> Row {
        let case = Case { carrier, payload, wait, pinned: true, fifo: false };
        let mut one_way = Delays::new();
        one_way.extend(std::iter::repeat_n(delay, 1000));
        Row { case, round_trip: one_way.clone(), one_way }
    }

    #[test]
    fn a_case_is_held_against_its_own_floor() {
        let rows = vec![
            row(Carrier::Iceoryx2, 64, Wait::Spin, 1000),
            row(Carrier::Graph, 64, Wait::Spin, 1200),
            row(Carrier::Futex, 64, Wait::Block, 10_000),
            row(Carrier::Graph, 64, Wait::Block, 14_000),
            row(Carrier::Channel, 64, Wait::Spin, 1000),
            row(Carrier::Channel, 8_000_000, Wait::Spin, 5000),
        ];
        let report = Report {
            rows,
            step: Delays::new(),
            step_unrecorded: Delays::new(),
            lateness: Delays::new(),
            bare_lateness: Delays::new(),
            warnings: Vec::new(),
        };
        let aims = aims(&report);
        let reached: Vec<(bool, f64)> =
            aims.iter().map(|aim| (aim.verdict == Verdict::Reached, aim.limit_ns)).collect();
        assert_eq!(reached.len(), 4, "{aims:?}: without samples nothing is said of steps");
        let expected = [(true, 1300.0), (true, 1300.0), (false, 13_500.0), (false, 1100.0)];
        for ((got, limit), (want, about)) in reached.iter().zip(expected) {
            assert_eq!(*got, want, "{aims:?}");
            assert!((limit / about - 1.0).abs() < 0.002, "{aims:?}");
        }
    }
}
