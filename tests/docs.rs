//! The documentation does what it says: its files are written, its commands are run, its pages are in the book.
//!
//! Of a page, in order: a block of `toml`, `python` or `csv` that begins with a comment of one file's name (`# FILE`) is
//! that file; a line of a block of `sh` is run, unless it says `# not run: WHY`.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod command;

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use command::json;
use parallax::model::effect::{Effect, EffectParameter};
use parallax::model::system::System;

fn docs() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("docs")
}

/// The blocks of a page: the language and the text of each.
fn blocks(page: &str) -> Vec<(String, String)> {
    let mut blocks = Vec::new();
    let mut open: Option<(String, String)> = None;
    for line in page.lines() {
        match (line.strip_prefix("```"), &mut open) {
            (Some(language), None) => open = Some((language.trim().to_owned(), String::new())),
            (Some(_), Some(_)) => blocks.extend(open.take()),
            (None, Some((_, text))) => *text += &format!("{line}\n"),
            (None, None) => {}
        }
    }
    assert!(open.is_none(), "a block is not closed");
    blocks
}

/// Runs a page in `folder`; gives what each command printed.
fn run(page: &str, folder: &Path) -> Vec<(String, String)> {
    let page = fs::read_to_string(docs().join(page)).unwrap();
    let mut printed = Vec::new();
    let program = Path::new(env!("CARGO_BIN_EXE_parallax"));
    let path = format!("{}:{}", program.parent().unwrap().display(), std::env::var("PATH").unwrap());
    for (language, text) in blocks(&page) {
        if language != "sh" {
            let name = text.lines().next().and_then(|line| line.strip_prefix("# "));
            if let Some(name) = name.filter(|name| !name.contains(' ') && name.contains('.')) {
                fs::write(folder.join(name), &text).unwrap();
            }
            continue;
        }
        for line in text.lines().filter(|line| !line.is_empty() && !line.contains("# not run: ")) {
            let output = Command::new("sh")
                .args(["-c", line])
                .current_dir(folder)
                .env("PATH", &path)
                .output()
                .unwrap();
            let errors = String::from_utf8_lossy(&output.stderr);
            assert!(output.status.success(), "{line}: {errors}");
            printed.push((line.to_owned(), String::from_utf8(output.stdout).unwrap()));
        }
    }
    printed
}

#[test]
fn ten_minutes_lead_to_the_answer() {
    let folder = tempfile::tempdir().unwrap();
    let printed = run("start.md", folder.path());
    assert_eq!(printed.len(), 8, "{printed:?}");
    let listed = &printed[1].1;
    assert!(listed.contains("semicolons") && listed.contains("100.00 Hz"), "{listed}");
    let report = |name: &str| -> serde_json::Value {
        serde_json::from_str(&fs::read_to_string(folder.path().join(name)).unwrap()).unwrap()
    };
    let answer = report("answer/report.json");
    let class = answer["which"][0]["class"].as_array().unwrap();
    assert!(class.iter().any(|name| name == "coulomb@joint:axis"), "{class:?}");
    let score = |name: &str| report(name)["gap"]["score"].as_f64().unwrap();
    let (before, after) = (score("answer/report.json"), score("again/report.json"));
    assert!(before > 20.0 && after < 2.0, "{before} and {after} noise units");
    // What is printed and written is explained.
    let explained = fs::read_to_string(docs().join("diagnosis.md")).unwrap();
    let (_, short) = printed.iter().find(|(line, _)| line.starts_with("parallax diagnose")).unwrap();
    let lines = short.lines().skip_while(|line| !line.is_empty());
    let labelled =
        lines.filter(|line| line.starts_with(char::is_alphabetic) && !line.starts_with("written to "));
    let labels: Vec<&str> = labelled.filter_map(|line| line.split("  ").next()).collect();
    assert!(labels.len() > 5, "{short}");
    for label in labels {
        assert!(explained.contains(&format!("| `{label}` |")), "diagnosis.md does not explain `{label}`");
    }
    for key in answer.as_object().unwrap().keys() {
        assert!(explained.contains(&format!("`{key}`")), "diagnosis.md does not explain the key `{key}`");
    }
}

#[test]
fn the_page_of_the_diagnosis_has_every_option() {
    let folder = tempfile::tempdir().unwrap();
    let page = fs::read_to_string(docs().join("diagnosis.md")).unwrap();
    let help = command::succeed(&folder, &["diagnose", "--help"]);
    let options: BTreeSet<&str> = help
        .split_whitespace()
        .filter(|word| word.starts_with("--"))
        .map(|w| w.trim_end_matches('.'))
        .collect();
    assert!(options.contains("--explain") && options.contains("--verbose"), "{options:?}");
    for option in options.into_iter().filter(|option| !["--help", "--version"].contains(option)) {
        assert!(page.contains(&format!("`{option}")), "diagnosis.md does not have {option}");
    }
}

