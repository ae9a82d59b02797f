//! Where inside the plant: what the innovations of the refitted nominal model depend on.
//!
//! Innovations of a right model depend on nothing. A map sorts them by a quantity (time, a joint's position or speed,
//! its load, the time since it reversed, a command) and shows their mean and energy in each part; another shows their
//! energy by frequency. Each map is held against permutations that keep what the innovations owe to their neighbours.

use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::search::Fit;
use crate::setup::Setup;
use parallax_model::system::JointValues;

/// Innovations of one output, sorted by one quantity.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Map {
    /// The output.
    pub output: String,
    /// What they are sorted by: `time`, `frequency`, `speed of joint:shaft`, `input:u`, …
    pub by: String,
    /// Its unit, a label.
    pub unit: String,
    /// The parts, ascending.
    pub bins: Vec<Bin>,
    /// Share of permutations that show as much structure.
    pub p_value: f64,
    /// Share of the innovations' energy that lies in the means of the parts; for `frequency`, by how much the
    /// distribution over bands differs from an even one (total variation).
    pub share: f64,
}

/// One part of a [`Map`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Bin {
    /// Where it begins, in the map's unit.
    pub low: f64,
    /// Where it ends.
    pub high: f64,
    /// How many innovations fall into it.
    pub count: usize,
    /// Their mean, in standard deviations of the filter's prediction; 0 for `frequency`.
    pub mean: f64,
    /// Their mean square, in the same unit squared; 1 where the filter's noise is right.
    pub energy: f64,
}

/// Parts of a map.
const BINS: usize = 10;
/// Permutations that a map is held against.
const PERMUTATIONS: usize = 199;
/// Fewer innovations than this say nothing.
const FEWEST: usize = 50;
/// A circular shift moves them by at least this share of their number.
const LEAST_SHIFT: f64 = 0.05;

/// What innovations can be sorted by, at each reading.
struct Regressor {
    by: String,
    unit: String,
    values: Vec<f64>,
}

/// All maps of all outputs under a fit, most structured first.
#[must_use]
pub fn maps(setup: &Setup, fit: &Fit, seed: u64) -> Vec<Map> {
    let pass = &fit.innovation.pass;
    let regressors = regressors(setup, fit);
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut maps = Vec::new();
    for (output, stated) in setup.equations.system().outputs.iter().enumerate() {
        let own: Vec<usize> = (0..pass.output.len()).filter(|k| pass.output[*k] == output).collect();
        if own.len() < FEWEST {
            continue;
        }
        let whitened: Vec<f64> = own.iter().map(|&k| pass.innovation[k] / pass.variance[k].sqrt()).collect();
        let stamps: Vec<f64> = own.iter().map(|&k| pass.stamp[k]).collect();
        let mut add = |by: &str, unit: &str, bins: Vec<Bin>, p_value: f64, share: f64| {
            let (output, by, unit) = (stated.name.clone(), by.to_owned(), unit.to_owned());
            maps.push(Map { output, by, unit, bins, p_value, share });
        };
        let block = ((setup.horizon / setup.period).ceil() as usize).max(1);
        let (bins, p, share) =
            sorted(&stamps, &whitened, &mut random, &|e, random| shuffled(e, block, random));
        add("time", "s", bins, p, share);
        for regressor in &regressors {
            let values: Vec<f64> = own.iter().map(|&k| regressor.values[k]).collect();
            if values.iter().all(|v| *v == values[0] || v.is_nan()) {
                continue;
            }
            let (bins, p, share) = sorted(&values, &whitened, &mut random, &shifted);
            add(&regressor.by, &regressor.unit, bins, p, share);
        }
        let (bins, p, share) = spectrum(&whitened, setup.period, &mut random);
        add("frequency", "Hz", bins, p, share);
    }
    maps.sort_by(|a, b| a.p_value.total_cmp(&b.p_value).then(b.share.total_cmp(&a.share)));
    maps
}

