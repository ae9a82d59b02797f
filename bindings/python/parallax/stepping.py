"""A node that this interpreter steps: what the runtime hands over as numbers, as the node's own pytrees, and back.

The runtime calls `step(seq, due, start, seen)` with times in ns and, for every port, stamps `[message, 3]` (seq, sent,
received), leaves `[message, leaf]` and data, and takes the leaves and the data of the message that the node sends.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .device import found_device
from .leaves import alike
from .member import Node, PlainNode
from .nodes import Message, Step, Window
from .structure import Structure, named
from .trees import flat, nested
from .types import Array, Floats, Scalar, Tree

__all__ = [
    "Began",
    "Input",
    "JaxStep",
    "JaxStepper",
    "PlainStepper",
    "Seen",
    "Shape",
    "Stepper",
    "began",
    "check_initial",
    "initial_of",
    "node_key",
    "stepper_of",
]

Input = tuple[str, int, list[str]]
"""A port, its window, and the leaves of its messages."""
Seen = tuple[Any, Any, list[bytes]]
"""What a port shows: stamps `[message, 3]`, leaves `[message, leaf]`, data."""
_SECOND = 1_000_000_000


@dataclass(frozen=True)
class Shape:
    """What a node receives and sends."""

    inputs: Sequence[Input]
    """Its ports."""
    message: str
    """The name of what it sends."""
    leaves: list[str]
    """Its leaves."""
    sees: Mapping[str, Structure]
    """What messages are at the ports where they are more than dictionaries of numbers."""
    tree: Structure | None
    """What it sends, where that is more than a dictionary of numbers."""
    initial: Mapping[str, float]
    """What receivers see before its first message; zero, where nothing is said."""

    @classmethod
    def of(cls, parameters: Mapping[str, Any], inputs: Sequence[Input], output: tuple[str, list[str]]) -> Shape:
        """From the parameters of a node of the kind `python`."""
        sees = {port: Structure(description) for port, description in parameters.get("sees", {}).items()}
        tree = Structure(parameters["tree"]) if "tree" in parameters else None
        return cls(inputs, *output, sees, tree, parameters.get("initial", {}))

    def numbers(self, sent: Tree, what: str) -> list[Scalar]:
        """A message's numbers, in the order of its leaves."""
        return flat(self.leaves, sent, what)

    def seen(self, port: str, names: Sequence[str], values: Sequence[Scalar], traced: bool) -> Tree:
        """A message at a port."""
        structure = self.sees.get(port)
        if structure is None:
            return nested(names, values)
        return structure.build(dict(zip(names, values, strict=True)).__getitem__, traced)


@dataclass
class Began:
    """What a node that is written in JAX begins with."""

    params: Tree
    state: Tree
    output: Tree


def node_key(seed: int, name: str) -> Array:
    """The key of a node in a run."""
    return jax.random.key((seed ^ zlib.crc32(name.encode())) & 0xFFFF_FFFF)


def began(node: Node, key: Array) -> Began:
    """Its parameters, state and first output."""
    params = node.init_params(key)
    state = jax.tree.map(jnp.asarray, node.init_state(key, params))
    return Began(params, state, node.init_output(key, params, state))


class PlainStepper:
    """Steps an object that is written in plain Python."""

    def __init__(self, node: Any, name: str, seed: int, shape: Shape) -> None:
        self._node = node
        self._shape = shape
        own = (seed ^ zlib.crc32(name.encode())) & 0xFFFF_FFFF
        self._random = np.random.default_rng(own)
        stop = getattr(node, "stop", None)
        self.stop: Callable[[str], Any] = stop if callable(stop) else lambda why: None
        if isinstance(node, PlainNode):
            node.start()

    def step(self, seq: int, due: int, start: int, seen: list[Seen]) -> tuple[list[float], bytes | None]:
        """What the node sends."""
        times = {"seq": seq, "due": due / _SECOND, "start": start / _SECOND}
        windows = {
            port: Window([self._message(port, leaves, *message) for message in zip(*shown, strict=True)])
            for (port, _, leaves), shown in zip(self._shape.inputs, seen, strict=True)
        }
        random: Any = self._random
        view = Step(times.__getitem__, windows, lambda: random, random.standard_normal)
        sent = self._node.step(view)
        data: bytes | None = None
        if isinstance(sent, tuple) and not hasattr(sent, "_fields") and self._is_pair(sent):
            sent, data = sent[0], bytes(sent[1])
        numbers = self._shape.numbers(sent, f"the message {self._shape.message}")
        return [float(leaf) for leaf in numbers], data

    @staticmethod
    def _is_pair(sent: tuple[Any, ...]) -> bool:
        return len(sent) == 2 and isinstance(sent[1], bytes | bytearray | memoryview | np.ndarray)

    def _message(self, port: str, leaves: list[str], stamp: Any, values: Any, data: bytes) -> Message:
        seq, sent, received = stamp.tolist()
        stamps = {"seq": seq, "sent": sent / _SECOND, "received": received / _SECOND}
        return Message(stamps.__getitem__, lambda: self._shape.seen(port, leaves, values.tolist(), False), data)


