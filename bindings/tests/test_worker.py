"""Nodes in Python that run in real time, each in an interpreter of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

import parallax as px
from conftest import ROOT, _program

NODES = '''
import os
import signal

import jax.numpy as jnp
import parallax as px


class Plain:
    """Sends the speed that it sees, and does what it is told at a step."""

    def __init__(self, at=None, what=None, gain=1.0):
        self.at, self.what, self.gain = at, what, gain

    def step(self, step):
        if step.seq == self.at:
            if self.what == "kill":
                os.kill(os.getpid(), signal.SIGKILL)
            raise RuntimeError("the policy has no answer")
        assert len(step["estimator"]) == 1 and step.due <= step.start
        return {"voltage": self.gain * step["estimator"].latest.message["speed"]}


class Jax(px.Node):
    """Counts its steps and adds half the speed."""

    def init_params(self, key):
        return {"gain": jnp.asarray(0.5)}

    def init_state(self, key, params):
        return {"count": jnp.asarray(0.0)}

    def init_output(self, key, params, state):
        return {"voltage": jnp.asarray(0.0)}

    def step(self, params, state, step):
        speed = step.inputs["estimator"].latest.message["speed"]
        return {"count": state["count"] + 1.0}, {"voltage": 0.01 * state["count"] + params["gain"] * speed}
'''


@pytest.fixture
def folder(tmp_path: Path):
    """A folder with the example's graph and the nodes above."""
    (tmp_path / "own.py").write_text(textwrap.dedent(NODES))
    (tmp_path / "launch.toml").write_text(f'[defaults]\ninterpreter = "{sys.executable}"\n')
    return tmp_path


def start(folder: Path, parameters: str, *arguments: str, duration: float = 1.0):
    """Runs the graph with this agent; gives what the command did."""
    graph = (ROOT / "examples/python/graph.toml").read_text()
    line = next(line for line in graph.splitlines() if line.startswith("parameters"))
    (folder / "graph.toml").write_text(graph.replace(line, f"parameters = {parameters}"))
    recording = folder / "run.mcap"
    command = [_program(), "run", folder / "graph.toml", "--duration", str(duration), "--out", recording, "--json"]
    environment = {name: value for name, value in os.environ.items() if name != "VIRTUAL_ENV"}
    return subprocess.run(
        [*command, *arguments], capture_output=True, text=True, timeout=300, env=environment, cwd=folder
    )


def seen(recording: px.Recording) -> np.ndarray:
    """The speed that each step of the agent saw."""
    port = recording["agent"].inputs["estimator"]
    leaf = recording["estimator"].leaves.index("speed")
    sent = recording["estimator"]
    messages = {int(seq): row[leaf] for seq, row in zip(sent.seq, sent.payload, strict=True)}
    return np.array([messages.get(int(seq), 0.0) for seq in port.seq[:, -1]])


@pytest.mark.parametrize("kind", ["Plain", "Jax"])
def test_a_node_in_python_runs_like_any_other(folder, kind):
    done = start(folder, f'{{ class = "own:{kind}" }}')
    assert done.returncode == 0, done.stdout + done.stderr
    agent = next(node for node in json.loads(done.stdout)["nodes"] if node["node"] == "agent")
    assert agent["exit"] == "clean", agent
    assert agent["steps"] > 5, agent
    recording = px.load(folder / "run.mcap")
    sent = recording["agent"].payload[:, 0]
    speeds = seen(recording)
    steps = np.arange(len(sent))
    expected = speeds if kind == "Plain" else 0.01 * steps + 0.5 * speeds
    np.testing.assert_allclose(sent, expected, rtol=1e-5, atol=1e-6)
    replayed = subprocess.run([_program(), "replay", folder / "run.mcap"], capture_output=True, text=True, timeout=120)
    assert replayed.returncode == 0, replayed.stdout + replayed.stderr


def test_an_exception_is_told_with_its_traceback(folder):
    done = start(folder, '{ class = "own:Plain", arguments = { at = 7 } }')
    assert done.returncode == 3, done.stdout + done.stderr
    assert "the policy has no answer" in done.stdout, done.stdout
    assert "own.py" in done.stdout
    assert "step 7" in done.stdout


