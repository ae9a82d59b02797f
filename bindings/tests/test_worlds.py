"""Other simulators as worlds of a graph."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import parallax as px
from conftest import ROOT, _program
from parallax.worlds import MjxWorld, MujocoWorld

mujoco = pytest.importorskip("mujoco")
HERE = ROOT / "examples" / "python" / "mujoco"
MODEL = HERE / "pendulum.xml"


@pytest.fixture
def example(monkeypatch):
    """The example's module, which other processes find."""
    monkeypatch.syspath_prepend(str(HERE))
    spec = importlib.util.spec_from_file_location("pendulum", HERE / "pendulum.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "pendulum", module)
    spec.loader.exec_module(module)
    return module


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
  <option timestep="0.001" integrator="implicitfast"/>
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


def driven(world):
    """A world of one of the simulators in a loop."""
    made = world(
        SMOOTH, commands={"motor.voltage": "drive"}, outputs={"angle": "position:hinge"}, rate=100.0, name="world"
    )
    agent, motor = Sine(rate=50.0, name="agent"), px.RustNode("pendulum/motor", rate=100.0)
    made.connect(motor, skip=True, window=16)
    agent.connect(made)
    motor.connect(agent)
    return px.Graph(agent, [made, agent, motor], clock=px.SIMULATED)


def test_mjx_moves_as_mujoco_does_and_compiles(tmp_path):
    pytest.importorskip("mujoco.mjx")
    graph = driven(partial(MjxWorld, parameters=["dof_damping"]))
    recording = graph.simulate(tmp_path / "mjx.mcap", 2.0)
    angle = recording["world"]["angle"]
    expected = driven(MujocoWorld).simulate(tmp_path / "mujoco.mcap", 2.0)["world"]["angle"]
    assert np.ptp(angle) > 1.0
    # On this grid both integrate to the ticks, in the same steps; MJX in single precision.
    np.testing.assert_allclose(angle, expected[: len(angle)], atol=1e-4)
    compiled = graph.compile(recording.to_graph(), keep=["world"])

    def rollout(damping):
        state = compiled.init(jax.random.key(0))
        state.params["world"]["dof_damping"] = damping[None]
        return compiled.rollout(state, record=lambda state: state.history["world"][0]["angle"])[1]

    angles = jax.jit(jax.vmap(rollout))(jnp.array([2e-4, 4e-4]))
    assert np.abs(angles[0] - angles[1]).max() > 0.05
    # Each step of the agent ends a pass; what the world shows then is one of the recorded angles near it.
    near = np.abs(np.asarray(angles[0])[:, None] - angle[None, :]).min(axis=1)
    assert near.max() < 1e-4


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
