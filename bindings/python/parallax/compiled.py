"""A graph, compiled: pure functions that step it along recorded or generated schedules.

`init`, `reset`, `step` and `rollout` work under `jit`, `vmap`, `grad` and `scan`. What they carry is small: every
node's state, the last outputs that somebody still reads, a step counter, an episode index and a random key. When each
node runs and what it consumes stands in `CompiledGraph.tables`, which is not carried: hand it to a jitted function as
an argument (`tables=...`), so that it does not become a literal in the program.

One supervisor step is one pass through the *slots*: places that steps of the nodes fill, in an order in which every
schedule can run them. A slot that no step fills in some pass leaves its node as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .delays import select_by_output, select_messages
from .leaves import alike, arrays, chosen, repeated, size_in_bytes, stored
from .native_rollout import NativeRollout, by_leaf, spread
from .nodes import Message, Step, Stepped, Window
from .noise import normals, words
from .slots import Input, Slot, read_slot
from .state import GraphState, Observation
from .tables import Column, Row, TableBuilder, Tables
from .trees import flat, nested
from .types import Array, Floats, Integers, Scalar, Tree

__all__ = ["CompiledGraph"]

SELECT = 8
"""Histories of at most this many messages are read and written by selection, larger ones by index."""


STREAMS = 1_000_000
"""Keys of streams are folded with numbers from here on, apart from those of `init`."""


@dataclass(frozen=True)
class _NodeInfo:
    name: str
    node: Stepped
    history: int
    leaves: tuple[Sequence[str], Sequence[str]]
    """Of a Rust model's state and output."""


@dataclass
class _Moment:
    """What a pass works on."""

    row: Row
    params: dict[str, Tree]
    state: dict[str, Tree]
    history: dict[str, Any]
    key: Array
    noise: Mapping[str, Array]


