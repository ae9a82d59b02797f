"""Nodes as Python writes them down, and their connections: what a graph is made of.

A `Node` is written in JAX and runs everywhere: in a process of its own on the wall clock, under the simulated clock,
and compiled. A `PlainNode` is any other Python, such as a driver, and runs on both clocks. A `RustNode` is one of the
kinds that come with Parallax. All of them connect to each other.
"""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from .delay import DelayLike, Trainable, delay_of
from .nodes import Step
from .structure import class_place
from .types import Array, Tree

__all__ = ["Connection", "Member", "Node", "PlainNode", "RustNode"]

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")


@dataclass(frozen=True)
class Connection:
    """One node's output feeding another's input."""

    sender: Member
    """Who sends."""
    port: str
    """The receiver's input: `step[port]`."""
    block: bool = False
    """Whether a step waits for the messages that belong to it."""
    window: int = 1
    """How many messages a step sees, oldest first."""
    skip: bool = False
    """Whether a message that arrives exactly at the start is left for the next step; breaks cycles."""
    delay: DelayLike = 0.0
    """How long a message travels, s."""
    jitter: Literal["latest", "buffer"] = "latest"
    """Whether a message may be used when it arrives, or is held until its expected arrival."""

    def json(self, receiver: str) -> dict[str, Any]:
        """As a `graph.toml` has it."""
        made: dict[str, Any] = {
            "from": self.sender.name,
            "to": receiver,
            "blocking": self.block,
            "window": self.window,
            "skip": self.skip,
            "jitter": self.jitter,
            "delay": delay_of(self.delay, f"the delay from {self.sender.name} to {receiver}"),
        }
        return made if self.port == self.sender.name else made | {"port": self.port}


@dataclass(frozen=True)
class _Call:
    """How a node was made, so that another process can make it again."""

    args: tuple[Any, ...]
    kwargs: dict[str, Any]


@dataclass
class _Settings:
    """What the graph has to know of a node."""

    name: str | None = None
    rate: float | None = None
    delay: DelayLike = 0.0
    advance: bool = False
    scheduling: Literal["phase", "frequency"] = "phase"
    core: int | None = None
    safe: Mapping[str, float | str] | None = None
    connections: list[Connection] = field(default_factory=list)


class Member:
    """A node of a graph: `Node`, `PlainNode` or `RustNode`."""

    _graph_settings: _Settings
    _graph_call: _Call

    def __new__(cls, *args: Any, **kwargs: Any) -> Any:
        """Remembers how it was made, and has settings even if its class does not call `super().__init__`."""
        self = super().__new__(cls)
        object.__setattr__(self, "_graph_call", _Call(args, kwargs))
        object.__setattr__(self, "_graph_settings", _Settings())
        return self

    def __init__(
        self,
        *,
        rate: float | None = None,
        name: str | None = None,
        delay: DelayLike = 0.0,
        advance: bool = False,
        scheduling: Literal["phase", "frequency"] = "phase",
        core: int | None = None,
        safe: Mapping[str, float | str] | None = None,
    ) -> None:
        """`rate` in steps a second; `name` is the class's, in lower case, if not said.

        `delay` (s) is how long a step takes: what receivers expect, and what simulated clocks draw. `advance` starts a
        step as soon as its blocking inputs are there. After an overrun `scheduling` keeps the grid (`"phase"`) or the
        time between steps (`"frequency"`). `core` pins its process. `safe` is what receivers get when it is gone: a
        number for each leaf of its message, or `"hold"`.
        """
        if rate is not None and not rate > 0:
            raise ValueError(f"node {name or type(self).__name__}: a rate of {rate} Hz is not possible")
        kept = self._graph_settings.connections
        object.__setattr__(self, "_graph_settings", _Settings(name, rate, delay, advance, scheduling, core, safe, kept))
        if not _NAME.fullmatch(self.name):
            raise ValueError(f"`{self.name}` cannot name a node: letters, digits and underscores, a letter first")

    @property
    def name(self) -> str:
        """Its name, unique in a graph."""
        return self._graph_settings.name or self._graph_name()

    @property
    def rate(self) -> float:
        """Steps a second."""
        if self._graph_settings.rate is None:
            raise ValueError(
                f"node {self.name} has no rate: give one, {type(self).__name__}(rate=50.0), and pass what is not the "
                "class's own on to super().__init__"
            )
        return self._graph_settings.rate

    @property
    def connections(self) -> tuple[Connection, ...]:
        """What feeds it, in the order of `connect`."""
        return tuple(self._graph_settings.connections)

    def connect(
        self,
        sender: Member,
        *,
        block: bool = False,
        window: int = 1,
        skip: bool = False,
        delay: DelayLike = 0.0,
        jitter: Literal["latest", "buffer"] = "latest",
        name: str | None = None,
    ) -> None:
        """Feeds an input with what `sender` sends; `step[name]` shows it, or `step[sender.name]` if no name is said.

        With `block`, step k waits for the messages that are ideally sent by its due time. `window` messages are seen,
        oldest first; before enough have come, the window is filled with the sender's `init_output`. `skip` breaks
        cycles: a message that arrives exactly at the start is left for the next step. `delay` (s) is how long a message
        travels: what the schedule expects, and what simulated clocks draw. `jitter="buffer"` holds a message until its
        expected arrival. Raises `ValueError` when the input is fed already.
        """
        if not isinstance(sender, Member):
            raise TypeError(f"{sender!r} is no node: connect a Node, PlainNode or RustNode")
        if window < 1:
            raise ValueError(f"a window of {window} messages from {sender.name} to {self.name}: it has one at least")
        port = name or sender.name
        if any(connection.port == port for connection in self._graph_settings.connections):
            raise ValueError(f"the input {port} of node {self.name} is fed already; give this one another name")
        self._graph_settings.connections.append(Connection(sender, port, block, window, skip, delay, jitter))

    def graph_spec(self) -> dict[str, Any]:
        """The node as a `graph.toml` has it; its messages stand in the graph."""
        own = self._graph_settings
        made: dict[str, Any] = {
            "name": self.name,
            "kind": self._graph_kind(),
            "rate": float(self.rate),
            "parameters": self._graph_parameters(),
            "computation": delay_of(own.delay, f"the delay of node {self.name}"),
            "advance": own.advance,
            "scheduling": own.scheduling,
        }
        if isinstance(own.delay, Trainable):
            raise TypeError(f"node {self.name}: only connections have trainable delays")
        return (
            made | ({} if own.core is None else {"core": own.core}) | ({} if own.safe is None else {"safe": own.safe})
        )

    def graph_copy(self) -> Any:
        """A node made as this one was, without its connections."""
        return type(self)(*self._graph_call.args, **self._graph_call.kwargs)

    def _graph_name(self) -> str:
        return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", type(self).__name__).lower()

    def _graph_kind(self) -> str:
        return "python"

    def _graph_parameters(self) -> dict[str, Any]:
        """The class, and the arguments with which another process makes such a node."""
        return {"class": type(self).__qualname__, "arguments": {}}

    def graph_place(self) -> dict[str, Any]:
        """Where another process finds its class, and with which arguments it makes such a node.

        Raises `TypeError` when it cannot: a class in a notebook or a function, or an argument that is no JSON.
        """
        signature = inspect.signature(type(self).__init__)
        bound = signature.bind(self, *self._graph_call.args, **self._graph_call.kwargs)
        own = inspect.signature(Member.__init__).parameters
        arguments: dict[str, Any] = {}
        for name, value in list(bound.arguments.items())[1:]:
            match signature.parameters[name].kind:
                case inspect.Parameter.VAR_POSITIONAL:
                    raise TypeError(f"node {self.name}: name its arguments; {value!r} have no names in a graph")
                case inspect.Parameter.VAR_KEYWORD:
                    arguments |= {key: given for key, given in value.items() if key not in own}
                case _ if name in own and signature.parameters[name].default is not inspect.Parameter.empty:
                    pass
                case _:
                    arguments[name] = value
        for name, value in arguments.items():
            try:
                json.dumps(value, allow_nan=False)
            except (TypeError, ValueError):
                raise TypeError(
                    f"node {self.name}: the argument {name} = {value!r:.80} cannot stand in a graph; another process "
                    "makes the node from numbers, text, lists and dictionaries (such as the path of a file)"
                ) from None
        return {"class": class_place(type(self)), "arguments": arguments}


