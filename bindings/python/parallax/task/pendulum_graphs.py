"""The pendulum's graphs: the machine as it runs, and the simulators on which policies are trained."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..commands import CommandError
from ..graph import Graph
from ..recording import Recording
from ..types import Floats
from .graphs import NONE, edge, ideal, node

__all__ = ["CAMERAS", "Seen", "deployed", "filters", "identify", "recorded", "simulated"]

CAMERAS = {"camera": ("film", "mark"), "side": ("side_film", "side_mark")}
"""For each camera the nodes that take its pictures and look for the mark in them."""

IDENTIFY = """\
# What is looked for in the recording: the constants of the dynamics, the first state, when a voltage acts, and which
# pixel of each camera belongs to which angle. Before both have seen the mark move there is nothing to compare.
format = 1
from = {begin:.3f}
hold_out = 0.2

[nodes.world]
kind = "pendulum/simulator"
rate = 100.0

# The detectors' places in the simulation: they tell where the mark is, without pictures.
[nodes.mark]
kind = "pendulum/detector-simulated"

[nodes.side_mark]
kind = "pendulum/detector-simulated"

[parameters]
"world.pendulum.inertia"  = {{ low = 8e-5, high = 3.2e-4, scale = "log", unit = "kg m^2", name = "J" }}
"world.pendulum.motor"    = {{ low = 0.015, high = 0.06, scale = "log", unit = "N m/A", name = "K" }}
"world.pendulum.damping"  = {{ low = 0.0, high = 1e-4, unit = "N m s/rad", name = "b" }}
"world.pendulum.friction" = {{ low = 0.0, high = 3e-3, unit = "N m", name = "c" }}

[initial]
"world.angle" = {{ low = 2.8, high = 3.5, unit = "rad" }}
"world.speed" = {{ low = -0.5, high = 0.5, unit = "rad/s" }}

[delays]
"motor -> world" = {{ max = 0.08, name = "actuator" }}

# From when a picture begins to be taken to when the mark is looked for in it, as the stamps tell.
[connections]
"world -> mark" = {mark:.6f}
"world -> side_mark" = {side_mark:.6f}

[outputs]
"""
"""The specification for `parallax identify`. Mass, length and resistance are known: only their combinations with the
others are determined by the motion."""

CLEAR = 1.5
"""Where the mark was at first is taken for the wall until it has been elsewhere: so long, s, it may be seen in part."""

TERMS = {"one": "1", "sin": "sin", "cos": "cos", "sin_sin": "sin_sin", "sin_cos": "sin_cos"}
"""The coefficients of a coordinate, and what each multiplies."""

PICTURES = {"film": 50.0, "side_film": 25.0}
"""Pictures a second of each camera; a recording holds all of them, 1.6 MB for each second of 50."""

RENDERING: dict[str, Any] = {"distribution": "normal", "mean": 1e-3, "std": 1e-4}
"""What a picture takes, as the schedule expects it,"""
LOOKING: dict[str, Any] = {"distribution": "normal", "mean": 1e-4, "std": 2e-5}
"""what looking for the mark in it takes,"""
MAPPING: dict[str, Any] = {"distribution": "constant", "seconds": 1e-5}
"""and what the angle takes that belongs to it."""

ENCODER = {"name": "encoder", "kind": "pendulum/encoder", "rate": 100.0, "computation": NONE}


@dataclass(frozen=True)
class Seen:
    """How pictures come to be seen, as the stamps of a recording tell."""

    begin: float
    """From when on all cameras see the whole mark, s."""
    lag: Mapping[str, float]
    """For each detector how long after a picture begins to be taken it looks for the mark there, s."""
    delay: tuple[float, float]
    """From when the front camera's picture begins to be taken to when its angle is told: mean and std, s."""

    @classmethod
    def of(cls, recording: Recording) -> Seen:
        """Of a run of the machine. Pictures are waited for, so that the steps of these nodes go together."""
        begin, lag = 0.0, {}
        for film, mark in CAMERAS.values():
            (seen,) = np.nonzero(recording[mark]["seen"])
            if not len(seen):
                raise CommandError(f"{mark} never saw the mark move: record for longer", 3)
            begin = max(begin, float(recording[mark].start[seen[0]]) + CLEAR)
            lag[mark] = float(np.mean(_after(recording[film].start, recording[mark].start)))
        told = _after(recording["film"].start, recording["camera"].end)
        return cls(begin, lag, (float(np.mean(told)), float(np.std(told))))


def _after(first: Floats, then: Floats) -> Floats:
    """How much later each of these times is."""
    both = min(len(first), len(then))
    later: Floats = then[:both] - first[:both]
    return later


