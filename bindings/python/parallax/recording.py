"""Recordings as numpy arrays."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from . import _native
from .flow import DataFlow
from .structure import Structure
from .trees import nested
from .types import Bytes, Floats, Integers, Tree

__all__ = ["NodeTrack", "PortTrack", "Recording", "Trajectory", "load", "trajectories"]


@dataclass(frozen=True)
class PortTrack:
    """What one node's steps consumed at one port; windows oldest first."""

    port: str
    """The port's name."""
    seq: Integers
    """Which messages, `[step, window]`; −1 for an initial message."""
    sent_ns: Integers
    """When they were sent, ns, `[step, window]`."""
    received_ns: Integers
    """When they arrived, ns, `[step, window]`."""
    superseded: Integers
    """How many messages left unseen since the step before, `[step]`."""

    @property
    def sent(self) -> Floats:
        """When they were sent, s, `[step, window]`."""
        return self.sent_ns / 1e9

    @property
    def received(self) -> Floats:
        """When they arrived, s, `[step, window]`."""
        return self.received_ns / 1e9


@dataclass(frozen=True)
class NodeTrack:
    """What one node did."""

    name: str
    """Its name."""
    message: str
    """The name of its messages' type."""
    leaves: tuple[str, ...]
    """The names of a message's leaves."""
    initial: Floats
    """The initial message, `[leaf]`."""
    stand_in: bool
    """Whether it stands in for hardware."""
    seq: Integers
    """The messages' numbers, `[message]`."""
    sent_ns: Integers
    """When they were sent, ns, `[message]`."""
    payload: Floats
    """The messages, `[message, leaf]`."""
    step_seq: Integers
    """The steps' numbers, `[step]`."""
    due_ns: Integers
    """When each step was due, ns, `[step]`."""
    start_ns: Integers
    """When it started, ns, `[step]`."""
    end_ns: Integers
    """When it ended, ns, `[step]`."""
    inputs: dict[str, PortTrack]
    """What the steps consumed, by port."""
    structure: Structure | None = None
    """What a message is, where a node in Python sends more than a dictionary of numbers."""

    @property
    def sent(self) -> Floats:
        """When the messages were sent, s, `[message]`."""
        return self.sent_ns / 1e9

    @property
    def due(self) -> Floats:
        """When each step was due, s, `[step]`."""
        return self.due_ns / 1e9

    @property
    def start(self) -> Floats:
        """When each step started, s, `[step]`."""
        return self.start_ns / 1e9

    @property
    def end(self) -> Floats:
        """When each step ended, s, `[step]`."""
        return self.end_ns / 1e9

    @cached_property
    def messages(self) -> dict[str, Floats]:
        """The messages' leaves by name, each `[message]`."""
        return {leaf: self.payload[:, place] for place, leaf in enumerate(self.leaves)}

    def __getitem__(self, leaf: str) -> Floats:
        """A leaf of all messages, `[message]`."""
        return self.messages[leaf]

    @cached_property
    def tree(self) -> Tree:
        """The messages as the node sent them, with a leading axis `[message]`: what a rollout takes as `pinned`.
        Numbers that are recorded as they are (`float32` and `float64`) are `float64` views of `payload`."""
        if self.structure is None:
            return nested(self.leaves, [self.payload[:, place] for place in range(len(self.leaves))])
        return self.structure.columns(self.payload, self.leaves)

    def to_pandas(self) -> Any:
        """The messages as a `pandas.DataFrame` with a column for each leaf, by when they were sent (s). It is a view of
        `payload`. Needs the package `pandas`."""
        import pandas

        index = pandas.Index(self.sent, name="sent")
        return pandas.DataFrame(self.payload, index=index, columns=list(self.leaves), copy=False)

    def to_xarray(self) -> Any:
        """The messages as an `xarray.Dataset` with a variable for each leaf along `sent` (s). They are views of
        `payload`. Needs the package `xarray`."""
        import xarray

        coordinates = {"sent": ("sent", self.sent, {"units": "s"}), "seq": ("sent", self.seq)}
        leaves = {leaf: ("sent", values) for leaf, values in self.messages.items()}
        return xarray.Dataset(leaves, coords=coordinates, attrs={"node": self.name, "message": self.message})


