"""Trees of JAX arrays, leaf by leaf: what a step leaves, what it stores, how much that is."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from .types import Array, Scalar, Tree

__all__ = ["alike", "arrays", "chosen", "repeated", "size_in_bytes", "stored"]


def alike(one: Tree, other: Tree) -> bool:
    """Whether two trees have the same structure."""
    first: object = jax.tree.structure(one)
    return bool(first == jax.tree.structure(other))


def chosen(run: Array | None, new: Scalar, old: Array) -> Array:
    """`new` where `run` holds (always, if it is None), as what `old` is."""
    if jnp.shape(new) != old.shape:
        raise TypeError(f"a leaf has shape {jnp.shape(new)} after the step and {old.shape} before")
    new = jnp.asarray(new, old.dtype)
    return new if run is None else jnp.where(run, new, old)


def stored(place: Scalar, run: Array | None, history: Array, new: Scalar) -> Array:
    """`history` with `new` at `place` where `run` holds (always, if it is None)."""
    old = lax.dynamic_index_in_dim(history, place, keepdims=False)
    return lax.dynamic_update_index_in_dim(history, chosen(run, new, old), place, 0)


def arrays(tree: Tree) -> Tree:
    """Every leaf as an array of the type that steps keep."""
    return jax.tree.map(_strong, tree)


def _strong(leaf: Any) -> Array:
    """Not weakly typed: a literal would change its type after the first step, and a scan refuses that."""
    leaf = jnp.asarray(leaf)
    return lax.convert_element_type(leaf, leaf.dtype)


def repeated(leaf: Array, count: int) -> Array:
    """The leaf `count` times, along a new first axis."""
    return jnp.broadcast_to(leaf, (count, *leaf.shape))


def size_in_bytes(leaf: Any) -> int:
    """How many bytes a leaf takes; a random key as its words."""
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        leaf = jax.eval_shape(jax.random.key_data, leaf)
    return leaf.size * leaf.dtype.itemsize
