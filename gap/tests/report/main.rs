//! What a reader gets: the page, the picture and the terminal's answer, from made-up diagnoses.

mod cases;

use parallax_gap::report::{Overlay, Report, html, sentence, svg, text};
use proptest::prelude::*;
use roxmltree::{Document, Node, ParsingOptions};

fn parse(text: &str) -> Document<'_> {
    let options = ParsingOptions { allow_dtd: true, ..ParsingOptions::default() };
    Document::parse_with_options(text, options).expect("well-formed XML")
}

fn all_text(document: &Document<'_>) -> String {
    let body = document.descendants().filter(|node| node.is_text() && !inside(*node, &["script", "style"]));
    body.filter_map(|node| node.text()).collect::<String>().replace('\u{a0}', " ")
}

fn inside(node: Node<'_, '_>, names: &[&str]) -> bool {
    node.ancestors().any(|ancestor| names.contains(&ancestor.tag_name().name()))
}

fn classed<'a, 'i>(document: &'a Document<'i>, class: &'a str) -> impl Iterator<Item = Node<'a, 'i>> {
    document
        .descendants()
        .filter(move |node| node.attribute("class").is_some_and(|list| list.split(' ').any(|c| c == class)))
}

/// Every coordinate is a number, and within reach of the drawing.
fn check_geometry(document: &Document<'_>) {
    let numbers = ["x", "y", "x1", "x2", "y1", "y2", "cx", "cy", "r", "width", "height", "viewBox", "d"];
    for node in document.descendants() {
        for attribute in node.attributes().filter(|attribute| numbers.contains(&attribute.name())) {
            let parts = attribute.value().split([' ', 'M', 'h', ',']).filter(|part| !part.is_empty());
            for part in parts {
                let number: f64 = part.trim_end_matches('%').parse().expect("a number");
                assert!(number.abs() < 5000.0, "{}=\"{}\"", attribute.name(), attribute.value());
            }
        }
    }
}

fn check_page(report: &Report, overlays: &[Overlay]) {
    for text in [html::page(report, overlays), svg::figure(report, overlays)] {
        let document = parse(&text);
        check_geometry(&document);
        let shown = all_text(&document);
        assert!(!shown.contains("NaN") && !shown.contains("inf"), "{shown}");
        assert!(!text.replace("http://www.w3.org/2000/svg", "").contains("http"), "something is fetched");
    }
    for line in text::summary(report).lines() {
        assert!(line.chars().count() <= 100, "too wide: {line}");
        assert!(!line.contains("NaN"), "{line}");
    }
}

fn same_before_and_after() -> Overlay {
    let overlay = cases::overlay();
    Overlay { before: overlay.after.clone(), ..overlay }
}

#[test]
fn every_kind_of_diagnosis_gives_a_well_formed_page() {
    let overlays = [cases::overlay(), cases::broken_overlay(), Overlay::default(), same_before_and_after()];
    let none = [];
    for report in [
        cases::one_effect(),
        cases::no_gap(),
        cases::none_of_these(),
        cases::empty(),
        cases::extreme(),
        cases::asked(),
        cases::interrupted(),
    ] {
        check_page(&report, &overlays);
        check_page(&report, &none);
        for overlay in &overlays {
            check_page(&report, std::slice::from_ref(overlay));
        }
    }
}

#[test]
fn the_page_names_everything_that_the_report_names() {
    let report = cases::one_effect();
    let page = html::page(&report, &[cases::overlay()]);
    let shown = all_text(&parse(&page));
    let mut names = vec![report.summary.clone(), report.system.clone()];
    names.extend(report.recordings.iter().cloned());
    names.extend(report.calibration.iter().map(|row| row.name.clone()));
    names.extend(report.where_.iter().map(|row| row.place.clone()));
    for which in &report.which {
        names.extend(which.effects.iter().map(|effect| format!("{}@{}", effect.name, effect.place)));
        names.extend(which.class.iter().filter(|name| !name.contains(" + ")).cloned());
    }
    names.extend(report.absorbed.iter().flat_map(|row| [row.effect.clone(), row.by.clone()]));
    names.extend(report.not_testable.iter().flat_map(|row| [row.effect.clone(), row.reason.clone()]));
    names.extend(report.confusable.iter().flat_map(|row| row.effects.clone()));
    names.extend(report.confusable.iter().map(|row| row.separate_by.clone()));
    names.extend(report.corrected_system.clone());
    for name in names {
        assert!(shown.contains(&name), "the page does not name {name}");
    }
    for number in
        ["0.0412 ± 0.0011 s", "97 %", "99.6 %", "99.2 to 99.8 %", "p = 10⁻¹²", "0.334 ± 0.004", "+3.5 σ"]
    {
        assert!(shown.contains(number), "the page does not give {number}");
    }
}

