"""Graphs: nodes, connections and one supervisor; their schedules, and their compilation."""

from __future__ import annotations

import json
import os
import tempfile
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from . import _native
from ._native import ParallaxError
from .assemble import all_nodes, assembled, beginnings
from .compiled import CompiledGraph
from .describe import described, looking_in
from .flow import DataFlow, jax_nodes
from .member import Member
from .nodes import ModelNode, PinnedNode, Port, Stepped
from .program import Program
from .recording import Recording, load
from .running import RunState, Session, named_devices
from .state import Observation
from .stepping import Began, JaxStep, Shape
from .types import Tree

__all__ = ["FAST_AS_POSSIBLE", "REAL_TIME", "SIMULATED", "WALL_CLOCK", "Episodes", "Graph"]

Episodes = _native.Episodes
"""The schedules of several runs: which step ran when and what it consumed, without payloads."""


WALL_CLOCK: Literal["wall"] = "wall"
"""In real time: every node is a process of its own."""
SIMULATED: Literal["simulated"] = "simulated"
"""Under a simulated clock, which draws the delays: the same seed gives the same run, bit for bit."""
REAL_TIME = 1.0
"""A simulated second a second."""
FAST_AS_POSSIBLE = None
"""Not held back."""


class Graph:
    """A graph that was checked.

    `Graph(supervisor, nodes)` is made of nodes that were connected: `Node`, `PlainNode` and `RustNode`. Else `source`
    is the text of a `graph.toml`, a path to one, to a recording (`.mcap`), or the name of a graph that comes with
    Parallax. Nodes whose kind the program does not know are written in Python: `Graph.compile` takes them by name.
    Their inputs are what the graph connects to them; what they send is what their receivers in Rust expect. A file that
    a node names (an estimator's `system`) is looked for beside the `graph.toml`, and becomes part of the graph; that of
    a text or a mapping in the working directory.

    The graph runs at its supervisor's rate: `init`, then `run` for each of its steps (or `reset` and `step`, which give
    its outputs from outside), and `stop`. `clock` is `WALL_CLOCK` or `SIMULATED`, and under the latter
    `real_time_factor` simulated seconds take a second at least.
    """

    def __init__(
        self,
        source: str | os.PathLike[str] | Mapping[str, Any] | Member,
        nodes: Sequence[Member] | None = None,
        *,
        clock: Literal["wall", "simulated"] = WALL_CLOCK,
        real_time_factor: float | None = None,
        name: str | None = None,
    ) -> None:
        self._members: dict[str, Member] = {}
        self._homeless: dict[str, str] = {}
        self._folder: Path | None = None
        self._supervisor: Member | None = None
        if isinstance(source, Member):
            self._supervisor, self._name = source, name or source.name
            self._members = all_nodes(source, nodes)
            source, self._homeless = assembled(source, self._members, self._name, beginnings(self._members, 0))
        elif nodes is not None:
            raise TypeError("a list of nodes goes with a supervisor: Graph(supervisor, nodes)")
        elif isinstance(source, str | os.PathLike) and "\n" not in os.fspath(source):
            self._folder = Path(source).absolute().parent
        self._native = _open(source)
        self._content = self._native.nodes()
        self.spec: dict[str, Any] = json.loads(self._native.json())
        """Nodes, connections and supervisor, as in a `graph.toml`."""
        if clock == WALL_CLOCK and real_time_factor not in (None, REAL_TIME):
            raise ValueError("the wall clock runs in real time; a real_time_factor is for clock=SIMULATED")
        self._clock, self._factor = clock, real_time_factor
        self._devices: dict[str, str] = {}
        self._steps: dict[str, JaxStep] = {}
        self._session: Session | None = None
        self._runs: tempfile.TemporaryDirectory[str] | None = None
        self._made = 0

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

    def _pinned(self, node: str) -> Stepped:
        """A node of which only the messages are known."""
        content = self._content[self._place(node)]
        return PinnedNode((content["leaves"], content["initial"]))

    def generate(self, duration: float, episodes: int = 1, seed: int = 0) -> Episodes:
        """Draws the schedules of `episodes` runs of `duration` seconds; a seed gives the same ones on every machine."""
        return self._native.generate(seed, duration, episodes)

    def simulate(self, path: str | os.PathLike[str], duration: float, seed: int = 0) -> Recording:
        """Runs the graph under the simulated clock for `duration` seconds, writes the recording to `path` and reads it.

        Nodes in Python are stepped by this interpreter. Raises `ParallaxError` when a node fails.
        """
        session = self._prepared(seed, Path(path), "", SIMULATED)
        session.simulate(duration)
        return load(path)

    def warmup(self, devices: Any = None) -> None:
        """Compiles ahead of time the steps of the nodes written in JAX that this process makes: all of them under the
        simulated clock, the supervisor's on the wall clock. The others are traced, so that what is wrong with them is
        said here, and compiled by their own processes before the common start.

        `devices` says where they step: one for each node, by name or node, or one for all; devices of JAX, or text such
        as `"cpu"` and `"gpu:0"`. Nodes without one step on the processor on the wall clock, and where JAX does by
        default under the simulated one. Raises `ValueError` when a device is not there.
        """
        self._devices = named_devices(devices, self._written())
        self._steps = {}
        self._warm(beginnings(self._written(), 0), self._clock, trace=True)

    def init(
        self,
        seed: int = 0,
        *,
        recording: str | os.PathLike[str] | None = None,
        launch: str | os.PathLike[str] | None = None,
        patience: float = 120.0,
    ) -> RunState:
        """The state before the first step of a run; nothing runs yet.

        `seed` is that of all randomness. The run is recorded to `recording` (`.mcap`; a file there is replaced), or to
        a temporary file. On the wall clock `launch` is the path of a `launch.toml` (docs/real-time.md), and every node
        has `patience` seconds to get ready. What the nodes written in JAX begin with may be replaced before the first
        step.
        """
        if self._session is not None and not self._session.ended:
            self.stop()
        if recording is None:
            self._runs = self._runs or tempfile.TemporaryDirectory(prefix="parallax-run-")
            recording = Path(self._runs.name) / f"run-{self._made}.mcap"
            self._made += 1
        text = "" if launch is None else Path(launch).read_text(encoding="utf-8")
        self._session = self._prepared(seed, Path(recording), text, self._clock, patience)
        return self._session.state()

    def run(self, state: RunState) -> RunState:
        """Waits for the supervisor's next step, lets it make that, and gives what is then. The first call starts the
        run.

        What was changed in `state` of the supervisor's parameters and state is what it steps with. Raises
        `ParallaxError` with the reason when the run has ended, such as a node that failed.
        """
        session = self._running()
        return session.make(state, session.due(state), None)

    def reset(self, state: RunState) -> tuple[RunState, Observation]:
        """Starts the run and waits for the supervisor's first step: what it sees there."""
        session = self._running()
        return state, session.observation(session.due(state))

    def step(self, state: RunState, output: Tree | None = None) -> tuple[RunState, Observation]:
        """Sends `output` in the place of what the supervisor's own step would send, and waits for its next step: what
        it sees there. Without `output` its own step is made.

        On the wall clock, what is done between two calls counts as the time that the supervisor's step takes.
        """
        session = self._running()
        after = session.make(state, session.due(state), output)
        return after, session.observation(session.due(after))

    def stop(self) -> dict[str, Any] | None:
        """Ends the run: all nodes stop in order, and the recording is complete. Gives the run's report: on the wall
        clock that of `parallax run --json` (times in ns). Raises `ParallaxError` when the run could not be made."""
        return None if self._session is None else self._session.stop()

    def get_record(self) -> Recording:
        """The recording of the last run, which must be stopped."""
        if self._session is None or not self._session.ended or self._session.run is None:
            raise ParallaxError("there is no recording: a graph is recorded from init() and run() to stop()")
        return replace(load(self._session.path), kept=self._runs)

    def around(self, native: _native.Graph, members: Mapping[str, Member]) -> Graph:
        """A graph of another native one, with these nodes; it is compiled, and does not run."""
        made = Graph.__new__(Graph)
        made.__dict__ = {**self.__dict__, "_native": native, "_members": dict(members), "_session": None}
        made.spec = json.loads(native.json())
        made._content = native.nodes()
        return made

    def _running(self) -> Session:
        if self._session is None:
            raise ParallaxError("no run has begun: call init() first")
        return self._session

    def _written(self) -> dict[str, Member]:
        """The nodes that Python wrote down; those of a graph.toml are made from what it says of them."""
        if self._supervisor is None and not self._members:
            self._members = self._described()
        return self._members

    def _described(self) -> dict[str, Member]:
        """The nodes of a graph.toml that are written in JAX, or for a process of their own."""
        found: dict[str, Member] = {}
        for node in self.spec["node"]:
            if node["kind"] == "python" and "class" in node.get("parameters", {}):
                with looking_in(self._folder):
                    made = described(node["name"], node["parameters"])
                if isinstance(made, Member):
                    found[node["name"]] = made
        return found

    def _prepared(
        self, seed: int, path: Path, launch: str, clock: Literal["wall", "simulated"], patience: float = 120.0
    ) -> Session:
        written = self._written()
        start = {name: own for name, own in beginnings(written, seed).items()}
        spec = self.spec
        if self._supervisor is not None:
            spec, _ = assembled(self._supervisor, written, self._name, start)
        for node in spec["node"]:
            if node["name"] in self._devices:
                node["parameters"] = {**node["parameters"], "device": self._devices[node["name"]]}
        native = _open(spec) if self._supervisor is not None or self._devices else self._native
        self._warm(start, clock)
        return Session(
            native=native,
            spec=spec,
            shapes={name: self._shape(name) for name in self.nodes},
            clock=clock,
            factor=self._factor,
            steps={name: step for name, step in self._steps.items() if name in self._here(clock)},
            written=written,
            homeless=self._homeless,
            seed=seed,
            path=path,
            launch=launch,
            patience=patience,
            start=start,
            folder=self._folder,
        )

    def _here(self, clock: str) -> set[str]:
        """The nodes that this process steps."""
        return set(self.nodes) if clock == SIMULATED else {self.supervisor}

    def _warm(self, start: Mapping[str, Began], clock: str, trace: bool = False) -> None:
        """Compiles the steps that this process makes; with `trace`, traces the others."""
        for name, own in start.items():
            here = name in self._here(clock)
            if name not in self._steps and (here or trace):
                device = self._devices.get(name) if here else None
                self._steps[name] = JaxStep(self._members[name].graph_copy(), name, self._shape(name), own, device)
            if here:
                self._steps[name].compiled()

    def _shape(self, name: str) -> Shape:
        """What a node receives and sends."""
        content = self._content[self._place(name)]
        inputs = [(port["name"], port["window"], list(port["leaves"])) for port in content["ports"]]
        parameters = next(node for node in self.spec["node"] if node["name"] == name).get("parameters", {})
        known = parameters if content["kind"] == "python" else {}
        return Shape.of(known, inputs, (content["message"], list(content["leaves"])))

    def episodes(self, *recordings: str | os.PathLike[str]) -> Episodes:
        """The schedules of recordings of this graph."""
        return self._native.recorded(recordings)

    def compile(
        self,
        episodes: Episodes | DataFlow,
        nodes: Mapping[str, Stepped] | None = None,
        *,
        trainable: Mapping[str, tuple[float, float] | tuple[float, float, str]] | None = None,
        keep: Sequence[str] = (),
        pinned: Sequence[str] = (),
        partitioning: Literal["balanced", "ancestors"] = "balanced",
        method: Literal["mcs", "topological", "generational"] = "mcs",
        output_delays: Literal["as scheduled", "at run time"] = "as scheduled",
    ) -> CompiledGraph:
        """The graph along these schedules, as pure functions.

        They are drawn (`generate`), read from recordings (`episodes`), or what a recording became (`DataFlow`), whose
        graph is then the one that is compiled. `nodes` are written in JAX and take the place of the nodes of their
        names; those that the graph was made of need not be named, and all others run by their Rust models. `trainable`
        makes connections' delays parameters between two bounds (s), by `"hold"` (the default) or `"linear"`
        interpolation. Steps that no later step of the supervisor depends on are left out, unless their node is named in
        `keep`. The outputs of nodes in `pinned` will be given to the rollout: their steps need no inputs, and what only
        feeds them is left out. `partitioning` is `"balanced"`, or `"ancestors"` as in the paper; `method` says how the
        slots are found: the minimum common supergraph, or one of the paper's baselines. `output_delays` says how long
        steps take whose delay follows from their output: as long as in the episodes (what was recorded, or what the
        graph expects), or as long as the outputs say that are computed at run time.
        """
        given: dict[str, Stepped] = {**jax_nodes(self._members), **dict(nodes or {})}
        if isinstance(episodes, DataFlow):
            found = {**episodes.trainable, **dict(trainable or {})}
            flow, episodes, trainable = episodes.graph, episodes.episodes, found
            if flow is not self:
                options: dict[str, Any] = {"keep": keep, "pinned": pinned, "partitioning": partitioning}
                options |= {"method": method, "output_delays": output_delays, "trainable": trainable}
                given = {name: node for name, node in given.items() if name in flow.nodes}
                return flow.compile(episodes, given, **options)
        unknown = given.keys() - set(self.nodes)
        if unknown:
            raise ValueError(f"the graph has no nodes {sorted(unknown)}; it has {', '.join(self.nodes)}")
        bound: list[tuple[str, Stepped]] = []
        for name in self.nodes:
            node: Stepped | None = given[name] if name in given else self.model(name)
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
    folder = Path()
    if isinstance(source, Mapping):
        spec: dict[str, Any] = dict(source)
    else:
        text = os.fspath(source)
        if text in _native.graphs():
            return _native.Graph.built_in(text)
        if text.endswith(".mcap"):
            return _native.Graph.from_recording(text, [])
        if "\n" not in text:
            folder, text = Path(text).parent, Path(text).read_text(encoding="utf-8")
        spec = tomllib.loads(text)
    return _native.Graph(json.dumps(spec), "json", _python_kinds(spec), folder)


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