class Node(Member):
    """A node that is written in JAX. All its methods are pure, and what they take and give are pytrees of arrays.

    ```python
    class Agent(px.Node):
        def init_params(self, key):
            return {"gain": jnp.asarray(0.05)}

        def init_output(self, key, params, state):
            return {"voltage": jnp.asarray(0.0)}

        def step(self, params, state, step):
            return state, {"voltage": -params["gain"] * step["estimator"].latest.message["speed"]}
    ```
    """

    def init_params(self, key: Array) -> Tree:
        """Constants that training or a fit may move; none, if not said."""
        return None

    def init_state(self, key: Array, params: Tree) -> Tree:
        """What it remembers before the first step; nothing, if not said."""
        return None

    def init_output(self, key: Array, params: Tree, state: Tree) -> Tree:
        """What receivers see before its first message: the structure, shapes and types of all messages."""
        raise NotImplementedError(f"{type(self).__name__} needs a method init_output(key, params, state)")

    def step(self, params: Tree, state: Tree, step: Step) -> tuple[Tree, Tree]:
        """The next state, and the message."""
        raise NotImplementedError(f"{type(self).__name__} needs a method step(params, state, step)")


class PlainNode(Member):
    """A node in plain Python, such as a driver or another simulator: what it remembers are its attributes.

    It runs on the wall clock and under the simulated one, made anew for every run, and cannot be compiled. A driver
    opens its hardware in `start` and not in `__init__`: the process that describes the graph makes the node, too.
    """

    data_bytes: int = 0
    """The most bytes that a message has beside its leaves, such as those of an image."""

    def start(self) -> None:
        """Called once, in the process that steps it, before the common start."""

    def init_output(self) -> Tree:
        """What receivers see before its first message: the structure, shapes and types of all messages."""
        raise NotImplementedError(f"{type(self).__name__} needs a method init_output()")

    def step(self, step: Step) -> Any:
        """What it sends, or a pair of that and bytes."""
        raise NotImplementedError(f"{type(self).__name__} needs a method step(step)")

    def stop(self, why: str) -> None:
        """Called once when it takes no further steps, whatever the reason: `"over"`, `"failed"`, `"sender_gone"`,
        `"launcher_gone"` or `"after_crash"`."""


class RustNode(Member):
    """A node of a kind that comes with Parallax: `RustNode("pendulum/world", rate=200.0)`."""

    def __init__(self, kind: str, *, parameters: Mapping[str, Any] | None = None, **settings: Any) -> None:
        """`kind` and `parameters` as in a `graph.toml`; its `name` is the kind's last part, if not said. The other
        settings are those of every node: rate, name, delay, advance, scheduling, core, safe."""
        self.kind = kind
        """The kind."""
        self.parameters = dict(parameters or {})
        """The kind's own parameters."""
        super().__init__(**settings)

    def _graph_name(self) -> str:
        return self.kind.rsplit("/", 1)[-1].replace("-", "_")

    def _graph_kind(self) -> str:
        return self.kind

    def _graph_parameters(self) -> dict[str, Any]:
        return self.parameters
