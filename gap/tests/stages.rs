//! Two stages that move by themselves: one whose command is clipped, and one that a spring pulls back so weakly that windows, whose
//! first states are free, hardly show it. Integrated here by a Runge–Kutta method of its own, with random numbers of its own.

use parallax_gap::diagnosis::{Options, diagnose};
use parallax_gap::report::Report;
use parallax_model::system::System;
use parallax_runtime::recording::log::{Log, Role, Signal};

const SYSTEM: &str = r#"
format = 1
name = "stages"

[parameters]
m = { value = 1.1, unit = "kg", calibrate = [0.5, 2.0] }
b = { value = 0.8, unit = "N s/m" }

[inputs]
fx = { signal = "ux" }
fy = { signal = "uy" }

[state]
qx = { derivative = "vx", initial = "x" }
vx = { derivative = "(fx - b*vx)/m" }
qy = { derivative = "vy", initial = "y" }
vy = { derivative = "(fy - b*vy)/m" }

[outputs]
x = { value = "qx", unit = "m", noise = 5e-4 }
y = { value = "qy", unit = "m", noise = 5e-4 }

[joints]
jx = { position = "qx", velocity = "vx", inertia = "m", drive = "fx" }
jy = { position = "qy", velocity = "vy", inertia = "m", drive = "fy" }
"#;

const SAMPLES: usize = 2000;
const PERIOD: f64 = 0.01;
const STEPS: usize = 10;
const NOISE: f64 = 5e-4;
/// What the command of the first stage is clipped to (N), and what pulls the second one back (N/m).
const CLIPPED: f64 = 1.1;
const STIFFNESS: f64 = 0.008;

/// Knuth's linear congruential generator of 64 bits, of which the upper ones are random.
struct Random(u64);

impl Random {
    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// Nearly normal: the sum of twelve.
    fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.uniform()).sum::<f64>() - 6.0
    }

    /// Steps that last for 0.2 to 0.8 s.
    fn commands(&mut self) -> Vec<f64> {
        let (mut out, mut left, mut force) = (Vec::new(), 0, 0.0);
        while out.len() < SAMPLES {
            if left == 0 {
                force = 1.6 * (2.0 * self.uniform() - 1.0);
                left = 20 + (60.0 * self.uniform()) as usize;
            }
            out.push(force);
            left -= 1;
        }
        out
    }
}

/// One step of the classical Runge–Kutta method: position and velocity of a mass of 1 kg.
fn step((q, v): (f64, f64), force: f64, stiffness: f64) -> (f64, f64) {
    let h = PERIOD / STEPS as f64;
    let rate = |q: f64, v: f64| (v, force - 0.8 * v - stiffness * q);
    let a = rate(q, v);
    let b = rate(q + 0.5 * h * a.0, v + 0.5 * h * a.1);
    let c = rate(q + 0.5 * h * b.0, v + 0.5 * h * b.1);
    let d = rate(q + h * c.0, v + h * c.1);
    let mean = |a: f64, b: f64, c: f64, d: f64| (a + 2.0 * b + 2.0 * c + d) / 6.0;
    (q + h * mean(a.0, b.0, c.0, d.0), v + h * mean(a.1, b.1, c.1, d.1))
}

/// The same commands in every recording; the noise is of its own.
fn record(seed: u64) -> Log {
    let (mut of_commands, mut of_noise) = (Random(7), Random(seed));
    let (first, second) = (of_commands.commands(), of_commands.commands());
    let (mut x, mut y) = ((0.0, 0.0), (0.0, 0.0));
    let (mut seen_x, mut seen_y) = (Vec::new(), Vec::new());
    for (fx, fy) in first.iter().zip(&second) {
        seen_x.push(x.0 + NOISE * of_noise.normal());
        seen_y.push(y.0 + NOISE * of_noise.normal());
        for _ in 0..STEPS {
            x = step(x, fx.clamp(-CLIPPED, CLIPPED), 0.0);
            y = step(y, *fy, STIFFNESS);
        }
    }
    let stamps: Vec<i64> = (0..SAMPLES as i64).map(|k| k * 10_000_000).collect();
    let signals = vec![
        Signal::new("ux", Role::Command, "N", stamps.clone(), first),
        Signal::new("uy", Role::Command, "N", stamps.clone(), second),
        Signal::new("x", Role::Measurement, "m", stamps.clone(), seen_x),
        Signal::new("y", Role::Measurement, "m", stamps, seen_y),
    ];
    Log { title: "stages".into(), signals, ..Log::default() }
}

fn diagnosed(log: &Log) -> Report {
    let system = System::parse(SYSTEM, "stages.toml").expect("the system is valid");
    diagnose(&system, log, &Options::default(), &|_, _| ()).expect("it can be diagnosed").report
}

/// Of the error over the horizon the spring makes a fiftieth; it is there in every drawing of the noise.
#[test]
fn a_weak_spring_of_one_stage_beside_a_clipped_command_of_the_other() {
    for seed in [505, 507, 508] {
        let report = diagnosed(&record(seed));
        let found: Vec<String> =
            report.which[0].effects.iter().map(|e| format!("{}@{}", e.name, e.place)).collect();
        assert_eq!(found, ["saturation@input:fx", "spring@joint:jy"], "{seed}: {}", report.summary);
    }
}
