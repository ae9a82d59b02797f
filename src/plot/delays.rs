//! Measured delays as histograms, and the fits over them.

use parallax_gap::plot::axis::{multiples, step};
use parallax_gap::plot::draw::{Anchor, Pen};
use parallax_gap::plot::format::{clip, number};
use parallax_runtime::delay::Delay;
use parallax_runtime::time::to_seconds;
use parallax_sim::delays::{DelayFit, Measured};

use super::{Drawing, Figure, NARROW, WIDE};

const PANEL: f64 = 128.0;
const TITLE: f64 = 36.0;
const AXIS: f64 = 30.0;
const BETWEEN: f64 = 26.0;

/// One panel a place: the samples in grey, the fit as a line.
pub(crate) fn figure(fits: &[DelayFit], measured: &[Measured]) -> Figure {
    Figure {
        title: "Delays".into(),
        note: "Grey: what was measured, by density. Line: the fitted distribution; a post where it is constant. \
               Outliers, and what lies far beyond the middle 90 %, are not \
               drawn."
            .into(),
        wide: panels(fits, measured, 3, WIDE),
        narrow: panels(fits, measured, 1, NARROW),
    }
}

fn panels(fits: &[DelayFit], measured: &[Measured], columns: usize, width: f64) -> Drawing {
    let mut pen = Pen::default();
    let panel = (width - BETWEEN * (columns - 1) as f64) / columns as f64;
    let height = TITLE + PANEL + AXIS;
    for (index, (fit, measured)) in fits.iter().zip(measured).enumerate() {
        let x = (panel + BETWEEN) * (index % columns) as f64;
        let y = height * (index / columns) as f64;
        draw(&mut pen, fit, measured, (x, y), panel);
    }
    Drawing { pen, height: height * fits.len().div_ceil(columns) as f64 }
}

/// The unit in which a delay is read best, and how many of it are a second.
fn unit(seconds: f64) -> (&'static str, f64) {
    match seconds {
        s if s < 1e-6 => ("ns", 1e9),
        s if s < 1e-3 => ("µs", 1e6),
        s if s < 1.0 => ("ms", 1e3),
        _ => ("s", 1.0),
    }
}

/// The normal distributions of a fit: weight, mean, standard deviation.
fn parts(delay: &Delay) -> Vec<(f64, f64, f64)> {
    match delay {
        Delay::Correlated { of, .. } => parts(of),
        Delay::Normal { mean, std } => vec![(1.0, *mean, *std)],
        Delay::Constant { seconds } => vec![(1.0, *seconds, 0.0)],
        Delay::Mixture { weights, means, stds } => {
            weights.iter().zip(means).zip(stds).map(|((w, m), s)| (*w, *m, *s)).collect()
        }
        _ => Vec::new(),
    }
}

