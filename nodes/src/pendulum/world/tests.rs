use parallax_runtime::time::SECOND;
use proptest::prelude::*;

use super::*;

const MS: Nanos = SECOND / 1000;

/// The pendulum after commands, each sent at a time.
fn world(effect: HiddenEffect, commands: &[(Nanos, f64)]) -> World {
    let mut world = World::new(effect);
    commands.iter().for_each(|(sent, voltage)| world.0.command(*sent, Voltage { voltage: *voltage }));
    world
}

#[test]
fn a_small_free_swing_decays_as_the_linear_equation_says() {
    let (amplitude, start) = (0.01, PI + 0.01);
    let mut pendulum = Pendulum::new(HiddenEffect::None, start, 0.0);
    pendulum.advance(2 * SECOND);
    let decay = 0.5 * (VISCOUS + MOTOR_CONSTANT * MOTOR_CONSTANT / RESISTANCE) / INERTIA;
    let frequency = (WEIGHT / INERTIA - decay * decay).sqrt();
    let expected = amplitude
        * (-decay * 2.0).exp()
        * ((frequency * 2.0).cos() + decay / frequency * (frequency * 2.0).sin());
    assert!((pendulum.angle - PI - expected).abs() < 2e-6, "{} {expected}", pendulum.angle - PI);
}

#[test]
fn it_is_of_second_order_where_nothing_sticks() {
    let end = |step: f64| {
        let mut pendulum = Pendulum::new(HiddenEffect::None, 0.5, 1.0);
        pendulum.command = 2.0;
        (0..(1.0 / step).round() as usize).for_each(|_| pendulum.step(step));
        pendulum.angle
    };
    let (coarse, middle, fine) = (end(4e-3), end(2e-3), end(1e-3));
    let order = ((coarse - middle) / (middle - fine)).log2();
    assert!((order - 2.0).abs() < 0.1, "order {order}");
}

#[test]
fn a_delay_shifts_the_response() {
    let commands = [(0, 2.0), (100 * MS, -1.0), (200 * MS, 3.0)];
    let prompt = world(HiddenEffect::None, &commands);
    let late = world(HiddenEffect::Delay { delay: 0.025 }, &commands);
    let (prompt, late) = (prompt.0.at(300 * MS), late.0.at(325 * MS));
    assert!((prompt.angle - late.angle).abs() < 1e-9, "{} {}", prompt.angle, late.angle);
    assert!((prompt.speed - late.speed).abs() < 1e-7);
    assert!((prompt.angle - world(HiddenEffect::None, &commands).0.at(325 * MS).angle).abs() > 0.01);
}

#[test]
fn a_lag_reaches_63_percent_after_its_time_constant() {
    let mut pendulum = Pendulum::new(HiddenEffect::Lag { time_constant: 0.03 }, PI, 0.0);
    pendulum.command = 2.0;
    pendulum.advance(30 * MS);
    assert!((pendulum.lagged - 2.0 * (1.0 - (-1f64).exp())).abs() < 1e-9);
}

#[test]
fn dry_friction_holds_and_lets_go_where_it_should() {
    let force = 1e-3;
    let holds = force / (MOTOR_CONSTANT / RESISTANCE);
    let moved = |voltage: f64| {
        let mut pendulum = Pendulum::new(HiddenEffect::Coulomb { force }, PI, 0.0);
        pendulum.command = voltage;
        pendulum.advance(SECOND);
        pendulum.angle - PI
    };
    assert!(moved(0.99 * holds).abs() < 1e-12, "it sticks");
    assert!(moved(1.01 * holds) > 1e-4, "it lets go");
    // Sliding to rest from a swing, it ends within the zone that friction holds, and stays.
    let mut pendulum = Pendulum::new(HiddenEffect::Coulomb { force }, PI + 1.0, 0.0);
    pendulum.advance(20 * SECOND);
    let rest = pendulum.angle;
    assert_eq!(pendulum.speed, 0.0);
    assert!((WEIGHT * (rest - PI).sin()).abs() <= force);
    pendulum.advance(30 * SECOND);
    assert_eq!(pendulum.angle, rest);
}

