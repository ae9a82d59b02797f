"""The yardstick: PPO as PureJaxRL does it, on the pendulum's bare equations; no graph, no messages, no delays.

Everything is one compiled function: the policy and the value function are evaluated in every step, observations and
rewards are normalised in every step, and an episode that is over is reset in every step, by selection. The settings are
those that are given, and so are the reward and the observations; only the machine is simpler.
"""

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import lax
from parallax.train import network

CONSTANTS = {"J": 1.6e-4, "mgl": 0.0509 * 0.0415 * 9.81, "b": 1.43e-5, "K": 0.0333, "R": 7.73, "c": 9.75e-4}
STEP = 0.01


class State(NamedTuple):
    angle: jax.Array
    speed: jax.Array
    last: jax.Array
    time: jax.Array


class Statistics(NamedTuple):
    mean: jax.Array
    variance: jax.Array
    count: jax.Array

    def updated(self, batch):
        mean, variance, many = jnp.mean(batch, 0), jnp.var(batch, 0), batch.shape[0]
        total, between = self.count + many, mean - self.mean
        squares = self.variance * self.count + variance * many + between**2 * self.count * many / total
        return Statistics(self.mean + between * many / total, squares / total, total)


def statistics(shape):
    return Statistics(jnp.zeros(shape), jnp.ones(shape), jnp.asarray(1e-4))


def acceleration(angle, speed, voltage):
    p = CONSTANTS
    torque = voltage * p["K"] / p["R"] + p["mgl"] * jnp.sin(angle)
    torque -= speed * (p["b"] + p["K"] ** 2 / p["R"]) + p["c"] * jnp.sign(speed)
    return torque / p["J"]


def runge_kutta(angle, speed, voltage):
    h = STEP
    a1 = acceleration(angle, speed, voltage)
    v2 = speed + 0.5 * h * a1
    a2 = acceleration(angle + 0.5 * h * speed, v2, voltage)
    v3 = speed + 0.5 * h * a2
    a3 = acceleration(angle + 0.5 * h * v2, v3, voltage)
    v4 = speed + h * a3
    a4 = acceleration(angle + h * v3, v4, voltage)
    return angle + h / 6 * (speed + 2 * v2 + 2 * v3 + v4), speed + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)


def observed(state):
    return jnp.stack([jnp.cos(state.angle), jnp.sin(state.angle), state.speed])


def reset(key):
    angle, speed = jax.random.uniform(key, (2,), minval=-1.0)
    state = State(math.pi * angle, 9.0 * speed, jnp.asarray(0.0), jnp.asarray(0, jnp.int32))
    return observed(state), state


def step(key, state, action, longest):
    voltage = 4.0 * action[0]
    angle, speed = state.angle, state.speed
    for _ in range(2):
        angle, speed = runge_kutta(angle, speed, voltage)
    near = angle - 2 * math.pi * jnp.floor((angle + math.pi) / (2 * math.pi))
    push = 0.05 * voltage**2 + 0.05 * (voltage - state.last) ** 2
    reward = -(near**2 + 0.1 * (speed / (1 + 10 * jnp.abs(near))) ** 2 + push)
    moved = State(angle, speed, voltage, state.time + 1)
    done = moved.time >= longest
    first, fresh = reset(key)
    chosen = jax.tree.map(partial(lax.select, done), fresh, moved)
    return jnp.where(done, first, observed(moved)), chosen, reward, done


class Transition(NamedTuple):
    done: jax.Array
    action: jax.Array
    value: jax.Array
    reward: jax.Array
    density: jax.Array
    inputs: jax.Array