#[test]
fn the_page_answers_what_was_asked() {
    let page = html::page(&cases::asked(), &[]);
    let shown = all_text(&parse(&page));
    for part in [
        "delay@input:goal is the answer.",
        "delay@output:angle belongs to the answer's class: this data cannot tell it from delay@input:goal.",
        "lag@input:goal loses to delay@input:goal.",
        "−57.4 against delay@input:goal, +418 against no effect at all",
        "time_constant 0.037 ± 0.002 s",
        "1.53 noise units, 1.08 with delay@input:goal",
        "goal 0.35 to 0.7: 62 % of the difference, on 12 % of the readings",
        "viscous@joint:shaft is not fitted: the calibrated parameter b does the same here.",
        "cogging@joint:shaft is not testable: the log covers 0.2 turns.",
    ] {
        assert!(shown.contains(part), "the page does not say `{part}`: {shown}");
    }
    assert!(!html::page(&cases::one_effect(), &[]).contains("What you asked about"), "nothing was asked");
}

#[test]
fn a_task_has_its_table_and_its_first_episode() {
    let mut report = cases::in_closed_loop();
    check_page(&report, &[cases::overlay()]);
    let page = html::page(&report, &[]);
    let shown = all_text(&parse(&page));
    for part in [
        "follow the course",
        "the effect matters for this task",
        "0.0395 (0.0285 to 0.0495)",
        "10 episodes of 2 s",
        "in the first episode",
    ] {
        assert!(shown.contains(part), "no `{part}` in: {shown}");
    }
    // Without a task there is no such section.
    assert!(!all_text(&parse(&html::page(&cases::one_effect(), &[]))).contains("closed loop"));

    // A loop that is unstable without the effect has no score, and says so.
    let scores = report.closed_loop.as_mut().expect("scores");
    (scores.refitted.score, scores.refitted.difference) = (None, None);
    scores.refitted.lost = scores.refitted.of;
    (scores.closed, scores.miss) = (None, Some(0.4));
    check_page(&report, &[]);
    let answer = text::summary(&report).split_whitespace().collect::<Vec<_>>().join(" ");
    for part in [
        "unstable: all 200 runs left all bounds",
        "nothing: every run is unstable without the effect",
        "it may not be the one that ran",
    ] {
        assert!(answer.contains(part), "no `{part}` in: {answer}");
    }
}

#[test]
fn an_interrupted_diagnosis_says_so_first_and_what_was_not_tried() {
    let report = cases::interrupted();
    let page = all_text(&parse(&html::page(&report, &[])));
    let text = text::summary(&report);
    assert!(text.starts_with("Interrupted before everything was tried. So far: "), "{text}");
    for shown in [page, text] {
        assert!(shown.contains("an unknown cause, backlash@input:goal, cogging@joint:shaft"), "{shown}");
        assert!(shown.contains("mong what was tried"), "{shown}");
        // What was not tried has no probability.
        assert!(!shown.contains("no named effect is the cause"), "{shown}");
    }
}

#[test]
fn of_hundreds_of_names_a_few_are_shown() {
    let mut report = cases::interrupted();
    let names: Vec<String> = (0..200).map(|number| format!("bias@output:sensor_{number}")).collect();
    report.interrupted.as_mut().unwrap().not_tried = names;
    let page = html::page(&report, &[]);
    let text = all_text(&parse(&page));
    assert!(text.contains("bias@output:sensor_11, and 188 more."), "{text}");
    let (before, hidden) = page.split_once("<details").unwrap();
    assert!(!before.contains("sensor_12") && hidden.contains("sensor_199"));
}

