"""Nodes of the tests, in a module that other processes find."""

from __future__ import annotations

import os
import time
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import parallax as px


class Place(NamedTuple):
    """A message of arrays."""

    position: Any
    count: Any


class Cam(px.Node):
    """Counts its pictures, in a message of many kinds of numbers."""

    def init_output(self, key, params, state):
        return {"place": Place(jnp.zeros((2, 3)), jnp.asarray(0)), "seen": [jnp.asarray(False)], "exact": jnp.uint32(7)}

    def step(self, params, state, step):
        count = jnp.asarray(step.seq, int)
        position = jnp.arange(6.0).reshape(2, 3) + step.seq
        # More than single precision holds.
        exact = jnp.uint32(16_777_217) + jnp.asarray(step.seq, jnp.uint32)
        return state, {"place": Place(position, count), "seen": [count % 2 == 1], "exact": exact}


class Agent(px.Node):
    """Weighs what it sees, and remembers how often it did."""

    def __init__(self, weight=0.5, **settings):
        super().__init__(**settings)
        self.weight = weight

    def init_params(self, key):
        return {"weight": jnp.asarray(self.weight)}

    def init_state(self, key, params):
        return {"steps": jnp.asarray(0)}

    def init_output(self, key, params, state):
        return {"voltage": jnp.asarray(0.25)}

    def step(self, params, state, step):
        seen = step["cam"].latest.message
        whole = jnp.where(seen["exact"] % 2 == 1, 1.0, -1.0)
        voltage = params["weight"] * seen["place"].position[1, 2] + state["steps"] + 0.0 * whole
        return {"steps": state["steps"] + 1}, {"voltage": voltage}


class Log(px.PlainNode):
    """Plain Python: sends back what it saw, and where it ran."""

    def __init__(self, fail_at=None, sleep=0.0, **settings):
        super().__init__(**settings)
        self.fail_at = fail_at
        self.sleep = sleep
        self.steps = 0

    def init_output(self):
        return {"process": 0.0, "steps": 0, "voltages": np.zeros(2), "corner": 0.0, "exact": np.uint32(0)}

    def step(self, step):
        if step.seq == self.fail_at:
            raise RuntimeError("the log is full")
        time.sleep(self.sleep)
        self.steps += 1
        voltages = np.array([message.message["voltage"] for message in step["agent"]])
        cam = step["cam"].latest.message
        assert isinstance(cam["place"], Place), cam
        corner = cam["place"].position[1, 2]
        return {
            "process": float(os.getpid()),
            "steps": self.steps,
            "voltages": voltages,
            "corner": float(corner),
            "exact": cam["exact"],
        }


def loop(log: dict[str, Any] | None = None, **agent: Any) -> tuple[px.Member, list[px.Member]]:
    """Camera, agent and log, with a motor of Rust."""
    cam = Cam(rate=60.0)
    supervisor = Agent(rate=30.0, **agent)
    record = Log(rate=20.0, **(log or {}))
    motor = px.RustNode("pendulum/motor", rate=50.0)
    supervisor.connect(cam, delay=px.Constant(0.002))
    motor.connect(supervisor, block=True, window=2)
    record.connect(supervisor, window=2)
    record.connect(cam)
    return supervisor, [cam, supervisor, record, motor]
