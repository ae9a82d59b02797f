//! An overlay made fit for drawing: what is missing or absurd marked, pieces of unbroken time, the stretch worth a
//! closer look.

use std::ops::Range;

use super::Overlay;

/// Beyond this a number counts as missing: spans of such numbers would overflow.
const ABSURD: f64 = 1e280;

/// Readings of one output.
pub(super) struct Readings<'a> {
    /// The output's name.
    pub(super) output: &'a str,
    /// Its unit.
    pub(super) unit: &'a str,
    /// One noise unit, if it is known.
    pub(super) noise: Option<f64>,
    /// Stamps (s).
    pub(super) stamp: Vec<f64>,
    /// What was measured; NaN where missing, as in the next two.
    pub(super) measured: Vec<f64>,
    /// Predicted before any effect.
    pub(super) before: Vec<f64>,
    /// Predicted with the effects; empty where this says nothing else than `before`.
    pub(super) after: Vec<f64>,
    /// Samples that follow one another without a break.
    pub(super) pieces: Vec<Range<usize>>,
}

impl<'a> Readings<'a> {
    /// Reads an overlay; series that are too short count as missing at their ends.
    pub(super) fn new(overlay: &'a Overlay) -> Self {
        let kept: Vec<usize> =
            (0..overlay.stamp.len()).filter(|&i| overlay.stamp[i].abs() < ABSURD).collect();
        let series = |values: &[f64]| -> Vec<f64> {
            kept.iter()
                .map(|&i| values.get(i).copied().filter(|v| v.abs() < ABSURD).unwrap_or(f64::NAN))
                .collect()
        };
        let stamp: Vec<f64> = kept.iter().map(|&i| overlay.stamp[i]).collect();
        let (before, after) = (series(&overlay.before), series(&overlay.after));
        let same = before.iter().zip(&after).all(|(b, a)| b == a || a.is_nan());
        let pieces = pieces(&stamp);
        Self {
            output: &overlay.output,
            unit: &overlay.unit,
            noise: Some(overlay.noise).filter(|noise| *noise > 1e-280 && *noise < ABSURD),
            measured: series(&overlay.measured),
            before,
            after: if same { Vec::new() } else { after },
            stamp,
            pieces,
        }
    }

    /// Predicted minus measured, in noise units where these are known.
    pub(super) fn residual(&self, predicted: &[f64]) -> Vec<f64> {
        let unit = self.noise.unwrap_or(1.0);
        let residual = |(p, m): (&f64, &f64)| Some((p - m) / unit).filter(|r| r.abs() < ABSURD);
        predicted.iter().zip(&self.measured).map(|pair| residual(pair).unwrap_or(f64::NAN)).collect()
    }

    /// Root mean square of the residual, if there is any.
    pub(super) fn error(&self, predicted: &[f64]) -> Option<f64> {
        let residual: Vec<f64> = self.residual(predicted).into_iter().filter(|r| r.is_finite()).collect();
        // Scaling by the largest keeps squares from overflowing.
        let largest = residual.iter().fold(0.0, |m: f64, r| m.max(r.abs()));
        if residual.is_empty() || largest == 0.0 {
            return (!residual.is_empty()).then_some(0.0);
        }
        let mean = residual.iter().map(|r| (r / largest).powi(2)).sum::<f64>() / residual.len() as f64;
        Some(largest * mean.sqrt())
    }

    /// How much the error falls from before to after, for ordering outputs.
    pub(super) fn improvement(&self) -> f64 {
        let before = self.error(&self.before).unwrap_or(0.0);
        before - self.error(&self.after).unwrap_or(before)
    }

    /// The stretch of about `length` seconds on which the prediction improves most, or, where only one prediction
    /// is drawn, errs most. None where the whole is hardly longer.
    pub(super) fn detail(&self, length: f64) -> Option<Range<usize>> {
        let covered: f64 = self.pieces.iter().map(|piece| self.duration(piece)).sum();
        let length = length.clamp(covered * 0.03, covered * 0.15);
        if self.stamp.len() < 60 || length.is_nan() || length <= 0.0 {
            return None;
        }
        let worst = self.residual(&self.before);
        let best = self.residual(&self.after);
        let finite = |r: f64| if r.is_finite() { r.abs() } else { 0.0 };
        // Running sums of the drop in error make the sum over any stretch one subtraction.
        let mut sums = vec![0.0];
        for i in 0..self.stamp.len() {
            let drop = finite(worst[i]) - best.get(i).map_or(0.0, |r| finite(*r));
            sums.push(sums[i] + drop.clamp(-ABSURD / 1e12, ABSURD / 1e12));
        }
        let mut found: Option<(f64, Range<usize>)> = None;
        for piece in &self.pieces {
            let mut start = piece.start;
            for end in piece.clone() {
                while self.stamp[end] - self.stamp[start] > length {
                    start += 1;
                }
                let total = sums[end + 1] - sums[start];
                let long = self.stamp[end] - self.stamp[start] >= length * 0.5 && end - start >= 8;
                if long && found.as_ref().is_none_or(|(most, _)| total > *most) {
                    found = Some((total, start..end + 1));
                }
            }
        }
        found.map(|(_, stretch)| stretch)
    }

