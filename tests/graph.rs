//! `parallax delays`, `parallax graph` and `parallax kinds` as their users meet them: what they print, draw and refuse.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod command;

use std::fs;

use command::{fail, json, parallax, succeed};
use parallax::nodes::pendulum;
use parallax::runtime::delay::Delay;
use parallax::runtime::graph::GraphSpec;
use serde_json::Value;
use tempfile::TempDir;

/// The command fails as one does whose input cannot be used, and says all of these.
#[track_caller]
fn refuse(folder: &TempDir, arguments: &[&str], expected: &[&str]) {
    fail(folder, arguments, 2, expected);
}

fn folder() -> TempDir {
    tempfile::tempdir().unwrap()
}

/// The pendulum's graph with one delay of every kind, in `graph.toml`.
fn with_delays() -> TempDir {
    let folder = folder();
    let mut spec = pendulum::graph();
    let delay = |spec: &mut GraphSpec, node: &str, delay: Delay| {
        spec.node_mut(node).unwrap().computation = delay;
    };
    let bimodal =
        Delay::Mixture { weights: vec![0.7, 0.3], means: vec![2e-3, 5e-3], stds: vec![0.2e-3, 0.3e-3] };
    delay(&mut spec, "camera", Delay::Correlated { correlation: 0.6, of: Box::new(bimodal) });
    delay(&mut spec, "estimator", Delay::Gamma { mean: 0.3e-3, std: 0.1e-3 });
    delay(&mut spec, "agent", Delay::LogNormal { mean: 1e-3, std: 0.3e-3 });
    let output = Delay::Output {
        leaf: "voltage".into(),
        offset: 0.1e-3,
        scale: 0.1e-3,
        min: 0.1e-3,
        max: 1e-3,
        expected: None,
    };
    delay(&mut spec, "motor", output);
    spec.connections[0].delay = Delay::Uniform { low: 0.1e-3, high: 0.3e-3 };
    spec.connections[1].delay = Delay::Empirical { samples: vec![0.1e-3, 0.2e-3, 0.4e-3] };
    fs::write(folder.path().join("graph.toml"), spec.to_toml().unwrap()).unwrap();
    folder
}

/// Twenty simulated seconds of it in `run.mcap`.
fn with_recording() -> TempDir {
    let folder = with_delays();
    succeed(&folder, &["sim", "graph.toml", "--duration", "20", "--seed", "3", "--out", "run.mcap"]);
    folder
}

fn read(folder: &TempDir, file: &str) -> String {
    fs::read_to_string(folder.path().join(file)).unwrap()
}

/// Well-formed XML that asks the network for nothing.
#[track_caller]
fn check_page(text: &str) {
    let options = roxmltree::ParsingOptions { allow_dtd: true, ..roxmltree::ParsingOptions::default() };
    let document = roxmltree::Document::parse_with_options(text, options).unwrap();
    for node in document.descendants() {
        for attribute in node.attributes() {
            assert!(!["href", "src"].contains(&attribute.name()), "{attribute:?}");
            for word in ["NaN", "inf"] {
                assert!(
                    attribute.name() == "aria-label" || !attribute.value().contains(word),
                    "{attribute:?}"
                );
            }
        }
    }
    assert!(!text.contains("@import") && !text.contains("url("));
}

#[test]
fn help_names_the_commands() {
    let folder = folder();
    let help = succeed(&folder, &["--help"]);
    assert!(help.contains("delays") && help.contains("graph"), "{help}");
    assert!(succeed(&folder, &["delays", "--help"]).contains("--plot"));
    assert!(succeed(&folder, &["graph", "--help"]).contains("--from"));
}

#[test]
fn delays_of_a_recording() {
    let folder = with_recording();
    insta::assert_snapshot!("delays", succeed(&folder, &["delays", "run.mcap"]));
    let found = json(&folder, &["delays", "run.mcap", "--json"]);
    let delays = found["delays"].as_array().unwrap();
    assert_eq!(delays.len(), 11);
    let camera = delays.iter().find(|delay| delay["node"] == "camera").unwrap();
    assert_eq!((&camera["what"], &camera["samples"]), (&Value::from("computation"), &Value::from(2000)));
    assert_eq!(camera["components"], 2);
    assert_eq!(camera["correlation"]["significant"], true);
    assert_eq!(camera["fit"]["distribution"], "correlated");
    let means = camera["fit"]["of"]["means"].as_array().unwrap();
    assert!((means[1].as_f64().unwrap() - 5e-3).abs() < 0.1e-3, "{means:?}");
}