class JaxStep:
    """The step of a node that is written in JAX: one function, compiled for the shapes that its graph gives it."""

    def __init__(self, node: Node, name: str, shape: Shape, start: Began, device: str | None = None) -> None:
        self.node = node
        self.name = name
        self.shape = shape
        self.device = found_device(device, name)
        """Where it runs."""
        self._float = jnp.zeros(0, float).dtype
        self._int = jnp.zeros(0, int).dtype
        # Whole numbers travel beside the others: single precision would round them.
        self._whole = [self._split(names, shape.sees.get(port)) for port, _, names in shape.inputs]
        self._sent_whole = self._split(shape.leaves, shape.tree)
        example = [
            (np.zeros((window, 3), np.int64), np.zeros((window, len(names))), [b""] * window)
            for _, window, names in shape.inputs
        ]
        start = self.here(start)
        self._example = (start.params, start.state, node_key(0, name), *self._numbers(0, 0, 0, example))
        try:
            self._lowered = jax.jit(self._whole_step).lower(*self._example)
        except Exception as error:
            error.add_note(f"while the step of node `{name}` was traced")
            raise
        self._compiled: Any = None

    def compiled(self) -> JaxStep:
        """Compiled, and run once."""
        if self._compiled is None:
            self._compiled = self._lowered.compile()
            jax.tree.map(np.asarray, self._compiled(*self._example))
        return self

    def here(self, start: Began) -> Began:
        """On the step's device, and with the types that arrays have."""
        state = jax.tree.map(jnp.asarray, start.state)
        if self.device is None:
            return Began(start.params, state, start.output)
        return Began(jax.device_put(start.params, self.device), jax.device_put(state, self.device), start.output)

    def __call__(
        self, params: Tree, state: Tree, key: Array, seq: int, due: int, start: int, seen: list[Seen]
    ) -> tuple[Tree, list[float]]:
        """The next state, and the leaves of what the node sends."""
        numbers = self._numbers(seq, due, start, seen)
        state, (floats, integers) = self._compiled(params, state, key, *numbers)
        real = np.asarray(floats, np.float64)
        if not self._sent_whole[1]:
            return state, real.tolist()
        sent: Floats = np.empty(len(self.shape.leaves))
        sent[self._sent_whole[0]] = real
        sent[self._sent_whole[1]] = np.asarray(integers)
        return state, sent.tolist()

    def _whole_step(
        self, params: Tree, state: Tree, key: Array, numbers: Array, times: Array, seen: list[Any]
    ) -> tuple[Tree, tuple[Array, Array]]:
        now = {"seq": numbers[0], "due": times[0], "start": times[1]}
        shown = {}
        for (port, window, names), split, at in zip(self.shape.inputs, self._whole, seen, strict=True):
            shown[port] = Window([self._traced(port, names, split, at, index) for index in range(window)])
        own = jax.random.fold_in(key, numbers[0])
        view = Step(now.__getitem__, shown, lambda: own, lambda count: list(jax.random.normal(own, (count,))))
        state, sent = self.node.step(params, state, view)
        values = self.shape.numbers(sent, f"the message {self.shape.message}")
        floats, integers = self._sent_whole
        return state, (
            jnp.stack([jnp.asarray(values[at], float) for at in floats]) if floats else jnp.zeros(0),
            jnp.stack([jnp.asarray(values[at], int) for at in integers]) if integers else jnp.zeros(0, int),
        )

    @staticmethod
    def _split(names: Sequence[str], structure: Structure | None) -> tuple[list[int], list[int]]:
        """The places of the leaves that are real, and of those that are whole."""
        whole = set(structure.integers) if structure is not None else set()
        places = range(len(names))
        return [at for at in places if names[at] not in whole], [at for at in places if names[at] in whole]

    def _traced(self, port: str, names: list[str], split: tuple[list[int], list[int]], at: Any, index: int) -> Message:
        seqs, times, floats, integers = at
        values: list[Any] = [None] * len(names)
        for column, place in enumerate(split[0]):
            values[place] = floats[index, column]
        for column, place in enumerate(split[1]):
            values[place] = integers[index, column]
        stamps = {"seq": seqs[index], "sent": times[index, 0], "received": times[index, 1]}
        return Message(stamps.__getitem__, partial(self.shape.seen, port, names, values, True))

    def _numbers(self, seq: int, due: int, start: int, seen: list[Seen]) -> tuple[Any, Any, Any]:
        times = np.asarray([due / _SECOND, start / _SECOND], self._float)
        shown = []
        for (stamps, values, _), (floats, integers) in zip(seen, self._whole, strict=True):
            shown.append(
                (
                    np.asarray(stamps[:, 0], self._int),
                    np.asarray(stamps[:, 1:] / _SECOND, self._float),
                    np.asarray(values[:, floats] if integers else values, self._float),
                    np.asarray(values[:, integers], self._int),
                )
            )
        return np.asarray([seq], self._int), times, shown


