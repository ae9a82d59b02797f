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

STYLE = """figure.drawn{background:#fff;padding:6px;break-inside:avoid}
figure.drawn svg{width:100%;height:auto;display:block}
.inner h2{font-size:14px}.inner>section{border:0;margin-top:14px;padding-top:0}.scroll th,.scroll td{text-align:left}
@media (max-width:760px){.scroll th,.scroll td{white-space:normal}}"""
"""What this page has beside the style of all pages."""
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
    identified = (out / "identify" / "report.html").read_text(encoding="utf-8")
    parts = [
        "<h1>The pendulum's task</h1>",
        f"<p class=note>A machine that nobody had measured (seed {result.seed}) was recorded, identified, and given "
        "policies that were trained on what had been found. What it was stands beside the estimates; it was asked for "
        "at last.</p>",
        "<section><h2>What was identified</h2>",
        _estimates(result),
        *(f"<p class=note>{html.escape(remark)}</p>" for remark in result.identified["remarks"]),
        "</section><section><h2>Open-loop reconstruction</h2>",
        _inner(identified),
        "</section><section><h2>Delays</h2>",
        _inner((out / "delays.html").read_text(encoding="utf-8")),
        _missing(delays),
        "</section><section><h2>Training</h2>",
        _drawn(curves.read_text(encoding="utf-8")),
        _trainings(result),
        "</section><section><h2>On the machine, in real time</h2>",
        "<p class=note>Upright is within 10° and 0.5 rad/s. Each number is a run; the second counts from when it first "
        "stood.</p>",
        _variants(result),
        _traces(traces),
        "</section>",
    ]
    style = _between(identified, "<style>", "</style>") + STYLE
    text = (
        '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"/>'
        '<meta name="viewport" content="width=device-width, initial-scale=1"/>'
        '<meta name="color-scheme" content="light dark"/>'
        f"<title>The pendulum's task</title><style>{style}</style></head><body><main>"
    )
    (out / "report.html").write_text(text + "\n".join(parts) + "</main></body></html>", encoding="utf-8")


def _between(text: str, start: str, end: str) -> str:
    """What stands between two marks, of which the second is looked for from the end."""
    return text.partition(start)[2].rpartition(end)[0]


def _inner(page: str) -> str:
    """The figures of another page: both have one style."""
    body = _between(page, "<main>", "</main>")
    return f"<div class=inner>{body[body.index('<section') :]}</div>"


def _drawn(svg: str) -> str:
    """Pictures whose letters are black, on white paper."""
    return "".join(f"<figure class=drawn>{picture}</figure>" for picture in SVG.findall(svg))


def _table(head: list[str], rows: list[list[str]]) -> str:
    cells = "".join(f"<th>{html.escape(cell)}</th>" for cell in head)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<div class=scroll><table><thead><tr>{cells}</tr></thead><tbody>{body}</tbody></table></div>"


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
    return _drawn(text.getvalue())
