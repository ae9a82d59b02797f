"""The pendulum's graphs: the machine as it runs, and the simulators on which policies are trained."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

from ..graph import Graph

__all__ = ["IDENTIFY", "deployed", "recorded", "simulated"]

IDENTIFY = """\
# What is looked for in the recording: the constants of the dynamics, the first state, and when a voltage acts.
format = 1
hold_out = 0.2

[nodes.world]
kind = "pendulum/simulator"
rate = 100.0

# The detector's place in the simulation: it shows the angle, without pictures.
[nodes.camera]
kind = "pendulum/detector-simulated"

[parameters]
"world.pendulum.inertia"  = { low = 8e-5, high = 3.2e-4, scale = "log", unit = "kg m^2", name = "J" }
"world.pendulum.motor"    = { low = 0.015, high = 0.06, scale = "log", unit = "N m/A", name = "K" }
"world.pendulum.damping"  = { low = 0.0, high = 1e-4, unit = "N m s/rad", name = "b" }
"world.pendulum.friction" = { low = 0.0, high = 3e-3, unit = "N m", name = "c" }

[initial]
"world.angle" = { low = 2.8, high = 3.5, unit = "rad" }
"world.speed" = { low = -0.5, high = 0.5, unit = "rad/s" }

[delays]
"motor -> world" = { max = 0.08, name = "actuator" }

[connections]
"world -> camera" = 0.0

[outputs]
"camera.angle" = { wrap = 6.283185307179586 }
"""
"""The specification for `parallax identify`. Mass, length and resistance are known: only their combinations with the
others are determined by the motion."""

NONE: dict[str, Any] = {"distribution": "constant", "seconds": 0.0}
PICTURES = 50.0
"""Pictures a second; a recording holds all of them, 1.6 MB for each second."""

RENDERING: dict[str, Any] = {"distribution": "normal", "mean": 1e-3, "std": 1e-4}
"""What a picture takes, as the schedule expects it."""

ENCODER = {"name": "encoder", "kind": "pendulum/encoder", "rate": 100.0, "computation": NONE}


def recorded() -> dict[str, Any]:
    """The machine, a film of it, the detector that finds its mark there, and its motor.

    The agent's commands come from a file.
    """
    spec = Graph("pendulum").spec
    spec["node"].append({"name": "film", "kind": "pendulum/film", "rate": PICTURES, "computation": RENDERING})
    node(spec, "camera").update(kind="pendulum/detector", rate=PICTURES)
    edges = [each for each in spec["connection"] if each["to"] != "camera"]
    edges += [
        {"from": "world", "to": "film", "blocking": True, "delay": wire(spec)},
        {"from": "film", "to": "camera", "blocking": True, "delay": wire(spec)},
    ]
    return {**spec, "connection": edges}


def deployed(sensor: str, policy: str, kind: str) -> dict[str, Any]:
    """The machine with a policy in the agent's place; `sensor` is what the policy sees."""
    spec = recorded()
    node(spec, "agent").update(kind=kind, parameters={"file": policy})
    edges = [edge for edge in spec["connection"] if edge["to"] != "agent"]
    if sensor == "encoder":
        spec["node"].append(copy.deepcopy(ENCODER))
        edges.append({"from": "world", "to": "encoder", "blocking": True, "delay": NONE})
    edges.append({"from": sensor, "to": "agent", "port": "observation", "blocking": True, "delay": wire(spec)})
    return {**spec, "connection": edges}


def simulated(identified: Mapping[str, Any], fitted: Mapping[str, Any], sensor: str, delays: bool) -> dict[str, Any]:
    """The loop with what was found: the simulator and its hidden delay from the identification, all other delays as
    they were measured. Without `delays`, none."""
    world = copy.deepcopy(node(identified, "world"))
    camera, agent, motor = (copy.deepcopy(node(fitted, name)) for name in ("camera", "agent", "motor"))
    camera.update(kind="pendulum/camera")
    own = camera if sensor == "camera" else copy.deepcopy(ENCODER)
    agent.update(kind="pendulum/camera-policy" if sensor == "camera" else "pendulum/policy", parameters={"file": "-"})
    hidden = edge(identified, "motor", "world")["delay"]
    seen = edge(fitted, "estimator", "agent")["delay"]
    edges = [
        {"from": "world", "to": sensor, "delay": NONE},
        {"from": sensor, "to": "agent", "port": "observation", "blocking": True, "delay": seen},
        {**edge(fitted, "agent", "motor")},
        # The simulator integrates to the commands' stamps: of those before the last tick it needs none.
        {"from": "motor", "to": "world", "skip": True, "window": 3, "delay": hidden},
    ]
    spec: dict[str, Any] = {
        "name": f"pendulum-{sensor}-{'delays' if delays else 'ideal'}",
        "supervisor": "agent",
        "node": [world, own, agent, motor],
        "connection": edges,
    }
    if not delays:
        for part in spec["node"]:
            part["computation"] = NONE
        for part in spec["connection"]:
            part["delay"] = NONE
    return spec


def node(spec: Mapping[str, Any], name: str) -> dict[str, Any]:
    """A node of a graph."""
    found: dict[str, Any] = next(node for node in spec["node"] if node["name"] == name)
    return found


def edge(spec: Mapping[str, Any], sender: str, receiver: str) -> dict[str, Any]:
    """A connection of a graph."""
    found: dict[str, Any] = next(
        edge for edge in spec["connection"] if (edge["from"], edge["to"]) == (sender, receiver)
    )
    return found


def wire(spec: Mapping[str, Any]) -> dict[str, Any]:
    """The expected delay of a message to the agent."""
    delay: dict[str, Any] = edge(spec, "estimator", "agent")["delay"]
    return delay
