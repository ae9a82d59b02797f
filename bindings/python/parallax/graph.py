"""Graphs: nodes, connections and one supervisor; their schedules, and their compilation."""

from __future__ import annotations

import json
import os
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from . import _native
from .compiled import CompiledGraph
from .nodes import ModelNode, Node, PinnedNode, Port
from .program import Program
from .recording import Recording, load

__all__ = ["Episodes", "Graph"]

Episodes = _native.Episodes
"""The schedules of several runs: which step ran when and what it consumed, without payloads."""


class Graph:
    """A graph that was checked.

    `text` is that of a `graph.toml`, a path to one, to a recording (`.mcap`), or the name of a graph that comes with
    Parallax. Nodes whose kind the program does not know are written in Python: `Graph.compile` takes them by name.
    Their inputs are what the graph connects to them; what they send is what their receivers in Rust expect.
    """

    def __init__(self, source: str | os.PathLike[str] | Mapping[str, Any]) -> None:
        self._native = _open(source)
        self._content = self._native.nodes()
        self.spec: dict[str, Any] = json.loads(self._native.json())
        """Nodes, connections and supervisor, as in a `graph.toml`."""

    @property
    def nodes(self) -> list[str]:
        """The nodes' names."""
        return [node["name"] for node in self._content]

    @property
    def supervisor(self) -> str:
        """The supervisor's name."""
        return self.nodes[self._native.supervisor]

    @property
    def connections(self) -> list[str]:
        """The connections' names: `from->to`, with `.port` where the port has another name than the sender."""
        return list(self._native.connections())

    @property
    def warnings(self) -> list[str]:
        """What is probably not meant."""
        return list(self._native.warnings())

    def toml(self) -> str:
        """The graph as the text of a `graph.toml`, for the command line."""
        return self._native.toml()

    def json(self) -> str:
        """The graph as text."""
        return self._native.json()

    def __repr__(self) -> str:
        return f"Graph({self.spec['name']!r}, nodes {', '.join(self.nodes)}, supervisor {self.supervisor})"

    def ports(self, node: str) -> list[Port]:
        """The inputs of a node, in the order of its kind."""
        return [
            Port(port["name"], port["connection"], port["from"], port["window"], tuple(port["leaves"]))
            for port in self._content[self._place(node)]["ports"]
        ]

    def model(self, node: str) -> ModelNode | None:
        """The Rust model of a node, bound to its ports; none for a node that is plain Rust or written in Python."""
        content = self._content[self._place(node)]
        model = content["model"]
        if model is None:
            return None
        return ModelNode(
            Program(model["program"]),
            (model["params"], model["params_start"]),
            (model["state"], model["state_start"]),
            (content["leaves"], content["initial"]),
            model["noise"],
            self.ports(node),
        )

    def _place(self, node: str) -> int:
        if node not in self.nodes:
            raise ValueError(f"the graph has no node `{node}`; it has {', '.join(self.nodes)}")
        return self.nodes.index(node)

    def _pinned(self, node: str) -> Node:
        """A node of which only the messages are known."""
        content = self._content[self._place(node)]
        return PinnedNode((content["leaves"], content["initial"]))

    def generate(self, duration: float, episodes: int = 1, seed: int = 0) -> Episodes:
        """Draws the schedules of `episodes` runs of `duration` seconds; a seed gives the same ones on every machine."""
        return self._native.generate(seed, duration, episodes)

    def simulate(self, path: str | os.PathLike[str], duration: float, seed: int = 0) -> Recording:
        """Runs the graph under the simulated clock for `duration` seconds, writes the recording to `path` and reads it.

        Every node must be one that comes with Parallax.
        """
        self._native.simulate(path, duration, seed)
        return load(path)

    def episodes(self, *recordings: str | os.PathLike[str]) -> Episodes:
        """The schedules of recordings of this graph."""
        return self._native.recorded(recordings)

    def compile(
        self,
        episodes: Episodes,
        nodes: Mapping[str, Node] | None = None,
        *,
        trainable: Mapping[str, tuple[float, float] | tuple[float, float, str]] | None = None,
        keep: Sequence[str] = (),
        pinned: Sequence[str] = (),
        partitioning: Literal["balanced", "ancestors"] = "balanced",
        method: Literal["mcs", "topological", "generational"] = "mcs",
        output_delays: Literal["as scheduled", "at run time"] = "as scheduled",
    ) -> CompiledGraph:
        """The graph along these schedules, as pure functions.

        `nodes` are written in JAX and take the place of the nodes of their names; all others run by their Rust
        models. `trainable` makes connections' delays parameters between two bounds (s), by `"hold"` (the
        default) or `"linear"` interpolation. Steps that no later step of the supervisor depends on are left
        out, unless their node is named in `keep`. The outputs of nodes in `pinned` will be given to the
        rollout: their steps need no inputs, and what only feeds them is left out. `partitioning` is
        `"balanced"`, or `"ancestors"` as in the paper; `method` says how the slots are found: the minimum
        common supergraph, or one of the paper's baselines. `output_delays` says how long steps take whose delay
        follows from their output: as long as in the episodes (what was recorded, or what the graph expects), or
        as long as the outputs say that are computed at run time.
        """
        given = dict(nodes or {})
        unknown = given.keys() - set(self.nodes)
        if unknown:
            raise ValueError(f"the graph has no nodes {sorted(unknown)}; it has {', '.join(self.nodes)}")
        bound: list[tuple[str, Node]] = []
        for name in self.nodes:
            node: Node | None = given[name] if name in given else self.model(name)
            if node is None and name in pinned:
                node = self._pinned(name)
            if node is None:
                raise ValueError(
                    f"node `{name}` is no model: give one written in JAX for it, as in nodes={{'{name}': ...}}"
                )
            bound.append((name, node))
        delays = []
        for connection, bounds in (trainable or {}).items():
            if connection not in self.connections:
                raise ValueError(f"no connection `{connection}`; there are {', '.join(self.connections)}")
            linear = len(bounds) == 3 and bounds[2] == "linear"
            delays.append((self.connections.index(connection), bounds[0], bounds[1], linear))
        stateful = [
            name in given or bool(content["model"] and content["model"]["state"])
            for content, (name, _) in zip(self._content, bound, strict=True)
        ]
        compiled = self._native.compile(
            episodes,
            trainable=delays,
            keep=[self._place(name) for name in keep],
            pinned=[self._place(name) for name in pinned],
            cut=partitioning,
            method=method,
            stateful=stateful,
            at_run_time={"as scheduled": False, "at run time": True}[output_delays],
        )
        ports = [[port.name for port in self.ports(name)] for name in self.nodes]
        return CompiledGraph(compiled.tables(), bound, ports, self.connections, compiled)


