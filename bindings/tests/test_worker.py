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