def test_a_killed_interpreter_comes_back(folder):
    parameters = '{ class = "own:Plain", arguments = { at = 5, what = "kill" } }'
    settings = ["--set", "agent.restart=on-failure", "--set", "agent.restart_delay=0.05"]
    done = start(folder, parameters, *settings, duration=15.0)
    assert done.returncode == 0, done.stdout + done.stderr
    agent = next(node for node in json.loads(done.stdout)["nodes"] if node["node"] == "agent")
    assert agent["restarts"] == 1, agent
    steps = px.load(folder / "run.mcap")["agent"].seq
    assert steps[4] == 4
    assert steps[5] > 5


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ('{ class = "absent:Plain" }', "finds no module `absent`"),
        ('{ class = "own:Nobody" }', "has no `Nobody`"),
        ("{ }", 'need class = "module:Class"'),
        ('{ class = "own:Plain", arguments = { speed = 1 } }', "unexpected keyword argument 'speed'"),
    ],
)
def test_what_is_missing_is_named(folder, parameters, message):
    done = start(folder, parameters)
    assert done.returncode != 0
    assert message in done.stderr + done.stdout, done.stderr


def test_an_interpreter_that_is_missing_is_named(folder):
    done = start(folder, '{ class = "own:Plain" }', "--set", "agent.interpreter=/no/such/python")
    assert done.returncode == 2, done.stderr
    assert "/no/such/python cannot be started" in done.stderr


@pytest.mark.parametrize("kind", ["Plain", "Jax"])
def test_a_simulated_clock_steps_it_and_a_seed_gives_the_same_bits(folder, kind):
    start(folder, f'{{ class = "own:{kind}" }}', duration=0.2)
    recordings = [folder / f"{name}.mcap" for name in ("first", "second")]
    for recording in recordings:
        command = [_program(), "sim", folder / "graph.toml", "--duration", "2", "--seed", "3", "--out", recording]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stdout + done.stderr
    assert recordings[0].read_bytes() == recordings[1].read_bytes()
    sent = px.load(recordings[0])["agent"].payload[:, 0]
    speeds = seen(px.load(recordings[0]))
    expected = speeds if kind == "Plain" else 0.01 * np.arange(len(sent)) + 0.5 * speeds
    np.testing.assert_allclose(sent, expected, rtol=1e-5, atol=1e-6)
    assert len(sent) > 50


def test_what_fails_under_a_simulated_clock_is_told(folder):
    start(folder, '{ class = "own:Plain", arguments = { at = 7 } }', duration=0.2)
    command = [_program(), "sim", folder / "graph.toml", "--duration", "1"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert "the policy has no answer" in done.stdout + done.stderr, done.stdout + done.stderr


TIMES = '''
import os
import time
from pathlib import Path


class Slow:
    """Says where it runs, and is late at one step."""

    def __init__(self, at):
        self.at = at

    def step(self, step):
        Path("cores.txt").write_text(" ".join(map(str, sorted(os.sched_getaffinity(0)))))
        if step.seq == self.at:
            time.sleep(0.2)
        return {"voltage": 1.0}
'''


def test_a_deadline_and_a_core_hold_for_a_node_in_python(folder):
    (folder / "late.py").write_text(TIMES)
    core = max(os.sched_getaffinity(0))
    settings = [f"agent.core={core}", "agent.deadline=0.1", "agent.on_deadline=safe", "agent.safe={ voltage = 0.25 }"]
    flags = [argument for setting in settings for argument in ("--set", setting)]
    done = start(folder, '{ class = "late:Slow", arguments = { at = 20 } }', *flags, duration=2.0)
    assert done.returncode == 0, done.stdout + done.stderr
    agent = next(node for node in json.loads(done.stdout)["nodes"] if node["node"] == "agent")
    assert agent["core"] == core
    assert (folder / "cores.txt").read_text() == str(core)
    assert agent["late"] >= 1, agent
    assert agent["replaced"] >= 1, agent
    sent = px.load(folder / "run.mcap")["agent"].payload[:, 0]
    assert sent[20] == 0.25
    assert np.count_nonzero(sent == 1.0) > 20
    # The replay knows what was sent in its place.
    replayed = subprocess.run([_program(), "replay", folder / "run.mcap"], capture_output=True, text=True, timeout=120)
    assert replayed.returncode == 0, replayed.stdout + replayed.stderr
