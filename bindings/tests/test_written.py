"""Functions in JAX, written down as systems, compute what the functions do."""

from __future__ import annotations

import json
import re
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import parallax as px
from conftest import ROOT, _program
from parallax.symbolic import Expression, Formulas, UntraceableError, formulas


def evaluated(function, *values):
    """The function's first result by its formulas, in Python's own arithmetic."""
    names = [f"x{number}" for number in range(len(values))]
    symbols = np.array([Expression.symbol(name) for name in names], object)
    result = np.asarray(formulas(function, symbols))
    texts = Formulas({f"out{n}": value for n, value in enumerate(result.flat)}, names)
    known = {name: getattr(np, {"atan2": "arctan2"}.get(name, name), None) for name in FUNCTIONS}
    known |= {"abs": abs, "min": min, "max": max, "select": lambda c, a, b: a if c else b}
    known |= {"atan": np.arctan, "asin": np.arcsin, "acos": np.arccos}
    known |= dict(zip(names, values, strict=True))
    for part, text in texts.parts.items():
        known[part] = eval(text.replace("^", "**"), {}, known)
    made = [eval(text.replace("^", "**"), {}, known) for text in texts.texts.values()]
    return np.array(made, float).reshape(result.shape)


FUNCTIONS = ["sin", "cos", "tan", "exp", "log", "sqrt", "sign", "tanh", "floor", "atan2"]


def halving(x):
    return jax.lax.while_loop(lambda c: c[0] < 5, lambda c: (c[0] + 1, c[1] * 0.5 + x[0]), (0, x[1]))[1]


def solved(x):
    matrix = jnp.array([[4.0, 1.0, 0.5], [1.0, 3.0, 0.2], [0.5, 0.2, 2.0]]) + jnp.diag(x**2)
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(matrix, lower=True), x)


@pytest.mark.parametrize(
    "function",
    [
        lambda x: jnp.sin(x[0]) * x[1] - x[2] / (1.0 + x[0] ** 2),
        lambda x: -x[0] - (-(x[1] - (x[2] - 2.0))) * -3.0,
        lambda x: 2.0 ** (x[0] * x[1]) + jnp.abs(x[2]) ** 1.5 + x[0] ** -3,
        lambda x: jnp.where(x[0] > x[1], x[2], jnp.where((x[0] < 0) | (x[1] == 0.2), x[0], x[1])),
        lambda x: jnp.clip(x[0], -0.3, 0.3) + jnp.maximum(x[1], x[2]) + jnp.arctan2(x[1], x[2]),
        lambda x: jnp.mod(x[0] * 7.0, 2.0) + jax.lax.rem(x[1] * -5.0, 1.5) + jnp.round(x[2] * 3.3),
        lambda x: (x[:2] * 10.0).astype(int) // 3 + (x[:2] * 10.0).astype(int) % 4,
        lambda x: jnp.where(~((x[0] > 0) & (x[1] > 0)), x[2], x[0]),
        lambda x: x @ x + jnp.dot(x[:2], jnp.array([2.0, 3.0])),
        lambda x: jnp.linalg.norm(jnp.cross(x, jnp.array([1.0, 2.0, 3.0]))),
        lambda x: x[jnp.array([2, 0, 0])].at[1].add(x[1]).at[jnp.array([0, 0])].add(x[:2])[::-1].cumsum(),
        lambda x: jnp.einsum("i,ijk,k->j", x, jnp.arange(27.0).reshape(3, 3, 3), x),
        lambda x: jax.lax.scan(lambda c, y: (c * 0.9 + y, c * y), x[0], x)[1],
        lambda x: jax.lax.scan(lambda c, y: (c * 0.9 + y, c * y), x[0], x, reverse=True)[1],
        lambda x: jax.lax.cond(x[0] > 0, lambda v: v * 2.0, lambda v: v - 1.0, x),
        lambda x: jax.vmap(lambda a: jnp.tanh(a) + jax.nn.sigmoid(a) + jnp.cosh(a))(x),
        lambda x: jax.grad(lambda y: jnp.sum(jnp.sin(y) * y))(x),
        lambda x: jnp.tile(jnp.pad(x, 1), 2).reshape(2, 5).T.sum(0),
        halving,
        solved,
    ],
)
def test_formulas_compute_what_the_function_does(function):
    values = [0.7, -0.4, 1.9]
    with jax.enable_x64(True):
        expected = np.asarray(function(jnp.array(values)))
    np.testing.assert_allclose(evaluated(function, *values), expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda x: jax.lax.while_loop(lambda c: c < x[1], lambda c: c + 1.0, x[0]), "ends by what it computes"),
        (lambda x: x[x[0].astype(int)], "at places that it computes from names"),
        (lambda x: jnp.sort(x)[0], "computes `sort`"),
        (lambda x: x[0].astype(int) & 1, "computes `and`"),
        (lambda x: jax.scipy.special.erf(x[0]), "computes `erf`"),
    ],
)
def test_what_no_formula_does_is_named(function, message):
    with pytest.raises(UntraceableError, match=message):
        evaluated(function, 0.5, 1.5, 2.5)


