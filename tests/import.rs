//! `parallax import` as its users run it, from a log that somebody else wrote to one that is diagnosed.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod command;

use std::fmt::Write as _;
use std::fs;

use command::{Noise, ends, fail, json, on_a_terminal, succeed};
use tempfile::TempDir;

/// A mass on a rail: a force in N, a position in mm, times in ms, numbers as a German spreadsheet writes them.
fn with_bench() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let mut text = String::from("Zeit [ms];Kraft [N];Position [mm]\n");
    let (mut x, mut v, mut noise) = (0.0_f64, 0.0_f64, Noise(1));
    for k in 0..1500 {
        let t = f64::from(k) * 0.01;
        let force = 4.0 * (1.3 * t).sin() + 3.0 * (3.1 * t).cos();
        let row = format!("{};{force:.6};{:.4}", k * 10, 1e3 * x + 0.1 * noise.draw());
        let _ = writeln!(text, "{}", row.replace('.', ","));
        // Exact to the second order, so that the error is far below the noise.
        for _ in 0..10 {
            let acceleration = (force - 1.5 * v) / 2.0;
            x += 0.001 * (v + 0.0005 * acceleration);
            v += 0.001 * acceleration * (1.0 - 0.0005 * 0.75);
        }
    }
    fs::write(folder.path().join("bench.csv"), text).unwrap();
    let system = "format = 1\nname = \"cart\"\n[parameters]\nm = { value = 2.0, unit = \"kg\", calibrate = [0.5, 8.0] }\n\
        b = { value = 1.0, unit = \"N s/m\", calibrate = [0.0, 10.0] }\n[inputs]\nu = { signal = \"Kraft\" }\n[state]\n\
        q = { derivative = \"v\", initial = \"Position\" }\nv = { derivative = \"(u - b*v)/m\" }\n[outputs]\n\
        Position = { value = \"q\", unit = \"m\" }\n[joints]\ncart = { position = \"q\", velocity = \"v\", inertia = \"m\", drive = \"u\" }\n";
    fs::write(folder.path().join("system.toml"), system).unwrap();
    folder
}

#[test]
fn an_untidy_log_is_imported_and_diagnosed() {
    let folder = with_bench();
    let before = fs::read(folder.path().join("bench.csv")).unwrap();
    let shown = succeed(&folder, &["import", "bench.csv", "--list"]);
    for part in [
        "semicolons, decimal comma",
        "14.990 s at 100.00 Hz",
        "Kraft",
        "command",
        "Position",
        "mm",
        "measurement",
    ] {
        assert!(shown.contains(part), "no `{part}` in: {shown}");
    }
    let listed = json(&folder, &["import", "bench.csv", "--list", "--json"]);
    assert_eq!(listed[0]["groups"][0]["signals"][1]["suggested"], "measurement");
    // Where nobody can be asked, what to say is said, and nothing is written.
    fail(
        &folder,
        &["import", "bench.csv"],
        2,
        &["nobody says", "--command Kraft", "--measurement Position", "--yes"],
    );
    assert!(!folder.path().join("bench_log").exists());

    let answer = succeed(&folder, &["import", "bench.csv", "--yes", "--unit", "Position=m"]);
    assert!(answer.contains("3000 samples of 2 signals written to bench_log"), "{answer}");
    assert!(answer.contains("parallax diagnose --system system.toml bench_log"), "{answer}");
    assert_eq!(fs::read(folder.path().join("bench.csv")).unwrap(), before);
    let info = json(&folder, &["info", "bench_log", "--json"]);
    assert_eq!(
        (&info["signals"][1]["unit"], &info["signals"][1]["role"]),
        (&"m".into(), &"measurement".into())
    );
    assert_eq!(info["duration_s"], 14.99);
    // A mass with a friction that the system knows is found, and no cause beside it.
    let found =
        json(&folder, &["diagnose", "--system", "system.toml", "bench_log", "--json", "--out", "out"]);
    assert_eq!(found["gap"]["detected"], false, "{found}");
    let friction =
        &found["calibration"].as_array().unwrap().iter().find(|p| p["name"] == "b").unwrap()["value"];
    assert!((friction.as_f64().unwrap() - 1.5).abs() < 0.1, "{friction}");

    // What is there is not overwritten.
    fail(&folder, &["import", "bench.csv", "--yes"], 2, &["bench_log exists already", "--out"]);
    // As one file, and with other names.
    succeed(
        &folder,
        &["import", "bench.csv", "--command", "Kraft", "--rename", "Kraft=u", "--out", "made/one.mcap"],
    );
    let info = json(&folder, &["info", "made/one.mcap", "--json"]);
    assert_eq!((info["signals"].as_array().unwrap().len(), &info["signals"][0]["name"]), (1, &"u".into()));
}

