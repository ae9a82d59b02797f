//! A recording as the fits see it: held commands and stamped readings.

mod rests;

/// A command, held from each stamp until the next.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Held {
    /// Stamps (s), increasing.
    pub times: Vec<f64>,
    /// Values from each stamp on.
    pub values: Vec<f64>,
}

/// One sample of one output.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample {
    /// Stamp (s).
    pub stamp: f64,
    /// Index of the output.
    pub output: usize,
    /// The reading.
    pub value: f64,
}

/// One recording, bound to a system's inputs and outputs.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Experiment {
    /// One per input of the system.
    pub inputs: Vec<Held>,
    /// The voltage behind each input that has one; may be shorter than `inputs`.
    pub supplies: Vec<Option<SupplyVoltage>>,
    /// Which inputs nobody can choose, such as a battery's voltage; may be shorter than `inputs`.
    pub given: Vec<bool>,
    /// Unit of each input, a label; empty where the log states none.
    pub input_units: Vec<String>,
    /// All readings in the order of their stamps, then of their outputs.
    pub samples: Vec<Sample>,
    /// Per output: the period of an angle, if it wraps.
    pub wraps: Vec<Option<f64>>,
    /// The recordings that were put one after the other; empty where there is one.
    pub parts: Vec<Part>,
    /// From when to when long rests were left out (s), increasing.
    pub rests: Vec<(f64, f64)>,
}

/// One of several recordings on a common axis of time.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Part {
    /// Its name.
    pub title: String,
    /// Where its own zero lies (s).
    pub origin: f64,
    /// Stamp of its first reading (s).
    pub from: f64,
    /// Stamp of its last reading (s).
    pub to: f64,
    /// The system's parameters with this recording's constants.
    pub parameters: Vec<f64>,
}

impl Held {
    /// The median time between two commands (s).
    #[must_use]
    pub fn period(&self) -> f64 {
        crate::statistics::median(&mut self.times.windows(2).map(|w| w[1] - w[0]).collect::<Vec<_>>())
    }

    /// The mean of several, from when all have begun.
    #[must_use]
    pub fn mean(mut all: Vec<Held>) -> Held {
        if all.len() == 1 {
            return all.remove(0);
        }
        let begin =
            all.iter().filter_map(|held| held.times.first().copied()).fold(f64::NEG_INFINITY, f64::max);
        let mut times: Vec<f64> =
            all.iter().flat_map(|held| &held.times).copied().filter(|t| *t >= begin).collect();
        times.sort_by(f64::total_cmp);
        times.dedup();
        let at = |time: &f64| all.iter().map(|held| held.at(*time)).sum::<f64>() / all.len() as f64;
        Held { values: times.iter().map(at).collect(), times }
    }

    /// Adds a value that holds from `time` (s) on, which is not before the last stamp.
    pub fn push(&mut self, time: f64, value: f64) {
        self.times.push(time);
        self.values.push(value);
    }

    /// The value at `time`: the last one stamped at or before it, the first one before that.
    #[must_use]
    pub fn at(&self, time: f64) -> f64 {
        let after = self.times.partition_point(|t| *t <= time);
        self.values.get(after.saturating_sub(1)).copied().unwrap_or(0.0)
    }
}

/// A recorded voltage behind an input.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SupplyVoltage {
    /// The voltage, held from each stamp until the next.
    pub voltage: Held,
    /// The voltage at which the input acts as the equations say.
    pub nominal: f64,
}

impl SupplyVoltage {
    /// The voltage at a time, as a share of the nominal one; never below a hundredth.
    #[must_use]
    pub fn ratio(&self, time: f64) -> f64 {
        (self.voltage.at(time) / self.nominal).max(0.01)
    }
}

