"""How long steps and messages take: distributions in seconds, as a `graph.toml` writes them.

What falls below zero counts as zero, so that a normal distribution fitted to small delays stays one (van der Heijden et
al., "REX", section 3.3). A number stands for a delay that is always the same.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

__all__ = ["Constant", "Delay", "DelayLike", "Mixture", "Normal", "Trainable", "delay_of"]


@dataclass(frozen=True)
class Constant:
    """Always the same."""

    seconds: float
    """s."""

    def json(self) -> dict[str, Any]:
        """As a `graph.toml` has it."""
        return {"distribution": "constant", "seconds": float(self.seconds)}


@dataclass(frozen=True)
class Normal:
    """A normal distribution, clipped at zero."""

    mean: float
    """Mean before clipping, s."""
    std: float
    """Standard deviation before clipping, s."""

    def json(self) -> dict[str, Any]:
        """As a `graph.toml` has it."""
        return {"distribution": "normal", "mean": float(self.mean), "std": float(self.std)}


@dataclass(frozen=True)
class Mixture:
    """A mixture of normal distributions, clipped at zero; one entry a component."""

    weights: Sequence[float]
    """Shares of the components; only their proportions count."""
    means: Sequence[float]
    """Means before clipping, s."""
    stds: Sequence[float]
    """Standard deviations before clipping, s."""

    def json(self) -> dict[str, Any]:
        """As a `graph.toml` has it."""
        lists = {"weights": self.weights, "means": self.means, "stds": self.stds}
        return {"distribution": "mixture"} | {name: list(map(float, values)) for name, values in lists.items()}


@dataclass(frozen=True)
class Trainable:
    """A connection's delay that is chosen when the compiled graph runs, between two bounds; `params["delays"]` holds
    where, from 0 to 1. Runs and drawn schedules take the mean of both."""

    min: float
    """The shortest, s."""
    max: float
    """The longest, s."""
    interpolation: Literal["hold", "linear"] = "hold"
    """Whether a step sees the newest message that has arrived, or one interpolated between two."""

    def json(self) -> dict[str, Any]:
        """As a `graph.toml` has it."""
        return Constant(0.5 * (self.min + self.max)).json()


Delay: TypeAlias = Constant | Normal | Mixture | Trainable
"""A distribution of durations."""

DelayLike: TypeAlias = Delay | Mapping[str, Any] | float
"""A distribution, one as a `graph.toml` has it (every distribution of Parallax can be said so), or seconds."""


def delay_of(delay: DelayLike, what: str) -> dict[str, Any]:
    """As a `graph.toml` has it; raises `TypeError` or `ValueError` naming `what`."""
    if isinstance(delay, Mapping):
        return dict(delay)
    if isinstance(delay, int | float):
        if not math.isfinite(delay) or delay < 0:
            raise ValueError(f"{what} is {delay} s; it has to be finite and at least 0")
        return Constant(delay).json()
    if isinstance(delay, Constant | Normal | Mixture | Trainable):
        return delay.json()
    raise TypeError(f"{what} is {delay!r}; give seconds, Constant, Normal, Mixture, or a distribution of a graph.toml")
