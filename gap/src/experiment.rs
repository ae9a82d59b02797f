//! A recording as the fits see it: held commands and stamped readings.

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
#[derive(Clone, Debug, Default)]
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
}

impl Held {
    /// The value at `time`: the last one stamped at or before it, the first one before that.
    #[must_use]
    pub fn at(&self, time: f64) -> f64 {
        let after = self.times.partition_point(|t| *t <= time);
        self.values.get(after.saturating_sub(1)).copied().unwrap_or(0.0)
    }
}

/// A recorded voltage behind an input.
#[derive(Clone, Debug, Default)]
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
        let period =
            crate::statistics::median(&mut self.times.windows(2).map(|w| w[1] - w[0]).collect::<Vec<_>>());
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

impl Experiment {
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
