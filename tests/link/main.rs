//! A graph on several machines: network namespaces with cables between them, all but the first with a monotonic clock that is
//! thousands of seconds ahead (`unshare --time`), and the faults that a cable, a machine and a stranger can bring.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod cable;
#[path = "../command/mod.rs"]
mod command;
mod connections;

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::process::{Command, Stdio};
use std::time::Duration;

use cable::{AHEAD, Cable, MACHINES, Run, adds_up, graph, seen, seen_settings, settings, until_recorded};
use command::fail;
use parallax::runtime::launch::{Exit, RunReport};
use parallax::runtime::recording::{Fault, FaultKind, Recording};
use parallax::runtime::time::to_seconds;

#[test]
fn a_graph_on_two_machines_is_recorded_in_one_file_and_replays() {
    let cable = Cable::lay();
    let plant = cable.start("plant", &["--duration", "3"]);
    let desk = cable.start("desk", &["--duration", "3"]);
    let ((desk, code, errors), (plant, plant_code, plant_errors)) = (desk.report(), plant.report());
    assert_eq!((code, plant_code), (Some(0), Some(0)), "{errors}\n{plant_errors}");
    adds_up(&desk, &["estimator", "agent"]);
    adds_up(&plant, &["world", "camera", "motor"]);
    // Each machine knows of the other's nodes.
    for report in [&desk, &plant] {
        assert!(report.nodes.iter().all(|node| node.steps > 100 && node.exit == Exit::Clean), "{report:#?}");
        let link = report.link.as_ref().unwrap();
        assert_eq!((link.silences, &link.problem), (0, &None), "{link:?}");
        assert!(link.crossings.iter().all(|crossing| crossing.malformed == 0), "{link:?}");
    }
    let link = desk.link.unwrap();
    let camera = link.crossings.iter().find(|crossing| crossing.channel == "camera").unwrap();
    assert!(camera.received > 250, "{camera:?}");

    let path = cable.path("run.mcap");
    let recording = Recording::read(&path).unwrap();
    assert_eq!(recording.hosts["motor"], "plant");
    assert!(recording.nodes.iter().all(|track| track.steps.len() > 100), "a node is not recorded");
    // The clocks: what the kernel was told is the truth.
    let readings: Vec<_> = recording.clocks.iter().collect();
    assert!(readings.iter().any(|reading| reading.host == "plant" && reading.other == "desk"));
    assert!(readings.iter().filter(|reading| reading.host == "desk").count() > 2, "{readings:?}");
    for reading in readings {
        let truth = if reading.host == "desk" { AHEAD } else { -AHEAD } * 1_000_000_000;
        assert!((reading.offset - truth).abs() <= reading.bound, "{reading:?}");
        assert!(reading.skew.abs() <= reading.skew_bound, "{reading:?}");
        assert!(reading.ahead.abs() < 20_000_000 && reading.bound < 20_000_000, "{reading:?}");
    }
    for (from, to) in [("camera", "estimator"), ("agent", "motor")] {
        let bound = recording.clock_bound(from, to).expect("it crosses");
        let steps = &recording.node(to).unwrap().steps;
        let port = recording.graph.connections.iter().find(|c| c.from == from && c.to == to).unwrap().port();
        let consumed = steps.iter().flat_map(|step| &step.inputs).filter(|input| input.port == port);
        let sender = recording.node(from).unwrap();
        let mut seen = 0;
        for message in consumed.flat_map(|input| &input.consumed) {
            let Some(seq) = message.seq else { continue };
            seen += 1;
            assert!(message.sent <= message.received, "{from} -> {to}: {message:?}");
            // The receiver's statement of when it was sent agrees with the sender's to within what the clocks allow.
            let there = sender.message(seq).unwrap().sent;
            assert!(
                (message.sent - there).abs() < 20_000_000 + bound,
                "{from} -> {to}: {message:?}, {there}"
            );
        }
        assert!(seen > 50, "{from} -> {to}");
    }
    let replay = command::json(cable.folder.path(), &["replay", path.to_str().unwrap(), "--json"]);
    assert_eq!(replay["exact"], true, "{replay}");
    let info = command::succeed(cable.folder.path(), &["info", path.to_str().unwrap()]);
    assert!(
        info.contains("machine plant: camera, motor, world") && info.contains("clock of plant"),
        "{info}"
    );
}

