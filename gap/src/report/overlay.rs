//! The overlay of one output: measured and predicted readings over held-out time, the residuals below, and beside
//! them the stretch where the prediction improves most.

use std::ops::Range;

use super::axis::{self, Scale, Stretch};
use super::draw::{self, Anchor, Pen};
use super::format;
use super::readings::{Readings, thin};

/// What is left free right of a panel (px).
const MARGIN: f64 = 4.0;

/// A part of the drawing: where it stands, how wide it is, how high its two panels are (px).
#[derive(Clone, Copy)]
pub(super) struct Frame {
    pub(super) x: f64,
    pub(super) y: f64,
    pub(super) width: f64,
    pub(super) values: f64,
    pub(super) residuals: f64,
}

/// Room for a title above a panel, and for the time axis below.
const TITLE: f64 = 20.0;
const BETWEEN: f64 = 30.0;
const TIME: f64 = 34.0;

impl Frame {
    /// Height of everything from the first title to the time axis.
    pub(super) fn height(&self) -> f64 {
        TITLE + self.values + BETWEEN + self.residuals + TIME
    }
}

/// Draws the overlay of one output for a wide page or a narrow one. `horizon` is that of the predictions (s).
pub(super) fn plot(readings: &Readings<'_>, narrow: bool, horizon: f64) -> String {
    let mut pen = Pen::default();
    let label = format!("{}: measured and predicted on held-out time, residuals below", readings.output);
    let detail = readings.detail(4.0 * horizon);
    let top = 26.0;
    legend(&mut pen, readings, 0.0, 12.0, narrow);
    if narrow {
        let frame = Frame { x: 0.0, y: top, width: 360.0, values: 150.0, residuals: 72.0 };
        column(&mut pen, readings, &readings.pieces, detail.as_ref(), frame, false);
        let mut bottom = top + frame.height();
        if let Some(detail) = detail {
            let frame = Frame { y: bottom + 14.0, ..frame };
            column(&mut pen, readings, std::slice::from_ref(&detail), None, frame, false);
            bottom = frame.y + frame.height();
        }
        return pen.finish("plot narrow", 360.0, bottom, &label);
    }
    let whole = if detail.is_some() { 640.0 } else { 1040.0 };
    let frame = Frame { x: 0.0, y: top, width: whole, values: 200.0, residuals: 90.0 };
    column(&mut pen, readings, &readings.pieces, detail.as_ref(), frame, true);
    if let Some(detail) = detail {
        let frame = Frame { x: 664.0, width: 376.0, ..frame };
        column(&mut pen, readings, std::slice::from_ref(&detail), None, frame, true);
    }
    pen.finish("plot wide", 1040.0, top + frame.height(), &label)
}

/// Says which line is which.
pub(super) fn legend(pen: &mut Pen, readings: &Readings<'_>, x: f64, y: f64, narrow: bool) {
    let mut entries = vec![("measured", "measured")];
    match (readings.after.is_empty(), narrow) {
        (true, _) => entries.push(("after", "predicted")),
        (false, true) => entries.extend([("before", "before"), ("after", "with the effect")]),
        (false, false) => {
            entries.extend([("before", "predicted before"), ("after", "predicted with the effect")]);
        }
    }
    let mut x = x;
    for (class, name) in entries {
        pen.runs(class, &[vec![(x + 3.0, y - 4.0), (x + 27.0, y - 4.0)]]);
        pen.text("soft", (x + 34.0, y), Anchor::Start, name);
        x += 34.0 + draw::width(name, 12.0) + 16.0;
    }
}

