"""The quadrotor's graphs: the machine as it runs, and the simulators on which policies are trained."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import numpy as np

from .graphs import NONE, edge, ideal, node
from .work import chances

__all__ = ["IDENTIFY", "SENSED", "deployed", "recorded", "simulated"]

IDENTIFY = """\
# What is looked for in the recording: the paper's eight, of which three are delays that no stamp shows.
format = 1
hold_out = 0.2

[nodes.world]
kind = "quadrotor/simulator"
rate = 100.0

# The machine's drivers in the simulation: without what makes them late.
[nodes.mocap]
kind = "quadrotor/mocap"

[nodes.pid]
kind = "quadrotor/pid"

[parameters]
"world.quadrotor.mass"          = { low = 0.02, high = 0.05, scale = "log", unit = "kg", name = "mass" }
"world.quadrotor.attitude_gain" = { low = 0.5, high = 2.0, scale = "log", unit = "1", name = "gain" }
"world.quadrotor.attitude_time" = { low = 0.05, high = 0.4, scale = "log", unit = "s", name = "time" }
"world.quadrotor.drag_xy"       = { low = 2e-7, high = 4e-6, scale = "log", unit = "N s^2/(m rad)", name = "drag_xy" }
"world.quadrotor.drag_z"        = { low = 2e-7, high = 4e-6, scale = "log", unit = "N s^2/(m rad)", name = "drag_z" }

[delays]
"pid -> world"   = { max = 0.05, name = "actuator" }
"world -> pid"   = { max = 0.05, port = "mocap", name = "feedback" }
"world -> mocap" = { max = 0.05, name = "sensor" }

[outputs]
"mocap.velocity.x" = {}
"mocap.velocity.y" = {}
"mocap.velocity.z" = {}
"mocap.attitude.roll" = {}
"mocap.attitude.pitch" = {}
"""
"""The specification for `parallax identify`."""

SENSED = {"sensor": "world->mocap", "feedback": "world->pid.mocap"}
"""The hidden delays of what is sensed, and their connections."""

WORLD, MOCAP, AGENT, PID = 200.0, 50.0, 25.0, 50.0
"""Rates, Hz; those of the paper."""


def recorded() -> dict[str, Any]:
    """The machine with its drivers, and an agent that flies a circle with a shake."""
    short: dict[str, Any] = {"distribution": "normal", "mean": 2e-4, "std": 5e-5}
    nodes = [
        {"name": "world", "kind": "quadrotor/world", "rate": WORLD, "computation": NONE},
        {"name": "mocap", "kind": "quadrotor/tracker", "rate": MOCAP, "computation": short},
        {"name": "agent", "kind": "quadrotor/surveyor", "rate": AGENT, "computation": short},
        {"name": "pid", "kind": "quadrotor/onboard", "rate": PID, "computation": short},
    ]
    # Drivers look back over more than 50 ms.
    past = {"window": 16, "delay": short}
    edges = [
        {"from": "world", "to": "mocap", **past},
        {"from": "world", "to": "pid", "port": "mocap", **past},
        {"from": "mocap", "to": "agent", "delay": short},
        {"from": "agent", "to": "pid", "blocking": True, "delay": short},
        {"from": "pid", "to": "world", "skip": True, "window": 16, "delay": short},
    ]
    return {"name": "quadrotor", "supervisor": "agent", "node": nodes, "connection": edges}


def deployed(policy: str, radius: float, number: int = 0) -> dict[str, Any]:
    """The machine with a policy in the agent's place. It starts on the circle; in every run but the first somewhere
    else on it, up to 0.15 m beside it."""
    spec = recorded()
    place = [radius, 0.0, 1.0]
    if number > 0:
        turn, out, up = chances(number).uniform(-1.0, 1.0, 3)
        away = radius + 0.15 * out
        place = [float(away * np.cos(np.pi * turn)), float(away * np.sin(np.pi * turn)), float(1.0 + 0.15 * up)]
    node(spec, "world")["parameters"] = {"position": place}
    node(spec, "agent").update(kind="quadrotor/policy", parameters={"file": policy})
    edge(spec, "mocap", "agent")["port"] = "observation"
    return spec


def simulated(
    identified: Mapping[str, Any],
    fitted: Mapping[str, Any],
    delays: bool,
    *,
    policy: str = "-",
    radius: float = 1.0,
    rate: float = 100.0,
) -> dict[str, Any]:
    """The loop with what was found: the simulator and its hidden delays from the identification, all other delays as
    they were measured. Without `delays`, none."""
    world, mocap, pid = (copy.deepcopy(node(identified, name)) for name in ("world", "mocap", "pid"))
    agent = copy.deepcopy(node(fitted, "agent"))
    for own in (mocap, pid):
        own["computation"] = node(fitted, own["name"])["computation"]
    world["rate"] = rate
    world["parameters"] = {**world.get("parameters", {}), "position": [radius, 0.0, 1.0]}
    agent.update(kind="quadrotor/policy", parameters={"file": policy})
    hidden = {
        pair: edge(identified, *pair)["delay"] for pair in (("pid", "world"), ("world", "pid"), ("world", "mocap"))
    }
    edges = [
        {"from": "world", "to": "mocap", "delay": hidden["world", "mocap"]},
        {"from": "world", "to": "pid", "port": "mocap", "delay": hidden["world", "pid"]},
        {**edge(fitted, "mocap", "agent"), "port": "observation"},
        {**edge(fitted, "agent", "pid")},
        # The simulator integrates to the commands' stamps: of those before the last tick it needs none.
        {"from": "pid", "to": "world", "skip": True, "window": 3, "delay": hidden["pid", "world"]},
    ]
    name = f"quadrotor-{'delays' if delays else 'ideal'}"
    spec = {"name": name, "supervisor": "agent", "node": [world, mocap, agent, pid], "connection": edges}
    return spec if delays else ideal(spec)
