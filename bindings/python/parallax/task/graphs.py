"""Parts of a graph's content, as the tasks put graphs together."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

__all__ = ["NONE", "edge", "ideal", "node"]

NONE: dict[str, Any] = {"distribution": "constant", "seconds": 0.0}
"""No delay."""


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


def ideal(spec: dict[str, Any]) -> dict[str, Any]:
    """The same without any delay."""
    for part in spec["node"]:
        part["computation"] = NONE
    for part in spec["connection"]:
        part["delay"] = NONE
    return spec