#[test]
fn a_cable_that_is_out_for_a_second_and_garbage_on_the_port_cost_messages_that_are_counted() {
    let cable = Cable::lay();
    let plant = cable.start("plant", &["--duration", "7"]);
    let desk = cable.start("desk", &["--duration", "7"]);
    until_recorded(&cable.path("run.mcap"));
    // Somebody who has no business here. `nc` is not everywhere, and bash is.
    let garbage = "exec 3<>/dev/tcp/10.231.7.1/7447; head -c 100000 /dev/urandom >&3; sleep 0.3";
    let stranger = Command::new("ip")
        .args(["netns", "exec", &cable.names[1], "bash", "-c", garbage])
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    cable.set_link("down");
    std::thread::sleep(Duration::from_secs(1));
    cable.set_link("up");
    drop(stranger.wait_with_output());
    let ((desk, code, errors), (plant, plant_code, plant_errors)) = (desk.report(), plant.report());
    assert_eq!((code, plant_code), (Some(0), Some(0)), "{errors}\n{plant_errors}");
    assert!(
        errors.contains("machine plant has been silent") && errors.contains("is heard again"),
        "{errors}"
    );
    assert!(plant_errors.contains("machine desk has been silent"), "{plant_errors}");
    adds_up(&desk, &["estimator", "agent"]);
    adds_up(&plant, &["world", "camera", "motor"]);
    // The motor stood on the agent's safe output meanwhile, and went on with commands afterwards.
    let motor = plant.nodes.iter().find(|node| node.node == "motor").unwrap();
    assert!(motor.inputs[0].safe > 0, "{motor:?}");
    assert!(motor.inputs[0].consumed > 150, "{motor:?}");
    let lost = |report: &RunReport| report.nodes.iter().map(|node| node.inputs.clone()).collect::<Vec<_>>();
    let recording = Recording::read(cable.path("run.mcap")).unwrap();
    assert_eq!(recording.truncated, None, "{:?}", lost(&desk));
}

#[test]
fn a_machine_that_is_gone_ends_the_run_and_the_recording_is_kept() {
    let cable = Cable::lay();
    for machine in ["desk", "plant"] {
        cable.settings(machine, "gone = 1.0");
    }
    let mut plant = cable.start("plant", &["--duration", "60"]);
    let desk = cable.start("desk", &["--duration", "60"]);
    until_recorded(&cable.path("run.mcap"));
    // With the cable out, nothing can be said any more.
    cable.set_link("down");
    drop(plant.0.as_mut().unwrap().kill());
    let (desk, code, errors) = desk.report();
    assert_eq!(code, Some(3), "{errors}");
    assert!(errors.contains("error: machine plant: it has been silent for"), "{errors}");
    assert!(desk.nodes.iter().any(|node| node.node == "agent" && node.exit == Exit::Clean), "{desk:#?}");
    let recording = Recording::read(cable.path("run.mcap")).unwrap();
    assert!(recording.truncated.is_none() && recording.node("motor").unwrap().steps.len() > 10);
    assert!(to_seconds(recording.duration) < 50.0);
}

#[test]
fn a_link_that_is_killed_ends_the_run_on_both_machines() {
    let cable = Cable::lay();
    let plant = cable.start("plant", &["--duration", "60"]);
    let desk = cable.start("desk", &["--duration", "60"]);
    until_recorded(&cable.path("run.mcap"));
    let launcher = desk.0.as_ref().unwrap().id();
    let children = fs::read_to_string(format!("/proc/{launcher}/task/{launcher}/children")).unwrap();
    let is_link = |pid: &&str| {
        let line = fs::read_to_string(format!("/proc/{pid}/cmdline")).unwrap_or_default();
        line.contains("@link")
    };
    let link = children.split_whitespace().find(is_link).expect("the link is a process of its own");
    assert!(Command::new("kill").args(["-KILL", link]).status().unwrap().success());
    let ((_, code, errors), (_, plant_code, plant_errors)) = (desk.report(), plant.report());
    assert_eq!((code, plant_code), (Some(3), Some(3)), "{errors}\n{plant_errors}");
    assert!(errors.contains("the link to the other machines ended: process"), "{errors}");
    assert!(plant_errors.contains("machine desk: it has been silent"), "{plant_errors}");
}