def identify(seen: Seen) -> str:
    """The specification for `parallax identify`. The maps of the cameras enter linearly, and are solved for."""
    text = IDENTIFY.format(begin=seen.begin, **seen.lag)
    for camera, (_, mark) in CAMERAS.items():
        for coordinate in ("u", "v"):
            terms = ", ".join(f'"{camera}.{coordinate}.{term}" = "{leaf}"' for term, leaf in TERMS.items())
            text += f'"{mark}.{coordinate}" = {{ linear = {{ {terms} }} }}\n'
    return text


def recorded() -> dict[str, Any]:
    """The machine, two films of it, the detectors that find its mark there, and its motor.

    The agent's commands come from a file.
    """
    spec = _machine()
    camera = node(spec, "camera")
    side = [
        _film("side_film", parameters={"view": "side"}),
        _detector("side_mark", "side_film"),
        {**camera, "name": "side", "rate": PICTURES["side_film"]},
    ]
    edges = [
        {**edge(spec, "world", "film"), "to": "side_film"},
        {**edge(spec, "film", "mark"), "from": "side_film", "to": "side_mark", "port": "film"},
        {**edge(spec, "mark", "camera"), "from": "side_mark", "to": "side", "port": "mark"},
    ]
    return copy.deepcopy({**spec, "node": spec["node"] + side, "connection": spec["connection"] + edges})


def _machine() -> dict[str, Any]:
    """The ready-made graph with a film in the place of its camera."""
    spec = Graph("pendulum").spec
    node(spec, "camera").update(kind="pendulum/camera-map", rate=PICTURES["film"], computation=MAPPING)
    spec["node"] += [_film("film"), _detector("mark", "film")]
    edges = [each for each in spec["connection"] if each["to"] != "camera"]
    edges += [
        {"from": "world", "to": "film", "blocking": True, "delay": wire(spec)},
        {"from": "film", "to": "mark", "blocking": True, "delay": wire(spec)},
        {"from": "mark", "to": "camera", "blocking": True, "delay": wire(spec)},
    ]
    return {**spec, "connection": edges}


def _film(name: str, **more: Any) -> dict[str, Any]:
    return {"name": name, "kind": "pendulum/film", "rate": PICTURES[name], "computation": RENDERING, **more}


def _detector(name: str, film: str) -> dict[str, Any]:
    return {"name": name, "kind": "pendulum/detector", "rate": PICTURES[film], "computation": LOOKING}


def deployed(
    sensor: str, policy: str, kind: str, filters: Mapping[str, Mapping[str, Any]], identified: Mapping[str, Any]
) -> dict[str, Any]:
    """The machine with a policy in the agent's place; `sensor` is what the policy sees: `encoder`, `camera` by the map
    that was `identified`, or one of `filters`, whose parameters these are. All of the filters run, so that they can be
    compared."""
    spec = _machine()
    node(spec, "agent").update(kind=kind, parameters={"file": policy})
    node(spec, "camera").update(parameters=node(identified, "camera")["parameters"])
    expected = node(spec, "estimator")["computation"]
    seen = edge(spec, "estimator", "agent")
    heard = [edge for edge in spec["connection"] if edge["to"] == "estimator"]
    spec["node"] = [each for each in spec["node"] if each["name"] != "estimator"]
    edges = [edge for edge in spec["connection"] if "estimator" not in (edge["from"], edge["to"])]
    edges.append({**seen, "from": sensor, "port": "observation"})
    if sensor == "encoder":
        # Nobody looks at pictures.
        pictures = ("film", "mark", "camera")
        spec["node"] = [each for each in spec["node"] if each["name"] not in pictures] + [ENCODER]
        edges = [edge for edge in edges if not {edge["from"], edge["to"]}.intersection(pictures)]
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


def simulated(
    identified: Mapping[str, Any], fitted: Mapping[str, Any], seen: Seen, noise: float, sensor: str, delays: bool
) -> dict[str, Any]:
    """The loop with what was found: the simulator and its hidden delay from the identification, all other delays as
    they were measured, and the camera's `noise`, rad. Without `delays`, none."""
    world = copy.deepcopy(node(identified, "world"))
    camera, agent, motor = (copy.deepcopy(node(fitted, name)) for name in ("camera", "agent", "motor"))
    mean, std = seen.delay
    late = {"distribution": "normal", "mean": mean, "std": std}
    camera.update(kind="pendulum/camera", parameters={"noise": noise}, computation=late)
    own = camera if sensor == "camera" else copy.deepcopy(ENCODER)
    agent.update(kind="pendulum/camera-policy" if sensor == "camera" else "pendulum/policy", parameters={"file": "-"})
    hidden = edge(identified, "motor", "world")["delay"]
    heard = edge(fitted, "estimator", "agent")["delay"]
    edges = [
        {"from": "world", "to": sensor, "delay": NONE},
        {"from": sensor, "to": "agent", "port": "observation", "blocking": True, "delay": heard},
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