/// Joint motions, loads and commands at every reading.
fn regressors(setup: &Setup, fit: &Fit) -> Vec<Regressor> {
    let system = setup.equations.system();
    let stamps = &fit.innovation.pass.stamp;
    let mut all = Vec::new();
    for (joint, values) in system.joints.iter().zip(fit.joints(setup)) {
        let of = |what: fn(&JointValues<f64>) -> f64| values.iter().map(what).collect::<Vec<f64>>();
        let [position, speed] = [of(|joint| joint.position), of(|joint| joint.velocity)];
        let load = of(|joint| joint.load.unwrap_or(f64::NAN));
        let mut add = |what: &str, unit: &str, values: Vec<f64>| {
            all.push(Regressor { by: format!("{what} joint:{}", joint.name), unit: unit.to_owned(), values });
        };
        add("time since reversal of", "s", since_reversal(&speed, stamps));
        add("position of", "", position);
        add("speed of", "", speed);
        if load.iter().all(|l| !l.is_nan()) {
            add("load of", "", load);
        }
    }
    let units = &setup.experiment.input_units;
    for (index, (input, held)) in system.inputs.iter().zip(&setup.experiment.inputs).enumerate() {
        let values = stamps.iter().map(|stamp| held.at(*stamp)).collect();
        let unit = units.get(index).cloned().unwrap_or_default();
        all.push(Regressor { by: format!("input:{}", input.name), unit, values });
    }
    all
}

/// Seconds since the speed last changed its sign.
fn since_reversal(speed: &[f64], stamp: &[f64]) -> Vec<f64> {
    let mut last = stamp.first().copied().unwrap_or(0.0);
    let mut sign = 0.0;
    let mut since = Vec::with_capacity(speed.len());
    for (v, t) in speed.iter().zip(stamp) {
        if *v != 0.0 && v.signum() != sign {
            sign = v.signum();
            last = *t;
        }
        // Where a new stretch of the log begins, the clock starts again.
        since.push((t - last).max(0.0));
    }
    since
}

/// Permutes innovations.
type Permute<'a> = dyn Fn(&[f64], &mut ChaCha8Rng) -> Vec<f64> + 'a;

/// Moved along by a random number of places, around the end: neighbours stay neighbours.
fn shifted(values: &[f64], random: &mut ChaCha8Rng) -> Vec<f64> {
    let least = ((values.len() as f64 * LEAST_SHIFT) as usize).max(1);
    let by = random.random_range(least..values.len() - least);
    let mut moved = values.to_vec();
    moved.rotate_left(by);
    moved
}

/// Blocks in another order: neighbours stay neighbours, time does not stay.
fn shuffled(values: &[f64], block: usize, random: &mut ChaCha8Rng) -> Vec<f64> {
    let mut blocks: Vec<&[f64]> = values.chunks(block).collect();
    blocks.shuffle(random);
    blocks.concat()
}

