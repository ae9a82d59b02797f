"""Other simulators as worlds of a graph."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys

import numpy as np
import pytest

import parallax as px
from conftest import ROOT, _program

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
    from parallax.worlds import MujocoWorld

    arguments = {"model": str(MODEL), "commands": {"motor.voltage": "drive"}, "outputs": {"angle": "position:hinge"}}
    arguments |= change
    with pytest.raises(ValueError, match=message):
        MujocoWorld(arguments.pop("model"), rate=200.0, **arguments)