/// A machine loses its power: nothing of it is left, and its clock begins anew.
fn cut(run: &mut Run) {
    let process = run.0.as_mut().unwrap();
    process.kill().unwrap();
    process.wait().unwrap();
    // Its nodes end by themselves: they have lost their launcher.
    std::thread::sleep(Duration::from_secs(2));
}

fn restarted(recording: &Recording, node: &str) -> bool {
    let of = |fault: &&Fault| fault.node == node && matches!(fault.kind, FaultKind::Restarted { .. });
    recording.faults.iter().find(of).is_some()
}

#[test]
fn a_machine_that_is_started_again_takes_part_again() {
    let cable = Cable::lay();
    for machine in ["desk", "plant"] {
        cable.settings(machine, "gone = 1.0\n        on_gone = \"continue\"");
    }
    // The plant keeps a copy of what its own nodes record.
    let copy = cable.path("plant.mcap");
    let arguments = ["--duration", "14", "--out", copy.to_str().unwrap()];
    let mut first = cable.start("plant", &arguments);
    let desk = cable.start("desk", &["--duration", "14"]);
    until_recorded(&cable.path("run.mcap"));
    cut(&mut first);
    let plant = cable.start_with_clock("plant", AHEAD + 777, &arguments);
    let ((desk, code, errors), (plant, plant_code, plant_errors)) = (desk.report(), plant.report());
    assert_eq!((code, plant_code), (Some(0), Some(0)), "{errors}\n{plant_errors}");
    for said in ["machine plant has been silent", "machine plant is gone", "machine plant was started again"]
    {
        assert!(errors.contains(said), "{said}: {errors}");
    }
    assert_eq!(desk.link.as_ref().unwrap().rejoined, 1);
    adds_up(&desk, &["estimator", "agent"]);
    adds_up(&plant, &["world", "camera", "motor"]);

    let path = cable.path("run.mcap");
    let recording = Recording::read(&path).unwrap();
    for name in ["world", "camera", "motor"] {
        assert!(restarted(&recording, name), "{name}: {:?}", recording.faults);
        let steps = &recording.node(name).unwrap().steps;
        // One clock and one count before and after: no number is used twice, and the grid is kept.
        assert!(steps.windows(2).all(|pair| pair[0].seq < pair[1].seq && pair[0].start < pair[1].start));
        let (gap, before) =
            steps.windows(2).map(|pair| (pair[1].due - pair[0].due, pair[0].due)).max().unwrap();
        assert!(gap > 2_000_000_000, "{name}: {gap}");
        let after = steps.iter().filter(|step| step.due > before);
        assert!(after.clone().count() > 50, "{name}");
        let mut late: Vec<_> = after.map(|step| step.start - step.due).collect();
        late.sort_unstable();
        assert!(late[late.len() / 2] < 100_000_000, "{name}: {late:?}");
    }
    // What the plant had recorded and not yet sent when it lost its power is missing: of the steps about that moment the schedule cannot
    // be told whole, and what they gave can.
    let replay =
        Command::new(env!("CARGO_BIN_EXE_parallax")).arg("replay").arg(&path).arg("--json").output().unwrap();
    let replay: serde_json::Value = serde_json::from_slice(&replay.stdout).unwrap();
    for node in replay["nodes"].as_array().unwrap() {
        assert_eq!(node["differing"], 0, "{node}");
    }
    // The copy has it: what the plant's nodes did until then, and nothing of others.
    let copies = ["plant.mcap", "plant.1.mcap"].map(|name| cable.path(name));
    let kept = copies.each_ref().map(|copy| Recording::read(copy).unwrap());
    assert!(kept.iter().all(|kept| kept.node("agent").unwrap().steps.is_empty()));
    let whole = cable.path("whole.mcap");
    let files = [&path, &copies[0], &copies[1], &whole].map(|path| path.to_str().unwrap());
    command::succeed(cable.folder.path(), &["join", files[0], files[1], files[2], "--out", files[3]]);
    let whole = Recording::read(&whole).unwrap();
    for name in ["world", "camera", "motor"] {
        let of = |recording: &Recording| recording.node(name).unwrap().steps.clone();
        let union: std::collections::BTreeMap<u64, _> =
            [&recording, &kept[0], &kept[1]].into_iter().flat_map(of).map(|step| (step.seq, step)).collect();
        assert_eq!(of(&whole), union.into_values().collect::<Vec<_>>(), "{name}");
        assert!(of(&whole).len() >= of(&recording).len());
        // Without a hole up to the crash.
        let crash = kept[0].node(name).unwrap().steps.last().unwrap().seq;
        assert_eq!(of(&whole)[crash as usize].seq, crash, "{name}");
    }
}

