//! What holds for single connections between machines.

use std::fs;
use std::process::Command;

use parallax::runtime::launch::RunReport;
use parallax::runtime::recording::{LossReason, Recording};

use crate::cable::{Cable, MACHINES, adds_up, graph, seen, seen_settings, settings};
use crate::command;

/// The settings of two machines, with these of connections.
fn with_connections(cable: &Cable, connections: &str, nodes: impl Fn(String) -> String) {
    for machine in &MACHINES[..2] {
        let text = nodes(settings("")) + connections;
        fs::write(cable.path(machine).join("launch.toml"), text).unwrap();
    }
}

#[test]
fn a_connection_crosses_as_it_says() {
    let cable = Cable::lay();
    let connections = "
        [connection.\"motor->estimator\"]
        every = 3
        priority = \"low\"
        silence = 1.0
        [connection.\"agent->motor\"]
        priority = \"high\"
        [connection.\"world->camera\"]
        crosses = false
    ";
    with_connections(&cable, connections, |text| text);
    let plant = cable.start("plant", &["--duration", "3"]);
    let desk = cable.start("desk", &["--duration", "3"]);
    let ((desk, code, errors), (plant, plant_code, plant_errors)) = (desk.report(), plant.report());
    assert_eq!((code, plant_code), (Some(0), Some(0)), "{errors}\n{plant_errors}");
    adds_up(&desk, &["estimator", "agent"]);
    adds_up(&plant, &["world", "camera", "motor"]);
    // Two of three messages stay on the plant, for those who receive them elsewhere and for nobody else.
    let input = |report: &RunReport, node: &str| {
        let node = report.nodes.iter().find(|report| report.node == node).unwrap();
        node.inputs.iter().find(|input| input.from == "motor").unwrap().clone()
    };
    let (far, near) = (input(&desk, "estimator"), input(&plant, "world"));
    assert!(far.sent > 100 && near.held_back == 0 && near.consumed > far.consumed, "{far:?} {near:?}");
    assert!(far.held_back.abs_diff(far.sent * 2 / 3) <= 6, "{far:?}");
    let crossing = |report: &RunReport, channel: &str| {
        let link = report.link.clone().unwrap();
        link.crossings.into_iter().find(|crossing| crossing.channel == channel).unwrap()
    };
    let (here, there) = (crossing(&plant, "motor"), crossing(&desk, "motor"));
    assert!(here.held_back.abs_diff(2 * here.sent) <= 6, "{here:?}");
    assert_eq!((there.received + there.lost, there.malformed), (here.sent, 0), "{here:?} {there:?}");
    assert_eq!(crossing(&desk, "agent").held_back, 0);

    let path = cable.path("run.mcap");
    let recording = Recording::read(&path).unwrap();
    let estimator = recording.node("estimator").unwrap();
    let seen = estimator.steps.iter().flat_map(|step| &step.inputs).filter(|input| input.port == "motor");
    let mut seen: Vec<u64> =
        seen.flat_map(|input| &input.consumed).filter_map(|message| message.seq).collect();
    seen.dedup();
    assert!(seen.len() > 30 && seen.iter().all(|seq| seq % 3 == 0), "{seen:?}");
    let held_back = recording.losses.iter().filter(|loss| loss.reason == LossReason::HeldBack);
    assert!(held_back.clone().count() > 60);
    assert!(held_back.clone().all(|loss| loss.seq % 3 != 0 && loss.to == "estimator"));
    let replay = command::json(cable.folder.path(), &["replay", path.to_str().unwrap(), "--json"]);
    assert_eq!(replay["exact"], true, "{replay}");
}

/// Of the commands that a slow cable has to carry beside pictures, the share that was lost on the way; and of the pictures.
fn lost_beside_pictures(commands: &str, pictures: &str) -> (f64, f64) {
    let cable = Cable::lay();
    fs::write(cable.path("graph.toml"), seen()).unwrap();
    let connections = format!(
        "
        [connection.\"motor->estimator\"]
        priority = \"{commands}\"
        [connection.\"film->mark\"]
        priority = \"{pictures}\"
        "
    );
    with_connections(&cable, &connections, |text| {
        seen_settings(text).replace("recorder = \"desk\"", "silence = 4.0")
    });
    // 50 pictures a second of 32 kB are 13 Mbit/s.
    let slow =
        ["qdisc", "add", "dev", "to0", "root", "tbf", "rate", "4mbit", "burst", "16kb", "latency", "50ms"];
    let tc = Command::new("ip").args(["netns", "exec", &cable.names[1], "tc"]).args(slow).output().unwrap();
    assert!(tc.status.success(), "{}", String::from_utf8_lossy(&tc.stderr));
    let plant = cable.start("plant", &["--duration", "6"]);
    let desk = cable.start_unrecorded("desk", &["--duration", "6"]);
    let ((desk, code, errors), (_, _, plant_errors)) = (desk.report(), plant.report());
    assert_eq!(code, Some(0), "{errors}\n{plant_errors}");
    adds_up(&desk, &["mark", "camera", "estimator", "agent"]);
    let lost = |node: &str, from: &str| {
        let node = desk.nodes.iter().find(|report| report.node == node).unwrap();
        let input = node.inputs.iter().find(|input| input.from == from).unwrap();
        let on_the_way = input.lost.iter().find(|(reason, _)| *reason == LossReason::Transport);
        on_the_way.map_or(0.0, |(_, count)| *count as f64) / input.sent as f64
    };
    (lost("estimator", "motor"), lost("mark", "film"))
}

#[test]
fn on_a_slow_cable_commands_go_before_pictures() {
    let (commands, pictures) = lost_beside_pictures("high", "low");
    println!("commands first: {commands:.3} of the commands lost, {pictures:.3} of the pictures");
    assert!(pictures > 0.3, "the cable is too slow for them: {pictures}");
    assert!(commands < 0.1 && commands < pictures / 4.0, "{commands}, {pictures}");
}

#[test]
fn settings_of_connections_that_cannot_be_are_named() {
    let cable = Cable::lay();
    fs::write(cable.path("graph.toml"), graph()).unwrap();
    let refuse = |connections: &str, expected: &[&str]| {
        with_connections(&cable, connections, |text| text);
        let launch = cable.path("desk").join("launch.toml");
        let arguments = [
            "run",
            "graph.toml",
            "--duration",
            "1",
            "--launch",
            launch.to_str().unwrap(),
            "--host",
            "desk",
            "--out",
            "x.mcap",
        ];
        command::fail(cable.folder.path(), &arguments, 2, expected);
    };
    refuse(
        "[connection.\"motor->estimatr\"]\nevery = 2\n",
        &["motor->estimatr", "did you mean `motor->estimator`?"],
    );
    refuse("[connection.\"motor->estimator\"]\nevery = 0\n", &["motor->estimator", "every", "0 cannot be"]);
    refuse("[connection.\"camera->estimator\"]\nevery = 2\n", &["every", "is blocking"]);
    refuse(
        "[connection.\"world->camera\"]\nevery = 2\n",
        &["has no effect", "both ends are on machine plant"],
    );
    refuse("[connection.\"agent->motor\"]\ncrosses = false\n", &["it may not", "desk and plant"]);
    refuse("[connection.\"agent->motor\"]\nsilence = 0.01\n", &["silence", "at least 0.2 s"]);
    refuse("[connection.\"agent->motor\"]\nsilence = 60.0\n", &["silence", "longer than `gone`"]);
    refuse("[connection.\"agent->motor\"]\npriority = \"urgent\"\n", &["launch.toml", "urgent", "line"]);
    refuse("[connection.\"agent->motor\"]\nrate = 3\n", &["launch.toml", "rate", "line"]);
    // Without machines they are of no use.
    let alone = "[connection.\"agent->motor\"]\nevery = 2\n";
    fs::write(cable.path("alone.toml"), alone).unwrap();
    let arguments = ["run", "graph.toml", "--duration", "1", "--launch", "alone.toml"];
    command::fail(cable.folder.path(), &arguments, 2, &["agent->motor", "without machines"]);
}

#[test]
fn machines_that_differ_in_a_connection_say_so() {
    let cable = Cable::lay();
    let own = settings("") + "[connection.\"agent->motor\"]\npriority = \"high\"\n";
    fs::write(cable.path("desk").join("launch.toml"), own).unwrap();
    let plant = cable.start("plant", &["--duration", "2"]);
    let desk = cable.start("desk", &["--duration", "2"]);
    let both = [desk, plant].map(|run| String::from_utf8_lossy(&run.output().stderr).into_owned());
    assert!(both.iter().any(|errors| errors.contains("agent: one of 1, priority high")), "{both:?}");
}
