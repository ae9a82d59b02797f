"""Parameters and state of the nodes of a running graph."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

from . import _native

__all__ = ["NodeReading", "node_reading", "reset_state", "set_parameter", "set_parameters"]

_PATIENCE = 10.0


@dataclass(frozen=True)
class NodeReading:
    """What can be set of a running node, and its state, both before the same step."""

    step: int
    """That step."""
    parameters: dict[str, float]
    """The values of the parameters that can be set."""
    units: dict[str, str]
    """Their units."""
    state: dict[str, float]
    """Its state."""


def set_parameter(
    run: str | None, name: str, value: float, unit: str | None = None, *, patience: float = _PATIENCE
) -> int:
    """Set the parameter `NODE.PARAMETER` of a running graph; give the first step that sees the value.

    `run` is the run's id, the process of its launcher or its graph's name; `None` is the only one that runs. The
    recording says who set what and before which step. `ParallaxError` says what the node does not take; nothing is
    changed then.
    """
    return set_parameters(run, {name: value if unit is None else (value, unit)}, patience=patience)


def set_parameters(
    run: str | None, values: dict[str, float | tuple[float, str]], *, patience: float = _PATIENCE
) -> int:
    """Set parameters of one node of a running graph, all before the same step, or none; give that step."""
    nodes, assignments = set(), []
    for name, value in values.items():
        node, dot, parameter = name.partition(".")
        if not dot:
            raise _native.ParallaxError(f"`{name}` is no parameter: it must look like NODE.PARAMETER")
        number, unit = value if isinstance(value, tuple) else (value, None)
        nodes.add(node)
        assignments.append((parameter, float(number), unit))
    if len(nodes) != 1:
        raise _native.ParallaxError("parameters of one node are set together, and of one node only")
    return _told(_native.set_parameters(run, nodes.pop(), assignments, patience))["step"]


def node_reading(run: str | None, node: str, *, patience: float = _PATIENCE) -> NodeReading:
    """Read what can be set of a node of a running graph, and its state."""
    told = _told(_native.read_node(run, node, patience))
    return NodeReading(
        step=told["step"],
        parameters={about["name"]: value for about, value in told["parameters"]},
        units={about["name"]: about["unit"] for about, _ in told["parameters"]},
        state=dict(told["state"]),
    )


def reset_state(run: str | None, node: str, *, patience: float = _PATIENCE) -> int:
    """Put the state of a node of a running graph back to that before its first step; give the first step then."""
    return _told(_native.reset_state(run, node, patience))["step"]


def _told(text: str) -> dict[str, Any]:
    told: dict[str, Any] = json.loads(text)
    return told