#[test]
fn the_machine_that_records_goes_on_in_another_file() {
    let cable = Cable::lay();
    for machine in ["desk", "plant"] {
        cable.settings(machine, "gone = 1.0\n        on_gone = \"continue\"");
    }
    let plant = cable.start("plant", &["--duration", "14"]);
    let mut first = cable.start("desk", &["--duration", "14"]);
    until_recorded(&cable.path("run.mcap"));
    cut(&mut first);
    let desk = cable.start("desk", &["--duration", "14"]);
    let ((desk, code, errors), (plant, plant_code, plant_errors)) = (desk.report(), plant.report());
    assert_eq!((code, plant_code), (Some(0), Some(0)), "{errors}\n{plant_errors}");
    adds_up(&desk, &["estimator", "agent"]);
    adds_up(&plant, &["world", "camera", "motor"]);
    let parts = ["run.mcap", "run.1.mcap"].map(|name| Recording::read(cable.path(name)).unwrap());
    let [before, after] = parts.each_ref().map(|part| &part.node("agent").unwrap().steps);
    assert!(before.len() > 10 && after.len() > 10, "{} {}", before.len(), after.len());
    assert!(after[0].seq > before[before.len() - 1].seq && after[0].start > before[before.len() - 1].start);
    assert!(restarted(&parts[1], "agent") && !restarted(&parts[1], "motor"), "{:?}", parts[1].faults);
}

#[test]
fn pictures_cross_between_three_machines() {
    let cable = Cable::between(3);
    fs::write(cable.path("graph.toml"), seen()).unwrap();
    let settings =
        settings("").replace("[host.plant]", "[host.plant]\n[host.arm]\naddress = \"10.231.7.3:7447\"");
    let motor = "[node.motor]\n        host = \"plant\"";
    assert!(settings.contains(motor));
    let settings = seen_settings(settings).replace(motor, "[node.motor]\nhost = \"arm\"");
    for machine in MACHINES {
        fs::write(cable.path(machine).join("launch.toml"), &settings).unwrap();
    }
    let runs = MACHINES.map(|machine| cable.start(machine, &["--duration", "4"]));
    let reports = runs.map(Run::report);
    for (report, code, errors) in &reports {
        assert_eq!(*code, Some(0), "{errors}");
        assert!(report.nodes.iter().all(|node| node.steps > 50 && node.exit == Exit::Clean), "{report:#?}");
        // Every machine knows the clocks of both others.
        assert_eq!(report.link.as_ref().unwrap().clocks.len(), 2, "{:?}", report.link);
    }
    let [(desk, ..), (plant, ..), (arm, ..)] = &reports;
    adds_up(desk, &["mark", "camera", "estimator", "agent"]);
    adds_up(plant, &["world", "film"]);
    adds_up(arm, &["motor"]);

    let path = cable.path("run.mcap");
    let recording = Recording::read(&path).unwrap();
    assert_eq!(["film", "motor", "agent"].map(|node| &*recording.hosts[node]), ["plant", "arm", "desk"]);
    let film = recording.node("film").unwrap();
    assert!(
        film.messages.len() > 100 && film.messages.iter().all(|message| message.data.len() == 120 * 90 * 3)
    );
    // Those that the detector saw on the desk are those that the film took on the plant: seen again, they give the same.
    let seen = recording.node("mark").unwrap();
    assert!(seen.steps.len() > 100 && seen.messages.iter().any(|message| message.payload[0] != 0.0));
    let replay = command::json(cable.folder.path(), &["replay", path.to_str().unwrap(), "--json"]);
    assert_eq!(replay["exact"], true, "{replay}");
}