#[test]
fn names_cannot_become_markup() {
    let mut report = cases::one_effect();
    let wild = "<script>alert(\"1\")</script> & 'x'";
    report.summary = wild.to_owned();
    report.system = wild.to_owned();
    report.recordings = vec![wild.to_owned()];
    report.calibration[0].name = wild.to_owned();
    report.calibration[0].unit = wild.to_owned();
    report.where_[0].place = wild.to_owned();
    report.which[0].effects[0] = cases::effect(wild, wild, &[(wild, 1.0, 0.1, wild)]);
    report.which[0].class = vec![wild.to_owned()];
    report.which[4].effects[0].name = wild.to_owned();
    report.absorbed[0].effect = wild.to_owned();
    report.not_testable[0].reason = wild.to_owned();
    report.confusable[0].separate_by = wild.to_owned();
    report.corrected_system = Some(wild.to_owned());
    let overlay = Overlay { output: wild.to_owned(), unit: wild.to_owned(), ..cases::overlay() };
    check_page(&report, std::slice::from_ref(&overlay));
    let page = html::page(&report, std::slice::from_ref(&overlay));
    let document = parse(&page);
    let scripts = document.descendants().filter(|node| node.has_tag_name("script")).count();
    assert_eq!(scripts, 1, "only the page's own script may run");
    assert!(all_text(&document).matches(wild).count() > 10);
    assert!(!svg::figure(&report, &[overlay]).contains("<script"));
}

#[test]
fn the_leading_answer_leads() {
    let lead = |report: &Report| {
        let page = html::page(report, &[]);
        let document = parse(&page);
        let lead = classed(&document, "lead").next().expect("a first answer");
        lead.descendants().filter_map(|node| node.text()).next().map(str::to_owned)
    };
    assert_eq!(lead(&cases::one_effect()).as_deref(), Some("delay"));
    assert_eq!(lead(&cases::no_gap()).as_deref(), Some("no gap"));
    assert_eq!(lead(&cases::none_of_these()).as_deref(), Some("none of these"));
    assert_eq!(
        lead(&cases::extreme()).as_deref(),
        Some("delay"),
        "an unknown probability is no reason to lead"
    );
}

#[test]
fn bars_are_as_long_as_what_they_show() {
    let page = html::page(&cases::one_effect(), &[]);
    let document = parse(&page);
    let lead = classed(&document, "lead").next().expect("a first answer");
    let bar = lead.descendants().find(|node| node.attribute("class") == Some("bar-after")).expect("its bar");
    assert_eq!(bar.attribute("width"), Some("97%"));
}

#[test]
fn lines_break_between_held_out_blocks() {
    let svg = svg::figure(&cases::one_effect(), &[cases::overlay()]);
    let document = parse(&svg);
    let path = classed(&document, "measured").filter_map(|node| node.attribute("d")).max_by_key(|d| d.len());
    let path = path.expect("a measured line");
    assert_eq!(path.matches('M').count(), 4, "one line for each of the four blocks");
    assert!(path.split(' ').count() < 4 * 2400, "2400 samples are thinned to the pixels that there are");
}

#[test]
fn one_prediction_is_drawn_where_both_are_the_same() {
    let page = html::page(&cases::no_gap(), &[same_before_and_after()]);
    let document = parse(&page);
    assert_eq!(classed(&document, "before").count(), 0);
    assert!(classed(&document, "after").count() > 0);
    assert!(all_text(&document).contains("RMS error 0.983 noise units"));
}

#[test]
fn pages_do_not_grow_with_the_log() {
    let mut long = cases::overlay();
    for series in [&mut long.measured, &mut long.before, &mut long.after] {
        *series = series.iter().flat_map(|value| [*value; 100]).collect();
    }
    long.stamp = (0..240_000).map(|i| f64::from(i) * 1e-4).collect();
    let page = html::page(&cases::one_effect(), &[long]);
    assert!(page.len() < 400_000, "{} bytes", page.len());
}

#[test]
fn the_figure_stands_alone() {
    let svg = svg::figure(&cases::one_effect(), &[cases::overlay()]);
    let document = parse(&svg);
    let root = document.root_element();
    assert_eq!(root.attribute("viewBox"), Some("0 0 1000 520"));
    assert!(!svg.contains("var("), "not every viewer knows CSS variables");
    let shown = all_text(&document);
    for text in
        ["Commands reach the joint 41 ms late", "delay@input:goal", "97 %", "none of these", "angle (rad)"]
    {
        assert!(shown.contains(text), "the figure does not show {text}");
    }
}

