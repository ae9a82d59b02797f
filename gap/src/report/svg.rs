//! A diagnosis as one picture: the overlay of the output that improved most, the answers, how far they go.

use super::answer::{Answer, answers};
use super::bars;
use super::draw::{self, Anchor, Pen};
use super::format;
use super::overlay::{self, Frame};
use super::readings::Readings;
use super::{Overlay, Report};

const WIDTH: f64 = 1000.0;
const HEIGHT: f64 = 520.0;
/// Left edge of the column with the answers.
const RIGHT: f64 = 676.0;

/// Draws the figure: a standalone SVG of 1000 × 520 px on white, for pages that cannot hold the report itself.
///
/// ```
/// # use parallax_gap::report::{Report, svg};
/// # fn show(report: &Report) {
/// let picture = svg::figure(report, &[]);
/// assert!(picture.starts_with("<svg"));
/// # }
/// ```
#[must_use]
pub fn figure(report: &Report, overlays: &[Overlay]) -> String {
    let mut pen = Pen::default();
    pen.raw(&format!("<style>{}</style>", draw::style_on_paper()));
    pen.rect("paper", (0.0, 0.0), (WIDTH, HEIGHT));
    let mut y = 34.0;
    // Narrow enough for the widest of the usual fonts.
    let lines = format::wrap(&report.summary, 102);
    for (i, line) in lines.iter().take(4).enumerate() {
        let more = if i == 3 && lines.len() > 4 { " …" } else { "" };
        pen.text("title", (24.0, y), Anchor::Start, &format!("{line}{more}"));
        y += 21.0;
    }
    pen.text("soft", (24.0, y), Anchor::Start, &format::clip(&source(report), 130));
    let top = y + 40.0;

    let readings: Vec<Readings<'_>> = overlays.iter().map(Readings::new).collect();
    // The first wins where nothing improves, so that the picture does not depend on rounding.
    let mut chosen = readings.first();
    for candidate in &readings {
        if chosen.is_some_and(|best| candidate.improvement() > best.improvement()) {
            chosen = Some(candidate);
        }
    }
    match chosen.filter(|readings| !readings.stamp.is_empty()) {
        Some(readings) => {
            overlay::legend(&mut pen, readings, 24.0, top, false);
            let detail = readings.detail(4.0 * report.how_far.horizon_s);
            let width = if detail.is_some() { 344.0 } else { 620.0 };
            // The panels take what the title leaves.
            let frame = Frame { x: 24.0, y: top + 16.0, width, values: 320.0 - top, residuals: 92.0 };
            overlay::column(&mut pen, readings, &readings.pieces, detail.as_ref(), frame, false);
            if let Some(detail) = detail {
                let frame = Frame { x: 384.0, width: 264.0, ..frame };
                overlay::column(&mut pen, readings, &[detail], None, frame, false);
            }
        }
        None => pen.text("soft", (24.0, top), Anchor::Start, "No held-out readings were kept."),
    }
    let corner = (RIGHT, HEIGHT - bars::HOW_FAR_HEIGHT - 16.0);
    draw_answers(&mut pen, &answers(report), top, corner.1 - 34.0);
    let horizon = format::number(report.how_far.horizon_s, 3);
    let head = format!("How far, {horizon} s ahead on held-out time");
    pen.text("head", (RIGHT, corner.1 - 12.0), Anchor::Start, &head);
    bars::how_far(&mut pen, &report.how_far, corner, WIDTH - RIGHT - 24.0);
    pen.finish("figure", WIDTH, HEIGHT, &report.summary)
}

fn source(report: &Report) -> String {
    match report.recordings.as_slice() {
        [] => report.system.clone(),
        [one] if *one == report.system => report.system.clone(),
        [one] => format!("{}; {one}", report.system),
        [first, rest @ ..] => format!("{}; {first} and {} more", report.system, rest.len()),
    }
}

/// Lines of the first answer's parameters for each of its effects, where there is room for them, and their height.
const LINES: usize = 3;
const LINE: f64 = 15.0;

/// Draws the answers from `top` on, as many as end above `bottom`; the first with all of its effects, its parameters, and what it
/// cannot be told apart from.
fn draw_answers(pen: &mut Pen, answers: &[Answer<'_>], top: f64, bottom: f64) {
    pen.text("head", (RIGHT, top), Anchor::Start, "Which cause");
    let (left, right) = (RIGHT, WIDTH - 24.0);
    let mut y = top + 23.0;
    for (i, answer) in answers.iter().enumerate() {
        if i > 0 && y + 11.0 > bottom {
            break;
        }
        let (weight, class) = if i == 0 { ("strong", "bar-after") } else { ("plain", "bar-plain") };
        let lines =
            if i == 0 { first_lines(answer.names()) } else { vec![format::clip(&answer.name(), COLUMNS)] };
        for (line, text) in lines.iter().enumerate() {
            y += if line > 0 { LINE } else { 0.0 };
            pen.text(weight, (left, y), Anchor::Start, text);
        }
        pen.text("strong", (right, y), Anchor::End, &draw::typeset(&format::probability(answer.probability)));
        pen.rect("bar-track", (left, y + 5.0), (right - left, 6.0));
        let part = if answer.probability.is_finite() { answer.probability.clamp(0.0, 1.0) } else { 0.0 };
        pen.rect(class, (left, y + 5.0), ((right - left) * part, 6.0));
        y += 29.0;
        if i == 0 {
            let mut notes = packed(&answer.parameters(), 46);
            let room = ((bottom - y) / LINE).max(LINES as f64) as usize;
            notes.truncate((LINES * answer.names().len()).min(room));
            if !answer.alike.is_empty() {
                notes.push(format!("or {}: alike in this data", answer.alike.join(", ")));
            }
            for note in &notes {
                pen.text("small", (left, y - 4.0), Anchor::Start, &format::clip(note, 46));
                y += LINE;
            }
            y += if notes.is_empty() { 0.0 } else { 3.0 };
        }
    }
}

/// Characters that fit beside a probability, and of the first answer's wider ones.
const COLUMNS: usize = 36;
const STRONG_COLUMNS: usize = 30;

/// The first answer's effects, each on one line, or where that is too long on two, the second from its place on.
fn first_lines(names: Vec<String>) -> Vec<String> {
    let mut names = shortened(names);
    let last = names.len().saturating_sub(1);
    names[..last].iter_mut().for_each(|name| name.push_str(" +"));
    let lines = names.into_iter().flat_map(|name| match name.find('@') {
        Some(at) if name.chars().count() > STRONG_COLUMNS => {
            vec![name[..at].to_owned(), name[at..].to_owned()]
        }
        _ => vec![name],
    });
    lines.map(|line| format::clip(&line, STRONG_COLUMNS)).collect()
}

/// Effects of the first answer that there is room for, and how many there are beyond.
const NAMES: usize = 4;

fn shortened(mut names: Vec<String>) -> Vec<String> {
    if names.len() > NAMES {
        let beyond = names.len() - (NAMES - 1);
        names.truncate(NAMES - 1);
        names.push(format!("{beyond} more"));
    }
    names
}

/// Parameters one after another, each whole on its line.
fn packed(parameters: &[String], columns: usize) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for parameter in parameters {
        match lines.last_mut() {
            Some(line) if line.chars().count() + parameter.chars().count() + 2 <= columns => {
                line.push_str(", ");
                line.push_str(parameter);
            }
            _ => lines.push(parameter.clone()),
        }
    }
    lines.iter().map(|line| draw::typeset(line)).collect()
}