class CompiledGraph:
    """A graph as pure functions. `Graph.compile` makes it."""

    def __init__(
        self,
        compiled: Mapping[str, Any],
        nodes: Sequence[tuple[str, Stepped]],
        ports: Sequence[Sequence[str]],
        connections: Sequence[str],
        native: Any = None,
    ) -> None:
        self._native = native
        self.episodes: int = compiled["episodes"]
        """How many episodes there are."""
        self.steps: int = compiled["steps"]
        """How many steps the supervisor makes in the longest of them."""
        self.lengths = np.asarray(compiled["lengths"])
        """How many steps the supervisor makes in each, `[episode]`."""
        self.efficiency: float = compiled["efficiency"]
        """The share of slots that a step fills, on average."""
        self.source = compiled
        """The compiler's own tables, as numpy arrays."""
        self._nodes = [
            _NodeInfo(name, node, entry["history"], getattr(node, "leaves", ((), ())))
            for (name, node), entry in zip(nodes, compiled["nodes"], strict=True)
        ]
        self._connections = list(connections)
        self._builder = TableBuilder(self.episodes, self.steps)
        self._slots = [read_slot(slot, ports[slot["node"]], self._builder) for slot in compiled["slots"]]
        self._tables: dict[Any, Tables] = {}
        self.supervisor: str = self._nodes[self._slots[-1].node].name
        """The supervisor's name."""
        self.delays = {
            self._connections[port.connection]: port.trainable
            for slot in self._slots
            for port in slot.inputs
            if port.trainable is not None
        }
        """The trainable delays, by connection."""

    def __repr__(self) -> str:
        return (
            f"CompiledGraph({len(self._nodes)} nodes, {len(self._slots)} slots, {self.episodes} episodes of up to "
            f"{self.steps} steps)"
        )

    @property
    def tables(self) -> Tables:
        """The schedules, in the precision that JAX is set to."""
        key = jnp.result_type(float)
        if key not in self._tables:
            with jax.ensure_compile_time_eval():
                self._tables[key] = self._builder.tables()
        return self._tables[key]

    def state_bytes(self) -> int:
        """How many bytes one environment's `GraphState` takes."""
        state = jax.eval_shape(self.init, jax.eval_shape(lambda: jax.random.key(0)))
        return sum(size_in_bytes(leaf) for leaf in jax.tree.leaves(state))

    def init(
        self, key: Array, params: Mapping[str, Tree] | None = None, episode: Scalar = 0, step: Scalar = 0
    ) -> GraphState:
        """The state before the first step.

        `params` replaces the parameters of the nodes that it names (and `delays`); the others start as their nodes
        say. `episode` chooses the schedule, `step` where in it to start.
        """
        given = dict(params or {})
        unknown = given.keys() - {info.name for info in self._nodes} - {"delays"}
        if unknown:
            raise ValueError(f"parameters are given for {sorted(unknown)}, which the graph does not have")
        all_params: dict[str, Tree] = {}
        state: dict[str, Tree] = {}
        history: dict[str, Any] = {}
        for index, info in enumerate(self._nodes):
            keys = jax.random.split(jax.random.fold_in(key, index), 3)
            own = given[info.name] if info.name in given else info.node.init_params(keys[0])
            all_params[info.name] = own
            state[info.name] = arrays(info.node.init_state(keys[1], own))
            output = arrays(info.node.init_output(keys[2], own, state[info.name]))
            if info.history <= SELECT:
                history[info.name] = (output,) * info.history
            else:
                history[info.name] = jax.tree.map(partial(repeated, count=info.history), output)
        if self.delays:
            start = {name: jnp.asarray(0.5, float) for name in self.delays}
            chosen = given.get("delays", {})
            unknown = chosen.keys() - start.keys()
            if unknown:
                raise ValueError(f"{sorted(unknown)} are no trainable delays; those are {sorted(start)}")
            all_params["delays"] = start | dict(chosen)
        return GraphState(
            key, jnp.asarray(episode, jnp.int32), jnp.asarray(step, jnp.int32), all_params, state, history
        )

    def reset(self, state: GraphState, tables: Tables | None = None) -> tuple[GraphState, Observation]:
        """From `init` to the supervisor's first step: the new state and what the supervisor sees."""
        moment = self._moment(state, tables)
        self._before_supervisor(moment, {})
        return self._after(state, moment), self._observe(moment)

    def step(
        self, state: GraphState, output: Tree | None = None, tables: Tables | None = None
    ) -> tuple[GraphState, Observation]:
        """Makes the supervisor's step and everything up to its next one.

        With `output`, that is what the supervisor sends; its own model does not run and its state stays. Without, its
        model runs.
        """
        moment = self._moment(state, tables)
        self._supervisor(moment, output)
        state = replace(self._after(state, moment), step=state.step + 1)
        return self.reset(state, tables)

    def rollout(
        self,
        state: GraphState,
        steps: int | None = None,
        *,
        record: Callable[[GraphState], Tree] | Sequence[str] | None = None,
        pinned: Mapping[str, Tree] | None = None,
        noise: Mapping[str, Array] | None = None,
        tables: Tables | None = None,
        unroll: int = 1,
    ) -> tuple[GraphState, Tree]:
        """From `init` through `steps` steps of the supervisor (all, if not said).

        `record` says what to keep of each step: a function of the state after it, or names of nodes, for each of which
        a list with one entry per slot is kept: `run`, `seq`, `start`, `state` (before the step) and `output`.
        `pinned` gives nodes' outputs, `[steps, ...]`, instead of running them: the supervisor's by its steps, others'
        by their sequence numbers. `noise` gives nodes' standard normal numbers, `[steps of the node, count]`. Returns
        the last state and what was recorded, with a leading axis `[steps]`.

        A batch is fastest by two nested `vmap`s, the outer over episodes and the inner over environments of one episode
        (by sixteens), so that these share its schedule.
        """
        tables = self.tables if tables is None else tables
        steps = self.steps if steps is None else steps
        start = jnp.clip(state.step, 0, self.steps - steps)
        episode = Tables(*(lax.dynamic_index_in_dim(table, state.episode, keepdims=False) for table in tables))
        rows = Tables(*(lax.dynamic_slice_in_dim(table, start, steps) for table in episode))
        return self._rollout(state, rows, record, pinned or {}, noise or {}, unroll)

    def rollout_native(
        self,
        episodes: Sequence[int] | Integers,
        *,
        params: Mapping[str, Tree] | None = None,
        states: Mapping[str, Tree] | None = None,
        pinned: Mapping[str, Tree] | None = None,
        seeds: Sequence[int] | None = None,
        keep: Sequence[str] = (),
        precision: Literal["double", "double lanes", "single lanes"] = "double lanes",
    ) -> NativeRollout:
        """Runs whole episodes without JAX, on the lanes and cores of this machine.

        There is one environment for each entry of `episodes`. `params` (with `delays`) and `states` replace leaves,
        each by one value or by `[environment]`; `pinned` gives the outputs of the nodes that were pinned when
        compiling, `[environment, steps of the node]` a leaf. `seeds`, one for each environment, are those of the nodes'
        noise. The outputs of the nodes in `keep` are returned, and every node's last state. All nodes must be Rust
        models.
        """
        if self._native is None:
            raise ValueError("this graph was not compiled by `Graph.compile`")
        count = len(episodes)
        given = dict(params or {})
        delays = given.pop("delays", {})
        content = self._native.rollout(
            episodes=[int(episode) for episode in episodes],
            seeds=list(range(count)) if seeds is None else list(seeds),
            params=by_leaf(given, count),
            states=by_leaf(states or {}, count),
            delays=[(name, spread(alpha, count)) for name, alpha in delays.items()],
            given=[(name, self._stacked(name, outputs)) for name, outputs in (pinned or {}).items()],
            keep=list(keep),
            precision=precision,
        )
        names = {info.name: info.leaves for info in self._nodes}
        return NativeRollout(
            {name: nested(names[name][1], list(np.moveaxis(v, -1, 0))) for name, v in content["outputs"].items()},
            {
                name: nested(names[name][0], list(np.moveaxis(v, -1, 0)))
                for name, v in content["states"].items()
                if v.size
            },
        )

    def _stacked(self, name: str, outputs: Tree) -> Floats:
        leaves = next(info.leaves[1] for info in self._nodes if info.name == name)
        return np.stack(
            [np.asarray(leaf, np.float64) for leaf in flat(leaves, outputs, f"outputs of `{name}`")], axis=-1
        )

    def _rollout(
        self,
        state: GraphState,
        rows: Tables,
        record: Callable[[GraphState], Tree] | Sequence[str] | None,
        pinned: Mapping[str, Tree],
        noise: Mapping[str, Array],
        unroll: int,
    ) -> tuple[GraphState, Tree]:
        """Along rows of one episode, `[steps, column]`."""
        unknown = (pinned.keys() | noise.keys()) - {info.name for info in self._nodes}
        if unknown:
            raise ValueError(f"{sorted(unknown)} are pinned or given noise, but are no nodes of the graph")
        others = {name: outputs for name, outputs in pinned.items() if name != self.supervisor}
        names = [] if record is None or callable(record) else list(record)
        params, key = state.params, state.key

        def body(carry: tuple[Tree, ...], xs: tuple[Tree, Tree, Array | None]) -> tuple[tuple[Tree, ...], Tree]:
            moment = _Moment(Row(*xs[0]), params, dict(carry[0]), dict(carry[1]), key, noise)
            kept = self._before_supervisor(moment, others, names)
            kept |= self._supervisor(moment, xs[1], names)
            carry = (moment.state, moment.history)
            if callable(record):
                return carry, record(self._after(replace(state, step=jnp.asarray(xs[2])), moment))
            return carry, {name: [kept[place] for place in sorted(kept) if self._name(place) == name] for name in names}

        # The counter follows from where the rollout begins, so that it need not be carried.
        steps = rows.floats.shape[0]
        counts = state.step + 1 + jnp.arange(steps, dtype=jnp.int32) if callable(record) else None
        # Column by column: what no node reads falls away, and on a CPU XLA runs a loop that touches little data as one
        # function, several times faster.
        columns = tuple(tuple(jnp.unstack(table, axis=1)) for table in rows)
        (node_state, history), kept = lax.scan(
            body, (state.state, state.history), (columns, pinned.get(self.supervisor), counts), unroll=unroll
        )
        return replace(state, step=state.step + steps, state=node_state, history=history), kept

    def _name(self, slot: int) -> str:
        return self._nodes[self._slots[slot].node].name

    def _moment(self, state: GraphState, tables: Tables | None) -> _Moment:
        tables = self.tables if tables is None else tables
        place = jnp.clip(state.step, 0, self.steps - 1)
        row = Row(*(table[state.episode, place] for table in tables))
        return _Moment(row, state.params, dict(state.state), dict(state.history), state.key, {})

    def _after(self, state: GraphState, moment: _Moment) -> GraphState:
        return replace(state, state=moment.state, history=moment.history)

    def _before_supervisor(
        self, moment: _Moment, pinned: Mapping[str, Tree], record: Sequence[str] = ()
    ) -> dict[int, Tree]:
        kept: dict[int, Tree] = {}
        for place, slot in enumerate(self._slots[:-1]):
            name = self._nodes[slot.node].name
            output = None
            if name in pinned:
                seq = jnp.asarray(moment.row[slot.times["seq"]], jnp.int32)
                output = jax.tree.map(lambda outputs, seq=seq: outputs[seq], pinned[name])
            result = self._run(slot, moment, output, name in record)
            if name in record:
                kept[place] = result
        return kept

    def _supervisor(self, moment: _Moment, output: Tree | None, record: Sequence[str] = ()) -> dict[int, Tree]:
        wanted = self.supervisor in record
        result = self._run(self._slots[-1], moment, output, wanted)
        return {len(self._slots) - 1: result} if wanted else {}

    def _run(self, slot: Slot, moment: _Moment, output: Tree | None, record: bool) -> Tree:
        """One step of one node, where the row says so."""
        info = self._nodes[slot.node]
        before = moment.state[info.name]
        if output is None:
            after, output = info.node.step(moment.params[info.name], before, self._view(slot, moment))
            if not alike(after, before):
                raise TypeError(f"the step of node `{info.name}` returns a state of another structure than its first")
        else:
            after = before
        run = None if slot.run.place < 0 else moment.row[slot.run] != 0
        after = jax.tree.map(partial(chosen, run), after, before)
        moment.state[info.name] = after
        moment.history[info.name] = self._write(slot, moment, run, output)
        if not record:
            return None
        row = moment.row
        return {
            "run": jnp.asarray(True if run is None else run),
            "seq": jnp.asarray(row[slot.times["seq"]]),
            "start": jnp.asarray(row[slot.times["start"]]),
            "state": before,
            "output": jax.tree.map(jnp.asarray, output),
        }

    def _write(self, slot: Slot, moment: _Moment, run: Array | None, output: Tree) -> Any:
        """The history with an output in its place."""
        info = self._nodes[slot.node]
        history = moment.history[info.name]
        place = moment.row[slot.write]
        example = history[0] if info.history <= SELECT else history
        if not alike(output, example):
            raise TypeError(
                f"the step of node `{info.name}` sends {jax.tree.structure(output)}, its first output is "
                f"{jax.tree.structure(example)}"
            )
        if info.history > SELECT:
            return jax.tree.map(partial(stored, place, run), history, output)
        result = list(history)
        for other in slot.write.values:
            here = run
            if slot.write.place >= 0:
                at = place == other
                here = at if run is None else run & at
            result[other] = jax.tree.map(partial(chosen, here), output, history[other])
        return tuple(result)

    def _read(self, sender: int, column: Column, moment: _Moment) -> Tree:
        """The message at a place of a history."""
        info = self._nodes[sender]
        history = moment.history[info.name]
        place = moment.row[column]
        if info.history > SELECT:
            return jax.tree.map(lambda leaf: lax.dynamic_index_in_dim(leaf, place, keepdims=False), history)
        result = history[column.values[0]]
        for other in column.values[1:]:
            result = jax.tree.map(partial(chosen, place == other), history[other], result)
        return result

    def _view(self, slot: Slot, moment: _Moment) -> Step:
        """What the step in a slot sees; nothing is read before somebody looks."""
        info = self._nodes[slot.node]
        row = moment.row
        inputs: dict[str, Window] = {}
        for port in slot.inputs:
            if port.from_output is not None:
                messages = select_by_output(
                    port.from_output,
                    row[slot.times["start"]],
                    port.window,
                    {name: [row[column] for column in columns] for name, columns in port.stamps.items()},
                    [partial(self._read, port.sender, column, moment) for column in port.read],
                )
            elif port.trainable is None:
                messages = [
                    Message(
                        partial(_stamp, row, port, i),
                        partial(self._read, port.sender, port.read[i], moment),
                    )
                    for i in range(port.window)
                ]
            else:
                messages = select_messages(
                    port.trainable,
                    moment.params["delays"][self._connections[port.connection]],
                    row[slot.times["start"]],
                    port.window,
                    {name: [row[column] for column in columns] for name, columns in port.stamps.items()},
                    [partial(self._read, port.sender, column, moment) for column in port.read],
                )
            inputs[port.port] = Window(messages)

        def number(name: str) -> Scalar:
            return row[slot.times[name]]

        def drawn(count: int) -> Sequence[Array]:
            seq = jnp.asarray(number("seq"), jnp.int32)
            if info.name not in moment.noise:
                return normals(words(moment.key, slot.node), seq, count)
            given = lax.dynamic_index_in_dim(moment.noise[info.name], seq, keepdims=False)
            return [given[place] for place in range(count)]

        def key() -> Array:
            own = jax.random.fold_in(moment.key, STREAMS + slot.node)
            return jax.random.fold_in(own, jnp.asarray(number("seq"), jnp.int32))

        return Step(number, inputs, key, drawn)

    def _observe(self, moment: _Moment) -> Observation:
        """Everything that the supervisor sees."""
        view = self._view(self._slots[-1], moment)
        inputs = {
            port: {
                "seq": jnp.stack([jnp.asarray(message.seq, float) for message in window]),
                "sent": jnp.stack([jnp.asarray(message.sent, float) for message in window]),
                "received": jnp.stack([jnp.asarray(message.received, float) for message in window]),
                "message": window.stacked(),
            }
            for port, window in view.inputs.items()
        }
        seq, due, start = (jnp.asarray(value, float) for value in (view.seq, view.due, view.start))
        return Observation(seq, due, start, inputs)


def _stamp(row: Row, port: Input, index: int, name: str) -> Scalar:
    return row[port.stamps[name][index]]
