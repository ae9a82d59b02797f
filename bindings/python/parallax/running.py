"""A run of a graph that Python steps: on the wall clock, or under a simulated one.

On the wall clock every node is a process of its own, and the supervisor steps in the process that calls `Graph.run`;
they meet in shared memory. Under the simulated clock all nodes in Python are stepped by this interpreter, in the order
of the clock.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import tempfile
import weakref
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from . import _native, carry
from .describe import build, process_of
from .device import device_text
from .member import Member, Node
from .state import Observation
from .stepping import Began, Input, JaxStep, JaxStepper, Shape, Stepper, check_initial, stepper_of
from .trees import flat, nested
from .types import Tree

__all__ = ["RunState", "Session", "named_devices"]

_SECOND = 1_000_000_000
_RUST_NODE = Path(__file__).with_name("rust_node.py")


@dataclass(frozen=True)
class RunState:
    """What is known of a graph that runs. `replace` what the supervisor is to go on with."""

    step: int
    """How many steps the supervisor has made."""
    time: float
    """When its last one started, s since the run's start; 0 before the first."""
    params: dict[str, Tree]
    """What the nodes that are written in JAX begin with, and the supervisor goes on with."""
    state: dict[str, Tree]
    """The same of their states. Other nodes than the supervisor keep theirs to themselves while they run."""
    output: Tree = None
    """What the supervisor sent last."""

    def replace(self, **changes: Any) -> RunState:
        """With these fields changed."""
        return RunState(**{**self.__dict__, **changes})


@dataclass
class Session:
    """One run, from `init` to `stop`."""

    native: _native.Graph
    spec: dict[str, Any]
    shapes: Mapping[str, Shape]
    """What every node receives and sends."""
    clock: Literal["wall", "simulated"]
    factor: float | None
    steps: Mapping[str, JaxStep]
    """Those that this process makes, compiled."""
    written: Mapping[str, Member]
    """The nodes that Python wrote down."""
    homeless: Mapping[str, str]
    """Why other processes cannot make the nodes that they cannot make."""
    seed: int
    path: Path
    launch: str
    patience: float
    start: dict[str, Began]
    folder: Path | None = None
    run: _native.Run | None = None
    report: dict[str, Any] | None = None
    ended: bool = False
    steppers: dict[str, Stepper] = field(default_factory=dict)
    _kept: tempfile.TemporaryDirectory[str] | None = None

    @property
    def supervisor(self) -> str:
        """The supervisor's name."""
        return str(self.spec["supervisor"])

    def state(self) -> RunState:
        """Before the first step."""
        params = {name: start.params for name, start in self.start.items()}
        return RunState(0, 0.0, params, {name: start.state for name, start in self.start.items()})

    def due(self, state: RunState) -> tuple[int, int, int, list[Any]]:
        """What the supervisor sees at its next step, for which this waits."""
        if self.run is None:
            self._begin(state)
        assert self.run is not None
        seen = self.run.due()
        if seen is None:
            raise self._end_of_run()
        return seen

    def make(self, state: RunState, seen: tuple[int, int, int, list[Any]], output: Tree | None) -> RunState:
        """The supervisor's step, with the parameters and the state that it is given; or the output that it is given."""
        assert self.run is not None
        name, stepper = self.supervisor, self.steppers.get(self.supervisor)
        leaves = None
        if output is not None:
            leaves = [float(leaf) for leaf in flat(self.leaves, output, f"the output of `{name}`")]
        elif isinstance(stepper, JaxStepper):
            stepper.put(state.params[name], state.state[name])
        sent = self.run.make(leaves)
        if sent is None:
            raise self._end_of_run()
        after = dict(state.state)
        if isinstance(stepper, JaxStepper):
            after[name] = stepper.state
        tree = self.shapes[name].tree
        numbers = dict(zip(self.leaves, sent, strict=True))
        made = nested(self.leaves, sent) if tree is None else tree.build(numbers.__getitem__, False)
        return RunState(seen[0] + 1, seen[2] / _SECOND, state.params, after, made)

    def observation(self, seen: tuple[int, int, int, list[Any]]) -> Observation:
        """What the supervisor sees, as a compiled graph shows it."""
        shape = self.shapes[self.supervisor]
        inputs = {}
        for (port, _, names), (stamps, values, _) in zip(shape.inputs, seen[3], strict=True):
            structure = shape.sees.get(port)
            tree = structure.columns(values, names) if structure else nested(names, list(np.moveaxis(values, -1, 0)))
            inputs[port] = {
                "seq": stamps[:, 0].astype(float),
                "sent": stamps[:, 1] / _SECOND,
                "received": stamps[:, 2] / _SECOND,
                "message": tree,
            }
        seq, due, start = float(seen[0]), seen[1] / _SECOND, seen[2] / _SECOND
        number = np.float64
        return Observation(number(seq), number(due), number(start), inputs)  # type: ignore[arg-type]

    def simulate(self, duration: float) -> None:
        """The whole run, without anybody who steps it."""
        self._prepare(self.state())
        self.run = self.native.begin(
            path=self.path, seed=self.seed, build=self._build, duration=duration, factor=self.factor, stepped=False
        )
        try:
            self._finish()
        finally:
            self.stop()
        assert self.report is not None
        if self.report["failure"]:
            raise _native.ParallaxError(self.report["failure"])

    def stop(self) -> dict[str, Any] | None:
        """Ends the run and waits for that; gives its report."""
        self.ended = True
        if self.run is not None and self.report is None:
            self.run.stop()
            self._finish()
        return self.report

    @property
    def leaves(self) -> list[str]:
        """Those of the supervisor's messages."""
        return self.shapes[self.supervisor].leaves

    def _begin(self, state: RunState) -> None:
        if self.ended:
            raise _native.ParallaxError("this run is over; begin another one with init()")
        if process_of:
            raise _native.ParallaxError(
                f"the module that node `{process_of[0]}` is made from starts a run while it is imported; put what "
                'starts it under `if __name__ == "__main__":`'
            )
        self._prepare(state)
        if self.clock == "simulated":
            self.run = self.native.begin(
                path=self.path, seed=self.seed, build=self._build, duration=None, factor=self.factor, stepped=True
            )
        else:
            self.run = self._launch()
        weakref.finalize(self, _close, self.run)

    def _prepare(self, state: RunState) -> None:
        for name, own in self.start.items():
            self.start[name] = Began(state.params[name], state.state[name], own.output)
        described = {node["name"]: node.get("parameters", {}) for node in self.spec["node"]}
        for name, step in self.steps.items():
            check_initial(step.shape, self.start[name].output, described[name].get("initial", {}))
            self.steppers[name] = JaxStepper(step, self.seed, self.start[name])

    def _launch(self) -> _native.Run:
        processes = [
            node["name"] for node in self.spec["node"] if node["kind"] == "python" and node["name"] != self.supervisor
        ]
        for name in processes:
            if name in self.homeless:
                raise _native.ParallaxError(self.homeless[name])
        command = [sys.executable, "-m", "parallax.worker"]
        if self.folder is not None:
            command += ["--path", str(self.folder)]
        self._kept = tempfile.TemporaryDirectory(prefix="parallax-start-")
        private = {}
        for name in processes:
            private[name] = {"PYTHONPATH": os.pathsep.join(_import_path()), **_jax_settings()}
            if name in self.start:
                file = Path(self._kept.name) / f"{name}.npz"
                carry.write(file, self.start[name])
                private[name][carry.VARIABLE] = str(file)
        return self.native.launch(
            path=self.path,
            seed=self.seed,
            build=self._build,
            programs={name: command for name in processes},
            node_command=["-I", "-S", str(_RUST_NODE), str(_native.__file__)],
            private=private,
            launch=self.launch,
            patience=self.patience,
        )

    def _build(
        self, name: str, rate: float, seed: int, parameters: str, inputs: list[Input], output: tuple[str, list[str]]
    ) -> Stepper:
        """A node that is stepped by this process."""
        if name not in self.steppers:
            member = self.written.get(name)
            if member is None:
                self.steppers[name] = build(name, rate, seed, parameters, inputs, output)
            else:
                shape = Shape.of(json.loads(parameters), inputs, output)
                self.steppers[name] = stepper_of(member.graph_copy(), name, seed, shape, self.start.get(name))
        return self.steppers[name]

    def _finish(self) -> None:
        assert self.run is not None
        told = self.run.finish()
        self.report = {} if told is None else json.loads(told)

    def _end_of_run(self) -> _native.ParallaxError:
        """Why there is no further step."""
        self.ended = True
        self._finish()
        assert self.report is not None
        failure = self.report.get("failure")
        return _native.ParallaxError(failure or "the run is over; begin another one with init()")


