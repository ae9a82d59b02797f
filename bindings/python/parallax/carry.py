"""What a node in another process begins with, when it is not what its class says: changed parameters, a changed state.

The process that starts a run writes the leaves into a file and names it in the environment of the node's process.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .stepping import Began

__all__ = ["VARIABLE", "carried", "write"]

VARIABLE = "PARALLAX_START"
"""The environment variable that names the file."""


def write(path: Path, start: Began) -> None:
    """Writes the leaves of the parameters, the state and the first output."""
    leaves: dict[str, Any] = {f"leaf_{place}": _plain(leaf) for place, leaf in enumerate(_leaves(start))}
    np.savez(path, **leaves)


def carried(name: str, own: Began) -> Began:
    """What the file says that the environment names; `own`, what the class says, if there is none."""
    path = os.environ.get(VARIABLE)
    if path is None:
        return own
    before = _leaves(own)
    with np.load(path) as file:
        leaves = [file[f"leaf_{place}"] for place in range(len(file.files))]
    if len(leaves) != len(before):
        raise ValueError(f"node `{name}` was given {len(leaves)} leaves to begin with, and its class has {len(before)}")
    made = [_as(leaf, like) for leaf, like in zip(leaves, before, strict=True)]
    params, state, output = jax.tree.unflatten(jax.tree.structure((own.params, own.state, own.output)), made)
    return Began(params, state, output)


def _leaves(start: Began) -> list[Any]:
    return jax.tree.leaves((start.params, start.state, start.output))


def _plain(leaf: Any) -> np.ndarray:
    if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        leaf = jax.random.key_data(leaf)
    return np.asarray(leaf)


def _as(leaf: np.ndarray, like: Any) -> Any:
    if isinstance(like, jax.Array) and jnp.issubdtype(like.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(jnp.asarray(leaf), impl=jax.random.key_impl(like))
    return jnp.asarray(leaf) if isinstance(like, jax.Array) else leaf.item() if np.ndim(leaf) == 0 else leaf
