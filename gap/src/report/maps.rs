//! Maps of the innovations, as small plots: mean by part with its standard error, or energy by band.

use super::Report;
use super::draw::{self, Anchor, Pen, escape};
use super::format;
use crate::maps::{Bin, Map};
use crate::plot::axis::Scale;
use crate::plot::page;

/// At most so many are drawn.
const SHOWN: usize = 6;
/// Maps with a larger p-value are listed by name only.
const STRUCTURED: f64 = 0.01;
const WIDTH: f64 = 300.0;
const HEIGHT: f64 = 132.0;
const LEFT: f64 = 36.0;
const TOP: f64 = 8.0;
const BOTTOM: f64 = 26.0;

/// The maps that show structure, and the names of those that do not; `None` where none was made.
pub(super) fn content(report: &Report) -> Option<String> {
    if report.maps.is_empty() {
        return None;
    }
    let structured: Vec<&Map> = report.maps.iter().filter(|map| map.p_value <= STRUCTURED).collect();
    let figures: String = structured.iter().take(SHOWN).map(|map| figure(map)).collect();
    let mut content = String::new();
    if figures.is_empty() {
        content.push_str("<p>No map shows more structure than chance.</p>\n");
    } else {
        content.push_str(&format!("<div class=\"maps\">\n{figures}</div>\n"));
    }
    let list = |lead: &str, maps: &mut dyn Iterator<Item = &Map>| {
        let names: Vec<String> = maps.map(|map| escape(&title(map))).collect();
        if names.is_empty() { String::new() } else { page::listed(lead, &names, "; ") }
    };
    content.push_str(&list("Structure, too", &mut structured.iter().skip(SHOWN).copied()));
    content.push_str(&list(
        "No structure beyond chance",
        &mut report.maps.iter().filter(|map| map.p_value > STRUCTURED),
    ));
    Some(content)
}

fn title(map: &Map) -> String {
    format!("{} by {}", map.output, map.by)
}

fn figure(map: &Map) -> String {
    let share = draw::typeset(&format::share(map.share));
    let says =
        if map.by == "frequency" { "of the energy is out of place" } else { "of the energy is systematic" };
    format!(
        "<figure>{}<figcaption><p><b>{}</b> by {}: {} {says}, {}.</p></figcaption></figure>\n",
        plot(map),
        escape(&map.output),
        escape(&map.by),
        escape(&share),
        escape(&draw::typeset(&format::p_value(map.p_value))),
    )
}

fn plot(map: &Map) -> String {
    let frequency = map.by == "frequency";
    let mut pen = Pen::default();
    let value = |bin: &Bin| if frequency { bin.energy } else { bin.mean };
    // Of a mean, two standard errors; of a band's energy, those of as many lines.
    let error = |bin: &Bin| {
        let count = (bin.count as f64).max(1.0);
        if frequency {
            2.0 * bin.energy / count.sqrt()
        } else {
            2.0 * bin.energy.max(0.0).sqrt() / count.sqrt()
        }
    };
    let rest = if frequency { 1.0 } else { 0.0 };
    let known: Vec<f64> = map
        .bins
        .iter()
        .flat_map(|bin| [value(bin) - error(bin), value(bin) + error(bin)])
        .filter(|v| v.is_finite() && v.abs() < 1e280)
        .collect();
    let low = known.iter().copied().fold(rest, f64::min);
    let high = known.iter().copied().fold(rest, f64::max);
    let scale = Scale::new(low, if high > low { high } else { low + 1.0 }, 4.0);
    let height = HEIGHT - TOP - BOTTOM;
    let y = |v: f64| scale.y(v, TOP, height);
    for (tick, label) in &scale.ticks {
        pen.line("grid", (LEFT, y(*tick)), (WIDTH, y(*tick)));
        pen.text("tick", (LEFT - 5.0, y(*tick) + 3.5), Anchor::End, &draw::typeset(label));
    }
    let step = (WIDTH - LEFT) / map.bins.len().max(1) as f64;
    for (i, bin) in map.bins.iter().enumerate() {
        let (v, e) = (value(bin), error(bin));
        if !v.is_finite() || v.abs() > 1e280 {
            continue;
        }
        let left = LEFT + step * i as f64;
        let (from, to) = (y(v).min(y(rest)), y(v).max(y(rest)));
        pen.rect("bar-before", (left + 2.0, from), (step - 4.0, to - from));
        if e.is_finite() && e < 1e280 {
            let x = left + 0.5 * step;
            pen.line("whisker", (x, y(v - e)), (x, y(v + e)));
        }
    }
    pen.line("axis", (LEFT, y(rest)), (WIDTH, y(rest)));
    let end = |pen: &mut Pen, x: f64, anchor: Anchor, v: f64| {
        pen.text("tick", (x, HEIGHT - 10.0), anchor, &draw::typeset(&format::number(v, 3)));
    };
    if let (Some(first), Some(last)) = (map.bins.first(), map.bins.last()) {
        end(&mut pen, LEFT, Anchor::Start, first.low);
        end(&mut pen, WIDTH, Anchor::End, last.high);
        let unit = if map.unit.is_empty() { map.by.clone() } else { format!("{} ({})", map.by, map.unit) };
        pen.text("tick", (0.5 * (LEFT + WIDTH), HEIGHT - 10.0), Anchor::Middle, &format::clip(&unit, 32));
    }
    pen.finish("plot", WIDTH, HEIGHT, &format!("Innovations of {}", title(map)))
}
