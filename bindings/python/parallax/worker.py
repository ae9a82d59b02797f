"""A node of a running graph, in this interpreter.

`parallax run` starts `python -m parallax.worker` for every node of the kind `python`, whose parameters say what it is:

    parameters = { class = "my_module:MyNode", arguments = { gain = 0.05 } }

The class is called with the arguments. A subclass of `parallax.Node` is written in JAX: its step is compiled before
the run starts. Any other class needs a method `step(step)`, which returns what it sends; what it remembers are its
attributes.
"""

from __future__ import annotations

import gc
import importlib
import json
import os
import sys
import traceback
import zlib
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from . import _native
from .nodes import Message, Node, Step, Window
from .trees import flat, nested
from .types import Array, Tree

__all__ = ["main"]

_Input = tuple[str, int, list[str]]
"""A port, its window, and the leaves of its messages."""
_Seen = tuple[Any, Any, list[bytes]]
"""What a port shows: stamps `[message, 3]`, leaves `[message, leaf]`, data."""
_SECOND = 1_000_000_000


class _Plain:
    """Steps an object that is written in plain Python."""

    def __init__(self, node: Any, seed: int, inputs: Sequence[_Input], output: tuple[str, list[str]]) -> None:
        self._node = node
        self._inputs = inputs
        self._message, self._leaves = output
        self._random = np.random.default_rng(seed)
        stop = getattr(node, "stop", None)
        self.stop: Callable[[str], Any] = stop if callable(stop) else lambda why: None

    def step(self, seq: int, due: int, start: int, seen: list[_Seen]) -> tuple[list[float], bytes | None]:
        times = {"seq": seq, "due": due / _SECOND, "start": start / _SECOND}
        windows = {
            port: Window([_message(leaves, *message) for message in zip(*shown, strict=True)])
            for (port, _, leaves), shown in zip(self._inputs, seen, strict=True)
        }
        random: Any = self._random
        view = Step(times.__getitem__, windows, lambda: random, random.standard_normal)
        sent = self._node.step(view)
        data: bytes | None = None
        if isinstance(sent, tuple):
            sent, data = sent[0], bytes(sent[1])
        return [float(leaf) for leaf in flat(self._leaves, sent, f"the message {self._message}")], data


def _message(leaves: list[str], stamp: Any, values: Any, data: bytes) -> Message:
    seq, sent, received = stamp.tolist()
    stamps = {"seq": seq, "sent": sent / _SECOND, "received": received / _SECOND}
    return Message(stamps.__getitem__, lambda: nested(leaves, values.tolist()), data)


class _Compiled:
    """Steps a node that is written in JAX: one function, compiled before the first step."""

    def __init__(
        self,
        node: Node,
        seed: int,
        inputs: Sequence[_Input],
        output: tuple[str, list[str]],
        initial: dict[str, float],
    ) -> None:
        self._inputs = inputs
        message, leaves = output
        key = jax.random.key(seed)
        self._params = node.init_params(key)
        self._state = node.init_state(key, self._params)
        first = node.init_output(key, self._params, self._state)
        if first is not None:
            _check_initial(leaves, [float(leaf) for leaf in flat(leaves, first, f"the message {message}")], initial)
        self._float = jnp.zeros(0, float).dtype
        self._int = jnp.zeros(0, int).dtype
        self.stop: Callable[[str], Any] = getattr(node, "stop", lambda why: None)

        def whole(
            params: Tree, state: Tree, numbers: Array, times: Array, seen: list[tuple[Array, Array, Array]]
        ) -> tuple[Tree, Array]:
            now = {"seq": numbers[0], "due": times[0], "start": times[1]}
            shown = {
                port: Window([_traced(names, seqs[i], stamps[i], values[i]) for i in range(values.shape[0])])
                for (port, _, names), (seqs, stamps, values) in zip(inputs, seen, strict=True)
            }
            own = jax.random.fold_in(key, numbers[0])
            view = Step(now.__getitem__, shown, lambda: own, lambda count: list(jax.random.normal(own, (count,))))
            state, sent = node.step(params, state, view)
            values = [jnp.asarray(leaf, float) for leaf in flat(leaves, sent, f"the message {message}")]
            return state, jnp.stack(values) if values else jnp.zeros(0)

        example = [
            (np.zeros((window, 3), np.int64), np.zeros((window, len(names))), [b""] * window)
            for _, window, names in inputs
        ]
        arguments = (self._params, self._state, *self._numbers(0, 0, 0, example))
        # What a step is given has the types that the first one had.
        self._state = jax.tree.map(jnp.asarray, self._state)
        self._step = jax.jit(whole).lower(*arguments).compile()
        jax.tree.map(np.asarray, self._step(*arguments))

    def _numbers(self, seq: int, due: int, start: int, seen: list[_Seen]) -> tuple[Any, Any, Any]:
        times = np.asarray([due / _SECOND, start / _SECOND], self._float)
        shown = [
            (
                np.asarray(stamps[:, 0], self._int),
                np.asarray(stamps[:, 1:] / _SECOND, self._float),
                np.asarray(values, self._float),
            )
            for stamps, values, _ in seen
        ]
        return np.asarray([seq], self._int), times, shown

    def step(self, seq: int, due: int, start: int, seen: list[_Seen]) -> tuple[list[float], None]:
        self._state, sent = self._step(self._params, self._state, *self._numbers(seq, due, start, seen))
        return np.asarray(sent, np.float64).tolist(), None


