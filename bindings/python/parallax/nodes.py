"""Nodes of a compiled graph: Rust models by their programs, and nodes that are written in JAX.

A node that is written in JAX is any object with the four methods of `Stepped`. Its parameters, state and output are
pytrees of arrays; what it sends to a Rust model is a (nested) dictionary with the leaves of that model's message.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp

from .program import Program
from .trees import flat, nested
from .types import Array, Floats, Scalar, Tree

__all__ = ["Message", "ModelNode", "PinnedNode", "Port", "Step", "Stepped", "Window"]


@dataclass(frozen=True)
class Port:
    """An input of a node, as its graph connects it."""

    name: str
    """Its name."""
    connection: int
    """Index of the connection that feeds it."""
    sender: int
    """Index of the node that sends."""
    window: int
    """How many messages a step sees."""
    leaves: tuple[str, ...]
    """The names of a message's leaves."""


class Message:
    """One message in a window. Reading an attribute reads it from the graph; what is not read costs nothing."""

    def __init__(self, stamp: Callable[[str], Scalar], tree: Callable[[], Tree], data: bytes = b"") -> None:
        self._stamp = stamp
        self._tree = tree
        self.data = data
        """Its bytes beside the payload, such as those of an image; only in real time."""

    @property
    def seq(self) -> Scalar:
        """The sender's step that made it; −1 for an initial message."""
        return self._stamp("seq")

    @property
    def sent(self) -> Scalar:
        """When it was sent, s; 0 for an initial message."""
        return self._stamp("sent")

    @property
    def received(self) -> Scalar:
        """When it arrived, s; 0 for an initial message."""
        return self._stamp("received")

    @property
    def message(self) -> Tree:
        """The payload: the sender's output."""
        return self._tree()


class Window(Sequence[Message]):
    """The messages that a step sees at one port, oldest first; always the connection's window of them."""

    def __init__(self, messages: Sequence[Message]) -> None:
        self._messages = messages

    def __getitem__(self, index: Any) -> Any:
        return self._messages[index]

    def __len__(self) -> int:
        return len(self._messages)

    @property
    def latest(self) -> Message:
        """The newest message."""
        return self._messages[-1]

    def stacked(self) -> Tree:
        """The payloads with a leading axis `[window]`, oldest first."""
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *(message.message for message in self._messages))


class Step:
    """What a node's step sees. Times are seconds since the run's start."""

    def __init__(
        self,
        times: Callable[[str], Scalar],
        inputs: dict[str, Window],
        key: Callable[[], Array],
        noise: Callable[[int], Sequence[Array]],
    ) -> None:
        self._times = times
        self._key = key
        self._noise = noise
        self.inputs = inputs
        """The windows, by port."""

    @property
    def seq(self) -> Scalar:
        """The step's number, from 0."""
        return self._times("seq")

    @property
    def due(self) -> Scalar:
        """When it was due, s."""
        return self._times("due")

    @property
    def start(self) -> Scalar:
        """When it started, s."""
        return self._times("start")

    @property
    def key(self) -> Array:
        """A random key of this step alone."""
        return self._key()

    def noise(self, count: int) -> Array:
        """Independent standard normal numbers `[count]`, those that were given to the rollout or else drawn."""
        return jnp.stack(self.normals(count))

    def normals(self, count: int) -> Sequence[Array]:
        """As `noise`, one by one."""
        return self._noise(count)

    def __getitem__(self, port: str) -> Window:
        """The window at `port`."""
        return self.inputs[port]


@runtime_checkable
class Stepped(Protocol):
    """What a compiled graph steps: a model of Rust, a `Node`, or any other object with its four methods."""

    def init_params(self, key: Array) -> Tree:
        """Constants that training or a fit may move."""
        ...

    def init_state(self, key: Array, params: Tree) -> Tree:
        """What it remembers before the first step."""
        ...

    def init_output(self, key: Array, params: Tree, state: Tree) -> Tree:
        """What receivers see before its first message."""
        ...

    def step(self, params: Tree, state: Tree, step: Step) -> tuple[Tree, Tree]:
        """The next state, and the message."""
        ...


