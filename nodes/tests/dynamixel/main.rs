//! The servo driver against emulated servos on a pseudo-terminal: the good days and the bad ones.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod emulator;

use std::f64::consts::TAU;
use std::path::Path;
use std::time::Duration;

use emulator::{Emulator, Trouble};
use parallax_nodes::dynamixel::table::{self, Mode};
use parallax_nodes::dynamixel::{Bus, BusError, Parameters, Refusal, Servo, State};
use parallax_nodes::registry;
use parallax_runtime::node::{Consumed, InputWindow, Node, NodeContext, Step};
use serde_json::{Value, json};

/// Long enough for a loaded machine; only tests that wait for it in vain make it short.
const PATIENT: Duration = Duration::from_millis(900);

fn bus(emulator: &Emulator, timeout: Duration) -> Bus {
    Bus::open(&emulator.path, 1_000_000, timeout).unwrap()
}

fn parameters(emulator: &Emulator, mode: Mode) -> Parameters {
    Parameters {
        port: emulator.path.clone(),
        baud: 1_000_000,
        id: 1,
        mode,
        timeout: 0.9,
        patience: 3,
        watchdog: 0.0,
        max_current: None,
    }
}

/// One step of the node with this command.
fn step(servo: &mut Servo, tick: u64, goal: f64, torque: f64) -> Result<State, String> {
    let mut window = InputWindow::new("command", 2, 1);
    window.clear(0);
    window.push(Consumed { seq: Some(tick), sent: 1, received: 1 }, &[goal, torque]);
    let time = tick as i64 * 1_000_000;
    servo.step(&Step::new(tick, time, time, &[window])).map_err(|error| error.to_string())
}

#[test]
fn a_servo_is_found_read_and_written() {
    let emulator = Emulator::new(&[1, 7]);
    let mut bus = bus(&emulator, PATIENT);
    assert_eq!(bus.ping(7).unwrap(), (1200, 46));
    let mut position = [0; 4];
    bus.read(1, 132, &mut position).unwrap();
    assert_eq!(i32::from_le_bytes(position), 2048);
    bus.write(1, table::GOAL_POSITION, &1000_i32.to_le_bytes()).unwrap();
    assert_eq!(emulator.line().servos[0].long(116), 1000);
    // Values that look like a packet's header are stuffed on the way.
    let tricky = [0xff, 0xff, 0xfd, 0x00, 0xff, 0xff, 0xfd];
    emulator.line().servos[0].put(200, &tricky);
    let mut got = [0; 7];
    bus.read(1, 200, &mut got).unwrap();
    assert_eq!(got, tricky);
    assert!(matches!(bus.ping(253), Err(BusError::Question(_))));
    // A reboot clears what the hardware has reported.
    emulator.line().servos[0].put(70, &[4]);
    assert!(bus.read(1, 132, &mut position).unwrap().alert);
    bus.reboot(1).unwrap();
    assert!(!bus.read(1, 132, &mut position).unwrap().alert);
}

#[test]
fn several_servos_at_once() {
    let emulator = Emulator::new(&[3, 5, 9]);
    let mut bus = bus(&emulator, PATIENT);
    for (index, position) in [100_i32, 2000, 4000].into_iter().enumerate() {
        emulator.line().servos[index].put(132, &position.to_le_bytes());
    }
    let mut data = [0; 12];
    bus.sync_read(&[9, 3, 5], 132, &mut data).unwrap();
    let number = |part: &[u8]| i32::from_le_bytes(part.try_into().unwrap());
    let positions: Vec<i32> = data.chunks(4).map(number).collect();
    assert_eq!(positions, [4000, 100, 2000], "in the order asked for");
    bus.sync_write(table::GOAL_POSITION, &[(3, 11_i32.to_le_bytes()), (9, 99_i32.to_le_bytes())]).unwrap();
    // Nobody answers a sync write; the next answer comes after it was carried out.
    bus.ping(3).unwrap();
    let goals: Vec<i32> = emulator.line().servos.iter().map(|servo| servo.long(116)).collect();
    assert_eq!(goals, [11, 0, 99]);
    // One of them is not there.
    drop(bus);
    let mut bus = self::bus(&emulator, Duration::from_millis(150));
    let error = bus.sync_read(&[4, 3], 132, &mut data[..8]).unwrap_err();
    assert!(matches!(error, BusError::Silent { id: 4, .. }), "{error}");
    assert!(matches!(bus.sync_read(&[3, 5], 132, &mut data[..7]), Err(BusError::Question(_))));
}

