//! Stretches of a recording side by side: the lanes wait for each other at readings and go on together.
//!
//! All events of one time are one stop. Lanes step from stop to stop at once, however many events each has there, and
//! at a stop they read the same output at once: a reading or a command more on one lane does not put it out of step.

use crate::simulator::{At, LANES, Run};

/// A stretch: events from `first` up to `end`, not included, of which readings stamped in `[from, to)` are looked at.
#[derive(Clone, Copy, Debug)]
pub struct Stretch {
    /// Index of the first event.
    pub first: usize,
    /// Index after the last event.
    pub end: usize,
    /// First stamp of readings (s).
    pub from: f64,
    /// End of the stamps (s).
    pub to: f64,
}

/// What the lanes do next.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Tick {
    /// These lanes read the event that each is at, all of them the same output.
    Read(At),
    /// These lanes go from the event that each is at to the next one.
    Advance(At),
}

/// The walk of as many stretches as there are lanes.
#[derive(Clone, Debug)]
pub struct Lockstep {
    lanes: Vec<Lane>,
}

#[derive(Clone, Copy, Debug)]
struct Lane {
    stretch: Stretch,
    /// The event it is at.
    at: usize,
    /// Whether it has read that event.
    read: bool,
}

impl Lockstep {
    /// At the beginning of the stretches, one on each lane.
    #[must_use]
    pub fn new(stretches: impl Iterator<Item = Stretch>) -> Self {
        let lanes = stretches.take(LANES).map(|stretch| Lane { stretch, at: stretch.first, read: false });
        Lockstep { lanes: lanes.collect() }
    }

    /// What the lanes do next; nothing at the end.
    pub fn next(&mut self, run: &dyn Run) -> Option<Tick> {
        let mut wanted: At = [None; LANES];
        let mut least = usize::MAX;
        for (lane, wanted) in self.lanes.iter_mut().zip(&mut wanted) {
            *wanted = lane.pending(run).inspect(|output| least = least.min(*output));
        }
        let mut at: At = [None; LANES];
        if least < usize::MAX {
            for ((lane, at), wanted) in self.lanes.iter_mut().zip(&mut at).zip(wanted) {
                if wanted == Some(least) {
                    *at = Some(lane.at);
                    lane.read = true;
                }
            }
            return Some(Tick::Read(at));
        }
        for (lane, at) in self.lanes.iter_mut().zip(&mut at).filter(|(lane, _)| lane.goes_on()) {
            *at = Some(lane.at);
            lane.at += 1;
            lane.read = false;
        }
        at.iter().any(Option::is_some).then_some(Tick::Advance(at))
    }
}

impl Lane {
    fn goes_on(&self) -> bool {
        self.at + 1 < self.stretch.end
    }

    /// Goes to the next reading of this stop that is looked at, and gives its output; without one to the stop's end.
    fn pending(&mut self, run: &dyn Run) -> Option<usize> {
        let events = run.events();
        if self.at >= self.stretch.end {
            return None;
        }
        loop {
            let reading = events[self.at].reading.filter(|_| !self.read);
            let inside = reading.filter(|r| r.stamp >= self.stretch.from && r.stamp < self.stretch.to);
            if let Some(reading) = inside {
                return Some(reading.output);
            }
            if !self.goes_on() || !run.stands(self.at) {
                self.read = true;
                return None;
            }
            self.at += 1;
            self.read = false;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulator::{Event, Gradient, Motion, Reading};
    use parallax_model::lanes::F64x16;

    /// Events that are walked by nobody.
    struct Events(Vec<Event>);

    impl Run for Events {
        fn events(&self) -> &[Event] {
            &self.0
        }
        fn parameters(&self) -> usize {
            0
        }
        fn advance_lanes(&mut self, _: &At, _: &mut Motion) {}
        fn observe_lanes(&mut self, _: &At, _: &Motion, _: &mut Gradient) -> F64x16 {
            F64x16::splat(0.0)
        }
        fn wrap(&self, _: usize) -> Option<f64> {
            None
        }
    }

    #[test]
    fn lanes_that_differ_by_an_event_stay_in_step() {
        let reading =
            |time: f64, output| Event { time, reading: Some(Reading { output, value: 0.0, stamp: time }) };
        let command = |time| Event { time, reading: None };
        let events = vec![
            reading(0.0, 0),
            reading(0.0, 1),
            reading(1.0, 0),
            reading(1.0, 1),
            // The other stretch: a command more, a reading less.
            reading(2.0, 0),
            command(2.0),
            reading(3.0, 0),
            reading(3.0, 1),
        ];
        let run = Events(events);
        let stretch = |first, end| Stretch { first, end, from: 0.0, to: 9.0 };
        let mut lanes = Lockstep::new([stretch(0, 4), stretch(4, 8)].into_iter());
        let mut ticks = Vec::new();
        while let Some(tick) = lanes.next(&run) {
            let (kind, at) = match tick {
                Tick::Read(at) => ("read", at),
                Tick::Advance(at) => ("advance", at),
            };
            ticks.push((kind, at[0], at[1]));
        }
        let expected = [
            ("read", Some(0), Some(4)),
            ("read", Some(1), None),
            ("advance", Some(1), Some(5)),
            ("read", Some(2), Some(6)),
            ("read", Some(3), Some(7)),
        ];
        assert_eq!(ticks, expected);
    }
}
