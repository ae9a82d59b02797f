"""What ran, as a computation graph: the steps of a recording and what each consumed, with simulators where nothing was
recorded.

`Recording.to_graph` makes one, `DataFlow.augment` puts simulator nodes into it (van der Heijden et al., "REX", section
3.3 and figure 4), `DataFlow.compile` makes pure functions of it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from . import _native
from .assemble import all_nodes, assembled, beginnings
from .delay import Trainable
from .member import Connection, Member
from .member import Node as JaxNode

if TYPE_CHECKING:
    from .compiled import CompiledGraph
    from .graph import Graph

__all__ = ["DataFlow"]

Bounds = tuple[float, float, str]
"""The shortest and the longest delay, s, and how payloads follow."""


@dataclass(frozen=True)
class DataFlow:
    """Episodes of a graph: recorded ones, with what was put into them since."""

    graph: Graph
    """The graph that they are episodes of."""
    episodes: _native.Episodes
    """Which step ran when, and what it consumed."""
    trainable: dict[str, Bounds]
    """The connections whose delays are found by training."""

    def __add__(self, other: DataFlow) -> DataFlow:
        """The episodes of both, which are of one graph."""
        return DataFlow(self.graph, self.episodes + other.episodes, self.trainable)

    def augment(self, nodes: Sequence[Member], *, seed: int = 0) -> DataFlow:
        """The same with these nodes, the supervisor among them.

        A node that was recorded steps when it did and sees what it saw, also where another of its name takes its place
        (a simulated camera that of a camera). A node that was not recorded steps at its rate. A connection that was not
        recorded, which must not be blocking, gets its delay from its distribution, drawn from `seed`, or from training
        (`Trainable`). Recorded nodes that are not among `nodes` are left out. Raises `ParallaxError` or `ValueError`.
        """
        named = {node.name: node for node in nodes}
        if self.graph.supervisor not in named:
            raise ValueError(f"the supervisor {self.graph.supervisor} of what was recorded is not among the nodes")
        supervisor = named[self.graph.supervisor]
        members = all_nodes(supervisor, nodes)
        spec, _ = assembled(supervisor, members, self.graph.spec["name"], beginnings(members, 0))
        before = {node["name"]: node for node in self.graph.spec["node"]}
        known = [_edge(edge) for edge in self.graph.spec["connection"]]
        phases = {node["name"]: node["phase"] for node in _native.Graph(json.dumps(spec), "json", [], Path()).nodes()}
        changes = {
            "dropped": [name for name in before if name not in members],
            "recast": [node for node in spec["node"] if node["name"] in before and _other(node, before[node["name"]])],
            "nodes": [[node, phases[node["name"]]] for node in spec["node"] if node["name"] not in before],
            "connections": [
                [connection.json(receiver.name), _bounds(connection)]
                for receiver in members.values()
                for connection in receiver.connections
                if _edge(connection.json(receiver.name)) not in known
            ],
        }
        native, episodes, trainable = self.graph._native.augment(self.episodes, json.dumps(changes), seed)
        graph = self.graph.around(native, members)
        names = graph.connections
        found = {names[index]: (low, high, "linear" if linear else "hold") for index, low, high, linear in trainable}
        return DataFlow(graph, episodes, {**self.trainable, **found})

    def compile(self, nodes: Mapping[str, Any] | None = None, **options: Any) -> CompiledGraph:
        """As `Graph.compile`, along these episodes; nodes that were given to `augment` need not be named."""
        return self.graph.compile(self.episodes, nodes, **{"trainable": self.trainable, **options})


def _edge(edge: Mapping[str, Any]) -> tuple[Any, ...]:
    """What makes two connections the same: their delays are what was recorded."""
    port = edge.get("port") or edge["from"]
    return edge["from"], edge["to"], port, edge.get("window", 1), edge.get("skip", False)


def _other(node: Mapping[str, Any], before: Mapping[str, Any]) -> bool:
    """Whether a node is another one than the recorded one of its name."""

    def identity(spec: Mapping[str, Any]) -> Any:
        parameters = {key: value for key, value in spec.get("parameters", {}).items() if key != "device"}
        return spec["kind"], json.dumps(parameters, sort_keys=True)

    return bool(identity(node) != identity(before))


def _bounds(connection: Connection) -> Bounds | None:
    delay = connection.delay
    return (delay.min, delay.max, delay.interpolation) if isinstance(delay, Trainable) else None


def jax_nodes(members: Mapping[str, Member]) -> dict[str, JaxNode]:
    """Those that are written in JAX."""
    return {name: node for name, node in members.items() if isinstance(node, JaxNode)}
