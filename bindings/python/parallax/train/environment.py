"""A graph with its delays as an environment: pure functions in the manner of gymnax 1.0."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..compiled import CompiledGraph
from ..graph import Episodes, Graph
from ..nodes import PinnedNode, Stepped
from ..state import GraphState, Observation
from ..tables import Tables
from ..types import Array, Tree
from .interface import Interface, Memory
from .randomisation import Randomisation, with_leaf
from .task import Task

__all__ = ["Box", "EnvironmentParams", "EnvironmentState", "GraphEnvironment"]


@dataclass(frozen=True)
class Box:
    """Numbers within bounds: a space as gymnax has them."""

    low: Array
    high: Array
    shape: tuple[int, ...]
    dtype: Any = jnp.float32

    def sample(self, key: Array) -> Array:
        """One of them; where there are no bounds, from a standard normal distribution."""
        bounded = jnp.isfinite(self.low) & jnp.isfinite(self.high)
        within = jax.random.uniform(key, self.shape, self.dtype) * jnp.where(bounded, self.high - self.low, 0.0)
        free = jax.random.normal(key, self.shape, self.dtype)
        return jnp.where(bounded, jnp.where(bounded, self.low, 0.0) + within, free)

    def contains(self, x: Array) -> Array:
        """Whether it lies within."""
        return jnp.all((x >= self.low) & (x <= self.high))


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["tables", "nodes", "max_steps_in_episode", "task"],
    meta_fields=[],
)
@dataclass(frozen=True)
class EnvironmentParams:
    """What an environment runs along. Hand it to jitted functions as an argument: it holds the schedules."""

    tables: Tables
    """The schedules."""
    nodes: dict[str, Tree]
    """Parameters of nodes that replace those of the graph; what is randomised is drawn after that."""
    max_steps_in_episode: Array
    """After how many steps an episode is cut off, int32; at most `GraphEnvironment.longest`."""
    task: dict[str, Array] = field(default_factory=dict)
    """Numbers of the task that replace its own, such as a circle's radius: other ones need no other compilation."""


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["graph", "observation", "memory", "last", "time"],
    meta_fields=[],
)
@dataclass(frozen=True)
class EnvironmentState:
    """One environment."""

    graph: GraphState
    """The graph's state: every node's, and the messages on their way."""
    observation: Array
    """What the policy observes now, `[observation]`."""
    memory: Memory
    """What it remembers."""
    last: Array
    """The last action, in the leaves' units, `[action]`."""
    time: Array
    """Steps since the start, int32."""


