"""Two multilayer perceptrons: what to do, and how much that is worth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise

import jax
import jax.numpy as jnp

from ..types import Array, Tree

__all__ = ["ACTIVATIONS", "evaluate", "initial", "log_density"]

ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "tanh": jnp.tanh,
    "relu": jax.nn.relu,
    "leaky_relu": jax.nn.leaky_relu,
    "elu": jax.nn.elu,
    "swish": jax.nn.swish,
    "sigmoid": jax.nn.sigmoid,
    "softplus": jax.nn.softplus,
    "gelu": partial(jax.nn.gelu, approximate=True),
}
"""What may stand between two layers: those that the policy's node in real time knows, by the same names."""


def initial(key: Array, inputs: int, hidden: Sequence[int], actions: int, log_std: float) -> Tree:
    """Orthogonal weights, scaled so that first actions are near zero (S. Huang and others, *The 37 implementation
    details of proximal policy optimization*, 2022, details 2 and 13)."""
    of_actor, of_critic = jax.random.split(key)
    return {
        "actor": _layers(of_actor, [inputs, *hidden, actions], 0.01),
        "critic": _layers(of_critic, [inputs, *hidden, 1], 1.0),
        "log_std": jnp.full((actions,), log_std, float),
    }


def _layers(key: Array, widths: Sequence[int], last: float) -> list[dict[str, Array]]:
    keys = jax.random.split(key, len(widths) - 1)
    layers = []
    for place, (inputs, outputs) in enumerate(pairwise(widths)):
        scale = last if place == len(widths) - 2 else 2.0**0.5
        weight = _orthogonal(keys[place], scale, inputs, outputs)
        layers.append({"weight": weight, "bias": jnp.zeros(outputs, float)})
    return layers


def _orthogonal(key: Array, scale: float, inputs: int, outputs: int) -> Array:
    def weight(key: Array) -> Array:
        return jax.nn.initializers.orthogonal(scale)(key, (inputs, outputs), float)

    # One matrix after the other, however many seeds there are. A batch of decompositions asks for XLA's threads and
    # waits for them while it holds one itself: with as many layers as threads they wait for each other, for ever.
    drawn: Array = jax.custom_batching.sequential_vmap(weight)(key)  # type: ignore[no-untyped-call]
    return drawn


def evaluate(layers: Sequence[dict[str, Array]], x: Array, activation: str) -> Array:
    """The last layer's outputs `[..., output]` for inputs `[..., input]`."""
    between = ACTIVATIONS[activation]
    for place, layer in enumerate(layers):
        x = x @ layer["weight"] + layer["bias"]
        if place < len(layers) - 1:
            x = between(x)
    return x


def log_density(x: Array, mean: Array, log_std: Array) -> Array:
    """Logarithm of the density of independent normal numbers, summed over the last axis."""
    z = (x - mean) * jnp.exp(-log_std)
    return jnp.sum(-0.5 * z**2 - log_std - 0.5 * jnp.log(2 * jnp.pi), axis=-1)
