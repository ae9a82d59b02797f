"""Draws the measurements of `cargo bench --bench throughput`: plot.py MEASUREMENTS.jsonl FIGURE.svg"""

import json
import re
import sys
from pathlib import Path

import matplotlib

matplotlib.use("svg")
import matplotlib.pyplot as plt

INK, GRID = "#333333", "#dddddd"
# One colour for each peer, in every panel; a dashed line is double precision.
COLOURS = {
    "Parallax, native": "#0b6e4f",
    "Parallax, jax": "#1f77b4",
    "limit": "#333333",
    "lax.scan": "#8c6bb1",
    "rex-lib, jax 0.7": "#d95f02",
    "rex-lib, jax 0.4": "#e6ab02",
    "Drake": "#a6761d",
    "MuJoCo": "#999999",
}


def peer(line):
    """The key of its colour."""
    name = line["peer"]
    if name.startswith("rex-lib"):
        return "rex-lib, jax " + re.search(r"jax (0\.\d)", name).group(1)
    return next(key for key in COLOURS if name.startswith(key))


def read(path):
    lines = [json.loads(text) for text in Path(path).read_text().splitlines()]
    return [line for line in lines if line.get("steps_per_second")]


def panel(axes, title, x, y):
    axes.set_title(title, loc="left", fontsize=10, color=INK)
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.set_xscale("log", base=2)
    axes.set_yscale("log")
    axes.grid(color=GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")


def throughput(axes, lines, system):
    """Steps a second over environments; the best way of each peer."""
    panel(
        axes, f"{system}: graph with delays, and bare (peers without delays)", "environments", "million steps a second"
    )
    best = {}
    for line in lines:
        case = line["case"]
        if case not in (f"{system}, graph with delays", f"{system}, bare"):
            continue
        if peer(line) == "Parallax, native" and case.endswith("bare"):
            continue
        series = best.setdefault((peer(line), line["dtype"]), {})
        rate = line["steps_per_second"][-1] / 1e6
        series[line["envs"]] = max(rate, series.get(line["envs"], 0.0))
    for (name, dtype), series in best.items():
        points = sorted(series.items())
        style = "--" if dtype == "f64" else "-"
        axes.plot(
            *zip(*points, strict=True), style, marker="o", markersize=4, color=COLOURS[name], label=f"{name}, {dtype}"
        )
    axes.legend(fontsize=7, frameon=False, ncols=2)


def growth(axes, lines, what, x, key):
    """Seconds of a rollout as it grows, beside a line through the largest that is proportional."""
    panel(axes, f"pendulum, native: growth with {what}", x, "seconds of a rollout")
    found = [line for line in lines if line["case"].startswith(f"pendulum, growth with {what}")]
    points = sorted((key(line), seconds(line)) for line in found)
    if not points:
        return
    axes.plot(*zip(*points, strict=True), "o", color=COLOURS["Parallax, native"], markersize=5, label="measured")
    last = points[-1]
    axes.plot(
        [point[0] for point in points],
        [last[1] * point[0] / last[0] for point in points],
        color=GRID,
        linewidth=1.5,
        zorder=0,
        label="proportional",
    )
    axes.legend(fontsize=7, frameon=False)


def length(line):
    """Seconds of the episode."""
    found = re.search(r": (\d+) s", line["case"])
    return int(found.group(1)) if found else 20


def seconds(line):
    return line["envs"] * length(line) * 50 / line["steps_per_second"][-1]


def main():
    lines = read(sys.argv[1])
    figure, axes = plt.subplots(2, 2, figsize=(11, 8), layout="constrained")
    throughput(axes[0, 0], lines, "pendulum")
    throughput(axes[0, 1], lines, "quadrotor")
    growth(axes[1, 0], lines, "environments", "environments (20 s each)", lambda line: line["envs"])
    growth(axes[1, 1], lines, "steps", "seconds of the episode (128 environments)", length)
    figure.savefig(sys.argv[2], metadata={"Date": None})


main()
