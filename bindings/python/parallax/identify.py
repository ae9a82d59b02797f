"""Identification from Python: what `parallax identify` does, and any strategy of evosax on a compiled graph."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .commands import Parallax
from .graph import Graph
from .missing import package
from .types import Array, Floats, Scalar

__all__ = ["Estimate", "Evolution", "Identified", "evolve", "identify"]

PathLike = str | os.PathLike[str]


@dataclass(frozen=True)
class Estimate:
    """A number that was found."""

    name: str
    """What it is called."""
    value: float
    """In `unit`."""
    std: float | None
    """Its standard deviation; none where the data do not determine it."""
    interval: tuple[float, float]
    """95 %."""
    unit: str
    """A label."""


@dataclass(frozen=True)
class Identified:
    """What an identification came to; everything that it wrote is in `folder`."""

    folder: Path
    """`Randomisation.identified` takes it, and `varied_episodes`."""
    content: dict[str, Any]
    """`identified.json`: also remarks, outputs with their errors, and what is known only together."""

    @property
    def estimates(self) -> dict[str, Estimate]:
        """All of them by name, in the order of `covariance`."""
        return {
            each["name"]: Estimate(
                each["name"], each["value"], each["std"], (each["interval"][0], each["interval"][1]), each["unit"]
            )
            for each in self.content["estimates"]
        }

    def __getitem__(self, name: str) -> float:
        """The value that was found under a name."""
        estimates = self.estimates
        if name not in estimates:
            raise KeyError(f"nothing was identified as `{name}`; there is {', '.join(estimates)}")
        return estimates[name].value

    @property
    def covariance(self) -> Floats:
        """`[estimate, estimate]`."""
        count = len(self.content["estimates"])
        return np.asarray(self.content["covariance"], float).reshape(count, count)

    @property
    def graph(self) -> Graph:
        """The graph with the simulators, what was found in it."""
        return Graph(str(self.folder / "identified.toml"))


def identify(
    recordings: PathLike | Sequence[PathLike],
    specification: PathLike,
    out: PathLike = "out/identify",
    *,
    resume: bool = False,
    parallax: str | None = None,
) -> Identified:
    """Finds parameters, first states and hidden delays from recordings of one graph.

    It is `parallax identify`, on all cores, in a process of its own. `specification` is an `identify.toml`, or its
    text. Ctrl-C ends the search with the best so far; `resume` takes it up in the same folder. `parallax` is the
    program; without it `PARALLAX_BIN`, or the one on the path.

    Raises `CommandError` with what the program said.
    """
    folder = Path(out)
    text = os.fspath(specification)
    spec = Path(text)
    if "\n" in text:
        folder.mkdir(parents=True, exist_ok=True)
        spec = folder / "identify.toml"
        spec.write_text(text, encoding="utf-8")
    paths = [recordings] if isinstance(recordings, str | os.PathLike) else list(recordings)
    Parallax(parallax)("identify", *paths, "--spec", spec, "--out", folder, *(["--resume"] if resume else []))
    return Identified(folder, json.loads((folder / "identified.json").read_text(encoding="utf-8")))


@dataclass(frozen=True)
class Evolution:
    """What an evolution came to."""

    best: dict[str, float]
    """The best point that was seen."""
    loss: float
    """Its loss."""
    losses: Floats
    """The best so far after each generation, `[generation]`."""


def evolve(
    loss: Callable[[Mapping[str, Array]], Scalar],
    bounds: Mapping[str, tuple[float, float]],
    *,
    strategy: str | Callable[[int, Array], Any] = "CMA_ES",
    population: int = 64,
    generations: int = 50,
    key: Array | None = None,
    std: float = 0.2,
) -> Evolution:
    """The least of a function of JAX within bounds, such as how far a rollout of a compiled graph is from a recording.

    `strategy` is the name of one of evosax's algorithms (0.3), or what makes one for a population size and a point.
    The points of a generation are evaluated at once, and all generations are one compiled function. Each number is
    searched within its bounds, on a logarithmic scale where they are positive and far apart; points outside are
    reflected. `std` is the spread of the first generation, as a share of the bounds. A loss that is no number is the
    worst of all. Needs the package `evosax`.
    """
    names = list(bounds)
    if not names:
        raise ValueError("nothing is unknown: `bounds` is empty")
    for name, (low, high) in bounds.items():
        if not low < high:
            raise ValueError(f"`{name}` is to lie between {low} and {high}; the first must be less")
    first_of, last_of = (jnp.asarray([bounds[name][side] for name in names], float) for side in (0, 1))
    logarithmic = (first_of > 0) & (last_of > 2 * first_of)
    start, end = (jnp.where(logarithmic, jnp.log(jnp.where(logarithmic, x, 1.0)), x) for x in (first_of, last_of))

    def point(unit: Array) -> dict[str, Array]:
        # A triangle wave: what leaves the box comes back into it.
        within = 1 - jnp.abs(jnp.mod(unit, 2.0) - 1)
        value = start + within * (end - start)
        value = jnp.where(logarithmic, jnp.exp(jnp.where(logarithmic, value, 0.0)), value)
        return {name: value[place] for place, name in enumerate(names)}

    def judged(unit: Array) -> Array:
        found = jnp.asarray(loss(point(unit)), float)
        return jnp.where(jnp.isfinite(found), found, float(np.finfo(found.dtype).max))

    every = jax.vmap(judged)
    middle = jnp.full(len(names), 0.5)
    algorithm = _strategy(strategy)(population, middle)
    params = algorithm.default_params
    if hasattr(params, "std_init"):
        params = params.replace(std_init=std)
    first, begin, rest = jax.random.split(jax.random.key(0) if key is None else key, 3)
    if hasattr(algorithm, "get_mean"):
        state = algorithm.init(begin, middle, params)
    else:
        # One that keeps a population has to be given the first.
        drawn = jax.random.uniform(first, (population, len(names)), float)
        state = algorithm.init(begin, drawn, jax.jit(every)(drawn), params)

    def generation(carry: tuple[Any, Array, Array], key: Array) -> tuple[tuple[Any, Array, Array], Array]:
        state, best, least = carry
        ask, tell = jax.random.split(key)
        asked, state = algorithm.ask(ask, state, params)
        fitness = every(asked)
        state, _ = algorithm.tell(tell, asked, fitness, state, params)
        place = jnp.argmin(fitness)
        better = fitness[place] < least
        best, least = jnp.where(better, asked[place], best), jnp.where(better, fitness[place], least)
        return (state, best, least), least

    @jax.jit
    def run(state: Any, keys: Array) -> tuple[tuple[Any, Array, Array], Array]:
        return lax.scan(generation, (state, middle, judged(middle)), keys)

    (_, best, least), losses = run(state, jax.random.split(rest, generations))
    return Evolution(
        {name: float(value) for name, value in point(best).items()}, float(least), np.asarray(losses, float)
    )


def _strategy(strategy: str | Callable[[int, Array], Any]) -> Callable[[int, Array], Any]:
    if not isinstance(strategy, str):
        return strategy
    algorithms = package("evosax.algorithms", "evolve")
    found = getattr(algorithms, strategy, None)
    if found is None or not isinstance(found, type):
        known = ", ".join(name for name in dir(algorithms) if isinstance(getattr(algorithms, name), type))
        raise ValueError(f"evosax has no algorithm `{strategy}`; it has {known}")
    return lambda population, point: found(population_size=population, solution=point)
