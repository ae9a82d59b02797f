"""What a rollout without JAX takes and gives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from .types import Floats, Tree

__all__ = ["NativeRollout", "by_leaf", "spread"]


@dataclass(frozen=True)
class NativeRollout:
    """What a rollout without JAX gives, as trees of numpy arrays."""

    outputs: dict[str, Tree]
    """The outputs of the nodes kept, leaves `[environment, step]`; not a number where a step did not run."""
    states: dict[str, Tree]
    """Every node's state after the last step, leaves `[environment]`."""


def by_leaf(trees: Mapping[str, Tree], count: int) -> list[tuple[str, str, Floats]]:
    """Node, leaf and one value for each environment."""
    result = []
    for node, tree in trees.items():
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
            result.append((node, ".".join(str(part.key) for part in path), spread(leaf, count)))
    return result


def spread(leaf: Any, count: int) -> Floats:
    """One value for each environment, from one for all or one for each."""
    return np.ascontiguousarray(np.broadcast_to(np.asarray(leaf, np.float64), (count,)))
