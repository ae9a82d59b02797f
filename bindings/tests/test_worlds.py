"""Other simulators as worlds of a graph."""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import sys
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import parallax as px
from conftest import ROOT, _program
from parallax.worlds import BraxWorld, DrakeWorld, MjxWorld, MujocoWorld

mujoco = pytest.importorskip("mujoco")
EXAMPLES = ROOT / "examples" / "python"
HERE = EXAMPLES / "mujoco"
MODEL = HERE / "pendulum.xml"


def module(monkeypatch, folder):
    """An example's module, which other processes find."""
    monkeypatch.syspath_prepend(str(folder))
    spec = importlib.util.spec_from_file_location("pendulum", folder / "pendulum.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "pendulum", module)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def example(monkeypatch):
    return module(monkeypatch, HERE)


def integrated(recording):
    """The angle at the world's stamps, by MuJoCo alone, from the recorded commands and when they were sent."""
    model = mujoco.MjModel.from_xml_path(str(MODEL))
    model.opt.timestep = 1e-4
    data = mujoco.MjData(model)
    commands = iter([*zip(recording["motor"].sent, recording["motor"]["voltage"], strict=True), (np.inf, 0.0)])
    upcoming = next(commands)
    angles = []
    for stamp in recording["world"]["stamp"]:
        while data.time < stamp - 5e-5:
            while upcoming[0] <= data.time + 5e-5:
                data.ctrl[0] = upcoming[1]
                upcoming = next(commands)
            mujoco.mj_step(model, data)
        angles.append(data.qpos[0])
    return np.array(angles)


@pytest.mark.parametrize("clock", [px.SIMULATED, px.WALL_CLOCK])
def test_mujoco_integrates_to_the_stamps_of_the_commands(example, clock):
    graph = example.graph(clock)
    state = graph.init(seed=1)
    while state.time < 2.0:
        state = graph.run(state)
    graph.stop()
    recording = graph.get_record()
    expected = integrated(recording)
    shown = recording["world"]["angle"]
    assert len(shown) > 350
    assert np.ptp(expected) > 0.2
    np.testing.assert_allclose(shown, expected, atol=2e-3)
    # What is shown is what is so at the start of the step.
    np.testing.assert_allclose(recording["world"]["stamp"], recording["world"].start, atol=1e-6)


def test_the_diagnosis_finds_the_friction_that_the_simulator_lacks(tmp_path):
    recording = tmp_path / "run.mcap"
    command = [sys.executable, HERE / "pendulum.py", "--out", recording]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    command = [_program(), "diagnose", "--system", HERE / "system.toml", recording, "--out", tmp_path / "answer"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads((tmp_path / "answer" / "report.json").read_text())
    assert report["gap"]["detected"]
    assert "coulomb@joint:hinge" in report["which"][0]["class"], report["which"]
    (effect,) = report["which"][0]["effects"]
    # The model's frictionloss, N m.
    value = next(iter(effect["parameters"].values()))["value"]
    assert abs(value - 2e-3) < 4e-4, effect


SMOOTH = """
<mujoco>
  <option timestep="0.001"/>
  <worldbody><body>
    <joint name="hinge" type="hinge" axis="0 1 0" damping="2e-4" armature="5e-5"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.08" size="0.006" mass="0.05" contype="0" conaffinity="0"/>
  </body></worldbody>
  <actuator><motor name="drive" joint="hinge" gear="0.0043"/></actuator>
</mujoco>
"""


class Sine(px.Node):
    """A voltage to and fro."""

    def init_output(self, key, params, state):
        return {"voltage": jnp.asarray(0.0)}

    def step(self, params, state, step):
        return state, {"voltage": 2.0 * jnp.sin(6.0 * step.due)}


def driven(world, model=SMOOTH):
    """A world of one of the simulators in a loop."""
    made = world(
        model, commands={"motor.voltage": "drive"}, outputs={"angle": "position:hinge"}, rate=100.0, name="world"
    )
    agent, motor = Sine(rate=50.0, name="agent"), px.RustNode("pendulum/motor", rate=100.0)
    made.connect(motor, skip=True, window=16)
    agent.connect(made)
    motor.connect(agent)
    return px.Graph(agent, [made, agent, motor], clock=px.SIMULATED)


@pytest.mark.parametrize(
    ("world", "package", "field"), [(MjxWorld, "mujoco.mjx", "dof_damping"), (BraxWorld, "brax", "dof.damping")]
)
def test_worlds_in_jax_move_as_mujoco_does_and_compile(tmp_path, world, package, field):
    pytest.importorskip(package)
    graph = driven(partial(world, parameters=[field]))
    recording = graph.simulate(tmp_path / "jax.mcap", 2.0)
    angle = recording["world"]["angle"]
    expected = driven(MujocoWorld).simulate(tmp_path / "mujoco.mcap", 2.0)["world"]["angle"]
    assert np.ptp(angle) > 1.0
    # On this grid all integrate to the ticks, in the same steps; those in JAX in single precision. Brax inverts the
    # mass matrix by a few iterations.
    np.testing.assert_allclose(angle, expected[: len(angle)], atol=1e-4 if world is MjxWorld else 2e-2)
    compiled = graph.compile(recording.to_graph(), keep=["world"])

    def rollout(damping):
        state = compiled.init(jax.random.key(0))
        place = state.params["world"]
        *path, last = field.split(".")
        for part in path:
            place = place[part]
        place[last] = damping[None]
        return compiled.rollout(state, record=lambda state: state.history["world"][0]["angle"])[1]

    angles = jax.jit(jax.vmap(rollout))(jnp.array([2e-4, 4e-4]))
    assert np.abs(angles[0] - angles[1]).max() > 0.05
    # Each step of the agent ends a pass; what the world shows then is one of the recorded angles near it.
    near = np.abs(np.asarray(angles[0])[:, None] - angle[None, :]).min(axis=1)
    assert near.max() < 1e-4


@pytest.mark.parametrize("physics", ["spring", "positional"])
def test_braxs_other_pipelines_swing_as_a_pendulum_does(tmp_path, physics):
    pytest.importorskip("brax")
    free = SMOOTH.replace(' damping="2e-4" armature="5e-5"', "")
    graph = driven(partial(BraxWorld, physics=physics), free)
    angle = graph.simulate(tmp_path / "brax.mcap", 2.0)["world"]["angle"]
    expected = driven(MujocoWorld, free).simulate(tmp_path / "mujoco.mcap", 2.0)["world"]["angle"][: len(angle)]
    assert np.ptp(expected) > 1.0
    # They approximate the joint.
    assert np.abs(angle - expected).max() < 0.1 * np.ptp(expected)
    with pytest.raises(ValueError, match=f"{physics}.* does not simulate .*damping of joints, armature of joints"):
        driven(partial(BraxWorld, physics=physics))


HIDDEN = {
    "spring@joint:hinge": ("stiffness", 0.008),
    "saturation@input:voltage": ("high", 1.5),
    "bias@output:angle": ("bias", 0.05),
}
"""What a machine of Brax hides: at a generalised force, at an input, at an output."""


@pytest.mark.parametrize("hidden", HIDDEN)
def test_the_diagnosis_finds_what_a_world_in_jax_hides(tmp_path, monkeypatch, hidden):
    pytest.importorskip("brax")
    brax = EXAMPLES / "brax"
    parameter, value = HIDDEN[hidden]
    text = (brax / "pendulum.xml").read_text()
    stiffness = value if parameter == "stiffness" else 0.0
    text = re.sub(r'stiffness="[^"]*"', f'stiffness="{stiffness}"', text)
    if parameter == "high":
        text = text.replace('gear="0.0043"', f'gear="0.0043" ctrllimited="true" ctrlrange="{-value} {value}"')
    graph = module(monkeypatch, brax).graph(text, bias=value if parameter == "bias" else 0.0)
    graph.simulate(tmp_path / "run.mcap", 20.0, seed=1)
    command = [_program(), "diagnose", "--system", brax / "system.toml", tmp_path / "run.mcap", "--out", tmp_path / "a"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads((tmp_path / "a" / "report.json").read_text())
    assert report["gap"]["detected"]
    found = {f"{effect['name']}@{effect['place']}": effect["parameters"] for effect in report["which"][0]["effects"]}
    assert found.pop(hidden)[parameter]["value"] == pytest.approx(value, rel=0.1), report["which"][:2]
    # Brax's integrator is semi-implicit: what acts in a time step of 1 ms acts on all of it, half a step too early.
    half = found.pop("delay@input:voltage", {"delay": {"value": -5e-4}})
    assert half["delay"]["value"] == pytest.approx(-5e-4, abs=1e-4)
    assert not found


def swung(recording):
    """The angle at the world's stamps, from the recorded commands and when they were sent, by the equation itself."""
    from scipy.integrate import solve_ivp

    commands = [(0.0, 0.0), *zip(recording["motor"].sent, recording["motor"]["voltage"], strict=True)]
    stamps, angles = recording["world"]["stamp"], []
    state, time, voltage = np.array([0.2, 0.0]), 0.0, 0.0
    events = sorted([(sent, 0, volts) for sent, volts in commands] + [(stamp, 1, 0.0) for stamp in stamps])
    for until, sort, volts in events:
        if until > time:

            def speed(_, x, volts=voltage):
                force = 0.0043 * volts - 0.05 * 9.81 * 0.04 * np.sin(x[0]) - 2e-4 * x[1]
                return [x[1], force / (7.7e-5 + 0.05 * 0.04**2)]

            state = solve_ivp(speed, (time, until), state, rtol=1e-9, atol=1e-11).y[:, -1]
            time = until
        if sort == 1:
            angles.append(state[0])
        else:
            voltage = volts
    return np.array(angles)


@pytest.mark.parametrize("clock", [px.SIMULATED, px.WALL_CLOCK])
def test_drake_integrates_to_the_stamps_of_the_commands(monkeypatch, clock):
    pytest.importorskip("pydrake")
    graph = module(monkeypatch, EXAMPLES / "drake").graph(clock)
    state = graph.init(seed=1)
    while state.time < 2.0:
        state = graph.run(state)
    graph.stop()
    recording = graph.get_record()
    expected = swung(recording)
    shown = recording["world"]["angle"]
    assert len(shown) > 350
    assert np.ptp(expected) > 0.5
    # Drake's gravity is that of the Earth to five digits; its integrator is as accurate as it was told to be.
    np.testing.assert_allclose(shown, expected, atol=1e-3)
    np.testing.assert_allclose(recording["world"]["stamp"], recording["world"].start, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"model": "nowhere.xml"}, "there is no model at"),
        ({"commands": {"motor.voltage": "engine"}}, "no actuator `engine`; it has drive"),
        ({"commands": {"voltage": "drive"}}, "must look like PORT.LEAF"),
        ({"outputs": {"angle": "position:elbow"}}, "no joint `elbow`; it has hinge"),
        ({"outputs": {"angle": "sensor:gyro"}}, "no sensor `gyro`; it has none"),
        ({"outputs": {"angle": "hinge"}}, "must be position:JOINT"),
    ],
)
def test_what_a_model_does_not_have_is_named(change, message):
    arguments = {"model": str(MODEL), "commands": {"motor.voltage": "drive"}, "outputs": {"angle": "position:hinge"}}
    arguments |= change
    with pytest.raises(ValueError, match=message):
        MujocoWorld(arguments.pop("model"), rate=200.0, **arguments)


def test_mjx_names_what_does_not_fit():
    pytest.importorskip("mujoco.mjx")
    ports = {"commands": {"motor.voltage": "drive"}, "outputs": {"angle": "position:hinge"}}
    with pytest.raises(ValueError, match="whole number"):
        MjxWorld(SMOOTH, rate=300.0, **ports)
    with pytest.raises(ValueError, match="no fields"):
        MjxWorld(SMOOTH, rate=100.0, parameters=["friction_of_the_moon"], **ports)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"model": str(MODEL)}, "Brax .* does not simulate .*frictionloss"),
        ({"model": SMOOTH.replace("0.001", '0.001" integrator="RK4')}, "Only euler integration"),
        ({"parameters": ["dof_damping"]}, "no array `dof_damping`; it has dof.damping"),
        ({"outputs": {"angle": "sensor:gyro"}}, "Brax has no sensors"),
        ({"outputs": {"angle": "position:elbow"}}, "no joint `elbow`; it has hinge"),
        ({"physics": "quantum"}, "generalized, spring and positional"),
        ({"rate": 300.0}, "whole number"),
    ],
)
def test_brax_names_what_does_not_fit(change, message):
    pytest.importorskip("brax")
    arguments = {"model": SMOOTH, "commands": {"motor.voltage": "drive"}, "outputs": {"angle": "position:hinge"}}
    arguments |= {"rate": 100.0} | change
    with pytest.raises(ValueError, match=message):
        BraxWorld(arguments.pop("model"), **arguments)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"model": "nowhere.urdf"}, "there is no model at"),
        ({"model": "<robot name='x'><link"}, "Drake does not read this model"),
        ({"commands": {"motor.voltage": "engine"}}, "no actuator `engine`; it has drive"),
        ({"gains": {"engine": 1.0}}, "no actuator `engine`"),
        ({"outputs": {"angle": "position:elbow"}}, "no joint `elbow`; it has hinge"),
        ({"outputs": {"angle": "hinge"}}, "must be position:JOINT or velocity:JOINT"),
        ({"start": {"elbow": 1.0}}, "no joint `elbow`"),
    ],
)
def test_drake_names_what_a_model_does_not_have(change, message):
    pytest.importorskip("pydrake")
    arguments = {"model": str(EXAMPLES / "drake" / "pendulum.urdf"), "commands": {"motor.voltage": "drive"}}
    arguments |= {"outputs": {"angle": "position:hinge"}} | change
    with pytest.raises(ValueError, match=message):
        DrakeWorld(arguments.pop("model"), rate=200.0, **arguments)


@pytest.mark.parametrize(("world", "extra"), [(BraxWorld, "brax"), (DrakeWorld, "drake")])
def test_a_package_that_is_not_there_is_named_with_its_extra(monkeypatch, world, extra):
    for name in ("brax.io.mjcf", "pydrake.all"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ImportError, match=rf"pip install './bindings\[{extra}\]'"):
        world(SMOOTH, commands={}, outputs={}, rate=100.0)
