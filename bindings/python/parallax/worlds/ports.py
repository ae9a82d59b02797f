"""Which leaf of which message drives which actuator of a simulator."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from ..missing import package
from ..types import Scalar, Tree

__all__ = ["Ports", "package"]


class Ports(dict[str, list[tuple[str, int]]]):
    """The leaves of each port's messages that drive an actuator, with its number."""

    def __init__(self, commands: Mapping[str, str], number: Callable[[str], int]) -> None:
        """`commands` gives an actuator's name for each `PORT.LEAF`, and `number` its number. Raises `ValueError` for
        what does not look like that."""
        super().__init__()
        for leaf, name in commands.items():
            port, dot, rest = leaf.partition(".")
            if not dot or not rest:
                raise ValueError(f"commands: `{leaf}` must look like PORT.LEAF, such as motor.voltage")
            self.setdefault(port, []).append((rest, number(name)))

    def driven(self, port: str, message: Tree) -> list[tuple[int, Scalar]]:
        """The actuators that a message at a port drives, each with its command. Raises `ValueError` for a message
        without the leaf."""
        made = []
        for leaf, actuator in self[port]:
            value = message
            for part in leaf.split("."):
                if not isinstance(value, Mapping) or part not in value:
                    raise ValueError(f"a message at the port `{port}` has no leaf `{leaf}`: {message!r}")
                value = value[part]
            made.append((actuator, value))
        return made

    def check(self, node: str, inputs: Mapping[str, Any]) -> None:
        """Raises `ValueError` when nothing is connected to a port of the node `node`."""
        for port in self:
            if port not in inputs:
                raise ValueError(f"node {node}: nothing is connected to the port `{port}`; it has {[*inputs]}")