#[test]
fn refusals_are_told_in_words() {
    let emulator = Emulator::new(&[1]);
    let mut bus = bus(&emulator, PATIENT);
    let mut refused = |address: u16, data: &[u8]| match bus.write(1, address, data) {
        Err(BusError::Refused { reason, .. }) => reason,
        other => panic!("{other:?}"),
    };
    assert_eq!(refused(table::OPERATING_MODE, &[77]), Refusal::Range);
    assert_eq!(refused(132, &[0; 4]), Refusal::Access);
    assert_eq!(refused(table::GOAL_POSITION, &[1, 2]), Refusal::Length);
    assert_eq!(refused(table::GOAL_CURRENT, &5000_i16.to_le_bytes()), Refusal::Limit);
    bus.write(1, table::TORQUE_ENABLE, &[1]).unwrap();
    let error = bus.write(1, table::OPERATING_MODE, &[0]).unwrap_err().to_string();
    assert!(error.contains("servo 1") && error.contains("address 11"), "{error}");
    assert!(error.contains("torque is on"), "{error}");
}

#[test]
fn a_bad_line_gives_an_error_and_the_next_question_its_answer() {
    let emulator = Emulator::new(&[1]);
    let mut bus = bus(&emulator, Duration::from_millis(150));
    let troubles = [
        (Trouble::Silence, "did not answer within 150.0 ms"),
        (Trouble::Flip, "damaged"),
        (Trouble::Half, "did not answer"),
        (Trouble::Stranger, "another servo answered"),
        (Trouble::Longer, "4 bytes instead of 3"),
    ];
    for (trouble, expected) in troubles {
        emulator.trouble(trouble);
        // A loaded machine may take longer than this bus waits: it is asked again.
        let named = (0..20).any(|_| {
            let error = bus.ping(1).unwrap_err().to_string();
            assert!(error.contains("servo 1"), "{trouble:?}: {error}");
            error.contains(expected)
        });
        assert!(named, "{trouble:?}");
        emulator.trouble(Trouble::None);
        assert!((0..20).any(|_| bus.ping(1).is_ok()), "after {trouble:?}");
    }
    assert!(bus.damaged() > 0);
    // Garbage in front and pieces are no trouble at all.
    emulator.trouble(Trouble::Noise);
    assert!((0..20).any(|_| bus.ping(1).is_ok()));
    // An answer that comes too late is not taken for that to the next question.
    emulator.trouble(Trouble::Late(Duration::from_millis(300)));
    assert!(matches!(bus.ping(1), Err(BusError::Silent { .. })));
    std::thread::sleep(Duration::from_millis(300));
    let mut position = [0; 4];
    assert!((0..20).any(|_| bus.read(1, 132, &mut position).is_ok()));
    assert_eq!(i32::from_le_bytes(position), 2048);
}

#[test]
fn ports_that_cannot_be_used_are_named() {
    let missing = Bus::open(Path::new("/dev/no-such-port"), 57_600, PATIENT).unwrap_err().to_string();
    assert!(missing.contains("/dev/no-such-port") && missing.contains("dialout"), "{missing}");
    let file = tempfile::NamedTempFile::new().unwrap();
    assert!(matches!(Bus::open(file.path(), 57_600, PATIENT), Err(BusError::Open { .. })), "no terminal");
    let mut emulator = Emulator::new(&[1]);
    let mut bus = bus(&emulator, PATIENT);
    bus.ping(1).unwrap();
    emulator.unplug();
    let error = bus.ping(1).unwrap_err();
    assert!(matches!(error, BusError::Port { .. } | BusError::Silent { .. }), "{error}");
}