class JaxStepper:
    """Steps a node that is written in JAX through a run."""

    def __init__(self, step: JaxStep, seed: int, start: Began) -> None:
        start = step.here(start)
        self._step = step.compiled()
        self._key = node_key(seed, step.name)
        self.params: Tree = start.params
        """Its parameters."""
        # What a step is given has the types that the first one had.
        self.state: Tree = start.state
        """What it remembers."""
        self.stop: Callable[[str], Any] = getattr(step.node, "stop", lambda why: None)

    def step(self, seq: int, due: int, start: int, seen: list[Seen]) -> tuple[list[float], None]:
        """What the node sends."""
        self.state, sent = self._step(self.params, self.state, self._key, seq, due, start, seen)
        return sent, None

    def put(self, params: Tree, state: Tree) -> None:
        """Takes parameters and a state for the next step, of the structure of the first ones."""
        if params is self.params and state is self.state:
            return
        given = self._step.here(Began(params, state, None))
        self.params = _like(self.params, given.params, "parameters")
        self.state = _like(self.state, given.state, "state")


Stepper = PlainStepper | JaxStepper
"""What steps a node."""


def stepper_of(
    node: Any, name: str, seed: int, shape: Shape, start: Began | None = None, device: str | None = None
) -> Stepper:
    """What steps `node`; one that is written in JAX is compiled here."""
    if isinstance(node, Node):
        start = began(node, node_key(seed, name)) if start is None else start
        check_initial(shape, start.output, shape.initial)
        return JaxStepper(JaxStep(node, name, shape, start, device), seed, start)
    if device is not None:
        raise ValueError(f"node `{name}` is plain Python: a device is for nodes that are written in JAX")
    return PlainStepper(node, name, seed, shape)


def _like(old: Tree, new: Tree, what: str) -> Tree:
    """`new`, if it can stand where `old` is."""
    if old is new:
        return new
    if not alike(old, new):
        raise TypeError(f"the {what} are {jax.tree.structure(new)}, and were {jax.tree.structure(old)}")

    def leaf(before: Any, now: Any) -> Any:
        if np.shape(before) != np.shape(now):
            raise TypeError(f"a leaf of the {what} has shape {np.shape(now)}, and had {np.shape(before)}")
        return jnp.asarray(now, jnp.asarray(before).dtype) if jnp.result_type(now) != jnp.result_type(before) else now

    return jax.tree.map(leaf, old, new)


def check_initial(shape: Shape, output: Tree, initial: Mapping[str, float]) -> None:
    """Receivers see the graph's initial message: a first output that says something else would never be seen."""
    if output is None:
        return
    first = shape.numbers(output, f"the message {shape.message}")
    for leaf, value in zip(shape.leaves, map(float, first), strict=True):
        if not np.isclose(value, initial.get(leaf, 0.0)):
            raise ValueError(
                f"init_output gives {leaf} = {value}, and the graph {initial.get(leaf, 0.0)}; "
                f"put initial = {{ {leaf} = {value} }} into the node's parameters"
            )


def initial_of(output: Tree) -> dict[str, float]:
    """The leaves of a first output that are not zero."""
    return {name: float(value) for name, value in named(output).items() if float(value) != 0.0}