#[test]
fn fitted_delays_make_a_graph_that_runs() {
    let folder = with_recording();
    succeed(&folder, &["delays", "run.mcap", "-o", "made/fitted.toml"]);
    let spec = GraphSpec::from_toml(&read(&folder, "made/fitted.toml")).unwrap();
    assert!((spec.node("camera").unwrap().computation.expected() - 2.9e-3).abs() < 0.1e-3);
    assert!((spec.connections[0].delay.expected() - 0.2e-3).abs() < 0.02e-3);
    succeed(&folder, &["sim", "made/fitted.toml", "--duration", "1"]);
    assert!(succeed(&folder, &["info", "made/fitted.toml"]).contains("camera"));
}

#[test]
fn a_graph_in_words() {
    let folder = with_delays();
    insta::assert_snapshot!("graph", succeed(&folder, &["graph", "graph.toml", "--duration", "2"]));
    let shown = json(&folder, &["graph", "pendulum", "--duration", "2", "--json"]);
    assert_eq!(shown["supervisor"], "agent");
    assert_eq!(shown["nodes"][0]["steps"], 400);
    assert_eq!(shown["connections"][4]["blocking"], false);
    assert!(shown["measured_delays"].is_null());
    let found = shown["supergraphs"].as_array().unwrap();
    assert_eq!(found.len(), 4);
    let slots = |index: usize| found[index]["slots"].as_array().unwrap().len();
    // Four steps of the world, two each of three others, and the supervisor's own.
    assert_eq!((slots(0), found[0]["slots"][10].as_str()), (11, Some("agent")));
    assert!(slots(1) >= slots(0) && slots(2) >= slots(0) && slots(3) >= slots(0));
    assert!(found[0]["efficiency"].as_f64().unwrap() > 0.95);
}

#[test]
fn a_recording_s_graph_is_drawn() {
    let folder = with_recording();
    let text = succeed(&folder, &["graph", "run.mcap", "--plot", "plots/graph.html"]);
    assert!(text.contains("20 s recorded in run.mcap") && text.contains("written to plots/graph.html"));
    let page = read(&folder, "plots/graph.html");
    check_page(&page);
    for part in [
        "Nodes and connections",
        "Schedule",
        "Supergraph",
        "Delays",
        "camera-&gt;estimator",
        "50 Hz",
        "1 component",
    ] {
        assert!(page.contains(part), "{part}");
    }
    // Every drawing has one for wide pages and one for narrow ones.
    assert_eq!(page.matches("class=\"plot wide\"").count(), page.matches("class=\"plot narrow\"").count());
    assert!(page.len() < 600_000, "{} bytes", page.len());

    succeed(&folder, &["graph", "run.mcap", "--plot", "graph.svg"]);
    check_page(&read(&folder, "graph.svg"));
    succeed(&folder, &["delays", "run.mcap", "--plot", "delays.html"]);
    check_page(&read(&folder, "delays.html"));
    succeed(&folder, &["delays", "run.mcap", "--plot", "delays.SVG"]);
    assert!(read(&folder, "delays.SVG").starts_with("<svg"));
}

#[test]
fn the_drawn_stretch_is_chosen() {
    let folder = with_delays();
    let boxes = |arguments: &[&str]| {
        let all = [&["graph", "graph.toml", "--plot", "graph.html"], arguments].concat();
        succeed(&folder, &all);
        let page = read(&folder, "graph.html");
        check_page(&page);
        page.matches("class=\"work\"").count()
    };
    // 4 nodes that are not the supervisor take 500 steps a second; half as long is drawn on narrow pages.
    let (short, long) = (boxes(&["--from", "1", "--for", "0.1"]), boxes(&["--from", "1", "--for", "0.2"]));
    assert!((70..90).contains(&short) && (140..170).contains(&long), "{short} {long}");
    refuse(
        &folder,
        &["graph", "graph.toml", "--plot", "a.html", "--from", "11"],
        &["--from 11 s", "last step"],
    );
    refuse(&folder, &["graph", "graph.toml", "--plot", "a.html", "--for", "200"], &["--for 200 s", "100 s"]);
    refuse(
        &folder,
        &["graph", "graph.toml", "--plot", "a.html", "--from", "-1"],
        &["--from", "at least zero"],
    );
    refuse(&folder, &["graph", "graph.toml", "--from", "1"], &["--plot"]);
}

