//! The pages of reference hold all that there is: every command with its options, every key of the files.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod command;

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use parallax::model::system::System;
use parallax::runtime::delay::Delay;
use parallax::runtime::graph::GraphSpec;
use parallax::runtime::launch::LaunchSpec;

fn page(name: &str) -> String {
    fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("docs").join(name)).unwrap()
}

#[test]
fn the_page_of_commands_is_what_help_says() {
    let now = command::succeed(".", &["reference"]);
    let page = page("cli.md");
    let changed = now.lines().zip(page.lines()).find(|(now, page)| now != page);
    assert!(
        now == page,
        "docs/cli.md is old; `make reference` writes it anew. First difference: {changed:?}"
    );
}

/// The names in backticks that an error lists after `start`.
fn listed(error: &str, start: &str) -> BTreeSet<String> {
    let Some((_, list)) = error.split_once(start) else { panic!("`{start}` is not in: {error}") };
    let line = list.lines().next().unwrap();
    line.split('`').skip(1).step_by(2).map(str::to_owned).collect()
}

/// The keys in the first column of the tables under a heading, up to the next heading.
fn documented(page: &str, heading: &str) -> BTreeSet<String> {
    let Some((_, rest)) = page.split_once(&format!("\n### {heading}\n")) else {
        panic!("no heading {heading}")
    };
    let section = rest.split("\n## ").next().unwrap().split("\n### ").next().unwrap();
    section
        .lines()
        .filter_map(|line| line.strip_prefix("| `")?.split('`').next())
        .map(str::to_owned)
        .collect()
}

/// What is no key is refused, with the keys that there are: those have to be on the page.
#[track_caller]
fn all_are_there(page: &str, heading: &str, keys: &BTreeSet<String>) {
    assert!(!keys.is_empty(), "{heading}");
    let documented = documented(page, heading);
    let missing: Vec<_> = keys.difference(&documented).collect();
    assert!(missing.is_empty(), "{heading} does not have {missing:?}");
}

#[test]
fn every_key_of_a_graph_is_on_its_page() {
    let page = page("graph.md");
    let head = "name = 'x'\nsupervisor = 'a'\n";
    let keys = |text: &str| {
        let error = GraphSpec::from_toml(text).unwrap_err().to_string();
        listed(&error, "expected ")
    };
    let node = "[[node]]\nname = 'a'\nkind = 'k'\nrate = 1.0\n";
    for (heading, text) in [
        ("The graph", format!("wrong = 1\n{head}")),
        ("The graph", format!("{head}[plant]\nwrong = 1\n")),
        ("A node", format!("{head}{node}wrong = 1\n")),
        ("A connection", format!("{head}[[connection]]\nfrom = 'a'\nto = 'b'\nwrong = 1\n")),
    ] {
        all_are_there(&page, heading, &keys(&text));
    }
    // A key whose value is a word: the words.
    for key in ["scheduling", "on_dead_sender"] {
        for word in keys(&format!("{head}{node}{key} = 'wrong'\n")) {
            assert!(page.contains(&format!("`{word}`")), "graph.md does not have {key} = {word}");
        }
    }
    let (_, delays) = page.split_once("\n## Delays\n").unwrap();
    let distribution = |text: &str| toml::from_str::<Delay>(text).unwrap_err().to_string();
    for name in listed(&distribution("distribution = 'wrong'"), "expected ") {
        let row = delays.lines().find(|line| line.starts_with(&format!("| `{name}` |")));
        let row = row.unwrap_or_else(|| panic!("graph.md does not have the distribution {name}"));
        let wrong = distribution(&format!("distribution = '{name}'\nwrong = 1\n"));
        for key in listed(&wrong, "expected ") {
            assert!(row.contains(&format!("`{key}`")), "graph.md: {name} does not have {key}");
        }
    }
}

#[test]
fn every_setting_of_a_launch_is_on_its_page() {
    let page = page("real-time.md");
    let error = LaunchSpec::from_toml("launch.toml", "[defaults]\nwrong = 1\n").unwrap_err().to_string();
    for key in listed(&error, "expected ") {
        assert!(page.contains(&format!("`{key}`")), "real-time.md does not have {key}");
    }
    let several = self::page("several-machines.md");
    for text in ["[link]\nwrong = 1\n", "[host.a]\nwrong = 1\n"] {
        let error = LaunchSpec::from_toml("launch.toml", text).unwrap_err().to_string();
        for key in listed(&error, "expected ") {
            let there = several.contains(&format!("`{key}`")) || several.contains(&format!("{key} = "));
            assert!(there, "several-machines.md does not have {key}");
        }
    }
}

#[test]
fn every_key_of_a_system_is_on_its_page() {
    let page = page("system.md");
    let whole = "[outputs]\ny = { value = '1' }\n";
    let head = "format = 1\nname = 'x'\n";
    let keys = |text: &str| -> BTreeSet<String> {
        let error = System::parse(text, "system.toml").unwrap_err().to_string();
        let (_, list) = error.rsplit_once("known: ").unwrap_or_else(|| panic!("{error}"));
        list.trim_end_matches(')').split(", ").map(str::to_owned).collect()
    };
    let state = "[state]\nq = { derivative = '0' }\n";
    let own = "[joints]\nj = { position = 'q', velocity = 'q', inertia = '1' }\n";
    for (heading, text) in [
        ("The file", format!("wrong = 1\n{head}{whole}")),
        ("A parameter", format!("{head}[parameters]\nm = {{ value = 1, wrong = 1 }}\n{whole}")),
        ("An input", format!("{head}[inputs]\nu = {{ wrong = 1 }}\n{whole}")),
        ("An input", format!("{head}[inputs]\nu = {{ supply = {{ wrong = 1 }} }}\n{whole}")),
        ("A state", format!("{head}[state]\nq = {{ derivative = '0', wrong = 1 }}\n{whole}")),
        ("A state", format!("{head}[state]\nq = {{ derivative = '0', initial = {{ wrong = 1 }} }}\n{whole}")),
        ("An output", format!("{head}[outputs]\ny = {{ value = '1', wrong = 1 }}\n")),
        ("A joint", format!("{head}{state}{whole}[joints]\nj = {{ wrong = 1 }}\n")),
        ("An `[[effect]]`", format!("{head}{whole}[[effect]]\nwrong = 1\n")),
        ("An effect of your own", format!("{head}{state}{whole}{own}[effects.e]\nwrong = 1\n")),
        (
            "An effect of your own",
            format!(
                "{head}{state}{whole}{own}[effects.e]\nplace = 'joint:j'\nadds = '0'\nparameters = {{ p = {{ wrong = 1 }} }}\n"
            ),
        ),
    ] {
        all_are_there(&page, heading, &keys(&text));
    }
}