@dataclass(frozen=True)
class Recording:
    """The messages and the schedule of one run."""

    graph_json: str
    """The graph that ran, as JSON."""
    clock: dict[str, Any]
    """The clock that drove it, with its seed."""
    duration: float
    """How long it ran, s."""
    nodes: dict[str, NodeTrack]
    """What every node did, by name, in the order of the graph."""
    losses: list[dict[str, Any]]
    """Messages that were sent and never reached a window, with the reason; times in ns."""
    faults: list[dict[str, Any]]
    """Nodes that ended before the run did; times in ns."""
    truncated: str | None
    """Where the file stops, when its end is missing."""
    path: Path | None = None
    """The file."""
    kept: Any = None
    """What keeps a temporary file for as long as somebody has the recording."""

    @cached_property
    def graph(self) -> dict[str, Any]:
        """The graph that ran: nodes, connections, supervisor."""
        content: dict[str, Any] = json.loads(self.graph_json)
        return content

    def to_graph(self) -> DataFlow:
        """What ran, as a computation graph, to be augmented and compiled."""
        from .graph import Graph

        if self.path is None:
            raise ValueError("this recording is of no file; load() it from one")
        graph = Graph(self.path)
        return DataFlow(graph, graph.episodes(self.path), {})

    def data(self, node: str) -> list[Bytes]:
        """The data of each of a node's messages, such as pictures, in the order of the messages; read from the file at
        every call. A picture of `w` by `h` pixels in rgb8 is `.reshape(h, w, 3)`. Raises `ParallaxError` where there is
        no such node."""
        if self.path is None:
            raise ValueError("this recording is of no file; load() it from one")
        return _native.data(self.path, node)

    def __getitem__(self, node: str) -> NodeTrack:
        """What the node called `node` did."""
        return self.nodes[node]

    def __repr__(self) -> str:
        return f"Recording({self.graph['name']!r}, {self.duration} s, nodes {', '.join(self.nodes)})"


def load(path: str | os.PathLike[str]) -> Recording:
    """Reads a recording (`.mcap`). Raises `ParallaxError` with the reason when it cannot."""
    content = _native.load(path)
    described = {node["name"]: node.get("parameters", {}) for node in json.loads(content["graph"])["node"]}
    nodes = {}
    for node in content["nodes"]:
        inputs = {port["port"]: _port(port) for port in node["inputs"]}
        nodes[node["name"]] = NodeTrack(
            name=node["name"],
            message=node["message"],
            leaves=tuple(node["leaves"]),
            initial=node["initial"],
            stand_in=node["stand_in"],
            seq=node["seq"],
            sent_ns=node["sent"],
            payload=node["payload"],
            step_seq=node["step_seq"],
            due_ns=node["due"],
            start_ns=node["start"],
            end_ns=node["end"],
            inputs=inputs,
            structure=_structure(described.get(node["name"], {})),
        )
    return Recording(
        graph_json=content["graph"],
        clock=json.loads(content["clock"]),
        duration=content["duration"] / 1e9,
        nodes=nodes,
        losses=json.loads(content["losses"]),
        faults=json.loads(content["faults"]),
        truncated=content["truncated"],
        path=Path(path),
    )


def _structure(parameters: dict[str, Any]) -> Structure | None:
    """What a node in Python says of its messages."""
    return Structure(parameters["tree"]) if "tree" in parameters and "class" in parameters else None


def _port(port: dict[str, Any]) -> PortTrack:
    return PortTrack(port["port"], port["seq"], port["sent"], port["received"], np.asarray(port["superseded"]))


@dataclass(frozen=True)
class Trajectory:
    """What one model went through in a recorded run."""

    params: Floats
    """Its parameters, `[leaf]`."""
    states: Floats
    """Its state before every step and after the last, `[step + 1, leaf]`."""
    noise: Floats
    """The standard normal numbers that every step drew, `[step, number]`."""
    outputs: Floats
    """What it sent, `[step, leaf]`."""
    differing: int
    """How many outputs are not the recorded ones, bit for bit."""


def trajectories(path: str | os.PathLike[str]) -> dict[str, Trajectory]:
    """Runs the models of a recording again, each step on what it consumed, and tells what they went through."""
    return {name: Trajectory(**content) for name, content in _native.trajectories(path).items()}
