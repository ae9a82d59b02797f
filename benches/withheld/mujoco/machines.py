"""The machines: what their files say of them, and MuJoCo's bodies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Parameter:
    """A number of the nominal `system.toml`; the real one lies off it by up to `spread`, relatively."""

    value: float
    unit: str
    spread: float = 0.0
    bounds: tuple[float, float] | None = None


@dataclass(frozen=True)
class Joint:
    """A joint, with the sizes from which magnitudes are drawn: N or N m, m/s or rad/s, m or rad, kg or kg m²."""

    force: float
    speed: float
    range: float
    inertia: float
    lever: float = 0.0
    """Where a payload hangs, m from the shaft; 0: none can."""
    tilts: bool = False
    bends: bool = False


@dataclass(frozen=True)
class Machine:
    """A machine: MuJoCo's model of it by its real parameters, and what its file says."""

    name: str
    parameters: dict[str, Parameter]
    inputs: dict[str, tuple[str, str, float]]
    """Key: signal, unit, amplitude of an excitation."""
    outputs: dict[str, tuple[str, float, float]]
    """Name: unit, least and most noise; one for each joint, in order."""
    joints: dict[str, Joint]
    body: Callable[[dict[str, float], float], str]
    """The world body by the real parameters and the mass of a payload."""
    equations: str
    absorbed: frozenset[str]
    """What lies in the span of the calibrated parameters, or does nothing that could be seen."""


def rod(mass: float, centre: float, inertia: float) -> str:
    """A rod that hangs along −z, with its inertia about its centre."""
    return f'<inertial pos="0 0 {-centre!r}" mass="{mass!r}" diaginertia="{inertia!r} {inertia!r} {0.01 * inertia!r}"/>'


def about_shaft(weight: float, inertia: float) -> str:
    """A rod of 0.8 kg by its weight times lever, N m, and its inertia about the shaft, kg m²."""
    centre = weight / (0.8 * 9.81)
    return rod(0.8, centre, inertia - 0.8 * centre**2)


def payload(mass: float, lever: float) -> str:
    """A small ball at the end of a rod."""
    if mass == 0.0:
        return ""
    return f'<body pos="0 0 {-lever!r}"><inertial pos="0 0 0" mass="{mass!r}" diaginertia="1e-7 1e-7 1e-7"/></body>'


def pendulum(p: dict[str, float], ball: float) -> str:
    """A rod on a shaft; its centre follows from its weight, its inertia about the shaft is J."""
    hinge = f'<joint name="shaft" type="hinge" axis="0 -1 0" damping="{p["b"]!r}"/>'
    return f"<body>{hinge}{about_shaft(p['mgl'], p['J'])}{payload(ball, 0.25)}</body>"


def arm(p: dict[str, float], ball: float) -> str:
    """Two rods, hanging."""
    upper = f'<joint name="shoulder" type="hinge" axis="0 -1 0" damping="{p["b1"]!r}"/>{rod(p["m1"], 0.15, 0.009)}'
    lower = f'<joint name="elbow" type="hinge" axis="0 -1 0" damping="{p["b2"]!r}"/>{rod(p["m2"], 0.12, 0.004)}'
    return f'<body>{upper}<body pos="0 0 -0.3">{lower}{payload(ball, 0.25)}</body></body>'


def crane(p: dict[str, float], ball: float) -> str:
    """A rod that hangs from a cart."""
    cart = f'<joint name="cart" type="slide" axis="1 0 0" damping="{p["b"]!r}"/>'
    cart += f'<inertial pos="0 0 0" mass="{p["M"]!r}" diaginertia="0.1 0.1 0.1"/>'
    swing = f'<joint name="swing" type="hinge" axis="0 -1 0" damping="{p["c"]!r}"/>{rod(p["m"], 0.4, 0.01)}'
    return f"<body>{cart}<body>{swing}{payload(ball, 0.4)}</body></body>"