/// Draws the values and the residuals of some samples over one time axis.
pub(super) fn column(
    pen: &mut Pen,
    readings: &Readings<'_>,
    pieces: &[Range<usize>],
    focus: Option<&Range<usize>>,
    frame: Frame,
    probe: bool,
) {
    let before = readings.residual(&readings.before);
    let after = readings.residual(&readings.after);
    let single = readings.after.is_empty();
    let values = value_scale(readings, pieces, frame.values);
    let residuals = residual_scale(readings.noise.is_some(), &before, &after, pieces, frame.residuals);
    let widest = |scale: &Scale| {
        scale.ticks.iter().map(|(_, label)| draw::width(label, 11.0)).fold(0.0, |a: f64, b| a.max(b))
    };
    let left = frame.x + widest(&values).max(widest(&residuals)) + 10.0;
    let right = frame.x + frame.width - MARGIN;
    let stretches = axis::stretches(&readings.stamp, pieces, left, right);
    let panel = Panel { left, right, top: frame.y + TITLE, height: frame.values };
    let strip = Panel { top: panel.top + panel.height + BETWEEN, height: frame.residuals, ..panel };

    if let Some(range) = focus
        && let Some((from, to)) = extent(&readings.stamp, &stretches, range)
    {
        let bottom = strip.top + strip.height;
        pen.rect("focus", (from, panel.top), (to - from, bottom - panel.top));
    }
    panel.scale(pen, &values, &format!("{}{}", readings.output, dimension(&values, readings.unit)));
    panel.open(pen);
    let curves = [("measured", &readings.measured), ("before", &readings.before), ("after", &readings.after)];
    for (class, series) in curves {
        let class = if single && class == "before" { "after" } else { class };
        panel.curve(pen, class, &values, readings, pieces, &stretches, series);
    }
    pen.raw("</svg>");

    if readings.noise.is_some() {
        let (high, low) = (strip.y(&residuals, 2.0), strip.y(&residuals, -2.0));
        let (high, low) = (high.max(strip.top), low.min(strip.top + strip.height));
        pen.rect("band", (left, high), (right - left, low - high));
    }
    let unit = if readings.noise.is_some() { "noise units" } else { readings.unit };
    strip.scale(pen, &residuals, &format!("residual{}", dimension(&residuals, unit)));
    strip.open(pen);
    strip.curve(
        pen,
        if single { "after" } else { "before" },
        &residuals,
        readings,
        pieces,
        &stretches,
        &before,
    );
    strip.curve(pen, "after", &residuals, readings, pieces, &stretches, &after);
    pen.raw("</svg>");

    time_axis(pen, &stretches, strip.top + strip.height);
    if probe {
        let bottom = strip.top + strip.height;
        pen.line("cursor", (left, panel.top), (left, bottom));
        let points = probe_points(readings, &stretches, &before, &after);
        pen.raw(&format!(
            "<rect class=\"probe\" x=\"{}\" y=\"{}\" width=\"{}\" height=\"{}\" data-points=\"{points}\"/>",
            draw::px(left),
            draw::px(panel.top),
            draw::px(right - left),
            draw::px(bottom - panel.top),
        ));
    }
}

/// ` (10⁻³ m)`.
fn dimension(scale: &Scale, unit: &str) -> String {
    let power = if scale.exponent == 0 { String::new() } else { format::power_of_ten(scale.exponent) };
    match format!("{power}{}", format::unit(unit)).trim() {
        "" => String::new(),
        text => format!(" ({text})"),
    }
}

fn bounds(values: &[f64], pieces: &[Range<usize>]) -> Option<(f64, f64)> {
    let finite =
        pieces.iter().flat_map(|piece| values.get(piece.clone()).unwrap_or(&[])).filter(|v| v.is_finite());
    finite.fold(None, |bounds, &v| match bounds {
        None => Some((v, v)),
        Some((low, high)) => Some((f64::min(low, v), f64::max(high, v))),
    })
}

/// Shows all that was measured and is predicted with the effect. A prediction without it may run away; it is shown
/// as far as this leaves the others readable.
fn value_scale(readings: &Readings<'_>, pieces: &[Range<usize>], height: f64) -> Scale {
    let unite = |a: Option<(f64, f64)>, b: Option<(f64, f64)>| match (a, b) {
        (Some(a), Some(b)) => Some((f64::min(a.0, b.0), f64::max(a.1, b.1))),
        (a, b) => a.or(b),
    };
    let before = bounds(&readings.before, pieces);
    let shown = bounds(&readings.measured, pieces);
    // Half the range above and below for the prediction with the effect, a quarter more for the other one.
    let limit = |inner: (f64, f64), outer: (f64, f64), part: f64| {
        let room = (inner.1 - inner.0).max(readings.noise.unwrap_or(0.0) * 4.0) * part;
        (outer.0.clamp(inner.0 - room, inner.0), outer.1.clamp(inner.1, inner.1 + room))
    };
    let shown = match (shown, bounds(&readings.after, pieces)) {
        (Some(inner), Some(outer)) => unite(Some(inner), Some(limit(inner, outer, 0.5))),
        (a, b) => a.or(b),
    };
    let shown = match (shown, before) {
        (Some(inner), Some(outer)) => Some(limit(inner, outer, 0.25)),
        (a, b) => a.or(b),
    };
    let (low, high) = shown.unwrap_or((0.0, 1.0));
    let noise = readings.noise.unwrap_or(0.0);
    let noise = if noise < (high - low).max(high.abs()) { noise } else { 0.0 };
    let none = if low == high && noise == 0.0 { low.abs().max(1.0) * 0.5 } else { noise };
    Scale::new(low - none, high + none, height / 36.0)
}

