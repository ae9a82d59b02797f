//! The five machines: what their files say of them, and their equations of motion, derived here by hand.

/// The most degrees of freedom, extra states or inputs of any machine here.
pub(crate) const N: usize = 3;

/// A nominal parameter; the real one lies off it by up to `spread` (relative).
pub(crate) struct Parameter {
    pub(crate) name: &'static str,
    pub(crate) unit: &'static str,
    pub(crate) value: f64,
    pub(crate) bounds: Option<(f64, f64)>,
    pub(crate) spread: f64,
}

/// A command, with its rest value and the amplitude of typical excitation.
pub(crate) struct Input {
    pub(crate) key: &'static str,
    pub(crate) signal: &'static str,
    pub(crate) unit: &'static str,
    pub(crate) rest: f64,
    pub(crate) amplitude: f64,
}

/// A sensor of a position (`dof` below the number of positions) or of an extra state (from there on).
pub(crate) struct Output {
    pub(crate) name: &'static str,
    pub(crate) unit: &'static str,
    pub(crate) of: usize,
    pub(crate) noise: (f64, f64),
}

/// What a mass at the joint does.
pub(crate) enum Payload {
    Lever(f64),
    Parameter(usize),
    None,
}

/// A joint with the sizes that magnitudes are drawn from.
pub(crate) struct Joint {
    pub(crate) name: &'static str,
    pub(crate) force: f64,
    pub(crate) speed: f64,
    pub(crate) range: f64,
    pub(crate) inertia: f64,
    pub(crate) rotates: bool,
    pub(crate) tilts: bool,
    pub(crate) solid: bool,
    pub(crate) geared: bool,
    pub(crate) payload: Payload,
}

/// Positions, speeds and first-order states.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct State {
    pub(crate) q: [f64; N],
    pub(crate) v: [f64; N],
    pub(crate) x: [f64; N],
}

/// Generalised forces, the mass matrix, and the derivatives of the first-order states.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Forces {
    pub(crate) drive: [f64; N],
    pub(crate) load: [f64; N],
    pub(crate) other: [f64; N],
    pub(crate) mass: [[f64; N]; N],
    pub(crate) dx: [f64; N],
}

/// How the commands come about.
#[derive(Clone, Copy, PartialEq)]
pub(crate) enum Control {
    Open,
    Axis,
    Hover,
}

/// A machine.
pub(crate) struct System {
    pub(crate) name: &'static str,
    pub(crate) parameters: &'static [Parameter],
    pub(crate) inputs: &'static [Input],
    pub(crate) outputs: &'static [Output],
    pub(crate) joints: &'static [Joint],
    pub(crate) extras: usize,
    pub(crate) command_rate: f64,
    pub(crate) sample_rate: f64,
    pub(crate) control: Control,
    /// Whether its laws of motion are linear: what filters its command filters its reading.
    pub(crate) linear: bool,
    pub(crate) equations: &'static str,
    pub(crate) absorbed: &'static [&'static str],
    pub(crate) body: fn(&[f64], &State, &[f64; N], &[f64; N]) -> Forces,
}

const fn fixed(name: &'static str, unit: &'static str, value: f64) -> Parameter {
    Parameter { name, unit, value, bounds: None, spread: 0.0 }
}

const fn fitted(
    name: &'static str,
    unit: &'static str,
    value: f64,
    low: f64,
    high: f64,
    spread: f64,
) -> Parameter {
    Parameter { name, unit, value, bounds: Some((low, high)), spread }
}

const fn input(
    key: &'static str,
    signal: &'static str,
    unit: &'static str,
    rest: f64,
    amplitude: f64,
) -> Input {
    Input { key, signal, unit, rest, amplitude }
}

const fn output(name: &'static str, unit: &'static str, of: usize, low: f64, high: f64) -> Output {
    Output { name, unit, of, noise: (low, high) }
}