def _close(run: _native.Run) -> None:
    """Ends a run that nobody has stopped."""
    run.stop()
    with contextlib.suppress(_native.ParallaxError):
        run.finish()


def _import_path() -> list[str]:
    """Where this interpreter looks for modules, for others to find the same."""
    main = getattr(sys.modules["__main__"], "__file__", None)
    places = [str(Path(main).resolve().parent)] if main else []
    return places + [os.path.abspath(place or ".") for place in sys.path]


def _jax_settings() -> dict[str, str]:
    """What JAX was told here, as the environment of other processes says it."""
    settings: Any = jax.config
    made = {"JAX_ENABLE_X64": "1" if settings.jax_enable_x64 else "0"}
    cache = settings.jax_compilation_cache_dir
    if cache:
        made["JAX_COMPILATION_CACHE_DIR"] = str(cache)
        made["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
        made["JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES"] = "-1"
    return made


def named_devices(devices: Any, nodes: Mapping[str, Any]) -> dict[str, str]:
    """The devices of single nodes, by name: `devices` names one for each, or one for all."""
    if devices is None:
        return {}
    written = [name for name, node in nodes.items() if isinstance(node, Node)]
    if not isinstance(devices, Mapping):
        return dict.fromkeys(written, device_text(devices))
    made = {}
    for node, device in devices.items():
        name = node if isinstance(node, str) else node.name
        if name not in nodes:
            raise ValueError(f"a device is named for `{name}`, and the graph has {', '.join(nodes)}")
        if name not in written:
            raise ValueError(f"a device is named for `{name}`, which is not written in JAX")
        made[name] = device_text(device)
    return made