def pendulum(path, **changes):
    """A pendulum with a motor, written down."""
    settings = {
        "name": "pendulum",
        "parameters": {"J": px.Parameter(0.02, "kg m^2", (0.01, 0.03)), "mgl": px.Parameter(0.5, "N m", None)},
        "inputs": {"u": "motor.torque"},
        "state": {"q": "angle", "v": 0.0},
        "outputs": {"angle": px.Reading(unit="rad", noise=1e-3)},
        "joints": {"shaft": px.Joint("q", "v")},
        "derivative": lambda p, x, u, f: {"q": x["v"], "v": (f["shaft"] - p["mgl"] * jnp.sin(x["q"])) / p["J"]},
        "output": lambda p, x, u: {"angle": x["q"]},
        "drive": lambda p, x, u: {"shaft": u["u"]},
        "load": lambda p, x: {"shaft": -p["mgl"] * jnp.sin(x["q"])},
    }
    px.write_system(path, **(settings | changes))


def test_a_simulator_in_jax_becomes_a_system(tmp_path):
    path = tmp_path / "system.toml"
    pendulum(path, effects=['[[effect]]\nname = "viscous"\nplace = "joint:shaft"\nparameters = { coefficient = 0.1 }'])
    assert 'initial = "angle"' in path.read_text()
    system = px.System(path)
    rates = system.derivative(system.params(), {"q": 0.3, "v": 2.0}, {"u": 0.4})
    assert float(rates["v"]) == pytest.approx((0.4 - 0.5 * np.sin(0.3) - 0.1 * 2.0) / 0.02, rel=1e-5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"inputs": {"q": None}}, "stand for two things"),
        ({"output": lambda p, x, u: {"speed": x["v"]}}, r"output returns \['speed'\]; it should return \['angle'\]"),
        ({"output": lambda p, x, u: {"angle": jnp.stack([x["q"], x["v"]])}}, r"has the shape \(2,\); one number"),
        ({"output": lambda p, x, u: {"angle": x["q"] + jnp.sqrt(-1.0)}}, "a formula holds nan"),
        ({"joints": {"shaft": px.Joint("q", "w")}}, "w"),
    ],
)
def test_what_is_no_system_is_named(tmp_path, changes, message):
    with pytest.raises((ValueError, px.ParallaxError), match=message):
        pendulum(tmp_path / "system.toml", **changes)


ARM = ROOT / "examples" / "python" / "mjx" / "arm.xml"


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """The arm's system, as the command line writes it."""
    pytest.importorskip("mujoco.mjx")
    out = tmp_path_factory.mktemp("arm") / "arm.toml"
    signals = {"turn": "agent.turn", "bend": "agent.bend", "shoulder": "encoder.shoulder", "elbow": "encoder.elbow"}
    options = [word for pair in signals.items() for word in ("--signal", "=".join(pair))]
    command = [_program(), "new", "system", "--mjcf", ARM, "--out", out, "--interpreter", sys.executable, *options]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "parallax diagnose --system" in done.stdout
    return out


def test_a_model_of_mujoco_moves_as_mujoco_says(arm):
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(ARM))
    data = mujoco.MjData(model)
    system = px.System(arm)
    derivative = jax.jit(system.derivative)
    draw = np.random.default_rng(1)
    for _ in range(20):
        data.qpos, data.qvel, data.ctrl = draw.uniform(-3, 3, 2), draw.uniform(-5, 5, 2), draw.uniform(-2, 2, 2)
        mujoco.mj_forward(model, data)
        state = dict(zip(["q_shoulder", "q_elbow", "v_shoulder", "v_elbow"], [*data.qpos, *data.qvel], strict=True))
        with jax.enable_x64(True):
            rates = derivative(system.params(), state, dict(zip(["turn", "bend"], data.ctrl, strict=True)))
        found = [float(rates["v_shoulder"]), float(rates["v_elbow"])]
        np.testing.assert_allclose(found, data.qacc, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ((b'<joint name="shoulder"', b"<freejoint/><!--"), "not well-formed|XML"),
        ((b"<worldbody>", b'<option density="1.2"/><worldbody>'), "a fluid"),
        ((b"<actuator>", b'<equality><joint joint1="shoulder" joint2="elbow"/></equality><actuator>'), "equality"),
    ],
)
def test_what_of_a_model_cannot_be_written_down_is_named(tmp_path, change, message):
    pytest.importorskip("mujoco.mjx")
    from parallax.worlds.equations import write_mjcf_system

    text = ARM.read_bytes().replace(*change).decode()
    with pytest.raises(ValueError, match=message):
        write_mjcf_system(tmp_path / "system.toml", text)