impl Held {
    /// The command averaged over intervals of `grid` seconds, if it changes faster than that.
    ///
    /// What a plant does over an interval depends on the command's mean there, to second order in the interval.
    #[must_use]
    pub fn averaged(&self, grid: f64) -> Held {
        let period = self.period();
        let (Some(first), Some(last)) = (self.times.first(), self.times.last()) else { return self.clone() };
        if period <= 0.0 || period > 0.67 * grid {
            return self.clone();
        }
        // Whole numbers of samples per interval keep even sampling even.
        let grid = period * (grid / period).round();
        let mut out = Held::default();
        let mut at = 0;
        for k in 0..((last - first) / grid).floor() as usize {
            let (from, to) = (first + k as f64 * grid, first + (k + 1) as f64 * grid);
            let (mut sum, mut now) = (0.0, from);
            while now < to {
                while at + 1 < self.times.len() && self.times[at + 1] <= now {
                    at += 1;
                }
                let until = self.times.get(at + 1).map_or(to, |next| next.min(to));
                sum += self.values[at] * (until - now);
                now = until;
            }
            out.times.push(from);
            out.values.push(sum / grid);
        }
        // What is left is shorter than an interval, and the last command holds from there on.
        let rest =
            self.times.partition_point(|t| *t <= first + out.times.len() as f64 * grid).saturating_sub(1);
        out.times.push(first + out.times.len() as f64 * grid);
        out.values.push(self.values[rest]);
        out.times.extend(&self.times[rest + 1..]);
        out.values.extend(&self.values[rest + 1..]);
        out
    }
}

/// Least time between two recordings on the common axis (s), and in periods of the fastest reading.
const BETWEEN: (f64, f64) = (3.0, 300.0);

impl Experiment {
    /// Puts recordings one after the other, with time between them in which commands that are late or smoothed settle
    /// to the next recording's first. Each comes with its name and the system's parameters under its constants.
    #[must_use]
    pub fn join(recordings: Vec<(String, Experiment, Vec<f64>)>) -> Experiment {
        let period = recordings
            .iter()
            .flat_map(|(_, e, _)| (0..e.wraps.len()).map(|output| e.period(output)))
            .filter(|p| *p > 0.0)
            .fold(f64::INFINITY, f64::min);
        let between = BETWEEN.0.max(if period.is_finite() { BETWEEN.1 * period } else { 0.0 });
        let mut all = Experiment::default();
        let mut next = 0.0;
        for (title, experiment, parameters) in recordings {
            let commands =
                experiment.inputs.iter().flat_map(|h| h.times.first().into_iter().chain(h.times.last()));
            let (from, to) = experiment.span();
            let begin = commands.clone().copied().fold(from, f64::min);
            let end = commands.copied().fold(to, f64::max);
            let origin = next - begin;
            next = end + origin + between;
            let append = |into: &mut Held, held: &Held, settle: bool| {
                if let (true, Some(value)) = (settle && !into.times.is_empty(), held.values.first()) {
                    into.times.push(origin + begin - 0.5 * between);
                    into.values.push(*value);
                }
                into.times.extend(held.times.iter().map(|t| t + origin));
                into.values.extend(&held.values);
            };
            if all.parts.is_empty() {
                all = Experiment {
                    inputs: Vec::new(),
                    supplies: Vec::new(),
                    samples: Vec::new(),
                    ..experiment.clone()
                };
                all.inputs.resize(experiment.inputs.len(), Held::default());
                all.supplies = experiment.supplies.clone();
                for supply in all.supplies.iter_mut().flatten() {
                    supply.voltage = Held::default();
                }
            }
            for (into, held) in all.inputs.iter_mut().zip(&experiment.inputs) {
                append(into, held, true);
            }
            for (into, supply) in all.supplies.iter_mut().flatten().zip(experiment.supplies.iter().flatten())
            {
                append(&mut into.voltage, &supply.voltage, true);
            }
            all.samples.extend(experiment.samples.iter().map(|s| Sample { stamp: s.stamp + origin, ..*s }));
            all.parts.push(Part { title, origin, from: from + origin, to: to + origin, parameters });
        }
        all
    }

    /// Index of the recording in which a time of the common axis lies.
    #[must_use]
    pub fn part(&self, time: f64) -> usize {
        // A recording begins to act, by late commands, before its first stamp: the middle of the gap divides them.
        let after = self.parts.windows(2).take_while(|pair| time > 0.5 * (pair[0].to + pair[1].from)).count();
        after.min(self.parts.len().saturating_sub(1))
    }

    /// Where the zero of the recording lies that a time of the common axis belongs to.
    #[must_use]
    pub fn origin(&self, time: f64) -> f64 {
        self.parts.get(self.part(time)).map_or(0.0, |part| part.origin)
    }

    /// First and last stamp of each recording.
    #[must_use]
    pub fn spans(&self) -> Vec<(f64, f64)> {
        if self.parts.is_empty() {
            return vec![self.span()];
        }
        self.parts.iter().map(|part| (part.from, part.to)).collect()
    }

