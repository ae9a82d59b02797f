//! The library of inputs: steps, ramps, staircases, sines of growing amplitude, mixtures of sines, sweeps, swings.
//!
//! A shape goes from −1 to 1 over its duration; a [`Span`] says what ±1 mean for a command.

use std::f64::consts::TAU;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// The range of a command and its rest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Span {
    /// Lowest value.
    pub low: f64,
    /// Where it rests.
    pub rest: f64,
    /// Highest value.
    pub high: f64,
}

impl Span {
    /// The range of a command. It rests at zero, or at `usual` where zero is no inner value.
    #[must_use]
    pub fn new(low: f64, high: f64, usual: f64) -> Self {
        let inner = |value: f64| value > low + 0.2 * (high - low) && value < high - 0.2 * (high - low);
        let rest = if inner(0.0) {
            0.0
        } else if inner(usual) {
            usual
        } else {
            0.5 * (low + high)
        };
        Span { low, rest, high }
    }

    /// The command of a shape's value, `amplitude` of the way to the ends of the range.
    #[must_use]
    pub fn value(&self, shape: f64, amplitude: f64) -> f64 {
        let reach = if shape >= 0.0 { self.high - self.rest } else { self.rest - self.low };
        self.rest + amplitude * shape.clamp(-1.0, 1.0) * reach
    }
}

/// What a shape may use.
#[derive(Clone, Copy, Debug)]
pub struct Frame {
    /// Its duration (s).
    pub duration: f64,
    /// The highest frequency that commands and readings can carry (Hz).
    pub highest: f64,
    /// Seed of phases and switching times; several commands at once take different ones.
    pub seed: u64,
}

/// A kind of input.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Shape {
    /// Levels through the whole range and back, held.
    Staircase,
    /// Ramps of a third of the duration.
    SlowRamps,
    /// Ramps between levels near rest and the ends, with holds: slow motion under changing load.
    RampsAndHolds,
    /// Ramps, each a thirtieth of the duration.
    FastRamps,
    /// A slow sine whose amplitude grows in steps.
    SlowAmplitudes,
    /// A fast sine whose amplitude grows in steps.
    FastAmplitudes,
    /// Steps back and forth of growing size.
    Reversals,
    /// Steps between the ends at irregular times.
    Steps,
    /// The same, a few samples long.
    FastSteps,
    /// A mixture of sines, evenly over the logarithm of frequency.
    Sines,
    /// A sweep to a fifth of the highest frequency.
    SlowSweep,
    /// A sweep to the highest frequency.
    Sweep,
    /// Pushes, and free motion after each.
    FreeSwings,
    /// Slow ramps with a mixture of sines on top.
    RampsWithSines,
}

impl Shape {
    /// All of them.
    pub const ALL: [Shape; 14] = [
        Shape::Staircase,
        Shape::SlowRamps,
        Shape::RampsAndHolds,
        Shape::FastRamps,
        Shape::SlowAmplitudes,
        Shape::FastAmplitudes,
        Shape::Reversals,
        Shape::Steps,
        Shape::FastSteps,
        Shape::Sines,
        Shape::SlowSweep,
        Shape::Sweep,
        Shape::FreeSwings,
        Shape::RampsWithSines,
    ];

    /// What it is, for a reader.
    #[must_use]
    pub fn describe(self, frame: &Frame) -> String {
        let hertz = |f: f64| format!("{} Hz", super::short(f));
        let low = lowest(frame);
        match self {
            Shape::Staircase => "a staircase through the range, held at each level".into(),
            Shape::SlowRamps => "slow ramps".into(),
            Shape::RampsAndHolds => "slow ramps between held levels".into(),
            Shape::FastRamps => "fast ramps".into(),
            Shape::SlowAmplitudes => format!("a sine of {} whose amplitude grows in steps", hertz(4.0 * low)),
            Shape::FastAmplitudes => {
                format!("a sine of {} whose amplitude grows in steps", hertz(middle(frame)))
            }
            Shape::Reversals => "steps back and forth of growing size".into(),
            Shape::Steps => "steps at irregular times".into(),
            Shape::FastSteps => "short steps at irregular times".into(),
            Shape::Sines => format!("sines from {} to {}", hertz(low), hertz(frame.highest)),
            Shape::SlowSweep => format!("a chirp from {} to {}", hertz(low), hertz(0.2 * frame.highest)),
            Shape::Sweep => format!("a chirp from {} to {}", hertz(low), hertz(frame.highest)),
            Shape::FreeSwings => "pushes with free motion after each".into(),
            Shape::RampsWithSines => format!("slow ramps with sines up to {} on top", hertz(frame.highest)),
        }
    }

