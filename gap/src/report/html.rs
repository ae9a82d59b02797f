//! `report.html`: one self-contained page with plots.

use super::answer::{Answer, answers};
use super::draw::{Pen, escape, typeset};
use super::overlay;
use super::readings::Readings;
use super::{
    Confusable, FittedEffect, Overlay, Report, bars, closed_loop, explained, format, maps, recorded,
};
use crate::closed_loop::Controlled;
use crate::plot::page;

/// Answers less probable than this are listed by name only.
const WORTH_A_ROW: f64 = 0.0005;
/// At most so many answers have a row of their own.
const ROWS: usize = 8;

/// Writes the page: HTML that is well-formed XML too, with its styles, plots and script inside; it asks the network
/// for nothing. Light or dark as the reader's system is, and black on white in print.
///
/// ```
/// # use parallax_gap::report::{Overlay, Report, html};
/// # fn save(report: &Report, overlays: &[Overlay]) -> std::io::Result<()> {
/// std::fs::write("report.html", html::page(report, overlays))
/// # }
/// ```
#[must_use]
pub fn page(report: &Report, overlays: &[Overlay]) -> String {
    let answers = answers(report);
    let body = [
        verdict(report, &answers),
        overlays_section(report, overlays),
        format!("<div class=\"pair\">{}{}</div>", which(&answers), where_(report)),
        explained_section(report),
        how_far(report),
        closed_loop_section(report),
        recorded_section(report),
        maps_section(report),
        calibration(report),
        unexplained(report),
        confusable(&report.confusable),
        format!("<div class=\"pair even\">{}{}</div>", absorbed(report), not_testable(report)),
        footer(report),
    ];
    let title = format!("Diagnosis of {}", report.system);
    page::write(&title, &body.concat(), include_str!("page.js"))
}

/// A number of the page: escaped, with true minus signs and unbroken spaces.
fn set(number: &str) -> String {
    escape(&typeset(number))
}

fn section(title: &str, note: &str, content: &str) -> String {
    let note = if note.is_empty() { String::new() } else { format!("<p class=\"note\">{note}</p>\n") };
    format!("<section>\n<h2>{title}</h2>\n{note}{content}</section>\n")
}

/// `delay` in bold, its place beside it.
fn effect_html(name: &str, place: &str) -> String {
    format!("<b>{}</b><wbr/><span class=\"place\">@{}</span>", escape(name), escape(place))
}

fn answer_html(answer: &Answer<'_>) -> String {
    if answer.effects.is_empty() {
        return format!("<b>{}</b>", escape(answer.word));
    }
    let effects = answer.effects.iter().map(|effect| effect_html(&effect.name, &effect.place));
    effects.collect::<Vec<_>>().join(" + ")
}