#[test]
fn the_node_reads_writes_and_leaves_torque_off() {
    let emulator = Emulator::new(&[1]);
    let mut servo = Servo::open(&parameters(&emulator, Mode::Position)).unwrap();
    let state = step(&mut servo, 1, 0.0, 0.0).unwrap();
    assert_eq!((state.position, state.torque, state.errors, state.stamp), (0.0, 0.0, 0.0, 0.001));
    let goals = |emulator: &Emulator| {
        let line = emulator.line();
        line.servos[0].written.iter().filter(|(address, _)| *address == table::GOAL_POSITION).count()
    };
    assert_eq!(goals(&emulator), 0);

    step(&mut servo, 2, TAU / 8.0, 1.0).unwrap();
    let state = step(&mut servo, 3, TAU / 8.0, 1.0).unwrap();
    assert!((state.position - TAU / 8.0).abs() < 1e-9 && state.torque == 1.0, "{state:?}");
    let order: Vec<u16> = emulator.line().servos[0].written.iter().map(|(address, _)| *address).collect();
    let on = order.iter().rposition(|address| *address == table::TORQUE_ENABLE).unwrap();
    assert!(order[..on].contains(&table::GOAL_POSITION), "the goal before the torque: {order:?}");

    // What is no number switches the motor off.
    let state = step(&mut servo, 4, f64::NAN, 1.0).unwrap();
    assert_eq!((state.torque, emulator.line().servos[0].table[64]), (0.0, 0));
    step(&mut servo, 5, 0.1, 1.0).unwrap();
    assert_eq!(emulator.line().servos[0].table[64], 1);
    drop(servo);
    assert_eq!(emulator.line().servos[0].table[64], 0, "the end of the node switches the motor off");
}

#[test]
fn current_and_pwm_are_written_in_their_modes() {
    for (mode, goal, address, expected) in [(Mode::Current, -0.35, 102, -350), (Mode::Pwm, 0.5, 100, 443)] {
        let emulator = Emulator::new(&[1]);
        let parameters = Parameters { max_current: Some(0.4), ..parameters(&emulator, mode) };
        let mut servo = Servo::open(&parameters).unwrap();
        assert_eq!(emulator.line().servos[0].word(38), 400);
        step(&mut servo, 1, goal, 1.0).unwrap();
        assert_eq!(emulator.line().servos[0].word(address), expected);
        assert_eq!(emulator.line().servos[0].table[11], mode.number());
        if mode == Mode::Current {
            // Beyond the limit the servo refuses: the step counts it.
            assert_eq!(step(&mut servo, 2, 9.0, 1.0).unwrap().errors, 1.0);
        }
    }
}

#[test]
fn a_node_bears_a_few_failures_and_then_says_why() {
    let emulator = Emulator::new(&[1]);
    let parameters = Parameters { timeout: 0.3, ..parameters(&emulator, Mode::Position) };
    let mut servo = Servo::open(&parameters).unwrap();
    let before = step(&mut servo, 1, 0.0, 0.0).unwrap();
    emulator.trouble(Trouble::Silence);
    let during = step(&mut servo, 2, 1.0, 1.0).unwrap();
    assert_eq!((during.errors, during.stamp), (1.0, before.stamp), "what is old keeps its stamp");
    assert_eq!(during.torque, 0.0);
    emulator.trouble(Trouble::None);
    let after = step(&mut servo, 3, 1.0, 1.0).unwrap();
    assert_eq!((after.errors, after.torque), (1.0, 1.0), "the count stays, the row is broken");
    emulator.trouble(Trouble::Silence);
    let error = (4..9).find_map(|tick| step(&mut servo, tick, 0.0, 0.0).err()).unwrap();
    assert!(error.contains("servo 1 did not answer") && error.contains("3 questions in a row"), "{error}");
}

#[test]
fn a_hardware_fault_is_told() {
    let emulator = Emulator::new(&[1]);
    let mut servo = Servo::open(&Parameters { patience: 1, ..parameters(&emulator, Mode::Current) }).unwrap();
    emulator.line().servos[0].put(70, &[0x20]);
    let error = step(&mut servo, 1, 9.0, 1.0).unwrap_err();
    assert!(error.contains("overloaded"), "{error}");
}

