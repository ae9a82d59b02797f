"""A node of a running graph, in this interpreter.

`parallax run` starts `python -m parallax.worker` for every node of the kind `python`, whose parameters say what it is:

    parameters = { class = "my_module:MyNode", arguments = { gain = 0.05 } }

The class is called with the arguments. A subclass of `parallax.Node` is written in JAX: its step is compiled before
the run starts, for the processor or for the `device` that the parameters name. Any other class needs a method
`step(step)`, which returns what it sends; what it remembers are its attributes.
"""

from __future__ import annotations

import gc
import json
import os
import sys
import traceback
from typing import Any

import numpy as np

from . import _native
from .describe import build, process_of
from .device import choose_platform
from .stepping import Input, Seen, Stepper

__all__ = ["main"]


def _build(
    name: str, rate: float, seed: int, parameters: str, inputs: list[Input], output: tuple[str, list[str]]
) -> Stepper:
    """The same in a process of its own."""
    process_of.append(name)
    device = json.loads(parameters).get("device")
    choose_platform(device if isinstance(device, str) else None)
    stepped = build(name, rate, seed, parameters, inputs, output)
    # What is there now stays; the collector need not look at it in the middle of a step.
    gc.collect()
    gc.freeze()
    return stepped


def _bits(values: Any) -> list[int]:
    return [int(bits) for bits in np.asarray(values, np.float64).view(np.uint64)]


def _shown(seen: dict[str, Any], leaves: int) -> Seen:
    stamps = np.asarray(seen["stamps"], np.int64).reshape(-1, 3)
    values = np.asarray(seen["leaves"], np.uint64).view(np.float64).reshape(len(stamps), leaves)
    return stamps, values, [bytes.fromhex(data) for data in seen["data"]]


def _lockstep() -> int:
    """Makes steps as they are asked for, a line each, until nothing more can be asked."""
    # What the node prints must not get between the answers.
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    node: Stepper | None = None
    inputs: list[Input] = []
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