    /// Its values, −1 to 1, at the times (s) from the start on; it begins and ends near rest.
    #[must_use]
    pub fn values(self, frame: &Frame, times: &[f64]) -> Vec<f64> {
        let total = frame.duration;
        let low = lowest(frame);
        let mut values: Vec<f64> = match self {
            Shape::Staircase => {
                const LEVELS: [f64; 16] = [
                    0.0, 0.25, 0.5, 0.75, 1.0, 0.5, 0.1, 0.0, -0.1, -0.25, -0.5, -0.75, -1.0, -0.5, -0.1, 0.0,
                ];
                times.iter().map(|t| LEVELS[piece(*t / total, LEVELS.len())]).collect()
            }
            Shape::SlowRamps => times.iter().map(|t| triangle(1.5 * t / total)).collect(),
            Shape::RampsAndHolds => {
                const LEVELS: [f64; 10] = [0.0, 0.3, 0.0, -0.3, 0.0, 1.0, 0.3, -0.3, -1.0, 0.0];
                let at = |t: f64| {
                    let along = (t / total).clamp(0.0, 1.0) * (LEVELS.len() - 1) as f64;
                    let k = (along as usize).min(LEVELS.len() - 2);
                    let within = ((along - k as f64) / 0.7).min(1.0);
                    LEVELS[k] + within * (LEVELS[k + 1] - LEVELS[k])
                };
                times.iter().map(|t| at(*t)).collect()
            }
            Shape::FastRamps => times.iter().map(|t| triangle(15.0 * t / total)).collect(),
            Shape::SlowAmplitudes | Shape::FastAmplitudes => {
                let frequency = if self == Shape::SlowAmplitudes { 4.0 * low } else { middle(frame) };
                let amplitude = |t: f64| [0.1, 0.25, 0.5, 0.75, 1.0][piece(t / total, 5)];
                // A cosine: what integrates it once does not drift.
                times.iter().map(|t| amplitude(*t) * (TAU * frequency * t).cos()).collect()
            }
            Shape::Reversals => times
                .iter()
                .map(|t| {
                    let k = piece(t / total, 24);
                    let size = [0.1, 0.2, 0.35, 0.5, 0.75, 1.0][k / 4];
                    // A quarter first and last: the mean of each group vanishes, and so does that of its integral.
                    [size, -size, -size, size][k % 4]
                })
                .collect(),
            Shape::Steps => switched(frame, times, 0.02 * total, 0.1 * total),
            Shape::FastSteps => switched(frame, times, 0.25 / frame.highest, 4.0 / frame.highest),
            Shape::Sines => sines(frame, times, low),
            Shape::SlowSweep => sweep(times, total, low, (0.2 * frame.highest).max(2.0 * low)),
            Shape::Sweep => sweep(times, total, low, frame.highest.max(2.0 * low)),
            Shape::FreeSwings => times
                .iter()
                .map(|t| {
                    let along = 5.0 * t / total;
                    let k = piece(along / 5.0, 5);
                    let push = along - k as f64;
                    let size = [0.3, -0.3, 1.0, -1.0, 0.6][k];
                    // A push and one back, so that speed is given and taken.
                    if push < 0.08 {
                        size
                    } else if push < 0.12 {
                        -size
                    } else {
                        0.0
                    }
                })
                .collect(),
            Shape::RampsWithSines => {
                let fast = sines(frame, times, (frame.highest * 0.05).max(low));
                times.iter().zip(fast).map(|(t, s)| 0.7 * triangle(1.5 * t / total) + 0.3 * s).collect()
            }
        };
        // The machine is left at rest.
        for (value, time) in values.iter_mut().zip(times) {
            if *time > 0.98 * total {
                *value = 0.0;
            }
        }
        values
    }
}

