"""Proximal policy optimisation (J. Schulman and others, 2017), as pure functions of the trainer's state.

Written after the conventions of PureJaxRL (C. Lu and others, *Discovered policy optimisation*, 2022) and of S. Huang
and others, *The 37 implementation details of proximal policy optimization*, 2022, except where an episode is cut off by
its time limit: there the value of the state that it would have gone on from is counted (F. Pardo and others, *Time
limits in reinforcement learning*, 2018).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from ..types import Array, Tree
from . import network
from .environment import EnvironmentParams, EnvironmentState, GraphEnvironment
from .missing import optax
from .statistics import Moments

__all__ = ["PENDULUM", "PPO", "QUADROTOR", "Learner", "TrainState", "advantages"]

OBSERVATION_CLIP = 10.0
"""Normalised observations are held within ± this."""


@dataclass(frozen=True)
class PPO:
    """Settings. The defaults are those of the paper's appendix F for the pendulum."""

    total_steps: int = 2_000_000
    """Steps of environments, over the whole training."""
    learning_rate: float = 3.26e-4
    """Of Adam."""
    anneal: bool = False
    """Whether the learning rate falls linearly to zero."""
    environments: int = 128
    """How many run side by side."""
    rollout_steps: int = 32
    """Steps of each between two updates."""
    epochs: int = 8
    """How often an update goes through what was collected."""
    minibatches: int = 16
    """Into how many parts, each time."""
    discount: float = 0.9939
    """γ, for each step."""
    trace: float = 0.971
    """λ of the generalised advantage estimate."""
    clip: float = 0.164
    """ε: how far a step's probability may change in one update."""
    entropy: float = 0.01
    """Coefficient of the entropy."""
    value: float = 0.802
    """Coefficient of the value function's loss."""
    clip_value: bool = True
    """Whether values may move by ε at most in one update."""
    largest_gradient: float = 0.963
    """Longer gradients are shortened to this norm."""
    hidden: tuple[int, ...] = (64, 64)
    """Widths of the hidden layers, of the policy and of the value function."""
    activation: str = "tanh"
    """Between layers."""
    squash: bool = True
    """Whether actions pass a hyperbolic tangent; else they are cut off at the ends of their ranges."""
    log_std: float = 0.0
    """Logarithm of the first standard deviation of the actions, which does not depend on the state."""
    normalise_observations: bool = True
    """Whether observations are normalised by their running means and standard deviations, which the policy keeps."""
    normalise_rewards: bool = True
    """Whether rewards are divided by the standard deviation of the running discounted return."""

    def __post_init__(self) -> None:
        batch = self.environments * self.rollout_steps
        if min(self.environments, self.rollout_steps, self.epochs, self.minibatches, self.total_steps) < 1:
            raise ValueError("environments, rollout_steps, epochs, minibatches and total_steps are positive")
        if batch % self.minibatches:
            raise ValueError(
                f"{self.environments} environments of {self.rollout_steps} steps are {batch}, which {self.minibatches} "
                f"minibatches do not divide"
            )
        if self.activation not in network.ACTIVATIONS:
            raise ValueError(f"no activation `{self.activation}`; there are {', '.join(network.ACTIVATIONS)}")
        if not 0.0 < self.discount <= 1.0 or not 0.0 <= self.trace <= 1.0:
            raise ValueError("discount and trace lie between 0 and 1")

    @property
    def batch(self) -> int:
        """Steps of one update."""
        return self.environments * self.rollout_steps

    @property
    def updates(self) -> int:
        """How many updates make `total_steps`, rounded up."""
        return -(-self.total_steps // self.batch)

    def changed(self, **settings: Any) -> PPO:
        """With other settings."""
        return replace(self, **settings)

    def as_dict(self) -> dict[str, Any]:
        """For a file."""
        return {name: list(x) if isinstance(x, tuple) else x for name, x in asdict(self).items()}


PENDULUM = PPO()
"""Appendix F, pendulum."""

QUADROTOR = PPO(
    total_steps=10_000_000,
    learning_rate=9.23e-4,
    rollout_steps=64,
    epochs=16,
    minibatches=8,
    discount=0.9844,
    trace=0.939,
    clip=0.131,
    value=0.756,
    largest_gradient=0.76,
)
"""Appendix F, quadrotor."""


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["network", "optimiser", "environments", "inputs", "seen", "returned", "running", "key", "update"],
    meta_fields=[],
)
@dataclass(frozen=True)
class TrainState:
    """Everything that training carries, for one seed."""

    network: Tree
    """Weights of the policy and the value function."""
    optimiser: Tree
    """Adam's."""
    environments: EnvironmentState
    """`[environment]`"""
    inputs: Array
    """What the policy sees next, `[environment, input]`."""
    seen: Moments
    """Of the inputs, `[input]`."""
    returned: Moments
    """Of the running discounted return."""
    running: Array
    """That return, `[environment]`, and the plain return and length of the present episodes."""
    key: Array
    """The seed's; what is drawn follows from it and from `update`."""
    update: Array
    """How many updates were made, int32."""