    fn duration(&self, range: &Range<usize>) -> f64 {
        self.stamp[range.end - 1] - self.stamp[range.start]
    }
}

/// Where the line has to break: after a step much longer than most, and where time runs backwards.
fn pieces(stamp: &[f64]) -> Vec<Range<usize>> {
    if stamp.is_empty() {
        return Vec::new();
    }
    let mut steps: Vec<f64> = stamp.windows(2).map(|pair| pair[1] - pair[0]).filter(|dt| *dt > 0.0).collect();
    steps.sort_by(f64::total_cmp);
    let quantile = |q: usize| steps.get(steps.len() * q / 100).copied().unwrap_or(f64::INFINITY);
    let longest = (4.0 * quantile(50)).max(1.5 * quantile(90));
    let mut pieces = Vec::new();
    let mut start = 0;
    for i in 1..stamp.len() {
        if !(0.0..=longest).contains(&(stamp[i] - stamp[i - 1])) {
            pieces.push(start..i);
            start = i;
        }
    }
    pieces.push(start..stamp.len());
    pieces
}

/// Points of a line, thinned to the least and the greatest of each pixel column where there are many; runs end where
/// a point is missing.
pub(super) fn thin(points: impl Iterator<Item = (f64, f64)>) -> Vec<Vec<(f64, f64)>> {
    let mut runs: Vec<Vec<(f64, f64)>> = vec![Vec::new()];
    for (x, y) in points {
        match runs.last_mut() {
            Some(run) if x.is_finite() && y.is_finite() => run.push((x, y)),
            Some(run) if run.is_empty() => {}
            _ => runs.push(Vec::new()),
        }
    }
    runs.retain(|run| !run.is_empty());
    runs.into_iter().map(columns).collect()
}

fn columns(run: Vec<(f64, f64)>) -> Vec<(f64, f64)> {
    let width = run[run.len() - 1].0 - run[0].0;
    if (run.len() as f64) < 3.0 * width.max(1.0) {
        return run;
    }
    let mut thinned = Vec::new();
    let mut i = 0;
    while i < run.len() {
        let column = run[i].0.floor();
        let (mut low, mut high) = (i, i);
        while i < run.len() && run[i].0.floor() == column {
            if run[i].1 < run[low].1 {
                low = i;
            }
            if run[i].1 > run[high].1 {
                high = i;
            }
            i += 1;
        }
        thinned.push(run[low.min(high)]);
        if low != high {
            thinned.push(run[low.max(high)]);
        }
    }
    thinned
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_break_at_gaps_and_where_time_runs_back() {
        let block = |start: f64| (0..20).map(move |i| start + 0.1 * f64::from(i));
        let stamp: Vec<f64> = block(0.0).chain(block(10.0)).chain(block(5.0)).collect();
        assert_eq!(pieces(&stamp), [0..20, 20..40, 40..60]);
        assert_eq!(pieces(&[]), Vec::<Range<usize>>::new());
        assert_eq!(pieces(&[1.0]), std::slice::from_ref(&(0..1)));
    }

    #[test]
    fn thinning_keeps_every_spike() {
        let points = (0..100_000).map(|i| (f64::from(i) * 1e-3, if i == 54_321 { 9.0 } else { 0.0 }));
        let runs = thin(points);
        assert_eq!(runs.len(), 1);
        assert!(runs[0].len() < 400);
        assert!(runs[0].iter().any(|(_, y)| *y == 9.0));
        let broken = thin([(0.0, 0.0), (1.0, f64::NAN), (2.0, 0.0), (3.0, f64::INFINITY)].into_iter());
        assert_eq!(broken, [vec![(0.0, 0.0)], vec![(2.0, 0.0)]]);
    }

    #[test]
    fn the_closer_look_is_where_the_prediction_improves() {
        let stamp: Vec<f64> = (0..1000).map(|i| f64::from(i) * 0.01).collect();
        let before: Vec<f64> = stamp.iter().map(|t| if (6.0..6.5).contains(t) { 1.0 } else { 0.1 }).collect();
        let zero = vec![0.0; 1000];
        let overlay = Overlay {
            noise: 0.1,
            measured: zero.clone(),
            after: zero.clone(),
            before,
            stamp: stamp.clone(),
            ..Overlay::default()
        };
        let readings = Readings::new(&overlay);
        let detail = readings.detail(1.0).expect("ten seconds are enough");
        assert!(stamp[detail.start] <= 6.0 && stamp[detail.end - 1] >= 6.49, "{detail:?}");
        assert!(readings.error(&readings.after) == Some(0.0));
    }
}
