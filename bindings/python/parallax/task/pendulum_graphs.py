"""The pendulum's graphs: the machine as it runs, and the simulators on which policies are trained."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

from ..graph import Graph
from .graphs import NONE, edge, ideal, node
from .pendulum_identify import Seen

__all__ = ["begun", "deployed", "filters", "recorded", "simulated"]

PICTURES = {"film": 50.0, "side_film": 25.0}
"""Pictures a second of each camera; a recording holds all of them, 1.6 MB for each second of 50."""

RENDERING: dict[str, Any] = {"distribution": "normal", "mean": 1e-3, "std": 1e-4}
"""What a picture takes, as the schedule expects it,"""
LOOKING: dict[str, Any] = {"distribution": "normal", "mean": 1e-4, "std": 2e-5}
"""what looking for the mark in it takes,"""
MAPPING: dict[str, Any] = {"distribution": "constant", "seconds": 1e-5}
"""and what the angle takes that belongs to it."""

ENCODER = {"name": "encoder", "kind": "pendulum/encoder", "rate": 100.0, "computation": NONE}


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


def begun(spec: Mapping[str, Any], hands: Mapping[str, Any]) -> dict[str, Any]:
    """The same graph with the world as `hands` hold it at first and tap it later: see `parallax_nodes`'
    `pendulum::world::Settings`."""
    held = copy.deepcopy(dict(spec))
    node(held, "world").update(parameters=dict(hands))
    return held


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
