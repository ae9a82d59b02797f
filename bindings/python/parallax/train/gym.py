"""The same environments for gymnasium: one, or many at once."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from numpy.typing import NDArray

from ..types import Array
from .environment import EnvironmentState, GraphEnvironment
from .missing import package

gymnasium: Any = package("gymnasium", "gym")
vector: Any = package("gymnasium.vector", "gym")

__all__ = ["GymEnvironment", "GymVectorEnvironment"]

Floats32 = NDArray[np.float32]


def _spaces(environment: GraphEnvironment) -> tuple[Any, Any]:
    inputs, actions = environment.interface.size, environment.num_actions
    return (
        gymnasium.spaces.Box(-np.inf, np.inf, (inputs,), np.float32),
        gymnasium.spaces.Box(-1.0, 1.0, (actions,), np.float32),
    )


class GymEnvironment(gymnasium.Env):  # type: ignore[misc]
    """A task on a graph as a `gymnasium.Env`. Actions are shares of their ranges, from −1 to 1."""

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (gymnasium's own)

    def __init__(self, environment: GraphEnvironment, render_mode: str | None = None) -> None:
        if render_mode is not None:
            raise ValueError(f"there is nothing to render: render_mode={render_mode!r}")
        self.environment = environment
        self.render_mode = render_mode
        self.observation_space, self.action_space = _spaces(environment)
        self._params = environment.default_params
        self._reset = jax.jit(environment.reset_env)
        self._step = jax.jit(partial(_step, environment))
        self._state: EnvironmentState | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats32, dict[str, Any]]:
        """The first observation; a seed gives the same episode again."""
        super().reset(seed=seed)
        key = jax.random.key(int(self.np_random.integers(2**31)))
        observation, self._state = self._reset(key, self._params)
        return np.asarray(observation, np.float32), {}

    def step(self, action: Any) -> tuple[Floats32, float, bool, bool, dict[str, Any]]:
        """One step."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call `reset` before the first step")
        result = self._step(self._state, jnp.asarray(action, float), self._params)
        observation, self._state, reward, terminated, truncated, metrics = result
        info = {name: float(value) for name, value in metrics.items()}
        return np.asarray(observation, np.float32), float(reward), bool(terminated), bool(truncated), info


class GymVectorEnvironment(vector.VectorEnv):  # type: ignore[misc]
    """Many environments as a `gymnasium.vector.VectorEnv`, stepped together by one compiled function.

    An episode that is over starts anew in the same step (`AutoresetMode.SAME_STEP`): `final_obs` and `final_info` hold
    what it ended with.
    """

    metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": vector.AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(self, environment: GraphEnvironment, num_envs: int) -> None:
        self.environment = environment
        self.num_envs = num_envs
        self.render_mode = None
        self.single_observation_space, self.single_action_space = _spaces(environment)
        batched = vector.utils.batch_space
        self.observation_space = batched(self.single_observation_space, num_envs)
        self.action_space = batched(self.single_action_space, num_envs)
        self._params = environment.default_params
        self._reset = jax.jit(jax.vmap(environment.reset_env, (0, None)))
        self._step = jax.jit(jax.vmap(partial(_step_and_reset, environment), (0, 0, 0, None)))
        self._state: EnvironmentState | None = None

    def _keys(self) -> Array:
        return jax.random.split(jax.random.key(int(self.np_random.integers(2**31))), self.num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats32, dict[str, Any]]:
        """The first observations, `[environment, ...]`; a seed gives the same episodes again."""
        if seed is not None and not isinstance(seed, int):
            raise ValueError("one seed serves all environments: they run in one function")
        super().reset(seed=seed)
        observation, self._state = self._reset(self._keys(), self._params)
        return np.array(observation, np.float32), {}

    def step(
        self, actions: Any
    ) -> tuple[Floats32, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """One step of each."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call `reset` before the first step")
        result = self._step(self._keys(), self._state, jnp.asarray(actions, float), self._params)
        observation, self._state, reward, terminated, truncated, metrics, final = result
        over = np.asarray(terminated | truncated)
        info: dict[str, Any] = {}
        for name, value in metrics.items():
            info[name], info[f"_{name}"] = np.asarray(value), ~over
        if over.any():
            seen = np.empty(self.num_envs, dtype=object)
            last = np.asarray(final, np.float32)
            for place in np.flatnonzero(over):
                seen[place] = last[place]
            info["final_obs"], info["_final_obs"] = seen, over
            final_info: dict[str, Any] = {}
            for name, value in metrics.items():
                final_info[name], final_info[f"_{name}"] = np.asarray(value), over
            info["final_info"], info["_final_info"] = final_info, over
        return (
            np.array(observation, np.float32),
            np.asarray(reward, np.float64),
            np.array(terminated),
            np.array(truncated),
            info,
        )


def _step(environment: GraphEnvironment, state: EnvironmentState, action: Array, params: Any) -> tuple[Any, ...]:
    seen, after, reward, terminated, metrics = environment.step_env(state.graph.key, state, action, params)
    return seen, after, reward, terminated, environment.is_truncated(after, params), metrics


def _step_and_reset(
    environment: GraphEnvironment, key: Array, state: EnvironmentState, action: Array, params: Any
) -> tuple[Any, ...]:
    seen, after, reward, terminated, truncated, metrics = _step(environment, state, action, params)
    first, fresh = environment.reset_env(key, params)
    over = terminated | truncated
    chosen = jax.tree.map(partial(lax.select, over), (first, fresh), (seen, after))
    return chosen[0], chosen[1], reward, terminated, truncated, metrics, seen