/// Innovations sorted by a quantity into parts of equal number: the parts, the share of permutations with as much
/// structure, and the share of the energy in the means.
fn sorted(
    by: &[f64],
    innovations: &[f64],
    random: &mut ChaCha8Rng,
    permute: &Permute<'_>,
) -> (Vec<Bin>, f64, f64) {
    let mut order: Vec<usize> = (0..by.len()).collect();
    order.sort_by(|a, b| by[*a].total_cmp(&by[*b]));
    // Equal values stay in one part: a command that is often at rest is one part, however large.
    let mut part = vec![0; by.len()];
    let mut bins: Vec<Bin> = Vec::new();
    for (rank, &k) in order.iter().enumerate() {
        let due = rank * BINS / order.len();
        let tied = rank > 0 && by[order[rank - 1]] == by[k];
        if bins.is_empty() || (due > part[order[rank.max(1) - 1]] && !tied && due >= bins.len()) {
            bins.push(Bin { low: by[k], ..Bin::default() });
        }
        part[k] = bins.len() - 1;
        if let Some(bin) = bins.last_mut() {
            bin.high = by[k];
            bin.count += 1;
        }
    }
    let energy = innovations.iter().map(|e| e * e).sum::<f64>().max(f64::MIN_POSITIVE);
    let spread = {
        let mean = energy / innovations.len() as f64;
        let square = innovations.iter().map(|e| (e * e - mean).powi(2)).sum::<f64>();
        (square / innovations.len() as f64).max(f64::MIN_POSITIVE)
    };
    let summed = |values: &[f64]| {
        let mut sums = vec![(0.0, 0.0); bins.len()];
        for (e, part) in values.iter().zip(&part) {
            sums[*part].0 += e;
            sums[*part].1 += e * e;
        }
        sums
    };
    let mean_square = energy / innovations.len() as f64;
    // Both parts are near chi-square where there is no structure.
    let structure = |sums: &[(f64, f64)]| -> [f64; 2] {
        let (mut means, mut energies) = (0.0, 0.0);
        for ((sum, squares), bin) in sums.iter().zip(&bins) {
            let count = bin.count as f64;
            means += sum * sum / count / mean_square;
            energies += (squares - count * mean_square).powi(2) / count / spread;
        }
        [means, energies]
    };
    let sums = summed(innovations);
    let found = structure(&sums);
    let total = found[0] + found[1];
    let as_much = (0..PERMUTATIONS)
        .filter(|_| structure(&summed(&permute(innovations, random))).iter().sum::<f64>() >= total)
        .count();
    for (bin, (sum, squares)) in bins.iter_mut().zip(&sums) {
        bin.mean = sum / bin.count as f64;
        bin.energy = squares / bin.count as f64;
    }
    let share = found[0] / innovations.len() as f64;
    (bins, (1 + as_much) as f64 / (1 + PERMUTATIONS) as f64, share)
}

/// Energy of the innovations in bands of frequency, each as wide as the one below times a constant; white ones have as
/// much in each per hertz.
fn spectrum(innovations: &[f64], period: f64, random: &mut ChaCha8Rng) -> (Vec<Bin>, f64, f64) {
    let density = |values: &[f64]| periodogram(values);
    let lines = innovations.len() / 2;
    let nyquist = 0.5 / period;
    let edges: Vec<usize> = (0..=BINS)
        .map(|k| (lines as f64).powf(k as f64 / BINS as f64).round() as usize)
        .collect::<std::collections::BTreeSet<_>>()
        .into_iter()
        .collect();
    let banded = |values: &[f64]| -> Vec<f64> {
        let lines = density(values);
        edges.windows(2).map(|e| lines[e[0]..e[1]].iter().sum::<f64>() / (e[1] - e[0]) as f64).collect()
    };
    let deviation = |bands: &[f64]| -> f64 {
        edges.windows(2).zip(bands).map(|(e, b)| (e[1] - e[0]) as f64 * (b.max(1e-12).ln()).powi(2)).sum()
    };
    let found = banded(innovations);
    let total = deviation(&found);
    let mut white = innovations.to_vec();
    let as_much = (0..PERMUTATIONS)
        .filter(|_| {
            white.shuffle(random);
            deviation(&banded(&white)) >= total
        })
        .count();
    let of = |line: usize| line as f64 / lines as f64 * nyquist;
    let bins = edges.windows(2).zip(&found).map(|(e, energy)| Bin {
        low: of(e[0]),
        high: of(e[1]),
        count: e[1] - e[0],
        mean: 0.0,
        energy: *energy,
    });
    let share = edges
        .windows(2)
        .zip(&found)
        .map(|(e, energy)| 0.5 * (energy - 1.0).abs() * (e[1] - e[0]) as f64 / lines as f64)
        .sum();
    (bins.collect(), (1 + as_much) as f64 / (1 + PERMUTATIONS) as f64, share)
}

