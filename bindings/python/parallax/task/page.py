"""The page of a task: one file that needs no other."""

from __future__ import annotations

import html
import io
import re
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ..train import plot_curves
from ..train.missing import package

if TYPE_CHECKING:
    from .work import Work

__all__ = ["figure", "table", "write_page"]

STYLE = """figure.drawn{background:#fff;padding:6px;break-inside:avoid}
figure.drawn svg{width:100%;height:auto;display:block}
.inner h2{font-size:14px}.inner>section{border:0;margin-top:14px;padding-top:0}.scroll th,.scroll td{text-align:left}
.scroll th,.scroll td{white-space:normal}"""
"""What this page has beside the style of all pages."""
SVG = re.compile(r"<svg\b.*?</svg>", re.DOTALL)


def write_page(work: Work, title: str, truths: Mapping[str, str], found: Sequence[str], machine: Sequence[str]) -> None:
    """Writes `report.html`. `truths` says what the machine calls an estimate; `found` shows more of what was
    identified, and `machine` is what came out on the machine."""
    result, out = work.result, work.out
    trained = {name: work.policy(name).parent for name in result.training}
    curves = plot_curves(trained, out / "curves.svg")
    identified = (out / "identify" / "report.html").read_text(encoding="utf-8")
    parts = [
        f"<h1>{html.escape(title)}</h1>",
        f"<p class=note>A machine that nobody had measured (seed {result.seed}) was recorded, identified, and given "
        "policies that were trained on what had been found. What it was stands beside the estimates; it was asked for "
        "at last.</p>",
        "<section><h2>What was identified</h2>",
        _estimates(work, truths),
        *(f"<p class=note>{html.escape(remark)}</p>" for remark in result.identified["remarks"]),
        "</section><section><h2>Open-loop reconstruction</h2>",
        _inner(identified),
        *found,
        "</section><section><h2>Delays</h2>",
        _inner((out / "delays.html").read_text(encoding="utf-8")),
        _missing(work),
        "</section><section><h2>Nodes</h2>",
        "<p class=note>How long the steps of the recorded run took, and how late they began.</p>",
        _nodes(work),
        "</section><section><h2>Training</h2>",
        _drawn(curves.read_text(encoding="utf-8")),
        _trainings(work),
        "</section><section><h2>On the machine, in real time</h2>",
        *machine,
        "</section>",
    ]
    style = _between(identified, "<style>", "</style>") + STYLE
    text = (
        '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"/>'
        '<meta name="viewport" content="width=device-width, initial-scale=1"/>'
        '<meta name="color-scheme" content="light dark"/>'
        f"<title>{html.escape(title)}</title><style>{style}</style></head><body><main>"
    )
    (out / "report.html").write_text(text + "\n".join(parts) + "</main></body></html>", encoding="utf-8")
    work.say(f"   The report is {out / 'report.html'}")


def table(head: list[str], rows: list[list[str]]) -> str:
    """A table of texts."""
    cells = "".join(f"<th>{html.escape(cell)}</th>" for cell in head)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<div class=scroll><table><thead><tr>{cells}</tr></thead><tbody>{body}</tbody></table></div>"


def figure(inches: tuple[float, float], draw: Callable[[Any], None]) -> str:
    """What `draw` puts into a figure of matplotlib, as SVG."""
    picture = package("matplotlib.figure").Figure(figsize=inches, layout="constrained")
    draw(picture)
    text = io.StringIO()
    picture.savefig(text, format="svg")
    return _drawn(text.getvalue())


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


def _estimates(work: Work, truths: Mapping[str, str]) -> str:
    result, rows = work.result, []
    for estimate in result.identified["estimates"]:
        truth = result.truth.get(truths.get(estimate["name"], ""))
        low, high = estimate["interval"]
        known = estimate["std"] is not None
        rows.append(
            [
                # A line may end behind a dot: a phone is narrow.
                estimate["name"].replace(".", ".\u200b"),
                f"{estimate['value']:.4g} {estimate['unit']}",
                f"{low:.4g} to {high:.4g}" if known else "not determined",
                "" if truth is None else f"{truth:.4g}",
            ]
        )
    return table(["", "estimate", "95 %", "the machine"], rows)


def _missing(work: Work) -> str:
    named = [str(place) for place in work.delays.get("without_samples", [])]
    return f"<p class=note>Nothing was measured of {html.escape(', '.join(named))}.</p>" if named else ""


def _nodes(work: Work) -> str:
    rows = [
        [name, f"{1e3 * told['mean']:.3f} ± {1e3 * told['std']:.3f}", f"{1e3 * told['late']:.2f}", f"{told['rate']:g}"]
        for name, told in work.result.nodes.items()
    ]
    return table(["node", "delay (ms)", "late (ms)", "rate (Hz)"], rows)


def _trainings(work: Work) -> str:
    names = list(dict.fromkeys(key for told in work.result.training.values() for key in told))
    own = [name for name in names if name not in ("seconds", "steps_per_second")]
    rows = [
        [name, f"{told['seconds']:.0f} s", f"{told['steps_per_second']:,.0f}/s", *(f"{told[key]:.3g}" for key in own)]
        for name, told in work.result.training.items()
    ]
    return table(["training", "time", "steps", *own], rows)