class ModelNode:
    """A Rust model, bound by its program."""

    def __init__(
        self,
        program: Program,
        params: tuple[list[str], Floats],
        state: tuple[list[str], Floats],
        output: tuple[list[str], Floats],
        noise: int,
        ports: Sequence[Port],
    ) -> None:
        self.program = program
        self.noise = noise
        self.ports = ports
        self._params, self._state, self._output = params, state, output
        self._states = len(state[0])
        self.leaves = (state[0], output[0])
        """The names of the leaves of its state and of its output."""
        # Where each input of the program comes from, in the order of the flat form.
        self._sources: list[tuple[Any, ...]] = [("params", i) for i in range(len(params[0]))]
        self._sources += [("state", i) for i in range(self._states)]
        self._sources += [("time", name) for name in ("seq", "due", "start")]
        self._sources += [("noise", i) for i in range(noise)]
        for port in ports:
            for index in range(port.window):
                self._sources += [("stamp", port.name, index, stamp) for stamp in ("seq", "sent", "received")]
                self._sources += [("leaf", port.name, index, leaf) for leaf in range(len(port.leaves))]
        if len(self._sources) != len(program.inputs):
            raise ValueError(f"{program!r} does not fit its ports {[port.name for port in ports]}")
        self._leaves = {port.name: port.leaves for port in ports}

    def params(self, values: Sequence[float] | Floats) -> Tree:
        """Values of the parameters' leaves, as `Trajectory.params` holds them, in the tree that `init` takes."""
        return nested(self._params[0], [jnp.asarray(value, float) for value in values])

    def init_params(self, key: Array) -> Tree:
        """Those of the graph."""
        return self.params(self._params[1])

    def init_state(self, key: Array, params: Tree) -> Tree:
        """That of the graph."""
        return nested(self._state[0], [jnp.asarray(value, float) for value in self._state[1]])

    def init_output(self, key: Array, params: Tree, state: Tree) -> Tree:
        """The kind's initial message."""
        return nested(self._output[0], [jnp.asarray(value, float) for value in self._output[1]])

    def step(self, params: Tree, state: Tree, step: Step) -> tuple[Tree, Tree]:
        """The program; inputs that no output depends on are not even read."""
        have = {
            "params": flat(self._params[0], params, "the node's parameters"),
            "state": flat(self._state[0], state, "the node's state"),
        }
        noise: Sequence[Array] | None = None
        messages: dict[tuple[str, int], list[Scalar]] = {}
        values: list[Scalar] = []
        for place, source in enumerate(self._sources):
            if place not in self.program.needed:
                values.append(0.0)
                continue
            match source:
                case ("params" | "state" as which, index):
                    values.append(have[which][index])
                case ("time", name):
                    values.append(getattr(step, name))
                case ("noise", index):
                    noise = step.normals(self.noise) if noise is None else noise
                    values.append(noise[index])
                case ("stamp", port, index, stamp):
                    values.append(getattr(step[port][index], stamp))
                case ("leaf", port, index, leaf):
                    if (port, index) not in messages:
                        messages[port, index] = flat(
                            self._leaves[port], step[port][index].message, f"the message at `{port}`"
                        )
                    values.append(messages[port, index][leaf])
        results = self.program(*values)
        return nested(self._state[0], results[: self._states]), nested(self._output[0], results[self._states :])

    @property
    def stamps(self) -> set[tuple[Any, ...]]:
        """The times and stamps that it reads: `("time", name)` and `("stamp", port, index, name)`."""
        return {self._sources[place] for place in self.program.needed if self._sources[place][0] in ("time", "stamp")}


class PinnedNode:
    """A node whose outputs are given; only its messages are known."""

    def __init__(self, output: tuple[list[str], Floats]) -> None:
        self._output = output
        self.leaves: tuple[list[str], list[str]] = ([], output[0])
        """The names of the leaves of its state and of its output."""

    def init_params(self, key: Array) -> Tree:
        """None."""
        return {}

    def init_state(self, key: Array, params: Tree) -> Tree:
        """None."""
        return {}

    def init_output(self, key: Array, params: Tree, state: Tree) -> Tree:
        """The kind's initial message."""
        return nested(self._output[0], [jnp.asarray(value, float) for value in self._output[1]])

    def step(self, params: Tree, state: Tree, step: Step) -> tuple[Tree, Tree]:
        """Refused: the outputs must be given."""
        raise TypeError("a pinned node has no step; give its outputs to the rollout, as in pinned={'agent': ...}")
