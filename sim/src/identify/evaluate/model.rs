//! Gauss–Newton models of the loss, with linear coefficients solved for and eliminated.

use parallax_model::fit::separable::{Sums, eliminate};
use parallax_model::fit::{Local, View};
use parallax_model::lanes::{Kernel, Level, Simd};
use rayon::prelude::*;

use super::stretch::{Stretch, Stretches};
use super::traces::{Predicted, Trace};
use super::{Evaluator, Fit, wrapped};
use crate::batch::BatchError;
use crate::identify::problem::Compared;

/// Into how many parts the time of all recordings is cut to see how much what they say differs: each longer than what
/// predictions lack is alike, and enough of them to tell.
pub(super) const PARTS: usize = 40;

/// The loss around a point.
pub(in crate::identify) struct Model {
    /// The Gauss–Newton model by coordinates and then linear coefficients.
    pub(in crate::identify) local: Local,
    /// What predictions sum up to.
    pub(in crate::identify) fit: Fit,
    /// What each part of the recordings' time adds to the model, priors apart; none where it was not asked for.
    pub(in crate::identify) parts: Vec<Local>,
}

impl Evaluator<'_> {
    /// The losses with their Gauss–Newton models, linear coefficients eliminated, by exact derivatives. Whole recordings
    /// alone.
    ///
    /// # Errors
    ///
    /// [`BatchError`] where the points cannot be put into the graph.
    pub fn exact_locals(&self, points: &[Vec<f64>], share: f64) -> Result<Vec<Local>, BatchError> {
        let stretches = self.stretches(View::whole(share));
        let traces = self.traces(points, &stretches)?;
        let linear: usize = self.problem.outputs.iter().map(|output| output.terms.len()).sum();
        let each = traces.par_iter().zip(points);
        Ok(each
            .map(|(traces, point)| eliminate(&self.model(traces, point, &stretches, 1).local, linear))
            .collect())
    }

    /// As [`exact_locals`](Self::exact_locals), by differences and in pieces as well: a point and its neighbours run on lanes
    /// together, for a tenth of the time. The derivatives are right to about five digits, which a search does not feel.
    ///
    /// # Errors
    ///
    /// As [`exact_locals`](Self::exact_locals).
    pub fn locals(&self, points: &[Vec<f64>], view: View) -> Result<Vec<Local>, BatchError> {
        let stretches = self.stretches(view);
        let linear: usize = self.problem.outputs.iter().map(|output| output.terms.len()).sum();
        self.differences(points, &stretches, |traces, point| {
            eliminate(&self.model(traces, point, &stretches, 1).local, linear)
        })
    }

    /// The loss with its Gauss–Newton model by coordinates and then linear coefficients, over whole recordings, and what each
    /// part of their time adds to it.
    pub(in crate::identify) fn explained(&self, point: &[f64]) -> Result<Model, BatchError> {
        let stretches = self.stretches(View::whole(1.0));
        let traces = self.traces(std::slice::from_ref(&point.to_vec()), &stretches)?;
        let traces = traces.into_iter().next().unwrap_or_default();
        Ok(self.model(&traces, point, &stretches, PARTS.div_ceil(self.problem.episodes)))
    }

    /// With what each of so many equal parts of a recording's time adds, where these are several.
    fn model(&self, traces: &[Trace<'_>], point: &[f64], stretches: &Stretches, parts: usize) -> Model {
        let problem = self.problem;
        let n = self.width(stretches);
        let linear: usize = problem.outputs.iter().map(|output| output.terms.len()).sum();
        let all = n + linear;
        let mut total = Local::zero(all);
        let mut alone = if parts > 1 { vec![Local::zero(all); parts * traces.len()] } else { Vec::new() };
        let mut fit = Fit { coefficients: Vec::new(), squares: Vec::new(), samples: Vec::new() };
        let mut column = n;
        let of_outputs = problem.outputs.par_iter().enumerate().map(|(index, output)| {
            let coefficients = self.solve(index, traces, stretches);
            let of_traces = traces
                .par_iter()
                .zip(&stretches.all)
                .map(|(trace, stretch)| in_parts(output, index, &coefficients, (trace, stretch), parts));
            let of_traces: Vec<Vec<Part>> = of_traces.collect();
            (coefficients, of_traces)
        });
        let of_outputs: Vec<(Vec<f64>, Vec<Vec<Part>>)> = of_outputs.collect();
        for (output, (coefficients, of_traces)) in problem.outputs.iter().zip(of_outputs) {
            let squares: f64 = of_traces.iter().flatten().map(|part| part.squares).sum();
            let samples = of_traces.iter().flatten().map(|part| part.samples).sum();
            let weight = match output.noise {
                Some(noise) => 1.0 / (noise * noise),
                None => samples as f64 / squares.max(f64::MIN_POSITIVE),
            };
            for (number, (of_trace, trace)) in of_traces.iter().zip(traces).enumerate() {
                let w = trace.columns.len();
                let place = |i: usize| if i < w { trace.columns[i] } else { column + i - w };
                for (k, part) in of_trace.iter().enumerate() {
                    add(&mut total, &part.gradient, &part.information, weight, place);
                    if let Some(alone) = alone.get_mut(number * parts + k) {
                        add(alone, &part.gradient, &part.information, weight, place);
                    }
                }
            }
            column += output.terms.len();
            fit.coefficients.push(coefficients);
            fit.squares.push(squares);
            fit.samples.push(samples);
        }
        let gaps = self.gaps(traces, point, stretches, &mut total);
        total.cost = self.loss(&fit) + self.prior(point) + gaps;
        for (i, (coordinate, z)) in problem.coordinates.iter().zip(point).enumerate() {
            if let Some((mean, std)) = coordinate.prior_of_place() {
                total.information[i * all + i] += 1.0 / (std * std);
                total.gradient[i] += (z - mean) / (std * std);
            }
        }
        Model { local: total, fit, parts: alone }
    }

    /// What it costs that pieces do not begin where those before them end, put into the model as well.
    fn gaps(&self, traces: &[Trace<'_>], point: &[f64], stretches: &Stretches, total: &mut Local) -> f64 {
        let weight = stretches.tightness * stretches.tightness;
        let mut cost = 0.0;
        for (index, stretch) in stretches.all.iter().enumerate() {
            let Some(first) = self.first_of(stretches, stretch) else { continue };
            let before = &traces[index - 1];
            let w = before.columns.len();
            for (leaf, end) in before.end.iter().enumerate() {
                let gap = end - point[first + leaf];
                cost += weight * gap * gap;
                let mut row = before.end_slopes[leaf * w..(leaf + 1) * w].to_vec();
                row.push(-1.0);
                let gradient: Vec<f64> = row.iter().map(|a| a * gap).collect();
                let information: Vec<f64> = row.iter().flat_map(|a| row.iter().map(move |b| a * b)).collect();
                let place = |i: usize| if i < w { before.columns[i] } else { first + leaf };
                add(total, &gradient, &information, weight, place);
            }
        }
        cost
    }

    /// The best coefficients of an output.
    fn solve(&self, index: usize, traces: &[Trace<'_>], stretches: &Stretches) -> Vec<f64> {
        let output = &self.problem.outputs[index];
        let mut sums = Sums::new(output.terms.len());
        if output.terms.is_empty() {
            return Vec::new();
        }
        for (trace, stretch) in traces.iter().zip(&stretches.all) {
            let Predicted { width, values, .. } = &trace.outputs[index];
            let recorded = &output.values[stretch.episode][stretch.steps[index].clone()];
            for (terms, value) in values.chunks_exact(*width).zip(recorded) {
                if value.is_finite() {
                    sums.add(terms, value - output.centre);
                }
            }
        }
        let (mut coefficients, _) = sums.solve(f64::EPSILON);
        output.uncentre(&mut coefficients);
        coefficients
    }
}

/// What a stretch adds to the model, by the numbers that it feels and then the output's coefficients; of the information the
/// lower half.
struct Part {
    gradient: Vec<f64>,
    information: Vec<f64>,
    squares: f64,
    samples: usize,
}

/// What each of so many equal parts of a stretch's time adds.
fn in_parts(
    output: &Compared,
    index: usize,
    coefficients: &[f64],
    (trace, stretch): (&Trace<'_>, &Stretch),
    count: usize,
) -> Vec<Part> {
    let (w, k) = (trace.columns.len(), coefficients.len());
    let width = w + k;
    let none = || Part {
        gradient: vec![0.0; width],
        information: vec![0.0; width * width],
        squares: 0.0,
        samples: 0,
    };
    let mut parts: Vec<Part> = (0..count).map(|_| none()).collect();
    let predicted = &trace.outputs[index];
    let recorded = &output.values[stretch.episode][stretch.steps[index].clone()];
    let mut rows = vec![0.0; width * recorded.len()];
    predicted.derive(coefficients, &mut rows, width);
    let steps = predicted.values.chunks_exact(predicted.width).zip(rows.chunks_exact_mut(width));
    for (at, ((terms, row), value)) in steps.zip(recorded).enumerate() {
        if !value.is_finite() {
            continue;
        }
        let prediction = match k {
            0 => terms[0],
            _ => terms.iter().zip(coefficients).map(|(x, c)| x * c).sum(),
        };
        let residual = wrapped(value - prediction, output.wrap);
        row[w..].copy_from_slice(if k == 0 { &[] } else { terms });
        // The rows are derivatives of the prediction; the residual's have the other sign.
        let part = &mut parts[at * count / recorded.len()];
        Level::widest().run(Outer { row, residual: -residual, part });
        part.squares += residual * residual;
        part.samples += 1;
    }
    parts
}

/// Adds a row times itself, and times its residual.
struct Outer<'a> {
    row: &'a [f64],
    residual: f64,
    part: &'a mut Part,
}

impl Kernel for Outer<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self) {
        let Self { row, residual, part } = self;
        for (i, (a, to)) in row.iter().zip(part.information.chunks_exact_mut(row.len())).enumerate() {
            for (to, b) in to[..i + 1].iter_mut().zip(row) {
                *to += a * b;
            }
        }
        for (to, a) in part.gradient.iter_mut().zip(row) {
            *to += a * residual;
        }
    }
}

/// Adds the lower half of a part's information, and its gradient, times `weight`, where `place` says.
fn add(
    total: &mut Local,
    gradient: &[f64],
    information: &[f64],
    weight: f64,
    place: impl Fn(usize) -> usize,
) {
    let (width, all) = (gradient.len(), total.gradient.len());
    for i in 0..width {
        total.gradient[place(i)] += weight * gradient[i];
        for j in 0..=i {
            let value = weight * information[i * width + j];
            total.information[place(i) * all + place(j)] += value;
            if i != j {
                total.information[place(j) * all + place(i)] += value;
            }
        }
    }
}