fn verdict(report: &Report, answers: &[Answer<'_>]) -> String {
    let tile = |label: &str, value: &str, note: &str| {
        format!("<div><dt>{label}</dt><dd>{value}</dd><dd class=\"note\">{note}</dd></div>\n")
    };
    let gap = &report.gap;
    let detected = if gap.detected { "Detected" } else { "None" };
    let p = format!("{} by chance", set(&format::p_value(gap.p_value)));
    let cause = match answers.first() {
        Some(answer) => {
            (answer_html(answer), format!("{} probable", set(&format::probability(answer.probability))))
        }
        None => (format::UNKNOWN.to_owned(), "no answer was tried".to_owned()),
    };
    let long = if report.summary.chars().count() > 130 { " class=\"long\"" } else { "" };
    let (closed, ends) = format::interval(&report.how_far.closed_by_effect);
    let ends = match ends {
        Some(ends) => format!("95 % interval {}", set(&ends)),
        None if !gap.detected => "there is nothing to close".to_owned(),
        None => "of what calibration leaves".to_owned(),
    };
    let not_tried = report.interrupted.as_ref().map_or_else(String::new, |interrupted| {
        let names: Vec<String> = interrupted.not_tried.iter().map(|name| escape(name)).collect();
        format!(
            "<div class=\"interrupted\"><p><b>This diagnosis was interrupted.</b> Probabilities are among what was \
             tried.</p>\n{}</div>\n",
            page::listed("Not tried", &names, ", ")
        )
    });
    format!(
        "<header>\n<p class=\"kicker\">Parallax diagnosis of <b>{}</b></p>\n{not_tried}<h1{long}>{}</h1>\n<dl class=\"verdict\">\n{}{}{}{}\
         </dl>\n</header>\n",
        escape(&report.system),
        escape(&report.summary).replace(" %", "\u{a0}%"),
        tile("Gap", detected, &p),
        tile("Size", &set(&format::number(gap.score, 3)), "noise units, after calibration"),
        tile("Cause", &cause.0, &cause.1),
        tile("Closed by the effect", &set(&closed), &ends),
    )
}

fn overlays_section(report: &Report, overlays: &[Overlay]) -> String {
    let mut readings: Vec<Readings<'_>> = overlays.iter().map(Readings::new).collect();
    readings.retain(|readings| !readings.stamp.is_empty());
    readings.sort_by(|a, b| b.improvement().total_cmp(&a.improvement()));
    if readings.is_empty() {
        return section("Measured and predicted", "", "<p>No held-out readings were kept.</p>\n");
    }
    let horizon = set(&format::number(report.how_far.horizon_s, 3));
    let is_loss = |effect: &FittedEffect| effect.name == "drops" && effect.place.starts_with("input:");
    let losses = report.which.first().is_some_and(|answer| answer.effects.iter().any(is_loss));
    let told = if losses { " Which commands were lost is told by these readings, too." } else { "" };
    let rests = report.rests_s.map_or_else(String::new, |rests| format!(" {}.", set(&format::rests(rests))));
    let note = format!(
        "Held-out time, which no fit has seen.{told}{rests} Each prediction runs {horizon}\u{a0}s from a state estimated from \
         earlier samples only. Before: the nominal system with its parameters refitted. Residual: predicted minus \
         measured."
    );
    let figures: String =
        readings.iter().map(|readings| figure(readings, report.how_far.horizon_s)).collect();
    section("Measured and predicted", &note, &figures)
}

fn figure(readings: &Readings<'_>, horizon: f64) -> String {
    let mut caption = format!("<b>{}</b>", escape(readings.output));
    let in_units =
        |error: Option<f64>| set(&error.map_or(format::UNKNOWN.to_owned(), |e| format::number(e, 3)));
    let unit = if readings.noise.is_some() { String::from("noise units") } else { readings.unit.to_owned() };
    let unit = escape(&unit);
    if readings.after.is_empty() {
        caption.push_str(&format!(": RMS error {} {unit}.", in_units(readings.error(&readings.before))));
    } else {
        let (before, after) = (readings.error(&readings.before), readings.error(&readings.after));
        caption.push_str(&format!(": RMS error {} → {} {unit}.", in_units(before), in_units(after)));
    }
    if let Some(noise) = readings.noise {
        let noise = format!("{}{}", format::number(noise, 2), format::unit(readings.unit));
        caption.push_str(&format!(" One noise unit is {}; shaded: ±2 of them.", set(&noise)));
    }
    if readings.detail(4.0 * horizon).is_some() {
        caption.push_str(" The stretch marked in colour is drawn again, larger.");
    }
    format!(
        "<figure>\n{}{}<figcaption><p class=\"readout\"></p><p>{caption}</p></figcaption>\n</figure>\n",
        overlay::plot(readings, false, horizon),
        overlay::plot(readings, true, horizon),
    )
}

fn which(answers: &[Answer<'_>]) -> String {
    let shown = answers
        .iter()
        .enumerate()
        .take_while(|(i, answer)| *i == 0 || (*i < ROWS && answer.probability >= WORTH_A_ROW))
        .count();
    let mut rows = String::new();
    for (i, answer) in answers[..shown].iter().enumerate() {
        let class = if i == 0 { "bar-after" } else { "bar-plain" };
        let lead = if i == 0 { " class=\"lead\"" } else { "" };
        let mut parameters = String::new();
        for effect in answer.effects {
            for (key, value) in &effect.parameters {
                let value = set(&format::uncertain(value));
                parameters.push_str(&format!("<span>{} <b>{value}</b></span> ", escape(key)));
            }
        }
        let mut below = String::new();
        if !parameters.is_empty() {
            below.push_str(&format!("<p class=\"parameters\">{}</p>", parameters.trim_end()));
        }
        if !answer.alike.is_empty() {
            let alike: Vec<String> = answer.alike.iter().map(|name| escape(name)).collect();
            below.push_str(&format!("<p class=\"note\">alike in this data: {}</p>", alike.join(", ")));
        }
        rows.push_str(&format!(
            "<li{lead}><div class=\"row\"><span>{}</span><b class=\"number\">{}</b></div>{}{below}</li>\n",
            answer_html(answer),
            set(&format::probability(answer.probability)),
            bars::share(answer.probability, class, None),
        ));
    }
    let mut content = format!("<ol class=\"answers\">\n{rows}</ol>\n");
    if shown < answers.len() {
        let names: Vec<String> = answers[shown..].iter().map(|answer| escape(&answer.name())).collect();
        content.push_str(&page::listed("Also tried, less probable", &names, ", "));
    }
    section("Which cause", "Probabilities of classes that this data can tell apart.", &content)
}

fn where_(report: &Report) -> String {
    if report.where_.is_empty() {
        return section("Where", "", "<p>No place stands out.</p>\n");
    }
    let mut places: Vec<_> = report.where_.iter().collect();
    let order = |p: f64| if p.is_nan() { f64::NEG_INFINITY } else { p };
    places.sort_by(|a, b| order(b.probability).total_cmp(&order(a.probability)));
    let row = |place: &&super::Where| {
        format!(
            "<li><p class=\"place\">{}</p><div class=\"pairbar\"><span>probability</span>{}<b class=\"number\">{}</b>\
             <span>share</span>{}<b class=\"number\">{}</b></div></li>\n",
            escape(&place.place),
            bars::share(place.probability, "bar-after", None),
            set(&format::probability(place.probability)),
            bars::share(place.share, "bar-plain", None),
            set(&format::share(place.share)),
        )
    };
    let mut content =
        format!("<ol class=\"answers\">\n{}</ol>\n", places.iter().take(ROWS).map(row).collect::<String>());
    if places.len() > ROWS {
        let rest: Vec<String> = places[ROWS..].iter().map(|place| escape(&place.place)).collect();
        content.push_str(&page::listed("Also considered", &rest, ", "));
    }
    section("Where", "Share: how much of the gap the best effect there explains.", &content)
}

/// What a task costs in closed loop, where one was given.
fn closed_loop_section(report: &Report) -> String {
    let Some(scores) = &report.closed_loop else { return String::new() };
    let unit = if scores.unit.is_empty() { String::new() } else { format!(", {}", set(&scores.unit)) };
    let row = |(name, score, remark): &(&str, String, String)| {
        format!(
            "<tr><th scope=\"row\">{}</th><td class=\"number\">{}</td><td class=\"mark\">{}</td></tr>\n",
            escape(name),
            set(score),
            set(remark)
        )
    };
    let rows: String = closed_loop::rows(scores).iter().map(row).collect();
    let table = format!(
        "<div class=\"scroll\"><table>\n<thead><tr><th scope=\"col\">system</th><th scope=\"col\">score (95 % \
         interval){unit}</th><th scope=\"col\" class=\"mark\">less the recorded</th></tr></thead>\n<tbody>{rows}</tbody></table></div>\n"
    );
    let readings = scores.episode.iter().map(Readings::new).filter(|readings| !readings.stamp.is_empty());
    let figures: String = readings
        .map(|readings| {
            format!(
                "<figure>\n{}{}<figcaption><p class=\"readout\"></p><p><b>{}</b> in the first episode: measured, and \
                 simulated once in closed loop without the effect (before) and with it (after).</p></figcaption>\n</figure>\n",
                overlay::plot(&readings, false, scores.horizon_s),
                overlay::plot(&readings, true, scores.horizon_s),
                escape(readings.output)
            )
        })
        .collect();
    let by = match scores.controller {
        Controlled::Policy => "The controller of the task file",
        Controlled::Graph => "The recorded graph",
    };
    let note = format!(
        "{}: {}. {by} runs around each system, from the recorded initial states; intervals are over initial states, noise \
         and delays.",
        escape(&scores.task),
        escape(&closed_loop::made(scores))
    );
    let content = format!("<p>{}</p>\n{table}{figures}", escape(&closed_loop::sentence(scores)));
    section("In closed loop", &note, &content)
}

fn explained_section(report: &Report) -> String {
    let note = "Log evidence above zero speaks for the effect, below zero for the other. Error ahead: root mean square over the \
                horizon. Worse: where the difference in fit lies, by time, command or state.";
    explained::content(report)
        .map_or_else(String::new, |content| section("What you asked about", note, &content))
}

fn recorded_section(report: &Report) -> String {
    let lines = recorded::lines(report);
    if lines.is_empty() {
        return String::new();
    }
    let (mut items, mut above) = (String::new(), "");
    for (label, text) in &lines {
        let heading = if *label == above { String::new() } else { format!("<dt>{label}</dt>") };
        items.push_str(&format!("{heading}<dd>{}</dd>\n", escape(text)));
        above = label;
    }
    let note = "Timing from the stamps, and every node replayed alone on what it received: before any fit.";
    section("What the recording proves", note, &format!("<dl class=\"list\">\n{items}</dl>\n"))
}

fn maps_section(report: &Report) -> String {
    let note = "What the refitted nominal model gets wrong from one reading to the next, sorted by what may rule it. Bars: \
                the mean innovation of each tenth of the readings, in standard deviations of the prediction, with two \
                standard errors; by frequency: the energy of each band over that of white noise.";
    maps::content(report)
        .map_or_else(String::new, |content| section("Where inside the plant", note, &content))
}

fn how_far(report: &Report) -> String {
    let how_far = &report.how_far;
    let draw = |class: &str, width: f64| {
        let mut pen = Pen::default();
        bars::how_far(&mut pen, how_far, (0.0, 4.0), width);
        pen.finish(class, width, bars::HOW_FAR_HEIGHT + 4.0, "Errors of prediction; the table holds the same")
    };
    let row = |(name, value, _): &(&str, f64, &str)| {
        let value = set(&format::number(*value, 3));
        format!("<tr><th scope=\"row\">{}</th><td class=\"number\">{value}</td></tr>", escape(name))
    };
    let table: String = bars::rows(how_far).iter().map(row).collect();
    let closed = |name: &str, note: &str, interval: &super::Interval| {
        let (value, ends) = format::interval(interval);
        let ends = ends.map_or(String::new(), |ends| format!(" <span>95 % interval {}</span>", set(&ends)));
        format!(
            "<div><dt>{name}</dt><dd><b>{}</b>{ends}{}</dd><dd class=\"note\">{note}</dd></div>\n",
            set(&value),
            bars::share(interval.value, "bar-after", Some((interval.low, interval.high))),
        )
    };
    let content = format!(
        "<div class=\"pair\"><figure class=\"errors\">{}{}<table class=\"unseen\"><caption>Root mean square errors of prediction in \
         noise units</caption>{table}</table></figure>\n<dl class=\"closed\">\n{}{}</dl></div>\n{}",
        draw("plot wide", 620.0),
        draw("plot narrow", 360.0),
        closed(
            "Closed in all",
            "of the mean square error of the nominal system above the noise floor",
            &how_far.closed_total
        ),
        closed("Closed by the effect", "of what calibration alone leaves", &how_far.closed_by_effect),
        split(how_far) + &report.corrected_system.as_ref().map_or(String::new(), |path| format!(
            "<p>The corrected system, with the effect added and the calibrated values set: <code>{}</code></p>\n",
            escape(path)
        )),
    );
    let horizon = set(&format::number(how_far.horizon_s, 3));
    let note = format!(
        "Held-out time, predicted {horizon}\u{a0}s ahead. Bars start at the noise floor. The black box is a flexible \
         residual on top of the effect: what it gains is still unexplained."
    );
    section("How far it goes", &note, &content)
}

/// What each of several effects closes.
fn split(how_far: &super::HowFar) -> String {
    if how_far.split.is_empty() {
        return String::new();
    }
    let row = |part: &super::Split| {
        format!(
            "<span><code>{}</code></span>{}<b class=\"number\">{}</b>\n",
            escape(&part.effect),
            bars::share(part.share, "bar-after", None),
            set(&format::share(part.share)),
        )
    };
    let rows: String = how_far.split.iter().map(row).collect();
    format!(
        "<p class=\"note\">What each effect closes of it, averaged over the orders in which they may be added:</p>\n\
         <div class=\"pairbar long\">{rows}</div>\n"
    )
}

fn calibration(report: &Report) -> String {
    if report.calibration.is_empty() {
        return section("Calibration", "", "<p>The system declares no parameter to calibrate.</p>\n");
    }
    let row = |row: &super::Calibration| {
        let change = (row.value - row.nominal) / row.nominal;
        let moved = (row.value - row.nominal) / row.std;
        let percent = if change.is_finite() { set(&signed(&format::share(change))) } else { "–".into() };
        let moved = if moved.is_finite() {
            format!("{} σ", signed(&format::number(moved, 2)))
        } else {
            "–".into()
        };
        let (class, mark) = match (row.significant, row.at_bound) {
            (true, true) => (" class=\"moved\"", "● moved to its bound"),
            (true, false) => (" class=\"moved\"", "● moved"),
            (false, true) => ("", "at its bound"),
            (false, false) => ("", ""),
        };
        format!(
            "<tr{class}><th scope=\"row\">{}</th><td>{}</td><td>{}</td><td class=\"unit\">{}</td><td>{percent}</td>\
             <td>{}</td><td class=\"mark\">{mark}</td></tr>\n",
            escape(&row.name),
            set(&format::number(row.nominal, 6)),
            set(&format::plus_minus(row.value, row.std)),
            escape(row.unit.trim()),
            set(&moved),
        )
    };
    let rows: String = report.calibration.iter().map(row).collect();
    let table = format!(
        "<div class=\"scroll\"><table class=\"calibrated\">\n<thead><tr><th scope=\"col\">parameter</th><th scope=\"col\">nominal</th>\
         <th scope=\"col\">fitted ± std</th><th scope=\"col\" class=\"unit\">unit</th><th scope=\"col\">change</th>\
         <th scope=\"col\">in std</th><th scope=\"col\"></th></tr></thead>\n<tbody>\n{rows}</tbody>\n</table></div>\n"
    );
    let note = "Parameters that the system allows to be refitted, under the leading answer. Moved: by more than two \
                standard deviations. What ends at a bound of its <code>calibrate</code> would go further if it might.";
    section("Calibration", note, &table)
}

fn signed(number: &str) -> String {
    if number.starts_with(['-', '–']) || number.starts_with("0 ") {
        number.to_owned()
    } else {
        format!("+{number}")
    }
}

fn unexplained(report: &Report) -> String {
    if !report.tried_the_unknown() {
        return section("Unexplained", "", "<p>Not tried: the diagnosis was interrupted.</p>\n");
    }
    let unexplained = &report.unexplained;
    let probability = set(&format::probability(unexplained.probability));
    let share = set(&format::share(unexplained.share));
    let hint = unexplained.hint.as_ref().map(|hint| format!("<p>{}</p>\n", escape(hint))).unwrap_or_default();
    let innovations = unexplained.innovations.as_ref().map(|innovations| {
        format!("<p>What the best answer leaves {}.</p>\n", escape(&format::innovations(innovations)))
    });
    let innovations = innovations.unwrap_or_default();
    let content = format!(
        "{hint}<div class=\"pairbar long\"><span>no named effect is the cause</span>{}<b class=\"number\">{probability}</b>\
         <span>share of the gap left to a flexible residual</span>{}<b class=\"number\">{share}</b></div>\n{innovations}",
        bars::share(unexplained.probability, "bar-plain", None),
        bars::share(unexplained.share, "bar-plain", None),
    );
    section("Unexplained", "", &content)
}

fn confusable(list: &[Confusable]) -> String {
    if list.is_empty() {
        return section("What would settle it", "", "<p>No likely answers look alike in this data.</p>\n");
    }
    let item = |confusable: &Confusable| {
        let effects: Vec<String> =
            confusable.effects.iter().map(|effect| format!("<code>{}</code>", escape(effect))).collect();
        format!("<dt>{}</dt><dd>{}</dd>\n", effects.join(" or "), escape(&confusable.separate_by))
    };
    let items: String = list.iter().map(item).collect();
    let note = "This data cannot tell these apart; beside them, what would.";
    section("What would settle it", note, &format!("<dl class=\"list\">\n{items}</dl>\n"))
}

fn absorbed(report: &Report) -> String {
    let item = |absorbed: &super::Absorbed| {
        format!(
            "<dt><code>{}</code></dt><dd>is covered by the calibrated <code>{}</code></dd>\n",
            escape(&absorbed.effect),
            escape(&absorbed.by)
        )
    };
    let items: String = report.absorbed.iter().map(item).collect();
    let note = "Effects that calibration already covers; they are no alternatives.";
    list("Absorbed", note, &items)
}

fn not_testable(report: &Report) -> String {
    let item = |untested: &super::NotTestable| {
        format!("<dt><code>{}</code></dt><dd>{}</dd>\n", escape(&untested.effect), escape(&untested.reason))
    };
    let items: String = report.not_testable.iter().map(item).collect();
    list("Not testable here", "Effects that this system or this log cannot show.", &items)
}

fn list(title: &str, note: &str, items: &str) -> String {
    if items.is_empty() {
        return section(title, "", "<p>None.</p>\n");
    }
    section(title, note, &format!("<dl class=\"list\">\n{items}</dl>\n"))
}

fn footer(report: &Report) -> String {
    let recordings: Vec<String> = report.recordings.iter().map(|title| escape(title)).collect();
    let recordings = if recordings.is_empty() { format::UNKNOWN.to_owned() } else { recordings.join("; ") };
    format!(
        "<footer>\n<p>System: <b>{}</b>. Recordings: {recordings}.</p>\n<p>Written by Parallax {}; the same numbers \
         are in report.json.</p>\n</footer>\n",
        escape(&report.system),
        env!("CARGO_PKG_VERSION"),
    )
}
