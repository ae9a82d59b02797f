"""What a compiled graph carries from step to step, and what its supervisor sees of it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax

from .types import Array, Tree

__all__ = ["GraphState", "Observation"]


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["key", "episode", "step", "params", "state", "history"],
    meta_fields=[],
)
@dataclass(frozen=True)
class GraphState:
    """What a compiled graph carries from step to step, for one environment."""

    key: Array
    """The key from which every step's random numbers follow."""
    episode: Array
    """Which episode's schedule it runs along, int32."""
    step: Array
    """How many steps the supervisor has made, int32."""
    params: dict[str, Tree]
    """Every node's parameters; under `delays`, the place of each trainable delay between its bounds, 0 to 1."""
    state: dict[str, Tree]
    """Every node's state."""
    history: dict[str, Any]
    """Every node's last outputs: a tuple of them, or, for long histories, one tree with a leading axis."""


@partial(jax.tree_util.register_dataclass, data_fields=["seq", "due", "start", "inputs"], meta_fields=[])
@dataclass(frozen=True)
class Observation:
    """What the supervisor's step sees. Times are seconds since the run's start."""

    seq: Array
    """The step's number, from 0."""
    due: Array
    """When it was due, s."""
    start: Array
    """When it starts, s."""
    inputs: dict[str, Tree]
    """For each port `seq`, `sent` and `received`, each `[window]`, and `message` with leaves `[window, ...]`, oldest
    first."""