def learner(settings, longest):
    """`init(key)` and `update(carry)`."""
    count = settings.environments
    optimiser = optax.chain(
        optax.clip_by_global_norm(settings.largest_gradient), optax.adam(settings.learning_rate, eps=1e-5)
    )
    both = jax.vmap(partial(step, longest=longest))

    def init(key):
        key, of_network, of_reset = jax.random.split(key, 3)
        weights = network.initial(of_network, 3, settings.hidden, 1, settings.log_std)
        inputs, states = jax.vmap(reset)(jax.random.split(of_reset, count))
        seen = statistics((3,)).updated(inputs)
        return weights, optimiser.init(weights), states, inputs, seen, statistics(()), jnp.zeros(count), key

    def collect(carry, _):
        weights, optimiser_state, states, inputs, seen, returned, running, key = carry
        key, of_action, of_step = jax.random.split(key, 3)
        normal = (inputs - seen.mean) / jnp.sqrt(seen.variance + 1e-8)
        mean = network.evaluate(weights["actor"], normal, settings.activation)
        value = network.evaluate(weights["critic"], normal, settings.activation)[:, 0]
        action = mean + jnp.exp(weights["log_std"]) * jax.random.normal(of_action, mean.shape)
        density = network.log_density(action, mean, weights["log_std"])
        inputs, states, reward, done = both(jax.random.split(of_step, count), states, jnp.tanh(action))
        seen = seen.updated(inputs)
        running = settings.discount * running * (1 - done) + reward
        returned = returned.updated(running)
        reward = reward / jnp.sqrt(returned.variance + 1e-8)
        kept = Transition(done, action, value, reward, density, normal)
        return (weights, optimiser_state, states, inputs, seen, returned, running, key), kept

    def loss(weights, part, advantage, target):
        mean = network.evaluate(weights["actor"], part.inputs, settings.activation)
        value = network.evaluate(weights["critic"], part.inputs, settings.activation)[:, 0]
        density = network.log_density(part.action, mean, weights["log_std"])
        near = part.value + jnp.clip(value - part.value, -settings.clip, settings.clip)
        wrong = 0.5 * jnp.mean(jnp.maximum((value - target) ** 2, (near - target) ** 2))
        ratio = jnp.exp(density - part.density)
        advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        held = jnp.clip(ratio, 1 - settings.clip, 1 + settings.clip)
        policy = -jnp.mean(jnp.minimum(ratio * advantage, held * advantage))
        entropy = jnp.sum(weights["log_std"] + 0.5 * jnp.log(2 * jnp.pi * jnp.e))
        return policy + settings.value * wrong - settings.entropy * entropy

    def update(carry):
        carry, kept = lax.scan(collect, carry, None, settings.rollout_steps)
        weights, optimiser_state, states, inputs, seen, returned, running, key = carry
        normal = (inputs - seen.mean) / jnp.sqrt(seen.variance + 1e-8)
        last = network.evaluate(weights["critic"], normal, settings.activation)[:, 0]

        def back(following, transition):
            advantage, value = following
            alive = 1.0 - transition.done
            error = transition.reward + settings.discount * value * alive - transition.value
            advantage = error + settings.discount * settings.trace * alive * advantage
            return (advantage, transition.value), advantage

        _, advantage = lax.scan(back, (jnp.zeros_like(last), last), kept, reverse=True, unroll=16)
        target = advantage + kept.value
        flat = jax.tree.map(lambda x: x.reshape(settings.batch, *x.shape[2:]), (kept, advantage, target))

        def gradient(carry, part):
            weights, optimiser_state = carry
            slopes = jax.grad(loss)(weights, *part)
            change, optimiser_state = optimiser.update(slopes, optimiser_state, weights)
            return (optax.apply_updates(weights, change), optimiser_state), None

        def epoch(carry, key):
            order = jax.random.permutation(key, settings.batch)
            shuffled = jax.tree.map(lambda x: jnp.take(x, order, axis=0), flat)
            parts = jax.tree.map(lambda x: x.reshape(settings.minibatches, -1, *x.shape[1:]), shuffled)
            return lax.scan(gradient, carry, parts)

        key, of_epochs = jax.random.split(key)
        (weights, optimiser_state), _ = lax.scan(
            epoch, (weights, optimiser_state), jax.random.split(of_epochs, settings.epochs)
        )
        return weights, optimiser_state, states, inputs, seen, returned, running, key

    return init, update