#[test]
fn whoever_has_another_secret_stays_outside() {
    let cable = Cable::lay();
    cable.secret("plant", "another word, well guessed");
    for machine in ["desk", "plant"] {
        cable.settings(machine, "patience = 3.0");
    }
    let plant = cable.start("plant", &["--duration", "2"]);
    let desk = cable.start("desk", &["--duration", "2"]);
    for output in [desk.output(), plant.output()] {
        let errors = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(3), "{errors}");
        assert!(errors.contains("which has not answered") && errors.contains("secret the same"), "{errors}");
    }
    assert!(!cable.path("run.mcap").exists(), "a run that never began left a recording");
}

#[test]
fn machines_that_run_different_graphs_say_so() {
    let cable = Cable::lay();
    let plant = cable.start("plant", &["--duration", "2", "--node", "agent.rate=25"]);
    let desk = cable.start("desk", &["--duration", "2"]);
    let (desk, plant) = (desk.output(), plant.output());
    let both = [&desk, &plant].map(|output| String::from_utf8_lossy(&output.stderr).into_owned());
    assert_eq!((desk.status.code(), plant.status.code()), (Some(3), Some(3)), "{both:?}");
    assert!(both.iter().any(|errors| errors.contains("runs another graph")), "{both:?}");
}

#[test]
fn settings_that_cannot_be_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let write = |text: &str| fs::write(folder.path().join("launch.toml"), text).unwrap();
    fs::write(folder.path().join("graph.toml"), graph()).unwrap();
    let secret = folder.path().join("link.secret");
    fs::write(&secret, "a word that nobody guesses").unwrap();
    fs::set_permissions(&secret, fs::Permissions::from_mode(0o600)).unwrap();
    let run = |more: &[&str]| {
        let all = [&["run", "graph.toml", "--duration", "1"], more].concat();
        all.into_iter().map(str::to_owned).collect::<Vec<String>>()
    };
    let refuse = |more: &[&str], expected: &[&str]| {
        let arguments = run(more);
        fail(folder.path(), &arguments.iter().map(String::as_str).collect::<Vec<_>>(), 2, expected);
    };
    write(&settings(""));
    refuse(&[], &["launch.toml", "--host NAME, one of desk, plant"]);
    refuse(&["--host", "dsk"], &["there is no machine `dsk`", "did you mean `desk`?"]);
    refuse(&["--host", "desk"], &["this machine records", "--out"]);
    write(&settings("").replace("recorder = \"desk\"", ""));
    refuse(&["--host", "plant", "--out", "x.mcap"], &["no machine records"]);
    write(&settings("gone = 0.1"));
    refuse(&["--host", "desk", "--out", "x.mcap"], &["[link] gone", "at least 0.2 s"]);
    write(&settings("").replace("10.231.7.1:7447", "0.0.0.0:7447"));
    refuse(&["--host", "desk", "--out", "x.mcap"], &["[host.desk] address", "every network"]);
    write(&settings("").replace("address = \"10.231.7.1:7447\"", ""));
    refuse(&["--host", "desk", "--out", "x.mcap"], &["address", "has to wait for the other"]);
    write(&settings("").replace("host = \"desk\"\n        safe", "safe"));
    refuse(&["--host", "desk", "--out", "x.mcap"], &["[node.agent] host", "is missing"]);
    fs::set_permissions(&secret, fs::Permissions::from_mode(0o644)).unwrap();
    write(&settings(""));
    refuse(&["--host", "desk", "--out", "x.mcap"], &["[link] secret", "chmod 600"]);
    fs::write(&secret, "short").unwrap();
    fs::set_permissions(&secret, fs::Permissions::from_mode(0o600)).unwrap();
    refuse(&["--host", "desk", "--out", "x.mcap"], &["at least 16"]);
}
