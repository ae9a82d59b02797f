//! What was identified: predictions over recorded readings, and the estimates with their intervals.

use parallax_gap::plot::axis::{Scale, multiples, step};
use parallax_gap::plot::draw::{Anchor, Pen, width};
use parallax_gap::plot::format::{clip, number};
use parallax_sim::identify::{Estimate, Identified, Reconstruction, Series};

use super::{Drawing, Figure, NARROW, WIDE};

const PANEL: f64 = 180.0;
const TITLE: f64 = 24.0;
const AXIS: f64 = 36.0;
const ROW: f64 = 22.0;

/// One figure for each output, and one of all estimates.
pub(crate) fn figures(found: &Identified, reconstructions: &[Reconstruction]) -> Vec<Figure> {
    let mut figures: Vec<Figure> = reconstructions.iter().map(|output| overlay(found, output)).collect();
    figures.push(Figure {
        title: "Estimates".into(),
        note: "Dot: the estimate. Line: where it lies with 95 % probability, from the lower to the upper bound of the \
               search. Hollow: the data do not determine it by itself."
            .into(),
        wide: estimates(found, WIDE),
        narrow: estimates(found, NARROW),
    });
    figures
}

/// What is shown of a recording: all of the time that is compared.
fn shown(series: &Series) -> Vec<usize> {
    let usable = |k: &usize| series.predicted[*k].is_finite() && series.recorded[*k].is_finite();
    let compared = |k: &usize| series.times[*k] <= series.compared_until + 1e-9;
    (0..series.times.len()).filter(|k| usable(k) && compared(k)).collect()
}

fn overlay(found: &Identified, output: &Reconstruction) -> Figure {
    let score = found.outputs.iter().find(|score| score.output == output.output);
    let error = score.map_or_else(String::new, |score| {
        let held_out = score
            .held_out
            .map_or_else(String::new, |error| format!(", {} on time that no fit has seen", number(error, 3)));
        format!(" Root mean square of the error: {} where it was fitted{held_out}.", number(score.fitted, 3))
    });
    Figure {
        title: output.output.clone(),
        note: format!(
            "Grey: recorded. Blue: predicted open loop, from the first state and the recorded commands alone; nothing \
             recorded corrects it on the way. Shaded: time that no fit has seen.{error}"
        ),
        wide: panels(output, WIDE),
        narrow: panels(output, NARROW),
    }
}

fn panels(output: &Reconstruction, width: f64) -> Drawing {
    let mut pen = Pen::default();
    let height = TITLE + PANEL + AXIS;
    for (index, series) in output.recordings.iter().enumerate() {
        let y = height * index as f64;
        if output.recordings.len() > 1 {
            let title = format!("recording {}", index + 1);
            pen.text("head", (0.0, y + 12.0), Anchor::Start, &title);
        }
        panel(&mut pen, output, series, y + TITLE, width);
    }
    Drawing { pen, height: height * output.recordings.len() as f64 }
}

fn panel(pen: &mut Pen, output: &Reconstruction, series: &Series, top: f64, wide: f64) {
    let samples = shown(series);
    let (Some(&first), Some(&last)) = (samples.first(), samples.last()) else {
        pen.text("soft", (0.0, top + 14.0), Anchor::Start, "nothing to compare");
        return;
    };
    // An angle that wraps is drawn where the recording has it.
    let predicted = |k: usize| match output.wrap {
        Some(period) => {
            let error = series.recorded[k] - series.predicted[k];
            series.recorded[k] - (error - period * (error / period).round())
        }
        None => series.predicted[k],
    };
    let values = samples.iter().flat_map(|&k| [series.recorded[k], predicted(k)]);
    let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
    let scale = Scale::new(low, high, 5.0);
    let left = scale.ticks.iter().map(|(_, label)| width(label, 11.0)).fold(0.0, f64::max) + 10.0;
    let (from, to) = (series.times[first], series.times[last].max(series.times[first] + 1e-9));
    let x = |time: f64| left + (wide - left - 4.0) * (time - from) / (to - from);
    let y = |value: f64| scale.y(value, top, PANEL);
    if series.held_out_from < to - 1e-9 {
        let begin = x(series.held_out_from.max(from));
        pen.rect("band", (begin, top), (wide - 4.0 - begin, PANEL));
    }
    for (value, label) in &scale.ticks {
        pen.line("rule", (left, y(*value)), (wide - 4.0, y(*value)));
        pen.text("tick", (left - 6.0, y(*value) + 4.0), Anchor::End, label);
    }
    for time in multiples(from, to, step((to - from) / if wide > 500.0 { 8.0 } else { 4.0 })) {
        pen.text_within("tick", (x(time), top + PANEL + 16.0), wide, &number(time, 4));
    }
    pen.text("soft", (wide - 4.0, top + PANEL + 30.0), Anchor::End, "s since the start");
    let wraps = output.wrap.map_or(f64::INFINITY, |period| 0.5 * period);
    let curve = |value: &dyn Fn(usize) -> f64| {
        let mut runs: Vec<Vec<(f64, f64)>> = vec![Vec::new()];
        let mut before: Option<f64> = None;
        for &k in &samples {
            let now = value(k);
            if before.is_some_and(|before| (now - before).abs() > wraps) {
                runs.push(Vec::new());
            }
            before = Some(now);
            if let Some(run) = runs.last_mut() {
                run.push((x(series.times[k]), y(now)));
            }
        }
        runs
    };
    pen.runs("measured", &curve(&|k| series.recorded[k]));
    pen.runs("after", &curve(&predicted));
}

fn estimates(found: &Identified, wide: f64) -> Drawing {
    let mut pen = Pen::default();
    let names = if wide > 500.0 { 260.0 } else { 105.0 };
    let values = if wide > 500.0 { 330.0 } else { 155.0 };
    let (left, right) = (names + 10.0, wide - values - 10.0);
    for (index, estimate) in found.estimates.iter().enumerate() {
        let y = 14.0 + ROW * index as f64;
        pen.text("small", (0.0, y), Anchor::Start, &clip(&estimate.name, (names / 6.6) as usize));
        pen.text("small", (right + 10.0, y), Anchor::Start, &said(estimate, wide > 500.0));
        let Some([low, high]) = estimate.bounds else { continue };
        // As the search sees it: by logarithms where the bounds are positive and far apart.
        let log = low > 0.0 && high > 2.0 * low;
        let share = |value: f64| match log {
            true => (value / low).ln() / (high / low).ln(),
            false => (value - low) / (high - low),
        };
        let x = |value: f64| left + (right - left) * share(value).clamp(0.0, 1.0);
        pen.line("rule", (left, y - 4.0), (right, y - 4.0));
        if estimate.std.is_some() {
            let [from, to] = estimate.interval.map(x);
            pen.runs("after", &[vec![(from, y - 4.0), (to.max(from + 0.5), y - 4.0)]]);
            pen.dot("bar", (x(estimate.value), y - 4.0), 4.0);
        } else {
            pen.dot("band", (x(estimate.value), y - 4.0), 4.0);
        }
    }
    Drawing { pen, height: 14.0 + ROW * found.estimates.len() as f64 }
}

fn said(estimate: &Estimate, interval: bool) -> String {
    let unit = if estimate.unit.is_empty() { String::new() } else { format!(" {}", estimate.unit) };
    let value = number(estimate.value, 4);
    match estimate.std {
        None if interval => format!("{value}{unit}, not determined"),
        Some(_) if interval => {
            let [low, high] = estimate.interval.map(|end| number(end, 4));
            format!("{value}{unit} ({low} to {high})")
        }
        _ => format!("{value}{unit}"),
    }
}
