//! The documentation does what it says: its files are written, its commands are run, its pages are in the book.
//!
//! Of a page, in order: a block of `toml`, `python` or `csv` that begins with a comment of one file's name (`# FILE`), or that
//! follows `<!-- file: FILE -->`, is that file; a block of `sh` is run line by line in one shell, except for lines that say `# not run: WHY`.
//! Blocks of `python` are run by bindings/tests/test_docs.py, those of `rust` by the doc-tests of src/lib.rs; `text` is what something prints.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod command;

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Mutex, PoisonError};

use command::{Noise, json};
use parallax::model::effect::{Effect, EffectParameter};
use parallax::model::system::System;
use parallax::runtime::delay::Delay;
use parallax::runtime::launch::LaunchSpec;
use serde_json::Value;

/// The pages of the command line, each run by a test below.
const RUN_HERE: [&str; 16] = [
    "README.md",
    "docs/closed-loop.md",
    "docs/compensation.md",
    "docs/delays.md",
    "docs/diagnosis.md",
    "docs/effects.md",
    "docs/graph.md",
    "docs/identification.md",
    "docs/import.md",
    "docs/latency.md",
    "docs/launch.md",
    "docs/performance.md",
    "docs/real-time.md",
    "docs/several-machines.md",
    "docs/start.md",
    "docs/system.md",
];
/// Pages that look at a run find it by the name of its graph, or because it is the only one: two at a time would meet.
static LIVE: Mutex<()> = Mutex::new(());
/// What `cargo` does in a page: this program, and the examples that are built with the tests.
const CARGO: &str = r#"#!/bin/sh
case "$*" in
    "run --release -- "*) shift 3; exec parallax "$@" ;;
    "run --release --example "*) exec "$EXAMPLES/$4" ;;
    *) echo "cargo $*: no page may ask for this without saying that it is not run" >&2; exit 1 ;;
esac
"#;

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn docs() -> PathBuf {
    root().join("docs")
}

/// A block of a page.
#[derive(Debug)]
struct Block {
    language: String,
    text: String,
    /// The file that it is.
    file: Option<String>,
}

fn blocks(page: &str) -> Vec<Block> {
    let (mut blocks, mut open, mut named) = (Vec::new(), None::<Block>, None);
    for line in page.lines() {
        match (line.strip_prefix("```"), &mut open) {
            (Some(language), None) => {
                let language = language.trim().to_owned();
                open = Some(Block { language, text: String::new(), file: named.take() });
            }
            (Some(_), Some(_)) => {
                let mut block = open.take().unwrap();
                let first = block.text.lines().next().and_then(|line| line.strip_prefix("# "));
                let first = first.and_then(|line| line.split(": ").next());
                let is_name = |name: &&str| !name.contains(' ') && name.contains('.');
                if block.language != "sh" {
                    block.file = block.file.or(first.filter(is_name).map(str::to_owned));
                }
                blocks.push(block);
            }
            (None, Some(block)) => block.text += &format!("{line}\n"),
            (None, None) => {
                let comment = line.strip_prefix("<!-- file: ").and_then(|rest| rest.strip_suffix(" -->"));
                named = comment.map(str::to_owned).or(named.filter(|_| line.is_empty()));
            }
        }
    }
    assert!(open.is_none(), "a block is not closed");
    blocks
}

/// A folder in which pages are run: the program and `cargo` on the path, and the examples.
struct Place {
    folder: tempfile::TempDir,
}

impl Place {
    fn new() -> Self {
        let place = Self { folder: tempfile::tempdir().unwrap() };
        let cargo = place.at("bin/cargo");
        fs::create_dir_all(cargo.parent().unwrap()).unwrap();
        fs::write(&cargo, CARGO).unwrap();
        fs::set_permissions(&cargo, fs::Permissions::from_mode(0o755)).unwrap();
        symlink(root().join("examples"), place.at("examples")).unwrap();
        place
    }