fn single(drive: f64, load: f64, other: f64, mass: f64) -> Forces {
    let mut f = Forces::default();
    (f.drive[0], f.load[0], f.other[0], f.mass[0][0]) = (drive, load, other, mass);
    f
}

fn pendulum(p: &[f64], s: &State, tilt: &[f64; N], u: &[f64; N]) -> Forces {
    single(p[3] * u[0], -p[1] * (s.q[0] + tilt[0]).sin(), -p[2] * s.v[0], p[0])
}

fn servo(p: &[f64], s: &State, tilt: &[f64; N], u: &[f64; N]) -> Forces {
    let duty = (p[3] * (u[0] - s.q[0])).clamp(-1.0, 1.0);
    let motor = p[0] * (7.4 * duty - p[0] * s.v[0]) / p[1];
    single(motor, -0.3 * 9.806_65 * 0.12 * (s.q[0] + tilt[0]).sin(), -p[2] * s.v[0], 0.3 * 0.12 * 0.12 + p[4])
}

fn axis(p: &[f64], s: &State, _: &[f64; N], u: &[f64; N]) -> Forces {
    single(u[0], 0.0, -p[1] * s.v[0] - p[2], p[0])
}

fn arm(p: &[f64], s: &State, _: &[f64; N], u: &[f64; N]) -> Forces {
    let (m1, m2, l1, l2, rotor, g) = (p[0], p[1], 0.35, 0.3, 0.01, 9.806_65);
    let (s2, c2) = s.q[1].sin_cos();
    let [v1, v2, _] = s.v;
    let far = m2 * l2 * l2;
    let cross = m2 * l1 * l2;
    let mut f = Forces::default();
    f.mass[0][0] = (m1 + m2) * l1 * l1 + far + 2.0 * cross * c2 + rotor;
    f.mass[0][1] = far + cross * c2;
    f.mass[1][0] = f.mass[0][1];
    f.mass[1][1] = far + rotor;
    f.load[1] = -m2 * g * l2 * (s.q[0] + s.q[1]).sin();
    f.load[0] = -(m1 + m2) * g * l1 * s.q[0].sin() + f.load[1];
    f.other[0] = cross * s2 * (2.0 * v1 * v2 + v2 * v2) - p[2] * v1;
    f.other[1] = -cross * s2 * v1 * v1 - p[3] * v2;
    (f.drive[0], f.drive[1]) = (u[0], u[1]);
    f
}

/// Rotor constants of the Crazyflie 2.0 (Förster, System Identification of the Crazyflie 2.0, 2015).
fn quadrotor(p: &[f64], s: &State, _: &[f64; N], u: &[f64; N]) -> Forces {
    let [roll, pitch, omega] = s.x;
    let thrust = 1.43e-4 * omega + 2.89e-7 * u[0];
    let (a, b, c) = (2.13e-11, 1.03e-6, 5.49e-4 - thrust / 4.0);
    let effective = (-b + (b * b - 4.0 * a * c).max(0.0).sqrt()) / (2.0 * a);
    let speed = 4.0 * (0.041 * effective + 380.83);
    let up = [pitch.sin() * roll.cos(), -roll.sin(), pitch.cos() * roll.cos()];
    let along: f64 = (0..3).map(|i| up[i] * s.v[i]).sum();
    let mut f = Forces::default();
    for i in 0..3 {
        f.mass[i][i] = p[0];
        f.drive[i] = thrust * up[i];
        f.other[i] = -speed * (p[2] * s.v[i] + (p[3] - p[2]) * up[i] * along);
    }
    f.load[2] = -p[0] * 9.81;
    f.dx = [(u[1] - roll) / p[1], (u[2] - pitch) / p[1], -15.47 * omega + u[0]];
    f
}

const fn joint(name: &'static str, force: f64, speed: f64, range: f64, inertia: f64) -> Joint {
    Joint {
        name,
        force,
        speed,
        range,
        inertia,
        rotates: true,
        tilts: false,
        solid: true,
        geared: true,
        payload: Payload::None,
    }
}