fn draw(pen: &mut Pen, fit: &DelayFit, measured: &Measured, (x, y): (f64, f64), width: f64) {
    let letters = (width / 7.4) as usize;
    pen.text("head", (x, y + 12.0), Anchor::Start, &clip(&fit.place.to_string(), letters));
    let mut about = format!("{} samples", fit.samples);
    match fit.components {
        0 => about.push_str(", constant"),
        1 => about.push_str(", 1 component"),
        n => about.push_str(&format!(", {n} components")),
    }
    if fit.outliers > 0 {
        about.push_str(&format!(", {} outlier{}", fit.outliers, if fit.outliers == 1 { "" } else { "s" }));
    }

    // All that is no outlier, and all of the fit that matters.
    let parts = parts(&fit.fit);
    let mut low = parts.iter().map(|(_, m, s)| m - 3.5 * s).fold(f64::INFINITY, f64::min).max(0.0);
    let mut high = parts.iter().map(|(_, m, s)| m + 3.5 * s).fold(0.0, f64::max);
    let mut samples: Vec<f64> = measured.delays.iter().map(|delay| to_seconds(*delay)).collect();
    samples.sort_by(f64::total_cmp);
    if fit.outliers == 0 {
        low = low.min(fit.min_s);
        high = high.max(fit.max_s);
    }
    // A long thin tail would leave no width for the rest; how much of it is cut is told.
    let at = |share: f64| samples[((samples.len() - 1) as f64 * share).round() as usize];
    let most = at(0.95) - at(0.05);
    if most > 0.0 {
        low = low.max(at(0.05) - most);
        high = high.min(at(0.95) + most);
    }
    let room = 0.04 * (high - low).max(0.02 * high).max(4.0 * fit.resolution_s);
    let (low, high) = ((low - room).max(0.0), high + room);
    let shown = &samples[samples.partition_point(|s| *s < low)..samples.partition_point(|s| *s <= high)];

    let beyond = samples.len() - shown.len();
    if beyond > fit.outliers {
        about.push_str(&format!(", {} beyond", beyond - fit.outliers));
    }
    pen.text("small", (x, y + 27.0), Anchor::Start, &about);

    let bottom = y + TITLE + PANEL;
    let at = |seconds: f64| x + width * ((seconds - low) / (high - low)).clamp(0.0, 1.0);
    // A constant is one narrow bar in the middle.
    let bins = if fit.components == 0 { 41 } else { bins(shown, low, high, fit.resolution_s) };
    let bin = (high - low) / bins as f64;
    let mut counts = vec![0.0_f64; bins];
    for sample in shown {
        counts[(((sample - low) / bin) as usize).min(bins - 1)] += 1.0;
    }
    let share = 1.0 / (samples.len().max(1) as f64 * bin);
    let curve: Vec<(f64, f64)> = (0..=200)
        .map(|i| low + (high - low) * f64::from(i) / 200.0)
        .map(|at| (at, fit.fit.density(at).unwrap_or(0.0)))
        .collect();
    let inside = (fit.samples - fit.outliers) as f64 / fit.samples.max(1) as f64;
    let peak = curve.iter().map(|(_, density)| density * inside).fold(0.0, f64::max);
    let most = counts.iter().map(|count| count * share).fold(peak, f64::max).max(1e-300) * 1.06;
    let level = |density: f64| bottom - PANEL * (density / most).clamp(0.0, 1.0);
    for (index, count) in counts.iter().enumerate().filter(|(_, count)| **count > 0.0) {
        let (left, right) = (at(low + bin * index as f64), at(low + bin * (index + 1) as f64));
        let height = level(count * share);
        pen.rect("histogram", (left, height), ((right - left).max(0.6), bottom - height));
    }
    if peak > 0.0 {
        let line: Vec<(f64, f64)> =
            curve.iter().map(|(s, density)| (at(*s), level(density * inside))).collect();
        pen.runs("fit", &[line]);
    }
    for (weight, mean, _) in parts.iter().filter(|(_, _, std)| *std == 0.0) {
        pen.line("fit", (at(*mean), bottom), (at(*mean), level(weight * inside / bin)));
    }
    pen.line("axis", (x, bottom), (x + width, bottom));
    let (name, per_second) = unit(high);
    let tick = step((high - low) * per_second / 5.0);
    for value in multiples(low * per_second, high * per_second, tick) {
        let place = at(value / per_second);
        pen.line("axis", (place, bottom), (place, bottom + 4.0));
        // At the right end stands the unit.
        if place - x > width - 30.0 {
            continue;
        }
        let anchor = if place - x < 12.0 { Anchor::Start } else { Anchor::Middle };
        let digits = ((high * per_second / tick).log10().ceil() as i32 + 1).clamp(3, 9);
        pen.text("tick", (place, bottom + 16.0), anchor, &number(value, digits));
    }
    pen.text("tick", (x + width, bottom + 16.0), Anchor::End, name);
}

/// How many bins show a distribution best: Freedman and Diaconis, within what a panel can hold, and none narrower than the
/// clock's step.
fn bins(sorted: &[f64], low: f64, high: f64, resolution: f64) -> usize {
    if sorted.is_empty() {
        return 1;
    }
    let at = |share: f64| sorted[((sorted.len() - 1) as f64 * share).round() as usize];
    let width = 2.0 * (at(0.75) - at(0.25)) / (sorted.len() as f64).cbrt();
    let wanted = if width > 0.0 { (high - low) / width } else { 60.0 };
    let most = ((high - low) / resolution).floor().max(1.0);
    wanted.ceil().clamp(12.0, 70.0).min(most) as usize
}