/// What the page of effects says of one of them: the text below its heading.
fn section<'a>(page: &'a str, name: &str) -> &'a str {
    let heading = format!("\n### `{name}`\n");
    let Some(at) = page.find(&heading) else { panic!("effects.md has no heading for {name}") };
    let text = &page[at + heading.len()..];
    let next = [text.find("\n## "), text.find("\n### ")].into_iter().flatten().min();
    &text[..next.unwrap_or(text.len())]
}

/// A number as the page of effects writes it.
fn written(value: f64) -> String {
    let pis = value / std::f64::consts::PI;
    if value.is_nan() {
        "the nominal value".into()
    } else if value.is_infinite() {
        if value > 0.0 { "∞".into() } else { "-∞".into() }
    } else if value != 0.0 && pis.fract() == 0.0 {
        format!("{pis}π").replace("1π", "π")
    } else {
        value.to_string()
    }
}

/// A parameter's physical range as the page of effects writes it.
fn range(parameter: &EffectParameter) -> String {
    match (parameter.low.is_finite(), parameter.high.is_finite()) {
        (false, false) => "any".into(),
        (true, false) => format!("≥ {}", written(parameter.low)),
        _ => format!("{} to {}", written(parameter.low), written(parameter.high)),
    }
}

#[test]
fn the_page_of_effects_says_what_the_library_has() {
    let page = fs::read_to_string(docs().join("effects.md")).unwrap();
    let headings: BTreeSet<&str> =
        page.lines().filter_map(|line| line.strip_prefix("### `")?.strip_suffix('`')).collect();
    let names: BTreeSet<&str> = Effect::ALL.into_iter().map(Effect::name).collect();
    assert_eq!(headings, names);
    for effect in Effect::ALL {
        let text = section(&page, effect.name());
        for kind in effect.places() {
            let place = format!("`{}:`", kind.name());
            assert!(text.contains(&place), "{effect:?} acts at {place}, and effects.md does not say so");
        }
        for parameter in effect.parameters() {
            let expected = [format!("`{}`", parameter.name), range(parameter), written(parameter.null)];
            let stated = text.lines().any(|line| {
                let cells: Vec<&str> = line.split('|').map(str::trim).collect();
                matches!(cells[..], ["", name, _, within, null, _, ""] if [name, within, null] == expected)
            });
            assert!(stated, "{effect:?}: effects.md has no row with {expected:?}");
        }
    }
}

#[test]
fn the_page_of_effects_states_every_form_of_them() {
    let page = fs::read_to_string(docs().join("effects.md")).unwrap();
    let examples: Vec<String> =
        blocks(&page).into_iter().filter(|(language, _)| language == "toml").map(|(_, text)| text).collect();
    let [system, entries @ ..] = examples.as_slice() else { panic!("effects.md has no example") };
    let (mut forms, mut own) = (BTreeSet::new(), 0);
    for entry in entries {
        let parsed = System::parse(&format!("{system}\n{entry}"), "effects.md");
        let system = parsed.unwrap_or_else(|error| panic!("{entry}\n{error}"));
        system.equations().unwrap_or_else(|error| panic!("{entry}\n{error}"));
        forms.extend(system.effects.iter().map(|effect| effect.resolve().unwrap().0));
        own += system.own.len();
    }
    assert_eq!(forms, BTreeSet::from(Effect::ALL));
    assert_eq!(own, 1);
}

#[test]
fn the_import_page_shows_what_is_printed() {
    let folder = tempfile::tempdir().unwrap();
    let page = fs::read_to_string(docs().join("import.md")).unwrap();
    let plain: Vec<String> =
        blocks(&page).into_iter().filter(|(language, _)| language.is_empty()).map(|(_, text)| text).collect();
    let [file, listing] = plain.as_slice() else { panic!("{plain:?}") };
    fs::write(folder.path().join("bench.csv"), file).unwrap();
    let printed = command::succeed(&folder, &["import", "bench.csv", "--list"]);
    assert_eq!(&printed, listing);
    let line = page.lines().find(|line| line.contains("--context Akku")).unwrap();
    let arguments: Vec<&str> = line.split_whitespace().skip(1).collect();
    command::succeed(&folder, &arguments);
    let info = json(&folder, &["info", "bench_log", "--json"]);
    assert_eq!(info["signals"].as_array().unwrap().len(), 3);
}

#[test]
fn every_page_is_in_the_book() {
    let summary = fs::read_to_string(docs().join("SUMMARY.md")).unwrap();
    let named: BTreeSet<String> =
        summary.split("](").skip(1).map(|rest| rest.split(')').next().unwrap().to_owned()).collect();
    let pages: BTreeSet<String> = fs::read_dir(docs())
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .filter(|name| name.ends_with(".md") && name != "SUMMARY.md")
        .collect();
    assert_eq!(named, pages);
}