/// Symmetric about zero, wide enough for all but the rarest residuals and for the band of the noise.
fn residual_scale(units: bool, before: &[f64], after: &[f64], pieces: &[Range<usize>], height: f64) -> Scale {
    let mut sizes: Vec<f64> = pieces
        .iter()
        .flat_map(|piece| [before, after].into_iter().flat_map(|r| r.get(piece.clone()).unwrap_or(&[])))
        .filter(|r| r.is_finite())
        .map(|r| r.abs())
        .collect();
    sizes.sort_by(f64::total_cmp);
    let largest = sizes.last().copied().unwrap_or(0.0);
    let most = sizes.get(sizes.len() * 99 / 100).copied().unwrap_or(0.0);
    // A prediction that runs away says so at any scale; the others are to be read.
    let usual = sizes.get(sizes.len() * 3 / 4).copied().filter(|size| *size > 0.0).unwrap_or(largest);
    let reach = largest.min(1.5 * most).min(20.0 * usual).max(if units { 3.0 } else { 0.0 });
    let reach = if reach > 0.0 { reach } else { 1.0 };
    Scale::new(-reach, reach, height / 20.0)
}

/// Left and right end of a range of samples (px).
fn extent(stamp: &[f64], stretches: &[Stretch], range: &Range<usize>) -> Option<(f64, f64)> {
    let stretch = stretches.iter().find(|stretch| stretch.samples.contains(&range.start))?;
    Some((stretch.x(*stamp.get(range.start)?), stretch.x(*stamp.get(range.end - 1)?)))
}

/// One panel (px).
#[derive(Clone, Copy)]
struct Panel {
    left: f64,
    right: f64,
    top: f64,
    height: f64,
}

impl Panel {
    fn y(&self, scale: &Scale, value: f64) -> f64 {
        scale.y(value, self.top, self.height)
    }

    fn scale(&self, pen: &mut Pen, scale: &Scale, title: &str) {
        let columns = ((self.right - self.left) / 7.2) as usize;
        pen.text("strong", (self.left, self.top - 7.0), Anchor::Start, &format::clip(title, columns));
        for (tick, label) in &scale.ticks {
            let y = self.y(scale, *tick);
            pen.line("grid", (self.left, y), (self.right, y));
            pen.text("tick", (self.left - 6.0, y + 4.0), Anchor::End, &draw::typeset(label));
        }
    }

    /// Opens a drawing of its own that cuts off what leaves the panel.
    fn open(&self, pen: &mut Pen) {
        let (x, y, w, h) = (self.left, self.top, self.right - self.left, self.height);
        let [x, y, w, h] = [x, y, w, h].map(draw::px);
        pen.raw(&format!(
            "<svg x=\"{x}\" y=\"{y}\" width=\"{w}\" height=\"{h}\" viewBox=\"{x} {y} {w} {h}\" overflow=\"hidden\">"
        ));
    }

    #[allow(clippy::too_many_arguments, reason = "one curve needs the panel, its scales and its samples")]
    fn curve(
        &self,
        pen: &mut Pen,
        class: &str,
        scale: &Scale,
        readings: &Readings<'_>,
        pieces: &[Range<usize>],
        stretches: &[Stretch],
        series: &[f64],
    ) {
        let mut runs = Vec::new();
        for piece in pieces {
            let Some(stretch) = stretches.iter().find(|stretch| stretch.samples.contains(&piece.start))
            else {
                continue;
            };
            let points = piece.clone().filter_map(|i| Some((readings.stamp[i], *series.get(i)?)));
            runs.extend(thin(points.map(|(time, value)| (stretch.x(time), self.y(scale, value)))));
        }
        pen.runs(class, &runs);
    }
}

