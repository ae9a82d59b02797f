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