def _open(source: str | os.PathLike[str] | Mapping[str, Any]) -> _native.Graph:
    if isinstance(source, Mapping):
        spec: dict[str, Any] = dict(source)
    else:
        text = os.fspath(source)
        if text in _native.graphs():
            return _native.Graph.built_in(text)
        if text.endswith(".mcap"):
            return _native.Graph.from_recording(text, [])
        if "\n" not in text:
            text = Path(text).read_text(encoding="utf-8")
        spec = tomllib.loads(text)
    return _native.Graph(json.dumps(spec), "json", _python_kinds(spec))


def _python_kinds(spec: Mapping[str, Any]) -> list[tuple[str, list[Any], tuple[str, list[str]], Any]]:
    """The kinds that no Rust crate brings, with the inputs and messages that the graph implies."""
    known = _native.kinds()
    spec = {**spec, "node": [node for node in spec.get("node", ()) if node["kind"] != "python"]}
    kind_of = {node["name"]: node["kind"] for node in spec.get("node", ())}
    connections = [(edge["from"], edge["to"], edge.get("port") or edge["from"]) for edge in spec.get("connection", ())]
    outputs: dict[str, tuple[str, list[str]]] = {}
    for kind in kind_of.values():
        if kind in known:
            outputs[kind] = known[kind]["output"]
            continue
        wanted = [
            known[kind_of[to]]["inputs"][port]
            for sender, to, port in connections
            if kind_of.get(sender) == kind and kind_of.get(to) in known and port in known[kind_of[to]]["inputs"]
        ]
        outputs[kind] = wanted[0] if wanted else (kind, [])
    kinds = []
    for kind in dict.fromkeys(kind_of.values()):
        if kind in known:
            continue
        inputs = {
            port: (port, *outputs[kind_of[sender]])
            for sender, to, port in connections
            if kind_of.get(to) == kind and sender in kind_of
        }
        message, leaves = outputs[kind]
        kinds.append((kind, list(inputs.values()), (message, leaves), np.zeros(len(leaves)).tolist()))
    return kinds