/// However many effects an answer has, they stay above the bars of how far they go.
#[test]
fn the_figures_answers_have_their_room() {
    for count in [1, 2, 4, 5, 14] {
        let mut report = cases::two_effects();
        let effects = &mut report.which[0].effects;
        *effects = effects.iter().cycle().take(count).cloned().collect();
        report.which[0].class = (0..3).map(|k| format!("another answer {k}")).collect();
        let svg = svg::figure(&report, &[cases::overlay()]);
        let document = parse(&svg);
        let texts: Vec<(&str, f64)> = document
            .descendants()
            .filter(|node| node.tag_name().name() == "text")
            .filter_map(|node| Some((node.text()?, node.attribute("y")?.parse().ok()?)))
            .collect();
        let place = |head: &str| texts.iter().position(|(text, _)| text.starts_with(head)).expect("a head");
        let (first, last) = (place("Which cause"), place("How far"));
        let answers = &texts[first + 1..last];
        assert!(answers.len() > 3, "{count}: {answers:?}");
        let lowest = answers.iter().map(|(_, y)| *y).fold(0.0, f64::max);
        assert!(lowest < texts[last].1 - 12.0, "{count}: {answers:?}, {:?}", texts[last]);
    }
}

#[test]
fn the_sentence_says_of_readings_what_they_give() {
    let steps = cases::steps();
    assert!(
        steps.summary.contains("no prediction can follow that, and knowing it gives 91.7 %"),
        "{}",
        steps.summary
    );
    assert!(!steps.summary.contains("closes"), "{}", steps.summary);
    let mut late = steps.clone();
    late.how_far.closed_by_effect.value = 0.53;
    let late = sentence::summary(&late);
    assert!(late.contains("adding this closes 53 %"), "what can be closed is said: {late}");
    let mut off = cases::no_gap();
    assert!(sentence::summary(&off).starts_with("No gap"));
    off.gap.score = 8.09;
    let off = sentence::summary(&off);
    assert!(off.starts_with("No cause was found") && off.contains("8.09 times"), "{off}");
}

#[test]
fn the_short_answer() {
    insta::assert_snapshot!("one_effect", text::summary(&cases::one_effect()));
    insta::assert_snapshot!("two_effects", text::summary(&cases::two_effects()));
    insta::assert_snapshot!("no_gap", text::summary(&cases::no_gap()));
    insta::assert_snapshot!("none_of_these", text::summary(&cases::none_of_these()));
    insta::assert_snapshot!("in_closed_loop", text::summary(&cases::in_closed_loop()));
    insta::assert_snapshot!("extreme", text::summary(&cases::extreme()));
}

#[test]
fn the_short_answer_is_short() {
    let mut report = cases::one_effect();
    let row = report.calibration[0].clone();
    report.calibration = vec![row; 40];
    let which = report.which[1].clone();
    report.which = vec![which; 40];
    let confusable = report.confusable[0].clone();
    report.confusable = vec![confusable; 40];
    let place = report.where_[0].clone();
    report.where_ = vec![place; 40];
    let lines = text::summary(&report).lines().count();
    assert!(lines <= 35, "{lines} lines");
}

fn any_series() -> impl Strategy<Value = Vec<f64>> {
    let value = prop_oneof![4 => -10.0..10.0, 1 => proptest::num::f64::ANY];
    proptest::collection::vec(value, 0..90)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn any_numbers_can_be_drawn(
        stamp in any_series(),
        sorted in any::<bool>(),
        measured in any_series(),
        before in any_series(),
        after in any_series(),
        noise in proptest::num::f64::ANY,
        errors in proptest::array::uniform6(proptest::num::f64::ANY),
    ) {
        let mut stamp = stamp;
        if sorted {
            stamp.sort_by(f64::total_cmp);
        }
        let mut report = cases::one_effect();
        let far = &mut report.how_far;
        [far.horizon_s, far.nominal, far.refitted, far.with_effect, far.black_box, far.noise_floor] = errors;
        far.closed_total.low = errors[0];
        far.closed_by_effect.value = errors[1];
        report.gap.score = errors[2];
        report.calibration[0].value = errors[3];
        report.calibration[0].std = errors[4];
        report.which[0].probability = errors[5];
        report.unexplained.share = errors[0];
        let overlay = Overlay { output: "y".to_owned(), unit: "m".to_owned(), noise, stamp, measured, before, after };
        check_page(&report, &[overlay]);
    }
}