#[test]
fn effects_on_the_voltage_change_it_as_their_formula_says() {
    let voltage = |effect, command| {
        let mut pendulum = Pendulum::new(effect, PI, 0.0);
        pendulum.command = command;
        pendulum.voltage(1e-4)
    };
    assert_eq!(voltage(HiddenEffect::None, -1.5), -1.5);
    assert_eq!(voltage(HiddenEffect::Offset { offset: 0.3 }, 1.0), 1.3);
    assert_eq!(voltage(HiddenEffect::Saturation { low: -1.8, high: 2.5 }, 3.0), 2.5);
    assert_eq!(voltage(HiddenEffect::Saturation { low: -1.8, high: 2.5 }, -3.0), -1.8);
    assert_eq!(voltage(HiddenEffect::Deadband { width: 0.25 }, 0.2), 0.0);
    assert_eq!(voltage(HiddenEffect::Deadband { width: 0.25 }, -1.0), -0.75);
    assert_eq!(World::new(HiddenEffect::Bias { bias: 0.05 }).0.at(0).mark(), PI + 0.05);
}

#[test]
fn it_begins_and_is_tapped_as_the_graph_says() {
    let parameters = r#"{"angle": 0.3, "speed": -1.0, "taps": [{"time": 0.25, "impulse": 4e-4}, {"time": 0.05, "impulse": -1e-4}]}"#;
    let context = |text: &str| NodeContext {
        name: "world".into(),
        rate: 200.0,
        seed: 1,
        parameters: serde_json::from_str(text).expect("a table"),
    };
    let settings = Settings::read(&context(parameters)).expect("settings");
    let world = World::new(HiddenEffect::None).begun(&settings);
    assert_eq!((world.0.at(0).angle, world.0.at(0).speed), (0.3, -1.0));
    for (tap, impulse) in [(50 * MS, -1e-4), (250 * MS, 4e-4)] {
        let (before, after) = (world.0.at(tap - 1), world.0.at(tap));
        assert!((after.speed - before.speed - impulse / INERTIA).abs() < 1e-6, "at {tap}");
        assert!((after.angle - before.angle).abs() < 1e-7);
    }
    // Whether it was looked at in between, or told something, makes no other tap of it.
    let mut told = world.clone();
    told.0.command(50 * MS, Voltage::default());
    told.0.command(260 * MS, Voltage::default());
    assert!((told.0.at(300 * MS).speed - world.0.at(300 * MS).speed).abs() < 1e-6);

    for (text, says) in [
        (r#"{"angel": 1.0}"#, "angel"),
        (r#"{"taps": [{"time": 0.0, "impulse": 1e-4}]}"#, "after the run's start"),
        (r#"{"taps": [{"time": 1.0}]}"#, "impulse"),
    ] {
        let error = Settings::read(&context(text)).expect_err("wrong").to_string();
        assert!(error.contains(says) && error.contains("world"), "{error}");
    }
}

proptest! {
    /// A command counts from its stamp, however late it is taken and however often the world was looked at before.
    #[test]
    fn wake_ups_do_not_matter(
        sort in 0usize..HiddenEffect::SORTS,
        seed in any::<u64>(),
        voltages in proptest::collection::vec(-4.0..4.0f64, 1..30),
        late in proptest::collection::vec(0i64..20, 30),
    ) {
        use parallax_runtime::random::{Purpose, stream};
        let effect = HiddenEffect::draw_sort(sort, &mut stream(seed, Purpose::Node, "test"));
        let commands: Vec<(Nanos, f64)> =
            voltages.iter().enumerate().map(|(tick, voltage)| (tick as Nanos * 10 * MS, *voltage)).collect();
        let prompt = world(effect, &commands);
        let mut hesitant = World::new(effect);
        for ((sent, voltage), late) in commands.iter().zip(&late) {
            let _ = hesitant.0.at(sent + late * MS);
            hesitant.0.command(*sent, Voltage { voltage: *voltage });
        }
        let end = commands.len() as Nanos * 10 * MS;
        let (a, b) = (prompt.0.at(end), hesitant.0.at(end));
        prop_assert_eq!((a.angle.to_bits(), a.speed.to_bits()), (b.angle.to_bits(), b.speed.to_bits()));
    }
}
