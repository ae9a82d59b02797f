"""Parameters of nodes that run, from Python."""

from __future__ import annotations

import signal
import subprocess
import time

import pytest

import parallax
from conftest import _program


@pytest.fixture
def running():
    """A pendulum that runs in real time: the process of its launcher."""
    run = subprocess.Popen([_program(), "run", "pendulum"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    yield str(run.pid)
    run.send_signal(signal.SIGINT)
    run.wait(30)


def _once_it_runs(run: str) -> parallax.NodeReading:
    deadline = time.monotonic() + 30
    while True:
        try:
            return parallax.node_reading(run, "motor")
        except parallax.ParallaxError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.05)


def test_a_parameter_is_set_and_read(running):
    before = _once_it_runs(running)
    assert (before.parameters, before.units, before.state) == ({"rated": 4.0}, {"rated": "V"}, {})
    step = parallax.set_parameter(running, "motor.rated", 2.0)
    assert step > before.step
    assert parallax.node_reading(running, "motor").parameters == {"rated": 2.0}
    assert parallax.set_parameters(running, {"agent.limit": (3.0, "V"), "agent.excitation": 0.5}) > 0
    with pytest.raises(parallax.ParallaxError, match="above 0"):
        parallax.set_parameter(running, "motor.rated", -1.0)
    with pytest.raises(parallax.ParallaxError, match="not in A"):
        parallax.set_parameter(running, "motor.rated", 2.0, "A")
    with pytest.raises(parallax.ParallaxError, match="no state"):
        parallax.reset_state(running, "motor")


def test_what_cannot_be_is_said():
    with pytest.raises(parallax.ParallaxError, match="running"):
        parallax.set_parameter("no-such-run", "motor.rated", 2.0)
    with pytest.raises(parallax.ParallaxError, match=r"NODE\.PARAMETER"):
        parallax.set_parameter("no-such-run", "motor", 2.0)
    with pytest.raises(parallax.ParallaxError, match="one node only"):
        parallax.set_parameters("no-such-run", {"motor.rated": 2.0, "agent.limit": 1.0})
