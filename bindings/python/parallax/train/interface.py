"""What a policy sees and what it sends: names, order, history and range, the same in training and in real time."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp

from ..trees import flat, nested
from ..types import Array, Tree

__all__ = ["Interface", "Memory"]

CALL = re.compile(r"^(sin|cos)\(\s*(.+?)\s*\)$")
"""An observation that is a function of a leaf."""


@partial(jax.tree_util.register_dataclass, data_fields=["observations", "actions"], meta_fields=[])
@dataclass(frozen=True)
class Memory:
    """What a policy with a history remembers, newest first."""

    observations: Array
    """`[past_observations, observation]`, as they were seen."""
    actions: Array
    """`[past_actions, action]`, as they were sent."""


@dataclass(frozen=True)
class Interface:
    """From the messages that the policy's node receives to the numbers that enter its network, and back.

    The network's inputs are the observation of this step, those of the steps before (newest first), and the actions of
    the steps before (newest first). In the first step the past observations are that of the step itself, and the past
    actions are zero. `nodes/src/policy` does the same in real time.
    """

    observations: tuple[str, ...]
    """Leaves of the message received, in order; `sin(leaf)` and `cos(leaf)` may stand for an angle."""
    actions: tuple[str, ...]
    """Leaves of the message sent, in order."""
    low: tuple[float, ...]
    """The smallest action, in the leaves' units."""
    high: tuple[float, ...]
    """The largest."""
    past_observations: int = 0
    """How many earlier observations the network sees."""
    past_actions: int = 0
    """How many earlier actions it sees."""

    def __post_init__(self) -> None:
        if not self.observations or not self.actions:
            raise ValueError("a policy needs at least one observation and one action")
        if not len(self.low) == len(self.high) == len(self.actions):
            raise ValueError(f"{len(self.actions)} actions have {len(self.low)} lower and {len(self.high)} upper ends")
        for name, low, high in zip(self.actions, self.low, self.high, strict=True):
            if not low < high:
                raise ValueError(f"the action `{name}` lies between {low} and {high}; the first must be less")
        if self.past_observations < 0 or self.past_actions < 0:
            raise ValueError("a history cannot be shorter than nothing")

    @classmethod
    def of(
        cls,
        observations: Sequence[str],
        actions: Mapping[str, tuple[float, float]],
        past_observations: int = 0,
        past_actions: int = 0,
    ) -> Interface:
        """From the observations' names and the actions' ranges."""
        low, high = zip(*actions.values(), strict=True) if actions else ((), ())
        return cls(
            tuple(observations),
            tuple(actions),
            tuple(float(x) for x in low),
            tuple(float(x) for x in high),
            past_observations,
            past_actions,
        )

    @property
    def size(self) -> int:
        """How many numbers enter the network."""
        return len(self.observations) * (1 + self.past_observations) + len(self.actions) * self.past_actions

    @property
    def names(self) -> list[str]:
        """What they are: `cos(angle)`, `cos(angle)[-1]` one step before, `voltage[-1]`."""
        past = [f"{name}[-{age}]" for age in range(1, self.past_observations + 1) for name in self.observations]
        sent = [f"{name}[-{age}]" for age in range(1, self.past_actions + 1) for name in self.actions]
        return [*self.observations, *past, *sent]

    @property
    def leaves(self) -> list[str]:
        """The leaves of the message that the observations need."""
        return [_parts(name)[1] for name in self.observations]

    def observe(self, message: Tree) -> Array:
        """The observation `[observation]` in a message."""
        values = flat(self.leaves, message, "the message that the policy observes")
        functions = [_parts(name)[0] for name in self.observations]
        return jnp.stack(
            [jnp.asarray(_apply(function, value), float) for function, value in zip(functions, values, strict=True)]
        )

    def start(self, observation: Array) -> Memory:
        """What is remembered before the first step, whose observation this is."""
        return Memory(
            jnp.broadcast_to(observation, (self.past_observations, len(self.observations))),
            jnp.zeros((self.past_actions, len(self.actions)), observation.dtype),
        )

    def inputs(self, observation: Array, memory: Memory) -> Array:
        """What enters the network, `[size]`."""
        return jnp.concatenate([observation, memory.observations.ravel(), memory.actions.ravel()])

    def remember(self, memory: Memory, observation: Array, action: Array) -> Memory:
        """What is remembered after a step that saw `observation` and sent `action`."""
        return Memory(_pushed(memory.observations, observation), _pushed(memory.actions, action))

    def scaled(self, share: Array) -> Array:
        """The action of a number from −1 (its smallest) to 1 (its largest), in the leaves' units."""
        low, high = jnp.asarray(self.low, share.dtype), jnp.asarray(self.high, share.dtype)
        return 0.5 * (low + high) + 0.5 * (high - low) * jnp.clip(share, -1.0, 1.0)

    def message(self, action: Array, example: Tree, leaves: Sequence[str]) -> Tree:
        """The message that sends an action; leaves that are no actions are as in `example`."""
        values = dict(zip(leaves, flat(leaves, example, "the message that the policy sends"), strict=True))
        values |= {name: action[place] for place, name in enumerate(self.actions)}
        return nested(list(leaves), [values[leaf] for leaf in leaves])


def _parts(name: str) -> tuple[str, str]:
    call = CALL.match(name)
    return (call[1], call[2]) if call else ("", name)


def _apply(function: str, value: Array) -> Array:
    return {"sin": jnp.sin, "cos": jnp.cos}[function](value) if function else value


def _pushed(past: Array, newest: Array) -> Array:
    if past.shape[0] == 0:
        return past
    return jnp.concatenate([newest[None].astype(past.dtype), past[:-1]])