MACHINES = (
    Machine(
        "motor-rod",
        {
            "J": Parameter(0.03, "kg m^2"),
            "mgl": Parameter(0.6, "N m", 0.06, (0.45, 0.75)),
            "b": Parameter(0.03, "N m s/rad", 0.3, (0.0, 0.2)),
            "K": Parameter(0.5, "N m/V", 0.05, (0.4, 0.6)),
        },
        {"u": ("voltage", "V", 0.8)},
        {"angle": ("rad", 0.001, 0.004)},
        {"shaft": Joint(0.4, 4.5, 1.0, 0.03, lever=0.25, tilts=True, bends=True)},
        pendulum,
        """[inputs]
u = { signal = "voltage" }
[state]
q = { derivative = "w", initial = "angle" }
w = { derivative = "(K*u - mgl*sin(q) - b*w)/J" }
[outputs]
angle = { value = "q", unit = "rad"@angle@ }
[joints]
shaft = { position = "q", velocity = "w", inertia = "J", drive = "K*u", load = "-mgl*sin(q)", lever = "0.25" }
""",
        frozenset({"viscous@joint:shaft", "gain@input:u"}),
    ),
    Machine(
        "rod-arm",
        {
            "m1": Parameter(1.2, "kg", 0.08, (0.8, 1.6)),
            "m2": Parameter(0.5, "kg"),
            "b1": Parameter(0.15, "N m s/rad"),
            "b2": Parameter(0.06, "N m s/rad"),
        },
        {"tau1": ("torque1", "N m", 1.2), "tau2": ("torque2", "N m", 0.35)},
        {"angle1": ("rad", 0.0008, 0.003), "angle2": ("rad", 0.0008, 0.003)},
        {"shoulder": Joint(1.2, 2.5, 0.5, 0.15), "elbow": Joint(0.35, 4.0, 0.6, 0.012)},
        arm,
        """[inputs]
tau1 = { signal = "torque1" }
tau2 = { signal = "torque2" }
[let]
cross = "m2*0.3*0.12"
far = "m2*0.12^2 + 0.004"
load2 = "-m2*9.81*0.12*sin(q1 + q2)"
load1 = "-(m1*0.15 + m2*0.3)*9.81*sin(q1) + load2"
M11 = "m1*0.15^2 + 0.009 + m2*0.3^2 + far + 2*cross*cos(q2)"
M12 = "far + cross*cos(q2)"
f1 = "tau1 + load1 + cross*sin(q2)*(2*v1*v2 + v2^2) - b1*v1"
f2 = "tau2 + load2 - cross*sin(q2)*v1^2 - b2*v2"
det = "M11*far - M12^2"
[state]
q1 = { derivative = "v1", initial = "angle1" }
v1 = { derivative = "(far*f1 - M12*f2)/det" }
q2 = { derivative = "v2", initial = "angle2" }
v2 = { derivative = "(M11*f2 - M12*f1)/det" }
[outputs]
angle1 = { value = "q1", unit = "rad"@angle1@ }
angle2 = { value = "q2", unit = "rad"@angle2@ }
[joints]
shoulder = { position = "q1", velocity = "v1", force = "f1", drive = "tau1", load = "load1" }
elbow = { position = "q2", velocity = "v2", force = "f2", drive = "tau2", load = "load2" }
""",
        frozenset(),
    ),
    Machine(
        "crane",
        {
            "M": Parameter(4.0, "kg", 0.08, (2.5, 6.0)),
            "m": Parameter(0.8, "kg"),
            "b": Parameter(6.0, "N s/m", 0.2, (0.0, 20.0)),
            "c": Parameter(0.01, "N m s/rad"),
        },
        {"u": ("force", "N", 6.0)},
        {"position": ("m", 0.0002, 0.001), "angle": ("rad", 0.0008, 0.003)},
        {"cart": Joint(6.0, 0.7, 0.5, 4.0), "swing": Joint(0.4, 1.5, 0.4, 0.14)},
        crane,
        """[inputs]
u = { signal = "force" }
[let]
ml = "m*0.4"
M22 = "m*0.4^2 + 0.01"
M12 = "ml*cos(a)"
f1 = "u - b*v + ml*sin(a)*w^2"
f2 = "-ml*9.81*sin(a) - c*w"
det = "(M + m)*M22 - M12^2"
[state]
x = { derivative = "v", initial = "position" }
v = { derivative = "(M22*f1 - M12*f2)/det" }
a = { derivative = "w", initial = "angle" }
w = { derivative = "((M + m)*f2 - M12*f1)/det" }
[outputs]
position = { value = "x", unit = "m"@position@ }
angle = { value = "a", unit = "rad"@angle@ }
[joints]
cart = { position = "x", velocity = "v", force = "f1", drive = "u" }
swing = { position = "a", velocity = "w", force = "f2", load = "-ml*9.81*sin(a)" }
""",
        # Nothing pulls the cart to a place: a shift is another initial state, a drift another speed.
        frozenset({"viscous@joint:cart", "bias@output:position", "drift@output:position"}),
    ),
)
