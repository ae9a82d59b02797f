"""Nodes from what a graph says of them: the class and its arguments, in the parameters of a node of the kind
`python`."""

from __future__ import annotations

import contextlib
import importlib
import json
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from .carry import carried
from .member import Node
from .stepping import Input, Shape, Stepper, began, node_key, stepper_of

__all__ = ["build", "described", "looking_in", "process_of"]

KNOWN = {"class", "arguments", "output", "initial", "tree", "sees", "device"}
"""The parameters of such a node."""
process_of: list[str] = []
"""The node whose process this is, if it is one's."""


def _resolve(place: str) -> Any:
    """The class at `module:Class`."""
    module, separator, name = place.partition(":")
    if not separator or not name:
        raise ValueError(f'class = "{place}" must look like "module:Class"')
    try:
        found: Any = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name and module != error.name and not module.startswith(f"{error.name}."):
            raise
        raise ModuleNotFoundError(f"{sys.executable} finds no module `{module}` in {sys.path}") from None
    for part in name.split("."):
        if not hasattr(found, part):
            raise AttributeError(f"the module `{module}` ({sys.modules[module].__file__}) has no `{name}`")
        found = getattr(found, part)
    return found


def described(name: str, given: Mapping[str, Any]) -> Any:
    """The object that the parameters of a node describe."""
    if unknown := sorted(given.keys() - KNOWN):
        raise ValueError(f"node `{name}` has unknown parameters {unknown}; what is its own belongs into `arguments`")
    if "class" not in given:
        raise ValueError(f'node `{name}` is of kind "python": its parameters need class = "module:Class"')
    node = _resolve(given["class"])(**given.get("arguments", {}))
    if not callable(getattr(node, "step", None)):
        raise TypeError(f"{given['class']} has no method `step`")
    return node


@contextlib.contextmanager
def looking_in(folder: Path | None) -> Iterator[None]:
    """Lets modules be found in `folder`, too."""
    if folder is None:
        yield
        return
    sys.path.insert(0, str(folder))
    try:
        yield
    finally:
        sys.path.remove(str(folder))


def build(
    name: str, rate: float, seed: int, parameters: str, inputs: list[Input], output: tuple[str, list[str]]
) -> Stepper:
    """The node that a graph describes, ready to step."""
    given: dict[str, Any] = json.loads(parameters)
    node = described(name, given)
    shape, device = Shape.of(given, inputs, output), given.get("device")
    start = None
    if isinstance(node, Node):
        start = carried(name, began(node, node_key(seed, name)))
    return stepper_of(node, name, seed, shape, start, device)