/// The time axis: ticks at the same step in each stretch, a mark where time is left out.
fn time_axis(pen: &mut Pen, stretches: &[Stretch], y: f64) {
    let total: f64 = stretches.iter().map(|stretch| stretch.time.1 - stretch.time.0).sum();
    let width: f64 = stretches.iter().map(|stretch| stretch.x.1 - stretch.x.0).sum();
    let step = axis::step(total / (width / 44.0).max(2.0));
    let places = |step| usize::try_from((-format::exponent(step)).clamp(0, 9)).unwrap_or(0);
    let decimals = places(step);
    let mut free = f64::NEG_INFINITY;
    let edge = stretches.last().map_or(0.0, |last| last.x.1 + MARGIN);
    for (i, stretch) in stretches.iter().enumerate() {
        pen.line("axis", (stretch.x.0, y), (stretch.x.1, y));
        if i > 0 {
            let x = (stretches[i - 1].x.1 + stretch.x.0) / 2.0;
            for shift in [-2.0, 2.0] {
                pen.line("axis", (x + shift - 2.0, y + 4.0), (x + shift + 2.0, y - 4.0));
            }
        }
        let slack = step * 1e-6;
        let mut ticks = axis::multiples(stretch.time.0 - slack, stretch.time.1 + slack, step);
        // A short stretch gets one tick of a finer step.
        let (mut finer, mut decimals) = (step, decimals);
        while ticks.is_empty() && finer > step * 1e-6 {
            finer = axis::step(finer / 3.0);
            ticks = axis::multiples(stretch.time.0, stretch.time.1, finer);
            ticks.truncate(1);
            decimals = places(finer);
        }
        for tick in ticks {
            let x = stretch.x(tick);
            pen.line("axis", (x, y), (x, y + 4.0));
            let text = draw::typeset(&format!("{:.decimals$}", tick + 0.0));
            let half = draw::width(&text, 11.0) / 2.0;
            if x - half > free {
                pen.text_within("tick", (x, y + 16.0), edge, &text);
                free = x + half + 4.0;
            }
        }
    }
    if let (Some(first), Some(last)) = (stretches.first(), stretches.last()) {
        let left_out = if stretches.len() > 1 { "time (s); // where time is left out" } else { "time (s)" };
        let room = last.x.1 - first.x.0;
        let text = if draw::width(left_out, 11.0) < room { left_out } else { "time (s)" };
        pen.text("tick", (last.x.1, y + 30.0), Anchor::End, text);
    }
}

/// What to show under the pointer: position, time, measured, before, its residual, after, its residual; points
/// separated by semicolons.
fn probe_points(readings: &Readings<'_>, stretches: &[Stretch], before: &[f64], after: &[f64]) -> String {
    let largest = readings.measured.iter().filter(|v| v.is_finite()).fold(0.0, |m: f64, v| m.max(v.abs()));
    let finest = readings.noise.unwrap_or(largest * 1e-4);
    let digits = (format::exponent(largest) - format::exponent(finest) + 2).clamp(3, 7);
    let text = |values: &[f64], i: usize, digits| {
        let value = values.get(i).copied().unwrap_or(f64::NAN);
        draw::typeset(&format::number(value, digits))
    };
    let mut points = Vec::new();
    for stretch in stretches {
        let mut last = f64::NEG_INFINITY;
        for i in stretch.samples.clone() {
            let x = stretch.x(readings.stamp[i]);
            if x - last < 2.0 {
                continue;
            }
            last = x;
            points.push(format!(
                "{},{},{},{},{},{},{}",
                draw::px(x),
                draw::typeset(&format::number(readings.stamp[i], 6)),
                text(&readings.measured, i, digits),
                text(&readings.before, i, digits),
                text(before, i, 2),
                text(&readings.after, i, digits),
                text(after, i, 2),
            ));
        }
    }
    draw::escape(&points.join(";"))
}