/// The slowest frequency of which a duration holds two periods (Hz), within what the highest allows.
fn lowest(frame: &Frame) -> f64 {
    (2.0 / frame.duration).min(0.25 * frame.highest)
}

fn middle(frame: &Frame) -> f64 {
    (lowest(frame) * frame.highest).sqrt()
}

/// Which of `count` equal pieces holds `along`, 0 to 1.
fn piece(along: f64, count: usize) -> usize {
    ((along * count as f64 + 1e-9) as usize).min(count - 1)
}

/// A triangle of period one, from 0 up.
fn triangle(turns: f64) -> f64 {
    let phase = (turns + 0.25).rem_euclid(1.0);
    1.0 - 4.0 * (phase - 0.5).abs()
}

fn switched(frame: &Frame, times: &[f64], shortest: f64, longest: f64) -> Vec<f64> {
    let mut random = ChaCha8Rng::seed_from_u64(frame.seed);
    let (mut until, mut value) = (0.0, 0.0);
    times
        .iter()
        .map(|t| {
            while *t + 1e-9 >= until {
                until += shortest + (longest - shortest) * random.random::<f64>();
                let size = [0.2, 0.5, 1.0][random.random_range(0..3)];
                value = if value > 0.0 { -size } else { size };
            }
            value
        })
        .collect()
}

fn sines(frame: &Frame, times: &[f64], low: f64) -> Vec<f64> {
    const COUNT: usize = 12;
    let mut random = ChaCha8Rng::seed_from_u64(frame.seed);
    let waves: Vec<(f64, f64)> = (0..COUNT)
        .map(|k| {
            let along = (k as f64 + 0.5 * random.random::<f64>()) / COUNT as f64;
            (low * (frame.highest / low).powf(along), TAU * random.random::<f64>())
        })
        .collect();
    let values: Vec<f64> =
        times.iter().map(|t| waves.iter().map(|(f, phase)| (TAU * f * t + phase).sin()).sum()).collect();
    let largest = values.iter().fold(1e-9_f64, |m, v| m.max(v.abs()));
    values.into_iter().map(|v| v / largest).collect()
}

/// A logarithmic sweep, as a cosine.
fn sweep(times: &[f64], total: f64, low: f64, high: f64) -> Vec<f64> {
    let rate = (high / low).ln() / total;
    times.iter().map(|t| (TAU * low * ((rate * t).exp() - 1.0) / rate).cos()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame() -> Frame {
        Frame { duration: 20.0, highest: 10.0, seed: 3 }
    }

    #[test]
    fn shapes_stay_in_range_use_it_and_end_at_rest() {
        let times: Vec<f64> = (0..2000).map(|k| f64::from(k) * 0.01).collect();
        for shape in Shape::ALL {
            let values = shape.values(&frame(), &times);
            let largest = values.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
            assert!((0.6..=1.0 + 1e-12).contains(&largest), "{shape:?}: {largest}");
            assert_eq!(values[1999], 0.0, "{shape:?}");
            assert_eq!(values, shape.values(&frame(), &times), "{shape:?} is drawn again alike");
        }
    }

    #[test]
    fn a_sweep_reaches_its_highest_frequency() {
        let times: Vec<f64> = (0..20_000).map(|k| f64::from(k) * 1e-3).collect();
        let values = Shape::Sweep.values(&frame(), &times);
        let crossings = |from: usize, to: usize| {
            values[from..to].windows(2).filter(|w| (w[0] >= 0.0) != (w[1] >= 0.0)).count() as f64
        };
        // Two crossings a period, over the second before the end.
        let last = crossings(18_000, 19_000) / 2.0;
        assert!((6.0..10.0).contains(&last), "{last} Hz");
        assert!(crossings(0, 2000) <= 2.0);
    }

    #[test]
    fn a_command_rests_inside_its_range() {
        assert_eq!(Span::new(-4.0, 4.0, 1.0).rest, 0.0);
        assert_eq!(Span::new(2.0, 12.0, 5.0).rest, 5.0);
        assert_eq!(Span::new(0.0, 1.0, 0.0).rest, 0.5);
        let span = Span::new(-1.0, 3.0, 0.0);
        assert_eq!([span.value(-1.0, 1.0), span.value(1.0, 0.5), span.value(9.0, 1.0)], [-1.0, 1.5, 3.0]);
    }
}
