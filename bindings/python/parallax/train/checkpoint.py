"""Training's state in a file, and back to the same bits."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..types import Tree
from .missing import package

__all__ = ["CheckpointError", "read", "read_about", "write"]

FORMAT = "parallax-training-1"


class CheckpointError(ValueError):
    """A checkpoint that does not belong to this training."""


def write(path: Path, state: Tree, about: Mapping[str, Any]) -> None:
    """Writes `state` with what is known about it; the file that stands there is replaced when the new one is whole."""
    numpy = package("safetensors.numpy")
    tensors = {name: np.asarray(_plain(leaf)) for name, leaf in _named(state).items()}
    partial = path.with_name(path.name + ".part")
    numpy.save_file(tensors, partial, metadata={"format": FORMAT, "about": json.dumps(about)})
    partial.replace(path)


def read_about(path: Path) -> dict[str, Any]:
    """What is known about the state in a file."""
    try:
        with package("safetensors").safe_open(str(path), framework="numpy") as file:
            metadata = file.metadata() or {}
    except Exception as error:
        raise CheckpointError(f"{path} cannot be read as a checkpoint: {error}") from error
    if metadata.get("format") != FORMAT:
        raise CheckpointError(f"{path} is no checkpoint of a training")
    about: dict[str, Any] = json.loads(metadata["about"])
    return about


def read(path: Path, like: Tree) -> Tree:
    """The state in a file; `like` has its shape."""
    tensors = package("safetensors.numpy").load_file(str(path))
    wanted = _named(like)
    for name, leaf in wanted.items():
        shape = jax.eval_shape(_plain, leaf)
        if name not in tensors:
            raise CheckpointError(f"{path} has no `{name}`; it is of another training")
        found = tensors[name]
        if found.shape != shape.shape or found.dtype != shape.dtype:
            raise CheckpointError(
                f"{path}: `{name}` is {found.dtype}{list(found.shape)}, and this training's is "
                f"{shape.dtype}{list(shape.shape)}"
            )
    leaves = []
    for name, leaf in wanted.items():
        value = jnp.asarray(tensors[name])
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            value = jax.random.wrap_key_data(value)
            if value.dtype != leaf.dtype:
                raise CheckpointError(f"{path}: `{name}` is a random key of another kind than JAX is set to")
        leaves.append(value)
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def _named(state: Tree) -> dict[str, Any]:
    leaves, _ = jax.tree_util.tree_flatten_with_path(state)
    return {jax.tree_util.keystr(path): leaf for path, leaf in leaves}


def _plain(leaf: Any) -> Any:
    """A random key as its words."""
    return jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf
