"""What differs from environment to environment: parameters and hidden delays, from ranges or from an identification."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from ..types import Array, Floats, Tree

__all__ = ["Distribution", "Joint", "LogUniform", "Normal", "Randomisation", "Uniform", "with_leaf"]


class Distribution(Protocol):
    """A number that is drawn for every episode of every environment."""

    def sample(self, key: Array) -> Array:
        """One number."""
        ...


@dataclass(frozen=True)
class Uniform:
    """Between two numbers."""

    low: float
    high: float

    def __post_init__(self) -> None:
        _ordered(self.low, self.high)

    def sample(self, key: Array) -> Array:
        """One number."""
        return jax.random.uniform(key, (), float, self.low, self.high)


@dataclass(frozen=True)
class LogUniform:
    """Between two positive numbers, uniform in the logarithm."""

    low: float
    high: float

    def __post_init__(self) -> None:
        _ordered(self.low, self.high)
        if self.low <= 0:
            raise ValueError(f"from {self.low}: a logarithm needs a positive number")

    def sample(self, key: Array) -> Array:
        """One number."""
        return jnp.exp(jax.random.uniform(key, (), float, float(np.log(self.low)), float(np.log(self.high))))


@dataclass(frozen=True)
class Normal:
    """Around a mean, held within bounds."""

    mean: float
    std: float
    low: float = -np.inf
    high: float = np.inf

    def __post_init__(self) -> None:
        _ordered(self.low, self.high)
        if self.std < 0:
            raise ValueError(f"a standard deviation of {self.std}; it must not be negative")

    def sample(self, key: Array) -> Array:
        """One number."""
        return jnp.clip(self.mean + self.std * jax.random.normal(key, (), float), self.low, self.high)


@dataclass(frozen=True)
class Joint:
    """Numbers that belong together: `mean + factor @ standard normal`, each held within its bounds."""

    places: tuple[tuple[str, ...], ...]
    """Where each number goes, as in `Randomisation`; several places are tied."""
    mean: Floats
    """`[number]`"""
    factor: Floats
    """`[number, direction]`: a square root of the covariance."""
    low: Floats
    """`[number]`"""
    high: Floats
    """`[number]`"""

    def sample(self, key: Array) -> Array:
        """All numbers, `[number]`."""
        free = jax.random.normal(key, (self.factor.shape[1],), float)
        return jnp.clip(jnp.asarray(self.mean, float) + jnp.asarray(self.factor, float) @ free, self.low, self.high)


class Randomisation:
    """What is drawn for every episode.

    `ranges` maps places to distributions: `"world.pendulum.mass"` is a leaf of a node's parameters, and
    `"delays.world->encoder"` a trainable delay of the compiled graph, in seconds. `joint` are groups of numbers that
    are drawn together.
    """

    def __init__(self, ranges: Mapping[str, Distribution] | None = None, joint: Sequence[Joint] = ()) -> None:
        self.ranges = dict(ranges or {})
        self.joint = tuple(joint)
        seen: set[str] = set()
        for place in self.places:
            if place in seen:
                raise ValueError(f"`{place}` is drawn twice")
            seen.add(place)

    @property
    def places(self) -> list[str]:
        """Every place that is drawn."""
        return [*self.ranges, *(place for group in self.joint for tied in group.places for place in tied)]

    def sample(self, key: Array) -> dict[str, Array]:
        """A number for every place."""
        keys = jax.random.split(key, max(1, len(self.ranges) + len(self.joint)))
        drawn = {place: range_.sample(keys[i]) for i, (place, range_) in enumerate(self.ranges.items())}
        for group, own in zip(self.joint, keys[len(self.ranges) :], strict=False):
            values = group.sample(own)
            drawn |= {place: values[i] for i, tied in enumerate(group.places) for place in tied}
        return drawn

    @classmethod
    def identified(
        cls,
        folder: str | os.PathLike[str],
        *,
        widen: float = 1.0,
        nodes: Iterable[str] | None = None,
    ) -> Randomisation:
        """What `parallax identify` was left unsure of.

        `folder` is where it wrote `identified.json`, which names the places. Parameters are drawn together from a
        normal distribution with the estimates' covariance, `widen` times as wide, within the search's bounds; first
        states and delays are not drawn. A direction in which the data do not narrow the bounds is left alone: the
        predictions do not depend on it, and drawn number by number it would pull what belongs together apart. With
        `nodes`, only at these; what is tied elsewhere stays.
        """
        file = Path(folder) / "identified.json"
        found = json.loads(file.read_text(encoding="utf-8"))
        estimates = found["estimates"]
        if any("places" not in estimate for estimate in estimates):
            raise ValueError(f"{file} does not say where its estimates stand; run `parallax identify` again")
        count = len(estimates)
        wanted = None if nodes is None else set(nodes)
        places = [_places(estimate, wanted) for estimate in estimates]
        # What is solved for has no bounds, and goes with what was searched.
        chosen = [i for i, estimate in enumerate(estimates) if places[i] and estimate["bounds"] is not None]
        if not chosen:
            where = "" if wanted is None else f" of {', '.join(sorted(wanted))}"
            raise ValueError(f"{file} has no estimate of a parameter{where}")
        covariance = np.asarray(found["covariance"], float).reshape(count, count)[np.ix_(chosen, chosen)]
        bounds = np.array([_bounds(estimates[i]) for i in chosen])
        mean = np.array([estimates[i]["value"] for i in chosen])
        factor = _determined(covariance, bounds[:, 1] - bounds[:, 0]) * widen
        tied = tuple(tuple(places[i]) for i in chosen)
        return cls(joint=[Joint(tied, mean, factor, bounds[:, 0], bounds[:, 1])])


def with_leaf(tree: Tree, path: Sequence[str], value: Any, what: str) -> Tree:
    """`tree` with another value at `path`; the rest is shared."""
    if not path:
        return value
    first, *rest = path
    if not isinstance(tree, dict) or first not in tree:
        inside = ", ".join(tree) if isinstance(tree, dict) else "nothing"
        raise ValueError(f"{what}: there is no `{first}`; there is {inside}")
    return {**tree, first: with_leaf(tree[first], rest, value, what)}


def _ordered(low: float, high: float) -> None:
    if not low <= high:
        raise ValueError(f"from {low} to {high}; the first must not be greater")


def _places(estimate: Mapping[str, Any], nodes: set[str] | None) -> list[str]:
    """The parameters that an estimate sets, `NODE.LEAF`."""
    of_nodes = [place for place in estimate["places"] if "parameter" in place]
    return [f"{p['node']}.{p['parameter']}" for p in of_nodes if nodes is None or p["node"] in nodes]


def _bounds(estimate: Mapping[str, Any]) -> tuple[float, float]:
    low, high = estimate["bounds"] or (-np.inf, np.inf)
    return float(low), float(high)


def _determined(covariance: Floats, width: Floats) -> Floats:
    """A square root of the covariance without the directions in which it is as wide as the bounds."""
    # A uniform distribution over the bounds has this standard deviation.
    scale = np.where(np.isfinite(width), width, 1.0) / np.sqrt(12.0)
    scaled = covariance / np.outer(scale, scale)
    values, vectors = np.linalg.eigh(0.5 * (scaled + scaled.T))
    kept = (values > 0) & (values < 1.0)
    return (scale[:, None] * vectors[:, kept]) * np.sqrt(values[kept])