    fn at(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn write(&self, name: &str, text: &str) {
        let path = self.at(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    }

    fn read(&self, name: &str) -> String {
        fs::read_to_string(self.at(name)).unwrap_or_else(|error| panic!("{name}: {error}"))
    }

    /// Runs a page; gives what its blocks of commands printed.
    fn run(&self, page: &str) -> Vec<(String, String)> {
        let page = fs::read_to_string(root().join(page)).unwrap();
        let mut printed = Vec::new();
        for block in blocks(&page) {
            if let Some(name) = &block.file {
                self.write(name, &block.text);
            }
            if block.language == "sh" {
                printed.extend(self.shell(&block.text));
            }
        }
        assert!(!printed.is_empty(), "the page runs nothing");
        printed
    }

    /// Runs the lines of a block in one shell, and gives what each printed.
    fn shell(&self, block: &str) -> Vec<(String, String)> {
        let lines: Vec<&str> =
            block.lines().filter(|line| !line.is_empty() && !line.contains("# not run: ")).collect();
        if lines.is_empty() {
            return Vec::new();
        }
        let live =
            lines.iter().any(|line| [" run ", " top", "demo", "task"].iter().any(|word| line.contains(word)));
        let _alone = live.then(|| LIVE.lock().unwrap_or_else(PoisonError::into_inner));
        let program = Path::new(env!("CARGO_BIN_EXE_parallax"));
        let folder = program.parent().unwrap();
        let path =
            format!("{}:{}:{}", self.at("bin").display(), folder.display(), std::env::var("PATH").unwrap());
        // `doctor` ends with 1 where it found something to change, as it does almost everywhere.
        let mark = "--- the next line of the page ---";
        let mut script = String::from("set -e\n");
        for line in &lines {
            let allowed = if line.contains("doctor") { " || [ $? = 1 ]" } else { "" };
            let (command, _) = line.split_once("   #").unwrap_or((line, ""));
            script += &format!("{command}{allowed}\necho '{mark}'\n");
        }
        // What was started in the background ends by itself.
        script += "wait\n";
        let output = Command::new("sh")
            .args(["-c", &script])
            .current_dir(self.folder.path())
            .env("PATH", path)
            .env("EXAMPLES", folder.join("examples"))
            .output()
            .unwrap();
        let text = String::from_utf8(output.stdout).unwrap();
        let parts: Vec<&str> = text.split(&format!("{mark}\n")).collect();
        let errors = String::from_utf8_lossy(&output.stderr);
        let reached = lines.get(parts.len() - 1).copied().unwrap_or_default();
        assert!(output.status.success(), "{reached}\n{text}\n{errors}");
        assert!(!errors.contains("panicked"), "{errors}");
        lines.into_iter().map(str::to_owned).zip(parts.into_iter().map(str::to_owned)).collect()
    }

    fn json(&self, name: &str) -> Value {
        serde_json::from_str(&self.read(name)).unwrap()
    }
}

/// What a log holds, column by column.
type Columns = BTreeMap<&'static str, Vec<f64>>;

/// An axis with dry friction that follows a course: what its logger wrote, `seconds` at 100 Hz.
fn axis(seconds: f64) -> Columns {
    let mut columns = Columns::new();
    let (mut x, mut v, mut sum, mut last) = (0.0_f64, 0.0_f64, 0.0, 0.0);
    let mut noise = Noise(3);
    for k in 0..(seconds * 100.0) as usize {
        let t = 0.01 * k as f64;
        let course = 0.1 * (1.3 * t).sin() + 0.06 * (4.1 * t).sin();
        let reading = x + 2e-5 * noise.draw();
        let error = course - reading;
        let force = (60.0 * error + 3.0 * sum - 14.0 * (reading - last) / 0.01).clamp(-20.0, 20.0);
        (sum, last) = (sum + 0.01 * error, reading);
        for (name, value) in [("t", t), ("u", force), ("q", reading), ("course", course)] {
            columns.entry(name).or_default().push(value);
        }
        for _ in 0..100 {
            v += 1e-4 * (force - 2.0 * v - 0.5 * (v / 1e-3).tanh()) / 2.0;
            x += 1e-4 * v;
        }
    }
    columns
}

/// Columns as a CSV file.
fn csv(columns: &Columns, header: &[(&str, &str)]) -> String {
    let names: Vec<&str> = header.iter().map(|(written, _)| *written).collect();
    let rows = (0..columns["t"].len()).map(|row| {
        let cells: Vec<String> = header.iter().map(|(_, key)| columns[*key][row].to_string()).collect();
        cells.join(",")
    });
    [names.join(",")].into_iter().chain(rows).map(|line| line + "\n").collect()
}

/// The axis as its simulator knows it: without the dry friction.
const SYSTEM: &str = r#"format = 1
name = "axis"
[parameters]
m = { value = 2.0, unit = "kg", calibrate = [1.0, 4.0] }
c = { value = 2.0, unit = "N s/m", calibrate = [0.0, 10.0] }
[inputs]
force = { signal = "force" }
[state]
q = { derivative = "v", initial = "position" }
v = { derivative = "(force - c*v)/m" }
[outputs]
position = { value = "q", unit = "m" }
[joints]
axis = { position = "q", velocity = "v", inertia = "m", drive = "force" }
"#;

/// Writes the axis' log as the folder `name`.
fn log(place: &Place, name: &str, seconds: f64) {
    let signal = |name: &str, role: &str, unit: &str, column: &str| {
        format!(
            "[[signal]]\nname = \"{name}\"\nrole = \"{role}\"\nunit = \"{unit}\"\nfile = \"log.csv\"\n\
             time = \"t\"\nvalue = \"{column}\"\n"
        )
    };
    let manifest = format!(
        "format = 1\ntitle = \"axis\"\n{}{}{}",
        signal("force", "command", "N", "u"),
        signal("position", "measurement", "m", "q"),
        signal("position_reference", "reference", "m", "course"),
    );
    place.write(&format!("{name}/recording.toml"), &manifest);
    let columns = csv(&axis(seconds), &[("t", "t"), ("u", "u"), ("q", "q"), ("course", "course")]);
    place.write(&format!("{name}/log.csv"), &columns);
}

#[test]
fn the_readme_runs() {
    let place = Place::new();
    let columns = axis(6.0);
    place.write("bench.csv", &csv(&columns, &[("t [s]", "t"), ("force [N]", "u"), ("position [m]", "q")]));
    // The block of the page describes it: a voltage `u` and a position `q`.
    place.write("my_log/log.csv", &csv(&columns, &[("t", "t"), ("u", "u"), ("q", "q")]));
    let page = fs::read_to_string(root().join("README.md")).unwrap();
    let manifest = blocks(&page)
        .into_iter()
        .find(|block| block.file.as_deref() == Some("my_log/recording.toml"))
        .unwrap();
    place.write("second_log/recording.toml", &manifest.text);
    place.write("second_log/log.csv", &csv(&axis(4.0), &[("t", "t"), ("u", "u"), ("q", "q")]));
    place.write("commands.csv", "# format = 1\ntime,motor.voltage\n0,0\n0.5,2.5\n");
    let printed = place.run("README.md");
    let said = |start: &str| {
        let found = printed.iter().find(|(line, _)| line.starts_with(start));
        found.unwrap_or_else(|| panic!("the page no longer has `{start}`")).1.clone()
    };
    assert!(said("cargo run --release -- demo").contains("report.html"));
    assert!(said("sleep 2 && cargo run --release -- top pendulum --once").contains("camera"));
    assert!(said("cargo run --release -- replay").contains("exact"), "{printed:?}");
    // An effect of one's own, put to the end of the file.
    let own = place.read("system.toml") + &place.read("magnet.toml");
    assert_eq!(System::parse(&own, "system.toml").unwrap().own.len(), 1);
    // Every delay of the page is one.
    let delays = blocks(&page).into_iter().find(|block| block.text.starts_with("# delays")).unwrap();
    for line in delays.text.lines().filter(|line| !line.starts_with('#')) {
        let (_, value) = line.split_once(" = ").unwrap();
        let table: toml::Table = toml::from_str(&format!("delay = {value}")).unwrap();
        table["delay"].clone().try_into::<Delay>().unwrap_or_else(|error| panic!("{line}: {error}"));
    }
}

#[test]
fn ten_minutes_lead_to_the_answer() {
    let place = Place::new();
    let printed = place.run("docs/start.md");
    assert_eq!(printed.len(), 8, "{printed:?}");
    let listed = &printed[1].1;
    assert!(listed.contains("semicolons") && listed.contains("100.00 Hz"), "{listed}");
    let answer = place.json("answer/report.json");
    let class = answer["which"][0]["class"].as_array().unwrap();
    assert!(class.iter().any(|name| name == "coulomb@joint:axis"), "{class:?}");
    let score = |name: &str| place.json(name)["gap"]["score"].as_f64().unwrap();
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
fn the_page_of_the_diagnosis_runs() {
    let place = Place::new();
    place.write("system.toml", SYSTEM);
    for (name, seconds) in [("my_log", 5.0), ("first", 3.0), ("second", 4.0), ("third", 3.0)] {
        log(&place, name, seconds);
    }
    command::succeed(&place.folder, &["sim", "pendulum", "--duration", "4", "--out", "run.mcap"]);
    let printed = place.run("docs/diagnosis.md");
    assert!(
        printed.iter().all(|(_, text)| text.contains("how far") || text.contains("no gap")),
        "{printed:?}"
    );
}

#[test]
fn the_page_of_the_closed_loop_runs() {
    let place = Place::new();
    place.write("system.toml", SYSTEM);
    log(&place, "my_log", 8.0);
    command::succeed(&place.folder, &["sim", "pendulum", "--duration", "5", "--out", "run.mcap"]);
    let page = fs::read_to_string(docs().join("closed-loop.md")).unwrap();
    let found = blocks(&page);
    // Its file is used before it is shown.
    let task = found.iter().find(|block| block.file.as_deref() == Some("task.toml")).unwrap();
    place.write("task.toml", &task.text.replace("to = 20.0", "to = 7.0"));
    let shown = found.iter().find(|block| block.language == "json").unwrap();
    let shown: Value = serde_json::from_str(&format!("{{{}}}", shown.text)).unwrap();
    let printed: Vec<_> =
        found.iter().filter(|b| b.language == "sh").flat_map(|b| place.shell(&b.text)).collect();
    assert!(printed.iter().all(|(_, text)| text.contains("closed loop")), "{printed:?}");
    let out = command::json(
        &place.folder,
        &[
            "diagnose",
            "--system",
            "system.toml",
            "my_log",
            "--task",
            "task.toml",
            "--json",
            "--out",
            "out/again",
        ],
    );
    for key in shown["closed_loop"].as_object().unwrap().keys() {
        assert!(!out["closed_loop"][key].is_null(), "the report has no `{key}`: {}", out["closed_loop"]);
    }
}

#[test]
fn the_pages_of_files_run() {
    let place = Place::new();
    place.run("docs/system.md");
    place.run("docs/graph.md");
}

#[test]
fn the_launch_runs_and_survives_its_agent() {
    let place = Place::new();
    let printed = place.run("docs/launch.md");
    let told = &printed.iter().find(|(line, _)| line.starts_with("cat out/killed.txt")).unwrap().1;
    assert!(told.contains("started again 1 times"), "{told}");
}

#[test]
fn the_page_of_real_time_runs() {
    let place = Place::new();
    place.write("robot.toml", "[defaults]\nrestart = \"on-failure\"\n");
    let printed = place.run("docs/real-time.md");
    assert!(printed.iter().any(|(line, text)| line.contains("get pendulum motor") && text.contains("rated")));
}

#[test]
fn the_pages_about_delays_run() {
    let place = Place::new();
    for page in ["delays", "compensation", "identification", "latency"] {
        place.run(&format!("docs/{page}.md"));
    }
}

#[test]
fn the_page_of_several_machines_has_a_whole_launch_file() {
    let place = Place::new();
    place.run("docs/several-machines.md");
    let launch = LaunchSpec::from_toml("launch.toml", &place.read("launch.toml")).unwrap();
    assert_eq!(launch.hosts.len(), 2);
}

#[test]
fn every_page_is_run_and_what_is_not_says_why() {
    let python = fs::read_to_string(root().join("bindings/tests/test_docs.py")).unwrap();
    let face = fs::read_to_string(root().join("src/lib.rs")).unwrap();
    let mut pages: Vec<String> = fs::read_dir(docs())
        .unwrap()
        .map(|entry| format!("docs/{}", entry.unwrap().file_name().into_string().unwrap()))
        // What is made from docstrings holds fragments, which stand beside what they explain.
        .filter(|name| name.ends_with(".md") && name != "docs/python-api.md")
        .collect();
    pages.push("README.md".into());
    for page in pages {
        let text = fs::read_to_string(root().join(&page)).unwrap();
        for Block { language, text, .. } in blocks(&text) {
            let here = RUN_HERE.contains(&page.as_str());
            let there = python.contains(&format!("\"{page}\""));
            let run = match language.as_str() {
                "text" => true,
                "python" => there || text.starts_with("# ") && text.contains(".py\n") && here,
                "rust" | "rust,no_run" => face.contains(&format!("../{page}")),
                "sh" | "toml" | "json" | "csv" => here || there,
                _ => panic!("{page}: a block of `{language}` is of no language that is run: {text}"),
            };
            let said = text.lines().filter(|line| !line.is_empty()).all(|line| line.contains("# not run: "));
            assert!(run || said, "{page}: nothing runs this block:\n{text}");
        }
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
        blocks(&page).into_iter().filter(|block| block.language == "toml").map(|block| block.text).collect();
    let [system, entries @ ..] = examples.as_slice() else { panic!("effects.md has no example") };
    let (mut forms, mut own) = (BTreeSet::new(), 0);
    for entry in entries {
        // Most are entries of the first system; what another machine needs is a system of its own.
        let whole = if entry.contains("format = 1") { entry.clone() } else { format!("{system}\n{entry}") };
        let parsed = System::parse(&whole, "effects.md");
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
    let place = Place::new();
    place.write(
        "bench.csv",
        "t [s];u [V];pos [m];vel [m/s];vbat [V]\n0.00;1;0;0;12\n0.01;-1;0.01;0.1;12\n0.02;1;0.02;0.1;12\n",
    );
    place.run("docs/import.md");
    let page = fs::read_to_string(docs().join("import.md")).unwrap();
    let listing = blocks(&page).into_iter().find(|block| block.language == "text").unwrap();
    assert_eq!(command::succeed(&place.folder, &["import", "bench.csv", "--list"]), listing.text);
    let info = json(&place.folder, &["info", "german", "--json"]);
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