/// Energy of each frequency above zero, over their mean.
fn periodogram(values: &[f64]) -> Vec<f64> {
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    let mut line: Vec<rustfft::num_complex::Complex<f64>> =
        values.iter().map(|v| rustfft::num_complex::Complex::new(v - mean, 0.0)).collect();
    rustfft::FftPlanner::new().plan_fft_forward(line.len()).process(&mut line);
    let energy: Vec<f64> = line[1..=values.len() / 2].iter().map(|c| c.norm_sqr()).collect();
    let mean = (energy.iter().sum::<f64>() / energy.len() as f64).max(f64::MIN_POSITIVE);
    energy.iter().map(|e| e / mean).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Innovations of a first-order process, which a plain permutation would take for structure.
    fn coloured(count: usize, random: &mut ChaCha8Rng) -> Vec<f64> {
        let mut last = 0.0;
        let mut draw = || random.random_range(-1.0..1.0) * 3.0_f64.sqrt();
        (0..count)
            .map(|_| {
                last = 0.5 * last + draw();
                last
            })
            .collect()
    }

    #[test]
    fn what_does_not_depend_on_the_quantity_is_not_structure() {
        let mut alarms = 0;
        for seed in 0..40 {
            let mut random = ChaCha8Rng::seed_from_u64(seed);
            let innovations = coloured(600, &mut random);
            let speed: Vec<f64> = (0..600).map(|k| (f64::from(k) * 0.05).sin()).collect();
            let (_, p, _) = sorted(&speed, &innovations, &mut random, &shifted);
            alarms += usize::from(p < 0.05);
        }
        assert!(alarms <= 6, "{alarms} of 40 maps without structure were taken for structured");
    }

    #[test]
    fn a_missing_friction_shows_by_speed_and_not_in_an_unrelated_command() {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let speed: Vec<f64> = (0..800).map(|k| (f64::from(k) * 0.037).sin()).collect();
        let command: Vec<f64> = (0..800).map(|_| random.random_range(-1.0..1.0)).collect();
        let noise = coloured(800, &mut random);
        let innovations: Vec<f64> = noise.iter().zip(&speed).map(|(e, v)| e - 0.5 * v.signum()).collect();
        let (bins, p, share) = sorted(&speed, &innovations, &mut random, &shifted);
        assert!(p < 0.02 && share > 0.05, "p {p}, share {share}");
        assert!(bins[0].mean > 0.2 && bins[BINS - 1].mean < -0.2, "{bins:?}");
        assert_eq!(bins.iter().map(|b| b.count).sum::<usize>(), 800);
        let (_, p, _) = sorted(&command, &innovations, &mut random, &shifted);
        assert!(p > 0.02, "p {p} of a command that has nothing to do with it");
    }

    #[test]
    fn equal_values_stay_in_one_part() {
        let by: Vec<f64> = (0..100).map(|k| if k < 70 { 0.0 } else { f64::from(k) }).collect();
        let innovations = vec![1.0; 100];
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let (bins, _, _) = sorted(&by, &innovations, &mut random, &shifted);
        assert_eq!((bins[0].low, bins[0].high, bins[0].count), (0.0, 0.0, 70));
        assert!(bins.windows(2).all(|pair| pair[0].high < pair[1].low), "{bins:?}");
    }

    #[test]
    fn a_resonance_shows_in_its_band_and_white_noise_does_not() {
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let white: Vec<f64> = (0..512).map(|_| random.random_range(-1.0..1.0)).collect();
        let (_, p, _) = spectrum(&white, 0.01, &mut random);
        assert!(p > 0.02, "p {p} of white noise");
        let ringing: Vec<f64> =
            white.iter().enumerate().map(|(k, e)| e + (k as f64 * 0.01 * 62.8).sin()).collect();
        let (bins, p, _) = spectrum(&ringing, 0.01, &mut random);
        let loudest = bins.iter().max_by(|a, b| a.energy.total_cmp(&b.energy));
        assert!(p < 0.02 && loudest.is_some_and(|b| b.low < 10.0 && b.high > 9.9), "p {p}, {bins:?}");
    }

    #[test]
    fn the_clock_since_a_reversal_starts_again_with_each() {
        let since = since_reversal(&[1.0, 1.0, -1.0, -1.0, 1.0], &[0.0, 0.1, 0.2, 0.3, 0.4]);
        assert_eq!(since, [0.0, 0.1, 0.0, 0.3 - 0.2, 0.0]);
    }
}