#[test]
fn what_cannot_be_shown_is_told() {
    let folder = with_delays();
    refuse(&folder, &["delays", "missing.mcap"], &["missing.mcap"]);
    refuse(&folder, &["delays", "graph.toml"], &["graph.toml"]);
    refuse(&folder, &["graph", "nothing"], &["nothing", "pendulum"]);
    refuse(&folder, &["graph", "."], &["is a folder"]);
    let text = read(&folder, "graph.toml");
    fs::write(folder.path().join("wrong.toml"), text.replace("\"voltage\"", "\"volts\"")).unwrap();
    refuse(&folder, &["graph", "wrong.toml"], &["node `motor`", "`volts`", "`voltage`"]);

    succeed(&folder, &["sim", "graph.toml", "--duration", "1", "--out", "run.mcap"]);
    refuse(&folder, &["delays", "run.mcap", "--plot", "run.mcap/x.html"], &["run.mcap"]);
    refuse(&folder, &["delays", "run.mcap", "-o", "."], &["."]);

    // A file that lacks its end: what is there is shown, and that it is not all.
    let bytes = fs::read(folder.path().join("run.mcap")).unwrap();
    fs::write(folder.path().join("cut.mcap"), &bytes[..bytes.len() / 2]).unwrap();
    let cut = parallax(&folder, &["graph", "cut.mcap"]);
    assert!(cut.status.success() && String::from_utf8_lossy(&cut.stderr).contains("only the beginning"));

    fs::create_dir(folder.path().join("log")).unwrap();
    let manifest = "format = 1\ntitle = \"a\"\n[[signal]]\nname = \"u\"\nrole = \"command\"\nunit = \"N\"\n\
        file = \"log.csv\"\ntime = \"t\"\nvalue = \"u\"\n";
    fs::write(folder.path().join("log/recording.toml"), manifest).unwrap();
    fs::write(folder.path().join("log/log.csv"), "t,u\n0,1\n1,2\n").unwrap();
    succeed(&folder, &["import", "log", "--out", "log.mcap"]);
    refuse(&folder, &["delays", "log.mcap"], &["log.mcap", "imported log"]);
    refuse(&folder, &["graph", "log.mcap"], &["log.mcap", "imported log"]);
}

#[test]
fn kinds_lists_all_that_a_graph_may_name_and_says_what_one_takes_and_sends() {
    let folder = folder();
    let listed = succeed(&folder, &["kinds"]);
    let registry = parallax::nodes::registry();
    for name in registry.names().filter(|name| !name.starts_with("playback/")) {
        assert!(listed.lines().any(|line| line.split_whitespace().next() == Some(name)), "{name}\n{listed}");
    }
    let encoder = succeed(&folder, &["kinds", "pendulum/encoder"]);
    for said in ["world: pendulum/WorldState { angle, speed, stamp }", "angle_noise", "0.0015"] {
        assert!(encoder.contains(said), "{encoder}");
    }
    let all = json(&folder, &["kinds", "--json"]);
    assert_eq!(all.as_array().unwrap().len(), registry.names().count() + 1, "and those in Python");
    let motor = json(&folder, &["kinds", "pendulum/motor", "--json"]);
    assert_eq!(motor["inputs"][0]["leaves"], serde_json::json!(["voltage"]));
    assert_eq!(motor["parameters"][0], serde_json::json!({ "name": "rated", "value": 4.0 }));
    refuse(&folder, &["kinds", "pendulum/moter"], &["pendulum/moter", "did you mean `pendulum/motor`?"]);
}