def _traced(names: list[str], seq: Array, stamp: Array, values: Array) -> Message:
    stamps = {"seq": seq, "sent": stamp[0], "received": stamp[1]}
    return Message(stamps.__getitem__, lambda: nested(names, [values[i] for i in range(len(names))]))


def _check_initial(leaves: list[str], first: list[float], initial: dict[str, float]) -> None:
    """Receivers see the graph's initial message: one that says something else would never be seen."""
    for leaf, value in zip(leaves, first, strict=True):
        if not np.isclose(value, initial.get(leaf, 0.0)):
            raise ValueError(
                f"init_output gives {leaf} = {value}, and the graph {initial.get(leaf, 0.0)}; "
                f"put initial = {{ {leaf} = {value} }} into the node's parameters"
            )


def _resolve(place: str) -> Any:
    """The class at `module:Class`."""
    module, separator, name = place.partition(":")
    if not separator or not name:
        raise ValueError(f'class = "{place}" must look like "module:Class"')
    try:
        found = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name and module != error.name and not module.startswith(f"{error.name}."):
            raise
        raise ModuleNotFoundError(f"{sys.executable} finds no module `{module}` in {sys.path}") from None
    if not hasattr(found, name):
        raise AttributeError(f"the module `{module}` ({found.__file__}) has no `{name}`")
    return getattr(found, name)


def _build(
    name: str, rate: float, seed: int, parameters: str, inputs: list[_Input], output: tuple[str, list[str]]
) -> _Plain | _Compiled:
    given: dict[str, Any] = json.loads(parameters)
    known = {"class", "arguments", "output", "initial"}
    if unknown := sorted(given.keys() - known):
        raise ValueError(f"node `{name}` has unknown parameters {unknown}; what is its own belongs into `arguments`")
    if "class" not in given:
        raise ValueError(f'node `{name}` is of kind "python": its parameters need class = "module:Class"')
    node = _resolve(given["class"])(**given.get("arguments", {}))
    if not callable(getattr(node, "step", None)):
        raise TypeError(f"{given['class']} has no method `step`")
    own = (seed ^ zlib.crc32(name.encode())) & 0xFFFF_FFFF
    stepped: _Plain | _Compiled
    if Node in type(node).__mro__:
        stepped = _Compiled(node, own, inputs, output, given.get("initial", {}))
    else:
        stepped = _Plain(node, own, inputs, output)
    # What is there now stays; the collector need not look at it in the middle of a step.
    gc.collect()
    gc.freeze()
    return stepped


def _bits(values: Any) -> list[int]:
    return [int(bits) for bits in np.asarray(values, np.float64).view(np.uint64)]


def _shown(seen: dict[str, Any], leaves: int) -> _Seen:
    stamps = np.asarray(seen["stamps"], np.int64).reshape(-1, 3)
    values = np.asarray(seen["leaves"], np.uint64).view(np.float64).reshape(len(stamps), leaves)
    return stamps, values, [bytes.fromhex(data) for data in seen["data"]]


def _lockstep() -> int:
    """Makes steps as they are asked for, a line each, until nothing more can be asked."""
    # What the node prints must not get between the answers.
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    node: _Plain | _Compiled | None = None
    inputs: list[_Input] = []
    for line in sys.stdin:
        asked = json.loads(line)
        answer: dict[str, Any]
        try:
            if node is None:
                inputs = [(port, window, leaves) for port, window, leaves in asked["inputs"]]
                message, leaves = asked["output"]
                described = (asked["name"], asked["rate"], asked["seed"], asked["parameters"])
                node = _build(*described, inputs, (message, leaves))
                answer = {}
            else:
                pairs = zip(asked["inputs"], inputs, strict=True)
                seen = [_shown(shown, len(names)) for shown, (_, _, names) in pairs]
                seq, due, start = asked["step"]
                sent, data = node.step(seq, due, start, seen)
                answer = {"leaves": _bits(sent), "data": (data or b"").hex()}
        except Exception:  # whatever it is, the clock has to know
            answer = {"error": traceback.format_exc().rstrip()}
        print(json.dumps(answer), file=answers, flush=True)
    if node is not None:
        node.stop("over")
    return 0


def main(arguments: list[str]) -> int:
    """Runs a node as its launcher says; gives the exit status."""
    if arguments[:1] == ["--path"]:
        sys.path.insert(0, arguments[1])
        arguments = arguments[2:]
    if arguments == ["--lockstep"]:
        return _lockstep()
    return 0 if _native.work(arguments, _build) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