static PENDULUM: System = System {
    name: "motor-pendulum",
    parameters: &[
        fixed("J", "kg m^2", 0.02),
        fitted("mgl", "N m", 0.5, 0.4, 0.6, 0.07),
        fitted("b", "N m s/rad", 0.03, 0.0, 0.2, 0.3),
        fitted("K", "N m/V", 0.5, 0.4, 0.6, 0.05),
    ],
    inputs: &[input("u", "voltage", "V", 0.0, 0.7)],
    outputs: &[output("angle", "rad", 0, 0.001, 0.004)],
    joints: &[Joint { tilts: true, payload: Payload::Lever(0.25), ..joint("shaft", 0.4, 5.0, 1.2, 0.02) }],
    extras: 0,
    command_rate: 50.0,
    sample_rate: 100.0,
    control: Control::Open,
    linear: false,
    equations: r#"[inputs]
u = { signal = "voltage" }
[state]
q = { derivative = "w", initial = "angle" }
w = { derivative = "(K*u - mgl*sin(q) - b*w)/J" }
[outputs]
angle = { value = "q", unit = "rad"@angle@ }
[joints]
shaft = { position = "q", velocity = "w", inertia = "J", drive = "K*u", load = "-mgl*sin(q)", lever = "0.25" }
"#,
    absorbed: &["viscous@joint:shaft", "gain@input:u"],
    body: pendulum,
};

static SERVO: System = System {
    name: "position-servo",
    parameters: &[
        fitted("kt", "N m/A", 0.6, 0.4, 0.9, 0.08),
        fixed("R", "ohm", 4.8),
        fitted("b", "N m s/rad", 0.01, 0.0, 0.1, 0.4),
        fitted("stiff", "1/rad", 2.5, 1.0, 5.0, 0.1),
        fitted("armature", "kg m^2", 0.0016, 0.0005, 0.005, 0.2),
    ],
    inputs: &[input("goal", "goal", "rad", 0.0, 0.6)],
    outputs: &[output("position", "rad", 0, 0.0006, 0.0025)],
    joints: &[Joint { tilts: true, payload: Payload::Lever(0.12), ..joint("shaft", 0.3, 4.0, 0.7, 0.006) }],
    extras: 0,
    command_rate: 50.0,
    sample_rate: 100.0,
    control: Control::Open,
    linear: false,
    equations: r#"[inputs]
goal = { signal = "goal" }
[let]
J = "0.3*0.12^2 + armature"
duty = "clamp(stiff*(goal - q), -1, 1)"
motor = "kt*(7.4*duty - kt*v)/R"
[state]
q = { derivative = "v", initial = "position" }
v = { derivative = "(motor - 0.3*9.80665*0.12*sin(q) - b*v)/J" }
[outputs]
position = { value = "q", unit = "rad"@position@ }
[joints]
shaft = { position = "q", velocity = "v", inertia = "J", drive = "motor", load = "-0.3*9.80665*0.12*sin(q)", lever = "0.12" }
"#,
    // Another resistance is another motor constant, another friction and another stiffness of the loop.
    absorbed: &["viscous@joint:shaft", "inertia@joint:shaft", "parameter@parameter:R"],
    body: servo,
};

