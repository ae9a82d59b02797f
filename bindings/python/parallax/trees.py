"""Dotted leaf names as nested dictionaries, the pytrees of Rust models' parameters, states and messages."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from .structure import named
from .types import Scalar, Tree

__all__ = ["flat", "nested"]


def nested(names: Sequence[str], values: Sequence[Scalar]) -> Tree:
    """`["position.x", "time"]` and two values as `{"position": {"x": ...}, "time": ...}`; a single leaf without a name
    is the value itself."""
    if list(names) == [""]:
        return values[0]
    result: dict[str, Any] = {}
    for name, value in zip(names, values, strict=True):
        *path, last = name.split(".")
        place = result
        for part in path:
            place = place.setdefault(part, {})
        place[last] = value
    return result


def flat(names: Sequence[str], tree: Tree, what: str) -> list[Scalar]:
    """The leaves in the order of `names`; `what` the tree is, for the message of the error."""
    if list(names) == [""]:
        return [tree]
    leaves = [_leaf(tree, name) for name in names]
    if any(leaf is None for leaf in leaves):
        # It may be another pytree, whose numbers have these names.
        have = named(tree)
        leaves = [have.get(name) for name in names]
    for name, leaf in zip(names, leaves, strict=True):
        if leaf is None:
            raise TypeError(f"{what} has no leaf `{name}`; it must be a (nested) dictionary with {', '.join(names)}")
    return leaves


def _leaf(tree: Tree, name: str) -> Scalar | None:
    """What a nested dictionary has at a dotted name."""
    place = tree
    for part in name.split("."):
        if not isinstance(place, dict) or part not in place:
            return None
        place = place[part]
    return place