class _Step(NamedTuple):
    """What is kept of a step of all environments."""

    inputs: Array
    action: Array
    density: Array
    after: Array
    reward: Array
    terminated: Array
    done: Array
    running: Array


class _Batch(NamedTuple):
    """What a gradient is made of."""

    inputs: Array
    action: Array
    density: Array
    value: Array
    advantage: Array
    target: Array


def advantages(
    reward: Array, value: Array, after: Array, terminated: Array, done: Array, discount: float, trace: float
) -> Array:
    """Generalised advantage estimates `[step, environment]` (J. Schulman and others, 2016).

    `value` is that of the observation of a step, `after` that of the observation which the step led to, before any
    reset. A terminated episode has no value after its end; one that was cut off has. Neither hands its advantage to
    the step before the reset.
    """
    error = reward + discount * after * (1.0 - terminated) - value

    def back(following: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        error, done = step
        advantage = error + discount * trace * (1.0 - done) * following
        return advantage, advantage

    return lax.scan(back, jnp.zeros_like(error[0]), (error, done), reverse=True, unroll=8)[1]


class Learner:
    """The functions of a training: `init`, `update`, `evaluate`. All are pure, for one seed; `vmap` makes them many."""

    def __init__(self, environment: GraphEnvironment, settings: PPO) -> None:
        self.environment = environment
        self.settings = settings
        rate: Any = settings.learning_rate
        if settings.anneal:
            gradients = settings.updates * settings.epochs * settings.minibatches
            rate = optax.linear_schedule(settings.learning_rate, 0.0, gradients)
        self.optimiser = optax.chain(optax.clip_by_global_norm(settings.largest_gradient), optax.adam(rate, eps=1e-5))

    def init(self, key: Array, params: EnvironmentParams) -> TrainState:
        """Before the first update."""
        own, of_network, of_reset = jax.random.split(key, 3)
        settings, interface = self.settings, self.environment.interface
        weights = network.initial(of_network, interface.size, settings.hidden, len(interface.actions), settings.log_std)
        inputs, environments = self._fresh(of_reset, params)
        # Spread over an episode, so that not all of them end in the same update.
        count = jnp.arange(settings.environments, dtype=jnp.int32)
        spread = count * params.max_steps_in_episode // settings.environments
        environments = replace(environments, time=environments.time + spread)
        seen = Moments.none((interface.size,))
        if settings.normalise_observations:
            seen = seen.updated(inputs)
        return TrainState(
            weights,
            self.optimiser.init(weights),
            environments,
            inputs,
            seen,
            Moments.none(()),
            jnp.zeros((settings.environments, 3), float),
            own,
            jnp.asarray(0, jnp.int32),
        )

    def update(self, state: TrainState, params: EnvironmentParams) -> tuple[TrainState, dict[str, Array]]:
        """Collects a batch, and goes through it."""
        key = jax.random.fold_in(state.key, state.update)
        of_rollout, of_epochs = jax.random.split(key)
        environments, inputs, running, steps = self._collect(of_rollout, state, params)
        batch, seen, returned = self._judged(state, steps)
        (weights, optimiser), losses = self._improved(of_epochs, state, batch)
        ended = steps.done.astype(float)
        metrics = {name: jnp.mean(loss) for name, loss in losses.items()}
        metrics |= {
            "episodes": jnp.sum(ended),
            "return": jnp.sum(steps.running[..., 1] * ended),
            "length": jnp.sum(steps.running[..., 2] * ended),
            "explained": 1.0 - jnp.var(batch.target - batch.value) / (jnp.var(batch.target) + 1e-8),
        }
        after = TrainState(
            weights, optimiser, environments, inputs, seen, returned, running, state.key, state.update + 1
        )
        return after, metrics

    def evaluate(self, state: TrainState, key: Array, params: EnvironmentParams, count: int) -> dict[str, Array]:
        """Without noise on actions, over `count` whole episodes: the mean return, its spread, and the task's metrics.

        What follows the end of an episode that terminated does not count.
        """
        environment = self.environment
        inputs, environments = jax.vmap(environment.reset_env, (0, None))(jax.random.split(key, count), params)

        def body(carry: tuple[Any, ...], _: None) -> tuple[tuple[Any, ...], dict[str, Array]]:
            environments, inputs, alive, total = carry
            share = self._share(network.evaluate(state.network["actor"], self._normal(state.seen, inputs), self._kind))
            inputs, environments, reward, terminated, metrics = jax.vmap(environment.step_env, (None, 0, 0, None))(
                key, environments, share, params
            )
            total = total + alive * reward
            kept = {name: jnp.sum(alive * value) for name, value in metrics.items()} | {"": jnp.sum(alive)}
            return (environments, inputs, alive * (1.0 - terminated), total), kept

        start = (environments, inputs, jnp.ones(count), jnp.zeros(count))
        (_, _, _, total), kept = lax.scan(body, start, length=environment.longest)
        steps = jnp.sum(kept.pop(""))
        result = {name: jnp.sum(value) / steps for name, value in kept.items()}
        return {"return": jnp.mean(total), "return_std": jnp.std(total), **result}

    @property
    def _kind(self) -> str:
        return self.settings.activation

    def _normal(self, seen: Moments, inputs: Array) -> Array:
        if not self.settings.normalise_observations:
            return inputs
        return jnp.clip((inputs - seen.mean) / seen.std, -OBSERVATION_CLIP, OBSERVATION_CLIP)

    def _share(self, action: Array) -> Array:
        """What the environment gets for a network's output; it cuts off what is beyond ±1."""
        return jnp.tanh(action) if self.settings.squash else action

    def _fresh(self, key: Array, params: EnvironmentParams) -> tuple[Array, EnvironmentState]:
        keys = jax.random.split(key, self.settings.environments)
        return jax.vmap(self.environment.reset_env, (0, None))(keys, params)

    def _collect(
        self, key: Array, state: TrainState, params: EnvironmentParams
    ) -> tuple[EnvironmentState, Array, Array, _Step]:
        """Runs the environments. One that ends goes on from a fresh start, of which each has one for every rollout:
        drawn once instead of in every step, because a reset costs as much as a step."""
        settings, environment = self.settings, self.environment
        of_reset, of_noise = jax.random.split(key)
        first, fresh = self._fresh(of_reset, params)
        shape = (settings.rollout_steps, settings.environments, environment.num_actions)
        noise = jax.random.normal(of_noise, shape, float)
        log_std = state.network["log_std"]

        def body(carry: tuple[Any, ...], noise: Array) -> tuple[tuple[Any, ...], _Step]:
            environments, inputs, running = carry
            mean = network.evaluate(state.network["actor"], self._normal(state.seen, inputs), self._kind)
            action = mean + jnp.exp(log_std) * noise
            density = network.log_density(action, mean, log_std)
            after, moved, reward, terminated, _ = jax.vmap(environment.step_env, (None, 0, 0, None))(
                key, environments, self._share(action), params
            )
            truncated = jax.vmap(environment.is_truncated, (0, None))(moved, params)
            done = terminated | truncated
            discounted = settings.discount * running[:, 0] + reward
            running = jnp.stack([discounted, running[:, 1] + reward, running[:, 2] + 1.0], axis=-1)
            kept = _Step(inputs, action, density, after, reward, terminated, done, running)
            environments = jax.tree.map(partial(_chosen, done), fresh, moved)
            inputs = jnp.where(done[:, None], first, after)
            return (environments, inputs, running * (1.0 - done[:, None])), kept

        carry, steps = lax.scan(body, (state.environments, state.inputs, state.running), noise)
        return *carry, steps

    def _judged(self, state: TrainState, steps: _Step) -> tuple[_Batch, Moments, Moments]:
        """Advantages and targets of a rollout."""
        settings = self.settings
        seen, returned, reward = state.seen, state.returned, steps.reward
        if settings.normalise_rewards:
            returned = returned.updated(steps.running[..., 0].reshape(-1))
            reward = reward / returned.std
        normal = self._normal(state.seen, steps.inputs)
        critic = state.network["critic"]
        value = network.evaluate(critic, normal, self._kind)[..., 0]
        after = network.evaluate(critic, self._normal(state.seen, steps.after), self._kind)[..., 0]
        terminated, done = steps.terminated.astype(float), steps.done.astype(float)
        advantage = advantages(reward, value, after, terminated, done, settings.discount, settings.trace)
        if settings.normalise_observations:
            seen = seen.updated(steps.inputs.reshape(-1, steps.inputs.shape[-1]))
        batch = _Batch(normal, steps.action, steps.density, value, advantage, advantage + value)
        return batch, seen, returned

    def _improved(self, key: Array, state: TrainState, batch: _Batch) -> tuple[tuple[Tree, Tree], dict[str, Array]]:
        """The weights after all epochs."""
        settings = self.settings
        flat = jax.tree.map(lambda x: x.reshape(settings.batch, *x.shape[2:]), batch)

        def gradient(carry: tuple[Tree, Tree], part: _Batch) -> tuple[tuple[Tree, Tree], dict[str, Array]]:
            weights, optimiser = carry
            slopes, losses = jax.grad(self._loss, has_aux=True)(weights, part)
            change, optimiser = self.optimiser.update(slopes, optimiser, weights)
            return (optax.apply_updates(weights, change), optimiser), losses

        def epoch(carry: tuple[Tree, Tree], key: Array) -> tuple[tuple[Tree, Tree], dict[str, Array]]:
            order = jax.random.permutation(key, settings.batch)
            size = settings.batch // settings.minibatches
            parts = jax.tree.map(lambda x: x[order].reshape(settings.minibatches, size, *x.shape[1:]), flat)
            return lax.scan(gradient, carry, parts)

        return lax.scan(epoch, (state.network, state.optimiser), jax.random.split(key, settings.epochs))

    def _loss(self, weights: Tree, part: _Batch) -> tuple[Array, dict[str, Array]]:
        settings = self.settings
        mean = network.evaluate(weights["actor"], part.inputs, self._kind)
        value = network.evaluate(weights["critic"], part.inputs, self._kind)[..., 0]
        log_std = weights["log_std"]
        change = network.log_density(part.action, mean, log_std) - part.density
        ratio = jnp.exp(change)
        advantage = (part.advantage - jnp.mean(part.advantage)) / (jnp.std(part.advantage) + 1e-8)
        held = jnp.clip(ratio, 1.0 - settings.clip, 1.0 + settings.clip)
        policy = -jnp.mean(jnp.minimum(ratio * advantage, held * advantage))
        wrong = (value - part.target) ** 2
        if settings.clip_value:
            near = part.value + jnp.clip(value - part.value, -settings.clip, settings.clip)
            wrong = jnp.maximum(wrong, (near - part.target) ** 2)
        worth = 0.5 * jnp.mean(wrong)
        # Of the normal distribution before the hyperbolic tangent.
        entropy = jnp.sum(log_std + 0.5 * jnp.log(2 * jnp.pi * jnp.e))
        loss = policy + settings.value * worth - settings.entropy * entropy
        seen = {
            "policy_loss": policy,
            "value_loss": worth,
            "entropy": entropy,
            # J. Schulman, *Approximating KL divergence*, 2020.
            "divergence": jnp.mean((ratio - 1.0) - change),
            "clipped": jnp.mean((jnp.abs(ratio - 1.0) > settings.clip).astype(float)),
        }
        return loss, seen


def _chosen(which: Array, one: Array, other: Array) -> Array:
    """`one` where `which` holds, environment by environment; also for random keys."""
    return jax.vmap(lax.select)(which, one, other)