# A body that floats, in its own frame: with what dampens it, a leg, and rotors that push and turn.
WALKER = """
<mujoco>
  <worldbody>
    <body name="walker" pos="0 0 1" quat="0.8 0.6 0 0">
      <joint name="float" type="free" damping="0.05"/>
      <geom type="box" size="0.1 0.08 0.02" pos="0.01 0 0" mass="1"/>
      <site name="left" pos="0 0.1 0"/>
      <site name="right" pos="0 -0.1 0" euler="20 0 0"/>
      <body name="leg" pos="0.05 0 -0.05">
        <joint name="hip" axis="0 1 0" damping="0.01" stiffness="0.3"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.01" mass="0.1"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="left" site="left" gear="0 0 1 0 0 0.02"/>
    <general name="right" site="right" gear="0 0 1 0 0 0" biastype="affine" biasprm="0 0 -0.2"/>
    <position name="hip" joint="hip" kp="2" kv="0.1"/>
  </actuator>
</mujoco>
"""
# A pendulum on a ball, held in the world.
BALL = """
<mujoco>
  <worldbody><body>
    <joint name="ball" type="ball" damping="0.02" stiffness="0.2" armature="0.01"/>
    <geom type="capsule" fromto="0 0 0 0.1 0 -0.3" size="0.02" mass="1"/>
  </body></worldbody>
  <actuator><motor name="twist" joint="ball" gear="0.5 0 1"/></actuator>
</mujoco>
"""


@pytest.mark.parametrize("text", [WALKER, BALL])
def test_free_and_ball_joints_move_as_mujoco_says(tmp_path, text):
    mujoco = pytest.importorskip("mujoco")
    pytest.importorskip("mujoco.mjx")
    from parallax.worlds.equations import write_mjcf_system

    path = tmp_path / "system.toml"
    write_mjcf_system(path, text)
    assert len(re.findall(r"^t\d+ = ", path.read_text(), re.MULTILINE)) < 200, "a formula for each sum and product"
    system = px.System(path)
    derivative = jax.jit(system.derivative)
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    draw = np.random.default_rng(1)
    for _ in range(10):
        mujoco.mj_integratePos(model, data.qpos, draw.normal(size=model.nv), 1.0)
        data.qvel, data.ctrl = 2.0 * draw.normal(size=model.nv), draw.normal(size=model.nu)
        mujoco.mj_forward(model, data)
        state = dict(zip(system.states, [*data.qpos, *data.qvel], strict=True))
        with jax.enable_x64(True):
            rates = derivative(system.params(), state, dict(zip(system.inputs, data.ctrl, strict=True)))
        found = np.array([float(rates[one]) for one in system.states])
        np.testing.assert_allclose(found[model.nq :], data.qacc, rtol=1e-9, atol=1e-9)
        moved = data.qpos.copy()
        mujoco.mj_integratePos(model, moved, data.qvel, 1e-7)
        np.testing.assert_allclose(found[: model.nq], (moved - data.qpos) / 1e-7, atol=1e-5)
        # A quaternion of another length is the same rotation.
        for first, _, count in [(place, 0, 4) for place in range(model.nq) if system.states[place].endswith("_qw")]:
            longer = state | {one: 1.7 * state[one] for one in system.states[first : first + count]}
            with jax.enable_x64(True):
                again = derivative(system.params(), longer, dict(zip(system.inputs, data.ctrl, strict=True)))
            again = [float(again[one]) for one in system.states[model.nq :]]
            np.testing.assert_allclose(again, data.qacc, rtol=1e-9, atol=1e-9)


def test_the_diagnosis_finds_that_the_thrust_of_a_drone_is_late(tmp_path):
    pytest.importorskip("mujoco.mjx")

    def done(*command):
        result = subprocess.run([*command], capture_output=True, text=True, timeout=600, cwd=tmp_path)
        assert result.returncode == 0, result.stdout + result.stderr

    drone = ARM.parent / "drone.py"
    done(sys.executable, drone, "--out", "flight", "--hide", "delay", "--duration", "3")
    model = ["--mjcf", drone.with_suffix(".xml"), "--out", "drone.toml", "--interpreter", sys.executable]
    done(_program(), "new", "system", *model)
    # A lag of 30 ms is alike, and the search for what separates them would be the most of this test.
    few = ["--only", "input:thrust", "--exclude", "lag"]
    done(_program(), "diagnose", "--system", "drone.toml", "flight", *few, "--out", "answer")
    report = json.loads((tmp_path / "answer" / "report.json").read_text())
    (effect,) = report["which"][0]["effects"]
    assert f"{effect['name']}@{effect['place']}" == "delay@input:thrust", report["which"][:2]
    # 30 ms, of which MuJoCo's semi-implicit integrator takes half of a step to one: 0.5 to 1 ms.
    assert effect["parameters"]["delay"]["value"] == pytest.approx(0.0295, abs=0.002)


def test_the_diagnosis_finds_what_a_simulator_in_jax_lacks(tmp_path, arm):
    recording = tmp_path / "arm.mcap"
    command = [sys.executable, ARM.parent / "arm.py", "--out", recording]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    command = [_program(), "diagnose", "--system", arm, recording, "--out", tmp_path / "answer"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads((tmp_path / "answer" / "report.json").read_text())
    (effect,) = report["which"][0]["effects"]
    assert f"{effect['name']}@{effect['place']}" == "coulomb@joint:elbow", report["which"][:2]
    # The friction loss of the example, N m.
    assert effect["parameters"]["force"]["value"] == pytest.approx(0.08, rel=0.05)
