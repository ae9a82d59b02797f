"""The pendulum's graphs: the machine as it runs, and the simulators on which policies are trained."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

from ..graph import Graph
from .graphs import NONE, edge, ideal, node

__all__ = ["IDENTIFY", "deployed", "filters", "recorded", "simulated"]

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


def deployed(sensor: str, policy: str, kind: str, filters: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The machine with a policy in the agent's place; `sensor` is what the policy sees: `encoder`, `camera`, or one of
    `filters`, whose parameters these are. All of the filters run, so that they can be compared."""
    spec = recorded()
    node(spec, "agent").update(kind=kind, parameters={"file": policy})
    expected = node(spec, "estimator")["computation"]
    seen = edge(spec, "estimator", "agent")
    heard = [edge for edge in spec["connection"] if edge["to"] == "estimator"]
    spec["node"] = [each for each in spec["node"] if each["name"] != "estimator"]
    edges = [edge for edge in spec["connection"] if "estimator" not in (edge["from"], edge["to"])]
    edges.append({**seen, "from": sensor, "port": "observation"})
    if sensor == "encoder":
        # Nobody looks at pictures.
        spec["node"] = [each for each in spec["node"] if each["name"] not in ("film", "camera")] + [ENCODER]
        edges = [edge for edge in edges if "film" not in (edge["from"], edge["to"])]
        edges.append({"from": "world", "to": "encoder", "blocking": True, "delay": NONE})
    for name, parameters in filters.items():
        spec["node"].append(
            {"name": name, "kind": "pendulum/ukf", "rate": 100.0, "computation": expected, "parameters": parameters}
        )
        edges += [{**edge, "to": name} for edge in heard]
    return copy.deepcopy({**spec, "connection": edges})


def filters(identified: Mapping[str, Any], noise: float, ahead: float) -> dict[str, dict[str, Any]]:
    """The filter with what was identified: `predicted` to when a command acts, `ahead` (s) of its step's start, and
    `filtered`, the same without prediction. `noise` is that of the camera's angle, rad."""
    own = {
        key: value for key, value in node(identified, "world")["parameters"].items() if key not in ("angle", "speed")
    }
    delay = edge(identified, "motor", "world")["delay"]
    predicted = {**own, "noise": noise, "motor_delay": delay.get("seconds", delay.get("mean")), "ahead": ahead}
    return {"predicted": predicted, "filtered": {**predicted, "predict": False}}


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
    return spec if delays else ideal(spec)


def wire(spec: Mapping[str, Any]) -> dict[str, Any]:
    """The expected delay of a message to the agent."""
    delay: dict[str, Any] = edge(spec, "estimator", "agent")["delay"]
    return delay
