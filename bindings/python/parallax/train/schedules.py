"""Schedules whose delays differ from episode to episode beyond what each delay's own distribution says."""

from __future__ import annotations

import copy
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax

from ..graph import Episodes, Graph
from .randomisation import Distribution

__all__ = ["varied_episodes"]


def varied_episodes(
    graph: Graph,
    seconds: float,
    *,
    extra: Mapping[str, Distribution] | None = None,
    identified: str | os.PathLike[str] | None = None,
    widen: float = 1.0,
    variants: int = 16,
    each: int = 4,
    seed: int = 0,
) -> Episodes:
    """`variants` times `each` episodes of `seconds` seconds.

    In each variant a number (s) is drawn for every place in `extra` and added to its delay: a connection by its name
    (one of `graph.connections`), or a node's computation by the node's. Drawn from an interval of an identified or
    fitted delay, it makes policies that do not rely on the delay being exactly what was estimated. What an own
    distribution scatters within an episode is not changed; a delay that would be negative is zero.

    `identified` is the folder of a `parallax identify`: in each variant the graph's hidden delays are drawn from its
    estimates, mean and spread, with `widen` times their standard deviations; a delay that was found to scatter is
    another one for every message, in two humps where two were found. Of one that the data do not determine, the
    estimate is taken.
    """
    spec = graph.spec
    hidden, humps = ({}, {}) if identified is None else _hidden(Path(identified), graph)
    result: Episodes | None = None
    for variant in range(variants):
        key = jax.random.fold_in(jax.random.key(seed), variant)
        changed = copy.deepcopy(spec)
        for index, (place, moments) in enumerate(hidden.items()):
            drawn = jax.random.normal(jax.random.fold_in(key, 1000 + index), (2,), float)
            values = [max(0.0, value + widen * std * float(z)) for (value, std), z in zip(moments, drawn, strict=False)]
            found = [value for value, _ in moments]
            changed["connection"][graph.connections.index(place)]["delay"] = _drawn(values, found, humps.get(place, []))
        for index, (place, distribution) in enumerate((extra or {}).items()):
            shift = float(distribution.sample(jax.random.fold_in(key, index)))
            _shift(changed, graph, place, shift)
        episodes = Graph(changed).generate(seconds, each, seed + variant)
        result = episodes if result is None else result + episodes
    if result is None:
        raise ValueError("no variants were asked for")
    return result


_Moments = dict[str, list[tuple[float, float]]]
_Humps = dict[str, list[dict[str, Any]]]


def _hidden(folder: Path, graph: Graph) -> tuple[_Moments, _Humps]:
    """For each hidden delay by its connection: value and standard deviation (s) of its mean, and of its spread where it
    scatters; and the humps of those that have two."""
    file = folder / "identified.json"
    content = json.loads(file.read_text(encoding="utf-8"))

    def connection(places: list[dict[str, Any]]) -> str | None:
        for place in places:
            if "of" not in place:
                continue
            name = f"{place['from']}->{place['to']}"
            for each in (name, f"{name}.{place['port']}"):
                if each in graph.connections:
                    return each
        return None

    result: _Moments = {}
    # A spread comes after its mean.
    estimates = content["estimates"]
    for estimate in sorted(estimates, key=lambda estimate: any(p.get("of") == "spread" for p in estimate["places"])):
        if name := connection(estimate["places"]):
            result.setdefault(name, []).append((float(estimate["value"]), float(estimate["std"] or 0.0)))
    if not result:
        known = ", ".join(graph.connections)
        raise ValueError(f"{file} has no hidden delay of a connection of this graph ({known})")
    humps = {connection(each["places"]): each["humps"] for each in content.get("humps", [])}
    return result, {name: each for name, each in humps.items() if name is not None}


def _drawn(values: list[float], found: list[float], humps: list[dict[str, Any]]) -> dict[str, Any]:
    """The distribution of a delay whose mean and spread (s) were drawn around those that were found. Humps keep their
    form: they are moved with the mean, and stretched with the spread."""
    if len(values) < 2:
        return {"distribution": "constant", "seconds": values[0]}
    if not humps or found[1] == 0.0:
        return {"distribution": "normal", "mean": values[0], "std": values[1]}
    stretch = values[1] / found[1]
    return {
        "distribution": "mixture",
        "weights": [hump["share"]["value"] for hump in humps],
        "means": [values[0] + stretch * (hump["mean"]["value"] - found[0]) for hump in humps],
        "stds": [stretch * hump["spread"]["value"] for hump in humps],
    }


def _shift(spec: dict[str, Any], graph: Graph, place: str, seconds: float) -> None:
    if place in graph.connections:
        entry, key = spec["connection"][graph.connections.index(place)], "delay"
    elif place in graph.nodes:
        entry, key = next(node for node in spec["node"] if node["name"] == place), "computation"
    else:
        known = ", ".join([*graph.connections, *graph.nodes])
        raise ValueError(f"`{place}` has no delay: it is neither a connection nor a node of the graph ({known})")
    entry[key] = _shifted(entry.get(key), seconds, place)


def _shifted(delay: Mapping[str, Any] | None, seconds: float, place: str) -> dict[str, Any]:
    """A delay, as a graph.toml has it, that is longer by so much."""
    if delay is None:
        return {"distribution": "constant", "seconds": max(0.0, seconds)}
    result = copy.deepcopy(dict(delay))
    match result["distribution"]:
        case "constant":
            result["seconds"] = max(0.0, result["seconds"] + seconds)
        case "normal":
            result["mean"] += seconds
        case "mixture":
            result["means"] = [mean + seconds for mean in result["means"]]
        case "uniform":
            result["low"], result["high"] = max(0.0, result["low"] + seconds), max(0.0, result["high"] + seconds)
        case "empirical":
            result["samples"] = [max(0.0, sample + seconds) for sample in result["samples"]]
        case "correlated":
            result["of"] = _shifted(result["of"], seconds, place)
        case other:
            raise ValueError(
                f"the delay of `{place}` is `{other}`, which cannot be made longer by a number of seconds; give it as "
                f"constant, normal, mixture, uniform, empirical, or correlated of these"
            )
    return result