#[test]
fn what_is_asked_of_import_and_cannot_be() {
    let folder = with_bench();
    let wrong = |arguments: &[&str], expected: &[&str]| {
        let arguments: Vec<&str> =
            ["import", "bench.csv", "--out", "x"].iter().chain(arguments).copied().collect();
        fail(&folder, &arguments, 2, expected);
        assert!(!folder.path().join("x").exists());
    };
    wrong(&["--command", "Kaft"], &["no signal `Kaft`; did you mean `Kraft`?", "Position"]);
    wrong(&["--command", "Kraft", "--measurement", "Kraft"], &["`Kraft` is a measurement and a command"]);
    wrong(&["--command", "Kraft", "--unit", "Kraft=m"], &["`Kraft` is in `N`", "mN"]);
    wrong(
        &["--command", "Kraft", "--unit", "Position=m"],
        &["`Position` is not among", "--measurement Position"],
    );
    wrong(&["--command", "Kraft", "--scale", "Kraft=zero"], &["--scale Kraft=zero"]);
    wrong(&["--yes", "--rows", "0:5"], &["--rows", "1:5000"]);
    wrong(&["--yes", "--rows", "9000:"], &["`Kraft` has no value in the rows"]);
    wrong(&["--yes", "--time", "clock"], &["no time `clock`", "Zeit [ms]"]);
    fail(&folder, &["import", "nowhere.csv", "--yes"], 2, &["nowhere.csv does not exist"]);
    fail(&folder, &["import", "bench_log", "bench.csv", "--yes"], 2, &["bench_log does not exist"]);
}

#[test]
fn a_person_is_asked() {
    let folder = tempfile::tempdir().unwrap();
    let rows: String = (0..50).map(|k| format!("{},{},{},{}\n", k * 20, k % 7, 2 * k, 24)).collect();
    fs::write(folder.path().join("bench.csv"), format!("t,motor,angle [deg],x\n{rows}")).unwrap();
    // The unit of the time (a wrong one first), commands, measurements by name, context, references, units, the folder.
    let answers = "hours\nms\nmotor\nangl\nangle\nx\n\nV\n\nnone\nmine\n";
    let (done, shown) = on_a_terminal(folder.path(), &["import", "bench.csv"], answers);
    assert!(done, "{shown}");
    for part in
        ["steps of 20", "a time is in s, ms, us or ns", "did you mean `angle`?", "to rad", "written to mine"]
    {
        assert!(shown.contains(part), "no `{part}` in: {shown}");
    }
    let info = json(&folder, &["info", "mine", "--json"]);
    let signals = info["signals"].as_array().unwrap();
    let told: Vec<_> = signals
        .iter()
        .map(|s| (s["name"].as_str().unwrap(), s["role"].as_str().unwrap(), s["unit"].as_str().unwrap()))
        .collect();
    assert_eq!(told, [("motor", "command", "V"), ("angle", "measurement", "rad"), ("x", "context", "")]);
    assert_eq!(info["duration_s"], 0.98);
    // Whoever goes away leaves nothing behind.
    let (done, _) = on_a_terminal(
        folder.path(),
        &["import", "bench.csv", "--time-unit", "ms", "--out", "other"],
        "motor\n\x04",
    );
    assert!(!done && !folder.path().join("other").exists());
}

#[test]
fn bags_and_several_files_are_imported() {
    let bag = concat!(env!("CARGO_MANIFEST_DIR"), "/runtime/tests/foreign/arm");
    let folder = tempfile::tempdir().unwrap();
    let (shown, _) = ends(&folder, 0, &["import", bag, "--list"]);
    assert!(shown.contains("/joint_states (sensor_msgs/msg/JointState): 50 rows"), "{shown}");
    let answer = json(
        &folder,
        &[
            "import",
            bag,
            "--command",
            "effort_cmd",
            "--measurement",
            "joint_states.shoulder.position,joint_states.elbow.position",
            "--unit",
            "joint_states.shoulder.position=rad",
            "--out",
            "arm",
            "--json",
        ],
    );
    assert_eq!(
        (&answer["signals"], &answer["samples"], &answer["origin_s"]),
        (&3.into(), &125.into(), &1.7e9.into())
    );
    assert_eq!(json(&folder, &["info", "arm", "--json"])["signals"][1]["unit"], "rad");

    // The files of one recording, with columns of the same names.
    for (name, scale) in [("command", 1), ("state", 10)] {
        let rows: String = (0..20).map(|k| format!("{}.{:02},{}\n", k / 100, k % 100, k * scale)).collect();
        fs::write(folder.path().join(format!("{name}.csv")), format!("t,elbow\n{rows}")).unwrap();
    }
    succeed(
        &folder,
        &[
            "import",
            "command.csv",
            "state.csv",
            "--command",
            "command.elbow",
            "--measurement",
            "state.elbow",
            "--out",
            "two",
        ],
    );
    let info = json(&folder, &["info", "two", "--json"]);
    assert_eq!(
        (&info["signals"][0]["name"], &info["signals"][1]["name"]),
        (&"command.elbow".into(), &"state.elbow".into())
    );
}