class GraphEnvironment:
    """A task on a graph, with the graph's delays.

    Every episode runs along a schedule of its own: `episodes` are drawn from the graph's delay distributions when the
    environment is made (or given), and each reset takes one of them and a place in it. `past_observations` and
    `past_actions` say how much of the past the policy sees; with delays, an observation alone does not tell where the
    machine is. Actions are shares: −1 is the task's smallest, 1 its largest.

    `nodes` and `trainable` are those of `Graph.compile`; the supervisor needs no model, because the
    policy acts in its place.
    """

    def __init__(
        self,
        graph: Graph | str,
        task: Task,
        *,
        episodes: int | Episodes = 64,
        seed: int = 0,
        past_observations: int = 0,
        past_actions: int = 0,
        randomisation: Randomisation | None = None,
        nodes: Mapping[str, Stepped] | None = None,
        trainable: Mapping[str, tuple[float, float] | tuple[float, float, str]] | None = None,
        spare: float = 2.0,
    ) -> None:
        """`spare` (s) is how much longer the drawn schedules are than an episode: places where it may start."""
        self.graph = Graph(graph) if isinstance(graph, str) else graph
        self.task = task
        self.interface = Interface.of(task.observations, task.actions, past_observations, past_actions)
        self.randomisation = randomisation or Randomisation()
        content = next(node for node in self.graph._content if node["name"] == self.graph.supervisor)
        self.rate: float = content["rate"]
        """Steps a second."""
        self.longest = round(task.seconds * self.rate)
        """After how many steps an episode is cut off."""
        self._leaves: list[str] = list(content["leaves"])
        ports = self.graph.ports(self.graph.supervisor)
        if not ports:
            raise ValueError(f"the supervisor `{self.graph.supervisor}` receives nothing that a policy could observe")
        self.port = ports[0].name
        """The supervisor's input that the policy observes: the first, as the policy's node in real time."""
        self._check(ports[0].leaves)
        if isinstance(episodes, int):
            # A little more, so that late ends of steps do not take the last ones away.
            duration = task.seconds + spare + 4 / self.rate
            episodes = self.graph.generate(duration, episodes, seed)
        commanded = PinnedNode((self._leaves, np.asarray(content["initial"], np.float64)))
        self.compiled: CompiledGraph = self.graph.compile(
            episodes, {self.graph.supervisor: commanded, **dict(nodes or {})}, trainable=trainable
        )
        """The graph along its schedules."""
        self._room = self.compiled.lengths - 1 - self.longest
        if self._room.min() < 0:
            raise ValueError(
                f"the task takes {self.longest} steps, and the shortest schedule has {self.compiled.lengths.min()}; "
                f"generate longer ones"
            )
        # What does not fit is found now rather than in the midst of training.
        jax.eval_shape(self.reset_env, jax.eval_shape(lambda: jax.random.key(0)), self.default_params)

    def _check(self, leaves: Sequence[str]) -> None:
        for leaf in self.interface.leaves:
            if leaf not in leaves:
                raise ValueError(
                    f"the task observes `{leaf}`; `{self.graph.supervisor}` receives {', '.join(leaves)} at "
                    f"`{self.port}`"
                )
        for leaf in self.interface.actions:
            if leaf not in self._leaves:
                raise ValueError(f"the task sends `{leaf}`; `{self.graph.supervisor}` sends {', '.join(self._leaves)}")

    @property
    def name(self) -> str:
        """What it is called."""
        return f"{type(self.task).__name__} on {self.graph.spec['name']}"

    @property
    def num_actions(self) -> int:
        """How many numbers an action has."""
        return len(self.interface.actions)

    @property
    def default_params(self) -> EnvironmentParams:
        """The schedules, and the parameters of the graph."""
        # A task need not have any.
        numbers = {name: jnp.asarray(getattr(self.task, name), float) for name in getattr(self.task, "numbers", ())}
        return EnvironmentParams(self.compiled.tables, {}, jnp.asarray(self.longest, jnp.int32), numbers)

    def action_space(self, params: EnvironmentParams | None = None) -> Box:
        """Shares of the actions' ranges."""
        one = jnp.ones(self.num_actions)
        return Box(-one, one, (self.num_actions,))

    def observation_space(self, params: EnvironmentParams | None = None) -> Box:
        """Everything that enters the network; without bounds, because noise has none."""
        wide = jnp.full(self.interface.size, jnp.inf)
        return Box(-wide, wide, (self.interface.size,))

    def reset_env(self, key: Array, params: EnvironmentParams) -> tuple[Array, EnvironmentState]:
        """The first observation, `[Interface.size]`, and the state."""
        # Few draws of many numbers: each call of a random generator takes XLA longer to compile than a node's step.
        of_graph, of_schedule, of_params, of_start = jax.random.split(key, 4)
        which, where = jax.random.uniform(of_schedule, (2,))
        episode = jnp.asarray(which * self.compiled.episodes, jnp.int32)
        room = jnp.asarray(self._room, jnp.int32)[episode]
        place = jnp.asarray(where * (room + 1), jnp.int32)
        graph = self.compiled.init(of_graph, params.nodes, episode, place)
        graph = replace(graph, params=self._drawn(of_params, graph.params))
        graph = self._task(params).start(of_start, graph)
        graph, seen = self.compiled.reset(graph, params.tables)
        observation = self._observe(seen)
        memory = self.interface.start(observation)
        last = jnp.zeros(self.num_actions, observation.dtype)
        state = EnvironmentState(graph, observation, memory, last, jnp.asarray(0, jnp.int32))
        return self.interface.inputs(observation, memory), state

    def step_env(
        self, key: Array, state: EnvironmentState, action: Array, params: EnvironmentParams
    ) -> tuple[Array, EnvironmentState, Array, Array, dict[str, Array]]:
        """One step without a reset: observation, state, reward, whether the episode ended for good, and the metrics.

        The random numbers follow from the state: `key` is not read.
        """
        del key
        sent = self.interface.scaled(jnp.asarray(action, state.observation.dtype))
        message = self.interface.message(sent, self._example(state.graph), self._leaves)
        graph, seen = self.compiled.step(state.graph, message, params.tables)
        memory = self.interface.remember(state.memory, state.observation, sent)
        observation = self._observe(seen)
        task = self._task(params)
        reward = jnp.asarray(task.reward(state.graph, state.last, sent, graph), float)
        after = EnvironmentState(graph, observation, memory, sent, state.time + 1)
        terminated = jnp.asarray(task.terminated(graph), bool)
        return self.interface.inputs(observation, memory), after, reward, terminated, task.metrics(graph)

    def is_truncated(self, state: EnvironmentState, params: EnvironmentParams) -> Array:
        """Whether the time is up."""
        return state.time >= params.max_steps_in_episode

    def reset(self, key: Array, params: EnvironmentParams | None = None) -> tuple[Array, EnvironmentState]:
        """The first observation, and the state."""
        return self.reset_env(key, self.default_params if params is None else params)

    def step(
        self, key: Array, state: EnvironmentState, action: Array, params: EnvironmentParams | None = None
    ) -> tuple[Array, EnvironmentState, Array, Array, Array, dict[str, Array]]:
        """One step, and a reset where the episode is over.

        Observation, state, reward, terminated, truncated, and a dictionary with the metrics and `final_observation`,
        the observation before the reset.
        """
        params = self.default_params if params is None else params
        of_step, of_reset = jax.random.split(key)
        seen, after, reward, terminated, metrics = self.step_env(of_step, state, action, params)
        truncated = self.is_truncated(after, params)
        first, fresh = self.reset_env(of_reset, params)
        done = terminated | truncated
        observation = jnp.where(done, first, seen)
        state = jax.tree.map(partial(lax.select, done), fresh, after)
        info = {**metrics, "terminated": terminated, "truncated": truncated, "final_observation": seen}
        return observation, state, reward, terminated, truncated, info

    def _task(self, params: EnvironmentParams) -> Task:
        """The task with its numbers of now."""
        if not params.task:
            return self.task
        task: Any = self.task
        changed: Task = replace(task, **params.task)
        return changed

    def _observe(self, seen: Observation) -> Array:
        message = jax.tree.map(lambda leaf: leaf[-1], seen.inputs[self.port]["message"])
        return self.interface.observe(message)

    def _example(self, graph: GraphState) -> Tree:
        sent = graph.history[self.graph.supervisor]
        return sent[0] if isinstance(sent, tuple) else jax.tree.map(lambda leaf: leaf[0], sent)

    def _drawn(self, key: Array, params: Mapping[str, Tree]) -> dict[str, Tree]:
        result = dict(params)
        for place, value in self.randomisation.sample(key).items():
            node, *path = place.split(".")
            if node == "delays":
                name = place.removeprefix("delays.")
                if name not in self.compiled.delays:
                    known = ", ".join(self.compiled.delays) or "none"
                    raise ValueError(f"`{place}` is randomised, but is no trainable delay; those are: {known}")
                delay = self.compiled.delays[name]
                share = (value - delay.min) / (delay.max - delay.min)
                result["delays"] = {**result["delays"], name: jnp.clip(share, 0.0, 1.0)}
                continue
            if node not in result:
                raise ValueError(f"`{place}` is randomised, and the graph has no node `{node}`")
            result[node] = with_leaf(result[node], path, value, f"`{place}` is randomised")
        return result
