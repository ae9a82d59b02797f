"""Recordings and diagnoses for the viewer Rerun.

```sh
python -m parallax.rerun out/run.mcap out/run.rrd     # then: rerun out/run.rrd
python -m parallax.rerun out/axis out/axis.rrd        # the folder of `parallax diagnose`
```

Needs the package `rerun-sdk`: `pip install './bindings[rerun]'`.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

from ._native import ParallaxError
from .recording import Recording, load

__all__ = ["export", "export_diagnosis"]

_TIMELINE = "time"
"""Seconds since the run's start, as everywhere."""


class _Stream:
    """A file of Rerun, and how many curves it has."""

    def __init__(self, name: str, path: str | os.PathLike[str]) -> None:
        self.rerun = _package()
        self.stream = self.rerun.RecordingStream(name)
        self.stream.save(str(path))
        self.curves = 0

    def curve(self, place: str, times: Any, values: Any) -> None:
        columns = self.rerun.Scalars.columns(scalars=values)
        self.stream.send_columns(place, indexes=[self.rerun.TimeColumn(_TIMELINE, duration=times)], columns=columns)
        self.curves += 1

    def constant(self, place: str, what: Any) -> None:
        self.stream.log(place, what, static=True)

    def close(self) -> int:
        self.stream.flush()
        self.stream.disconnect()
        return self.curves


def export(recording: Recording | str | os.PathLike[str], path: str | os.PathLike[str]) -> int:
    """Writes a recording to `path` (`.rrd`); gives the number of curves.

    `NODE/LEAF` holds a leaf of a node's messages when they were sent, `steps/NODE/computation` how long its steps took,
    s, when they ended. Raises `ImportError` without the package, `ParallaxError` for a recording that cannot be read.
    """
    _package()
    run = recording if isinstance(recording, Recording) else load(recording)
    stream = _Stream(f"parallax {run.graph['name']}", path)
    for name, node in run.nodes.items():
        for leaf, values in node.messages.items():
            stream.curve(f"{name}/{leaf.replace('.', '/')}", node.sent, values)
        stream.curve(f"steps/{name}/computation", node.end, node.end - node.start)
    return stream.close()


def export_diagnosis(folder: str | os.PathLike[str], path: str | os.PathLike[str]) -> int:
    """Writes what `parallax diagnose` left in `folder` to `path` (`.rrd`); gives the number of curves.

    Of each output, on held-out time: `OUTPUT/measured`, `OUTPUT/before` and `OUTPUT/after` in its unit, predicted by
    the refitted nominal system and with the leading answer, and `residuals/OUTPUT/before` and `.../after`, measured
    minus predicted, in noise units. `answer` is the short answer with all probabilities as a text, `probabilities` and
    `where` are bars in the order of that text. Raises `ImportError` without the package, `ParallaxError` when the
    folder holds no diagnosis.
    """
    _package()
    report, predictions = _diagnosis(Path(folder))
    stream = _Stream(f"parallax diagnosis of {report['system']}", path)
    rerun, views = stream.rerun, []
    blueprint = rerun.blueprint
    for output in predictions:
        times = np.asarray(output["time"], float)
        measured, before, after = (_numbers(output[name]) for name in ("measured", "before", "after"))
        name = output["output"]
        for place, values in (("measured", measured), ("before", before), ("after", after)):
            stream.curve(f"{name}/{place}", times, values)
        for place, values in (("before", before), ("after", after)):
            stream.curve(f"residuals/{name}/{place}", times, (measured - values) / output["noise"])
        unit = f" [{output['unit']}]" if output["unit"] else ""
        views.append(blueprint.TimeSeriesView(origin=name, name=f"{name}{unit}"))
        views.append(blueprint.TimeSeriesView(origin=f"residuals/{name}", name=f"{name}, residuals [noise units]"))
    stream.constant("answer", rerun.TextDocument(_text(report), media_type="text/markdown"))
    stream.constant("probabilities", rerun.BarChart([row[1] for row in _probabilities(report)]))
    stream.constant("where", rerun.BarChart([place["probability"] for place in report["where"]] or [0.0]))
    found = blueprint.Horizontal(
        blueprint.TextDocumentView(origin="answer", name="answer"),
        blueprint.BarChartView(origin="probabilities", name="probabilities"),
        blueprint.BarChartView(origin="where", name="where"),
    )
    stream.stream.send_blueprint(blueprint.Blueprint(blueprint.Vertical(found, *views)))
    return stream.close()


def _diagnosis(folder: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """The report and the predictions in a diagnosis's folder."""
    read: list[Any] = []
    for name in ("report.json", "predictions.json"):
        try:
            read.append(json.loads((folder / name).read_text(encoding="utf-8")))
        except OSError as error:
            raise ParallaxError(
                f"{folder / name}: {error.strerror}; give the folder that `parallax diagnose --out` wrote"
            ) from error
        except ValueError as error:
            raise ParallaxError(f"{folder / name} is no JSON: {error}; diagnose again") from error
    return read[0], read[1]


def _numbers(values: list[float | None]) -> np.ndarray:
    return np.array([np.nan if value is None else value for value in values], float)


def _probabilities(report: dict[str, Any]) -> list[tuple[str, float]]:
    """The hypotheses with their probabilities, the most probable first; what has no name is one of them."""
    rows = [
        (" + ".join(f"{e['name']}@{e['place']}" for e in which["effects"]) or "no gap", which["probability"])
        for which in report["which"]
    ]
    rows.append(("unexplained", report["unexplained"]["probability"]))
    return sorted(rows, key=lambda row: -row[1])


def _text(report: dict[str, Any]) -> str:
    lines = [report["summary"], "", "| | which | probability |", "|-|-|-|"]
    rows = enumerate(_probabilities(report))
    lines += [f"| {place} | `{name}` | {probability:.3f} |" for place, (name, probability) in rows]
    lines += ["", "| | where | share | probability |", "|-|-|-|-|"]
    lines += [
        f"| {place} | `{where['place']}` | {where['share']:.3f} | {where['probability']:.3f} |"
        for place, where in enumerate(report["where"])
    ]
    return "\n".join(lines)


def _package() -> Any:
    try:
        import rerun
        import rerun.blueprint
    except ImportError as error:
        raise ImportError("this needs the package `rerun-sdk`: pip install './bindings[rerun]'") from error
    return rerun


def main(arguments: list[str] | None = None) -> int:
    """The command; gives the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m parallax.rerun", description="A recording, or a diagnosis, for the viewer Rerun."
    )
    parser.add_argument("source", help="the recording (.mcap), or the folder of a diagnosis")
    parser.add_argument("out", nargs="?", help="the file to write (.rrd); beside the source, if not said")
    given = parser.parse_args(arguments)
    out = given.out or str(Path(given.source).with_suffix(".rrd"))
    try:
        curves = (export_diagnosis if Path(given.source).is_dir() else export)(given.source, out)
    except (ImportError, ParallaxError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{curves} curves written to {out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
