//! `parallax demo` as somebody sees it for the first time.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod command;

use command::{on_a_terminal, succeed};

const FEW: [&str; 5] = ["demo", "--seed", "7", "--duration", "4"];

#[test]
fn a_terminal_shows_the_stages_while_they_go_on() {
    let folder = tempfile::tempdir().unwrap();
    let (done, shown) = on_a_terminal(folder.path(), &FEW, "");
    assert!(done, "{shown}");
    // What goes on in a stage, its end, and how to go on.
    for part in [
        "world 200, camera ",
        " Hz",
        "nominal model",
        "\u{2713}",
        " was hidden",
        "report.html",
        "Next, to see",
    ] {
        assert!(shown.contains(part), "no `{part}` in: {shown}");
    }
    assert!(folder.path().join("out/demo/report.html").exists());
    let next: Vec<&str> = shown.split("Next, to see").nth(1).unwrap().lines().skip(1).collect();
    assert_eq!(next.iter().filter(|line| line.starts_with("  ")).count(), 3, "{next:?}");
}

#[test]
fn elsewhere_it_prints_a_line_for_each() {
    let folder = tempfile::tempdir().unwrap();
    let shown = succeed(&folder, &FEW);
    assert!(!shown.contains(['\u{1b}', '\u{2713}', '\r']), "{shown:?}");
    let stages =
        ["1. 5 processes for 4 s", "2. Running", "3. Looking", "4. Running the world again", "Next, to see"];
    let places: Vec<usize> =
        stages.iter().map(|stage| shown.find(stage).unwrap_or_else(|| panic!("{stage}: {shown}"))).collect();
    assert!(places.is_sorted(), "{shown}");
}
