"""Training curves as a picture."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .missing import package

__all__ = ["plot_curves", "read_log"]

HIDDEN = ("steps", "seconds", "updating", "train", "return_std")
"""What is no curve of a log."""

COLOURS = [f"C{number}" for number in range(10)] * 10
"""Those of matplotlib, one for each training."""


def read_log(path: str | os.PathLike[str]) -> list[dict[str, Any]]:
    """The lines of a `log.jsonl`, or of that in a training's folder."""
    place = Path(path)
    if place.is_dir():
        place = place / "log.jsonl"
    with place.open(encoding="utf-8") as file:
        return [json.loads(line) for line in file if line.strip()]


def plot_curves(
    trainings: Mapping[str, Sequence[Mapping[str, Any]] | str | os.PathLike[str]], path: str | os.PathLike[str]
) -> Path:
    """Draws the curves of trainings by their names into an SVG or PNG file: the mean over seeds, and each seed thinly.

    A training is the rows of its log, or its folder.
    """
    package("matplotlib")
    figure_class = package("matplotlib.figure").Figure
    logs = {
        name: read_log(rows) if isinstance(rows, str | os.PathLike) else list(rows) for name, rows in trainings.items()
    }
    names = list(dict.fromkeys(key for rows in logs.values() for row in rows for key in row if key not in HIDDEN))
    figure = figure_class(figsize=(4.2 * len(names), 3.2), layout="constrained")
    for axes, name in zip(np.atleast_1d(figure.subplots(1, len(names))), names, strict=True):
        for colour, (label, rows) in zip(COLOURS, logs.items(), strict=False):
            steps = np.array([row["steps"] for row in rows if name in row])
            values = np.array([row[name] for row in rows if name in row])
            if not len(steps):
                continue
            if values.shape[1] > 1:
                axes.plot(steps, values, color=colour, linewidth=0.6, alpha=0.4)
            axes.plot(steps, values.mean(axis=1), color=colour, label=label)
        axes.set_xlabel("steps")
        axes.set_ylabel(name)
        axes.grid(alpha=0.3)
        if any(logs):
            axes.legend()
    place = Path(path)
    place.parent.mkdir(parents=True, exist_ok=True)
    partial = place.with_name(place.stem + ".part" + place.suffix)
    figure.savefig(partial)
    partial.replace(place)
    return place