#[test]
fn after_the_watchdog_goals_are_taken_again() {
    let emulator = Emulator::new(&[1]);
    let parameters = Parameters { watchdog: 2.0, ..parameters(&emulator, Mode::Position) };
    let mut servo = Servo::open(&parameters).unwrap();
    assert_eq!(emulator.line().servos[0].table[98], 100);
    step(&mut servo, 1, 0.5, 1.0).unwrap();
    emulator.line().servos[0].put(98, &[255]);
    assert_eq!(step(&mut servo, 2, 1.0, 1.0).unwrap().errors, 0.0);
    let line = emulator.line();
    assert_eq!(line.servos[0].table[98], 100, "it watches again");
    assert_eq!(line.servos[0].long(116), 2048 + (4096.0 / TAU).round() as i32);
}

#[test]
fn parameters_that_do_no_good_are_refused_and_one_line_swaps_the_servo() {
    let emulator = Emulator::new(&[1]);
    let registry = registry();
    let of = |extra: Value| {
        let mut all = json!({ "port": emulator.path, "id": 1, "mode": "position", "timeout": 0.9 });
        all.as_object_mut().unwrap().extend(extra.as_object().unwrap().clone());
        all.as_object().unwrap().clone()
    };
    let build = |kind: &str, extra: Value, rate: f64| {
        let context = NodeContext { name: "servo".into(), rate, seed: 0, parameters: of(extra) };
        registry.get(kind).unwrap().build(&context).map(drop).map_err(|error| error.to_string())
    };
    build("servo/dynamixel", json!({}), 100.0).unwrap();
    for (extra, rate, expected) in [
        (json!({ "mode": "torque" }), 100.0, "torque"),
        (json!({ "timeout": 5.0 }), 100.0, "timeout"),
        (json!({ "watchdog": 0.02 }), 60.0, "two steps"),
        (json!({ "max_current": 0.0 }), 100.0, "max_current"),
        (json!({ "speed": 0.0 }), 100.0, "speed"),
        (json!({ "id": 2, "timeout": 0.03 }), 100.0, "servo 2 did not answer"),
        (json!({ "port": "/dev/nothing" }), 100.0, "/dev/nothing"),
    ] {
        let error = build("servo/dynamixel", extra, rate).unwrap_err();
        assert!(error.contains("servo") && error.contains(expected), "{error}");
    }
    // The same inputs, the same output, and the parameters of one do not disturb the other.
    let (real, simulated) =
        (registry.get("servo/dynamixel").unwrap(), registry.get("servo/simulated").unwrap());
    assert_eq!((simulated.inputs(), simulated.output()), (real.inputs(), real.output()));
    build("servo/simulated", json!({}), 200.0).unwrap();
    assert!(build("servo/simulated", json!({ "inertia": 0.0 }), 200.0).unwrap_err().contains("inertia"));
}

#[test]
fn the_simulated_servo_goes_where_it_is_told() {
    let registry = registry();
    let kind = registry.get("servo/simulated").unwrap();
    let run = |mode: &str, goal: f64, torque: f64, ticks: u64| {
        let Value::Object(parameters) = json!({ "mode": mode }) else { panic!("an object") };
        let context = NodeContext { name: "servo".into(), rate: 200.0, seed: 0, parameters };
        let mut node = kind.build(&context).unwrap();
        let mut output = vec![0.0; kind.output().leaves.len()];
        for tick in 0..ticks {
            let mut window = InputWindow::new("command", 2, 1);
            window.clear(0);
            window.push(Consumed { seq: Some(tick), sent: 1, received: 1 }, &[goal, torque]);
            let time = tick as i64 * 5_000_000;
            node.step_into(&Step::new(tick, time, time, &[window]), &mut output).unwrap();
        }
        output
    };
    assert!((run("position", 1.0, 1.0, 600)[0] - 1.0).abs() < 0.01);
    assert_eq!(run("position", 1.0, 0.0, 50)[..3], [0.0; 3], "without torque nothing moves");
    assert_eq!(run("position", f64::NAN, 1.0, 50)[..4], [0.0; 4]);
    // The data sheet: 103 turns a minute at 5 V without a load.
    let speed = run("pwm", 1.0, 1.0, 600)[1] * 60.0 / TAU;
    assert!((98.0..108.0).contains(&speed), "{speed} turns a minute");
    assert!((run("current", 5.0, 1.0, 3)[2] - 1.47).abs() < 1e-12, "the current is limited");
}
