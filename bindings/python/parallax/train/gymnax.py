"""The same environment for gymnax: an `Environment` of its own, with its spaces, for its wrappers and whoever asks for
one by its type."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from ..types import Array
from .environment import EnvironmentParams, EnvironmentState, GraphEnvironment
from .missing import package

base: Any = package("gymnax.environments.environment", "gymnax")
spaces: Any = package("gymnax.environments.spaces", "gymnax")

__all__ = ["GymnaxEnvironment"]


class GymnaxEnvironment(base.Environment):  # type: ignore[misc]
    """A task on a graph as an environment of gymnax 1.0, whose `reset` and `step` are gymnax's own.

    `GraphEnvironment` has the same functions, and needs no gymnax. Actions are shares of their ranges, from −1 to 1.
    """

    def __init__(self, environment: GraphEnvironment) -> None:
        self.environment = environment
        """The environment."""

    @property
    def name(self) -> str:
        """What it is called."""
        return self.environment.name

    @property
    def num_actions(self) -> int:
        """How many numbers an action has."""
        return self.environment.num_actions

    @property
    def default_params(self) -> EnvironmentParams:
        """The schedules, and the parameters of the graph."""
        return self.environment.default_params

    def reset_env(self, key: Array, params: EnvironmentParams) -> tuple[Array, EnvironmentState]:
        """The first observation, and the state."""
        return self.environment.reset_env(key, params)

    def step_env(
        self, key: Array, state: EnvironmentState, action: Array, params: EnvironmentParams
    ) -> tuple[Array, EnvironmentState, Array, Array, dict[str, Array]]:
        """One step without a reset."""
        return self.environment.step_env(key, state, action, params)

    def observe(self, key: Array, state: EnvironmentState, action: Array | None, params: EnvironmentParams) -> Array:
        """What the policy sees of a state."""
        return self.environment.interface.inputs(state.observation, state.memory)

    def is_terminated(self, state: EnvironmentState, params: EnvironmentParams) -> Array:
        """Whether the episode is over for good."""
        return jnp.asarray(self.environment.task.terminated(state.graph), bool)

    def action_space(self, params: EnvironmentParams | None = None) -> Any:
        """Shares of the actions' ranges."""
        return _space(self.environment.action_space(params))

    def observation_space(self, params: EnvironmentParams | None = None) -> Any:
        """Everything that enters the network; without bounds, because noise has none."""
        return _space(self.environment.observation_space(params))


def _space(box: Any) -> Any:
    return spaces.Box(box.low, box.high, box.shape, box.dtype)