static ARM: System = System {
    name: "two-link-arm",
    parameters: &[
        fitted("m1", "kg", 1.0, 0.7, 1.3, 0.08),
        fixed("m2", "kg", 0.6),
        fixed("b1", "N m s/rad", 0.15),
        fixed("b2", "N m s/rad", 0.08),
    ],
    inputs: &[input("tau1", "torque1", "N m", 0.0, 2.0), input("tau2", "torque2", "N m", 0.0, 0.7)],
    outputs: &[output("angle1", "rad", 0, 0.0008, 0.003), output("angle2", "rad", 1, 0.0008, 0.003)],
    joints: &[
        Joint { solid: false, ..joint("shoulder", 2.0, 2.5, 0.6, 0.3) },
        Joint { solid: false, payload: Payload::Parameter(1), ..joint("elbow", 0.7, 3.5, 0.7, 0.06) },
    ],
    extras: 0,
    command_rate: 50.0,
    sample_rate: 100.0,
    control: Control::Open,
    linear: false,
    equations: r#"[inputs]
tau1 = { signal = "torque1" }
tau2 = { signal = "torque2" }
[let]
far = "m2*0.3^2"
cross = "m2*0.35*0.3"
load2 = "-m2*9.80665*0.3*sin(q1 + q2)"
load1 = "-(m1 + m2)*9.80665*0.35*sin(q1) + load2"
M11 = "(m1 + m2)*0.35^2 + far + 2*cross*cos(q2) + 0.01"
M12 = "far + cross*cos(q2)"
M22 = "far + 0.01"
f1 = "tau1 + load1 + cross*sin(q2)*(2*v1*v2 + v2^2) - b1*v1"
f2 = "tau2 + load2 - cross*sin(q2)*v1^2 - b2*v2"
det = "M11*M22 - M12^2"
[state]
q1 = { derivative = "v1", initial = "angle1" }
v1 = { derivative = "(M22*f1 - M12*f2)/det" }
q2 = { derivative = "v2", initial = "angle2" }
v2 = { derivative = "(M11*f2 - M12*f1)/det" }
[outputs]
angle1 = { value = "q1", unit = "rad"@angle1@ }
angle2 = { value = "q2", unit = "rad"@angle2@ }
[joints]
shoulder = { position = "q1", velocity = "v1", force = "f1", drive = "tau1", load = "load1" }
elbow = { position = "q2", velocity = "v2", force = "f2", drive = "tau2", load = "load2", payload = { m2 = "m2 + mass" } }
"#,
    absorbed: &[],
    body: arm,
};