    /// First stamp after a recording's own zero, and the end of the longest recording, both in a recording's own time.
    #[must_use]
    pub fn own_span(&self) -> (f64, f64) {
        let Some(first) = self.parts.first() else { return self.span() };
        self.parts.iter().fold((first.from - first.origin, first.to - first.origin), |(low, high), part| {
            (low.min(part.from - part.origin), high.max(part.to - part.origin))
        })
    }

    /// Averages the commands as [`Held::averaged`] does, each recording by itself.
    pub fn average_commands(&mut self, grid: f64) {
        for held in &mut self.inputs {
            *held = per_part(&self.parts, held, grid);
        }
    }

    /// The voltage behind an input.
    #[must_use]
    pub fn supply(&self, input: usize) -> Option<&SupplyVoltage> {
        self.supplies.get(input)?.as_ref()
    }

    /// Stamps of the first and the last reading (s).
    #[must_use]
    pub fn span(&self) -> (f64, f64) {
        match (self.samples.first(), self.samples.last()) {
            (Some(first), Some(last)) => (first.stamp, last.stamp),
            _ => (0.0, 0.0),
        }
    }

    /// The readings of one output: stamps and values.
    #[must_use]
    pub fn output(&self, output: usize) -> (Vec<f64>, Vec<f64>) {
        self.samples.iter().filter(|s| s.output == output).map(|s| (s.stamp, s.value)).unzip()
    }

    /// Keeps every `keep`-th reading of each output.
    pub fn thin(&mut self, keep: usize) {
        let mut seen = vec![0_usize; self.wraps.len()];
        self.samples.retain(|s| {
            seen[s.output] += 1;
            (seen[s.output] - 1).is_multiple_of(keep.max(1))
        });
    }

    /// The median time between readings of one output (s).
    #[must_use]
    pub fn period(&self, output: usize) -> f64 {
        let (stamps, _) = self.output(output);
        let mut steps: Vec<f64> = stamps.windows(2).map(|w| w[1] - w[0]).collect();
        crate::statistics::median(&mut steps)
    }
}

/// A command averaged recording by recording.
fn per_part(parts: &[Part], held: &Held, grid: f64) -> Held {
    if parts.len() < 2 {
        return held.averaged(grid);
    }
    let mut out = Held::default();
    let mut begin = 0;
    for (k, part) in parts.iter().enumerate() {
        let until = parts.get(k + 1).map_or(f64::INFINITY, |next| 0.5 * (part.to + next.from) - 1e-9);
        let end = begin + held.times[begin..].partition_point(|t| *t < until);
        let own = Held { times: held.times[begin..end].to_vec(), values: held.values[begin..end].to_vec() };
        // The value that settles before a recording stands alone: it is no sample.
        let lead = usize::from(k > 0 && own.times.first().is_some_and(|t| *t < part.from - 0.25 * BETWEEN.0));
        let rest = Held { times: own.times[lead..].to_vec(), values: own.values[lead..].to_vec() };
        let averaged = rest.averaged(grid);
        out.times.extend(own.times[..lead].iter().copied().chain(averaged.times));
        out.values.extend(own.values[..lead].iter().copied().chain(averaged.values));
        begin = end;
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn recording(first: f64, value: f64) -> Experiment {
        let times: Vec<f64> = (0..100).map(|k| first + f64::from(k) * 0.01).collect();
        Experiment {
            inputs: vec![Held { times: times.clone(), values: vec![value; 100] }],
            samples: times.iter().map(|t| Sample { stamp: *t, output: 0, value }).collect(),
            wraps: vec![None],
            ..Experiment::default()
        }
    }

    #[test]
    fn recordings_follow_each_other_and_keep_their_own_time() {
        let recordings = [(0.0, 1.0), (5.0, 2.0), (0.5, 3.0)]
            .map(|(first, value)| (format!("{value}"), recording(first, value), vec![value]));
        let mut all = Experiment::join(recordings.into());
        assert!(all.samples.windows(2).all(|pair| pair[0].stamp < pair[1].stamp));
        for (k, first) in [0.0, 5.0, 0.5].into_iter().enumerate() {
            let part = &all.parts[k];
            assert_eq!(all.part(part.from), k);
            assert!((part.from - all.origin(part.from) - first).abs() < 1e-9);
            // A late command of this recording is its own, not the last one of the recording before.
            assert!((all.inputs[0].at(part.from - 0.3) - part.parameters[0]).abs() < 1e-12);
        }
        all.average_commands(0.04);
        for part in &all.parts {
            let mean = all.inputs[0].at(part.from + 0.4);
            assert!((mean - part.parameters[0]).abs() < 1e-12, "{mean}");
        }
    }
}
