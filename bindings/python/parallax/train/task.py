"""What a task is: what is to be done, seen, sent and rewarded. How fast it runs and how late, the graph says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Protocol

import jax
import jax.numpy as jnp

from ..state import GraphState
from ..types import Array, Scalar
from .randomisation import with_leaf

__all__ = ["Task", "with_state"]


class Task(Protocol):
    """What a policy learns to do. All methods are pure; they see one environment.

    A dataclass may name fields in `numbers`: these are read from `EnvironmentParams.task`, so that environments which
    differ in them alone are compiled once.
    """

    @property
    def observations(self) -> Sequence[str]:
        """Leaves of the message that the policy's node receives; `sin(leaf)` and `cos(leaf)` may stand for an angle."""
        ...

    @property
    def actions(self) -> Mapping[str, tuple[float, float]]:
        """Leaves of the message that it sends, each with its smallest and its largest value."""
        ...

    @property
    def seconds(self) -> float:
        """How long an episode lasts, s. Its end is no end of the world: the value of what follows is counted."""
        ...

    def start(self, key: Array, state: GraphState) -> GraphState:
        """Draws where an episode starts."""
        ...

    def reward(self, before: GraphState, last: Array, action: Array, after: GraphState) -> Array:
        """The reward of a step: `action` (in the leaves' units) follows the action `last`."""
        ...

    def terminated(self, state: GraphState) -> Array:
        """Whether the episode is over for good: nothing that follows is worth anything."""
        ...

    def metrics(self, state: GraphState) -> dict[str, Array]:
        """Numbers to be averaged over an evaluation's steps, such as whether the pendulum is upright."""
        ...


def with_state(state: GraphState, node: str, values: Mapping[str, Scalar], messages: Sequence[str] = ()) -> GraphState:
    """`state` in which leaves of a node's state have other values.

    So have the leaves of the same names in the messages that the nodes `messages` sent before: receivers must not see
    that the machine was elsewhere before the episode.
    """
    states, history = dict(state.state), dict(state.history)
    for leaf, value in values.items():
        states[node] = with_leaf(states[node], leaf.split("."), jnp.asarray(value, float), f"the state of `{node}`")
    for sender in messages:
        sent = history[sender]
        # A tuple of messages, or one tree with a leading axis, where all places get the one value.
        trees = sent if isinstance(sent, tuple) else (sent,)
        shape = () if isinstance(sent, tuple) else jax.tree.leaves(sent)[0].shape[:1]
        for leaf, value in values.items():
            shown = jnp.broadcast_to(jnp.asarray(value, float), shape)
            what = f"the messages of `{sender}`"
            trees = tuple(with_leaf(tree, leaf.split("."), shown, what) for tree in trees)
        history[sender] = trees if isinstance(sent, tuple) else trees[0]
    return replace(state, state=states, history=history)