static QUADROTOR: System = System {
    name: "quadrotor",
    parameters: &[
        fitted("m", "kg", 0.03, 0.025, 0.036, 0.05),
        fitted("tau", "s", 0.12, 0.05, 0.3, 0.15),
        fitted("kxy", "kg/rad", 9.2e-7, 1e-7, 5e-6, 0.3),
        fixed("kz", "kg/rad", 1.03e-6),
    ],
    inputs: &[
        input("pwm", "pwm", "1", 30_870.0, 1500.0),
        input("roll_ref", "roll_ref", "rad", 0.0, 0.08),
        input("pitch_ref", "pitch_ref", "rad", 0.0, 0.08),
    ],
    outputs: &[
        output("x", "m", 0, 0.0005, 0.002),
        output("y", "m", 1, 0.0005, 0.002),
        output("z", "m", 2, 0.0005, 0.002),
        output("roll", "rad", 3, 0.001, 0.004),
        output("pitch", "rad", 4, 0.001, 0.004),
    ],
    joints: &[
        Joint { rotates: false, geared: false, solid: false, ..joint("x", 0.02, 0.4, 0.5, 0.03) },
        Joint { rotates: false, geared: false, solid: false, ..joint("y", 0.02, 0.4, 0.5, 0.03) },
        Joint { rotates: false, geared: false, solid: false, ..joint("z", 0.02, 0.4, 0.5, 0.03) },
    ],
    extras: 3,
    command_rate: 50.0,
    sample_rate: 100.0,
    control: Control::Hover,
    linear: false,
    equations: r#"[inputs]
pwm = { signal = "pwm" }
roll_ref = { signal = "roll_ref" }
pitch_ref = { signal = "pitch_ref" }
[let]
thrust = "1.43e-4*omega + 2.89e-7*pwm"
effective = "(sqrt(max(1.03e-6^2 - 4*2.13e-11*(5.49e-4 - thrust/4), 0)) - 1.03e-6)/(2*2.13e-11)"
speed = "4*(0.041*effective + 380.83)"
ux = "sin(theta)*cos(phi)"
uy = "-sin(phi)"
uz = "cos(theta)*cos(phi)"
along = "ux*vx + uy*vy + uz*vz"
[state]
px = { derivative = "vx", initial = "x" }
py = { derivative = "vy", initial = "y" }
pz = { derivative = "vz", initial = "z" }
vx = { derivative = "(thrust*ux - speed*(kxy*vx + (kz - kxy)*ux*along))/m" }
vy = { derivative = "(thrust*uy - speed*(kxy*vy + (kz - kxy)*uy*along))/m" }
vz = { derivative = "(thrust*uz - m*9.81 - speed*(kxy*vz + (kz - kxy)*uz*along))/m" }
phi = { derivative = "(roll_ref - phi)/tau", initial = "roll" }
theta = { derivative = "(pitch_ref - theta)/tau", initial = "pitch" }
omega = { derivative = "-15.47*omega + pwm", initial = 1995.5 }
[outputs]
x = { value = "px", unit = "m"@x@ }
y = { value = "py", unit = "m"@y@ }
z = { value = "pz", unit = "m"@z@ }
roll = { value = "phi", unit = "rad"@roll@ }
pitch = { value = "theta", unit = "rad"@pitch@ }
[joints]
x = { position = "px", velocity = "vx", inertia = "m", drive = "thrust*ux" }
y = { position = "py", velocity = "vy", inertia = "m", drive = "thrust*uy" }
z = { position = "pz", velocity = "vz", inertia = "m", drive = "thrust*uz", load = "-m*9.81" }
"#,
    absorbed: &[
        "gain@input:pwm",
        // Far from zero a deadband is an offset, and near hover an offset is another mass.
        "offset@input:pwm",
        "deadband@input:pwm",
        // Along the thrust the drag of so slow a flight is next to nothing.
        "parameter@parameter:kz",
        // Nothing pulls the machine to a place: a shift is another initial state, a slow drift another speed.
        "bias@output:x",
        "bias@output:y",
        "bias@output:z",
        "drift@output:x",
        "drift@output:y",
        "drift@output:z",
    ],
    body: quadrotor,
};

static AXIS: System = System {
    name: "linear-axis",
    parameters: &[
        fitted("M", "kg", 95.0, 60.0, 140.0, 0.08),
        fitted("Fv", "N s/m", 200.0, 0.0, 600.0, 0.2),
        fitted("bias", "N", 0.0, -20.0, 20.0, 5.0),
    ],
    inputs: &[input("u", "force", "N", 0.0, 0.15)],
    outputs: &[output("position", "m", 0, 0.000_02, 0.0002)],
    joints: &[Joint { rotates: false, ..joint("axis", 60.0, 0.25, 0.12, 95.0) }],
    extras: 0,
    command_rate: 200.0,
    sample_rate: 200.0,
    control: Control::Axis,
    linear: true,
    equations: r#"[inputs]
u = { signal = "force" }
[state]
q = { derivative = "v", initial = "position" }
v = { derivative = "(u - Fv*v - bias)/M" }
[outputs]
position = { value = "q", unit = "m"@position@ }
[joints]
axis = { position = "q", velocity = "v", inertia = "M", drive = "u" }
"#,
    absorbed: &[
        "viscous@joint:axis",
        "gain@input:u",
        "inertia@joint:axis",
        "offset@input:u",
        "constant_force@joint:axis",
        "wind@joint:axis",
        "scale@output:position",
        // Nothing pulls the axis to a place: a shift is another initial state, a drift another speed under another bias.
        "bias@output:position",
        "drift@output:position",
    ],
    body: axis,
};

/// All machines, in the order of `systems()`.
pub(crate) static ALL: [&System; 5] = [&PENDULUM, &SERVO, &ARM, &QUADROTOR, &AXIS];
