"""The page of a task."""

from __future__ import annotations

import html
import io
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..train import plot_curves
from ..train.missing import package
from ..types import Floats

if TYPE_CHECKING:
    from .pendulum import Result

__all__ = ["write_report"]

STYLE = """body{font:15px/1.5 system-ui,sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem;color:#222}
table{border-collapse:collapse;margin:1rem 0}td,th{padding:.2rem .8rem;border-bottom:1px solid #ddd;text-align:left}
svg{max-width:100%;height:auto}p.note{color:#666}iframe{width:100%;height:44rem;border:1px solid #ddd}"""
SVG = re.compile(r"<svg\b.*?</svg>", re.DOTALL)
TRUTHS = {"J": "inertia", "K": "motor", "b": "viscous", "c": "coulomb", "actuator": "delay"}
"""What the machine calls what is identified."""


def write_report(
    out: Path,
    result: Result,
    delays: Mapping[str, Any],
    traces: Mapping[str, tuple[Floats, Floats]],
    trainings: Mapping[str, Path],
) -> None:
    """Writes `report.html`, which needs no other file."""
    curves = plot_curves(trainings, out / "curves.svg")
    parts = [
        "<h1>The pendulum's task</h1>",
        f"<p>A machine that nobody had measured (seed {result.seed}) was recorded, identified, and given policies that "
        "were trained on what had been found. What it was stands beside the estimates; it was asked for at last.</p>",
        "<h2>What was identified</h2>",
        _estimates(result),
        *(f"<p class=note>{html.escape(remark)}</p>" for remark in result.identified["remarks"]),
        "<h2>Open-loop reconstruction</h2>",
        _page(out / "identify" / "report.html"),
        "<h2>Delays</h2>",
        _page(out / "delays.html"),
        _missing(delays),
        "<h2>Training</h2>",
        "".join(SVG.findall(curves.read_text(encoding="utf-8"))),
        _trainings(result),
        "<h2>On the machine, in real time</h2>",
        "<p>Upright is within 10° and 0.5 rad/s. Each number is a run; the second counts from when it first stood.</p>",
        _variants(result),
        _traces(traces),
    ]
    text = f"<!doctype html><meta charset=utf-8><title>The pendulum's task</title><style>{STYLE}</style>"
    (out / "report.html").write_text(text + "\n".join(parts), encoding="utf-8")


def _page(path: Path) -> str:
    """A page within the page: both keep their styles."""
    return f'<iframe srcdoc="{html.escape(path.read_text(encoding="utf-8"))}"></iframe>'


def _table(head: list[str], rows: list[list[str]]) -> str:
    cells = "".join(f"<th>{html.escape(cell)}</th>" for cell in head)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><tr>{cells}</tr>{body}</table>"


def _estimates(result: Result) -> str:
    rows = []
    for estimate in result.identified["estimates"]:
        truth = result.truth.get(TRUTHS.get(estimate["name"], ""))
        low, high = estimate["interval"]
        known = estimate["std"] is not None
        rows.append(
            [
                estimate["name"],
                f"{estimate['value']:.4g} {estimate['unit']}",
                f"{low:.4g} to {high:.4g}" if known else "not determined",
                "" if truth is None else f"{truth:.4g}",
            ]
        )
    return _table(["", "estimate", "95 %", "the machine"], rows)


def _missing(delays: Mapping[str, Any]) -> str:
    named = [str(place) for place in delays.get("without_samples", [])]
    return f"<p class=note>Nothing was measured of {html.escape(', '.join(named))}.</p>" if named else ""


def _trainings(result: Result) -> str:
    rows = [
        [name, f"{told['seconds']:.0f} s", f"{told['steps_per_second']:,.0f}/s", f"{told['upright']:.0%}"]
        for name, told in result.training.items()
    ]
    return _table(["training", "time", "steps", "upright in simulation"], rows)


def _variants(result: Result) -> str:
    shares = [
        [
            name,
            told["about"],
            ", ".join(f"{share:.0%}" for share in told["upright"]),
            ", ".join(f"{share:.0%}" for share in told["held"]),
        ]
        for name, told in result.variants.items()
    ]
    return _table(["variant", "", "upright", "after it first stood"], shares)


def _traces(traces: Mapping[str, tuple[Floats, Floats]]) -> str:
    """The angle in the first run of each variant."""
    figure = package("matplotlib.figure").Figure(figsize=(8, 1.5 * len(traces)), layout="constrained")
    every = np.atleast_1d(figure.subplots(len(traces), 1, sharex=True))
    for axes, (name, (time, angle)) in zip(every, traces.items(), strict=True):
        # A line across the picture where the angle wraps would be no motion.
        jumps = np.abs(np.diff(angle, append=angle[-1])) > np.pi
        axes.plot(time, np.where(jumps, np.nan, np.degrees(angle)), linewidth=0.8)
        axes.set_ylim(-190, 190)
        axes.set_yticks([-180, 0, 180])
        axes.set_title(name, fontsize=9, loc="left")
        axes.grid(alpha=0.3)
    every[-1].set_xlabel("s")
    figure.supylabel("degrees from upright", fontsize=9)
    text = io.StringIO()
    figure.savefig(text, format="svg")
    return "".join(SVG.findall(text.getvalue()))
