"""The paper's figure 6: pictures of the machine beside what is rendered of the poses that were estimated."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np

from ..recording import Recording
from ..train.missing import package
from ..types import Floats
from .page import figure, table
from .pendulum_identify import CAMERAS, Seen
from .work import Work

__all__ = ["poses"]

SHOWN = 4
"""Pictures of each camera."""
MARK = 5.0
"""Radius of the mark in a picture, px."""


def poses(work: Work, recording: Recording, seen: Seen) -> list[str]:
    """Parts of a page: for both cameras pictures of time that no fit has seen, above what is rendered of the open-loop
    prediction at the same time, and how far the mark is from where it is predicted."""
    told = json.loads((work.out / "identify" / "predictions.json").read_text(encoding="utf-8"))["outputs"]
    predictions = {each["output"]: each["recordings"][0] for each in told}
    pictures = [row for camera in CAMERAS for row in _camera(work, recording, predictions, camera)]

    def draw(drawing: Any) -> None:
        rows = drawing.subplots(len(pictures), SHOWN)
        for row, (about, shown) in zip(rows, pictures, strict=True):
            for axes, (title, picture, pose) in zip(row, shown, strict=True):
                axes.imshow(picture)
                axes.set_xticks([])
                axes.set_yticks([])
                axes.set_title(title, fontsize=8)
                if pose is not None:
                    shaft, mark = pose
                    axes.plot(*zip(shaft, mark, strict=True), color="#333333", linewidth=3)
                    axes.add_patch(_disc(mark))
            row[0].set_ylabel(about, fontsize=8)

    rows = []
    for camera, (_, mark) in CAMERAS.items():
        off = _off(predictions, mark, seen.begin)
        rows.append([camera, f"{_rms(off[0]):.2f} px", f"{_rms(off[1]):.2f} px"])
    return [
        "<h3>Pictures, and what is rendered of the estimated poses</h3>",
        "<p class=note>From two stands that nobody had told: pictures of the time that no fit has seen, and below each "
        "the background with an arm and a mark where the open-loop prediction has them.</p>",
        figure((8, 1.6 * len(pictures)), draw),
        table(["the mark is off its prediction by (rms)", "fitted", "held out"], rows),
    ]


def _camera(
    work: Work, recording: Recording, predictions: dict[str, Any], camera: str
) -> list[tuple[str, list[tuple[str, Any, Any]]]]:
    """Two rows: pictures, and renderings."""
    film, mark = CAMERAS[camera]
    height, width = (int(recording[film][side][0]) for side in ("height", "width"))
    taken = [data.reshape(height, width, -1) for data in recording.data(film)]
    # The pendulum hides each place for a while only.
    background = np.median(np.stack(taken[:: max(1, len(taken) // 60)]), axis=0).astype(np.uint8)
    place = {int(seq): index for index, seq in enumerate(recording[film].seq)}
    consumed = recording[mark].inputs["film"].seq[:, -1]
    column, row = predictions[f"{mark}.u"], predictions[f"{mark}.v"]
    # Steps after the last that is compared have no prediction.
    after = [
        step
        for step, time in enumerate(column["times"])
        if time >= column["held_out_from"] and column["predicted"][step] is not None and int(consumed[step]) in place
    ]
    # From one side of the swing to the other.
    across = sorted(after, key=lambda step: float(column["predicted"][step]))
    chosen = sorted(across[int(share * (len(across) - 1))] for share in np.linspace(0.0, 1.0, SHOWN))
    shaft = [_shaft(work, camera, part) for part in "uv"]
    pictures, renderings = [], []
    for step in chosen:
        title = f"{column['times'][step]:.2f} s"
        pictures.append((title, taken[place[int(consumed[step])]], None))
        pose = (shaft, [column["predicted"][step], row["predicted"][step]])
        renderings.append((title, background, pose))
    return [(camera, pictures), (f"{camera}, rendered", renderings)]


def _shaft(work: Work, camera: str, part: str) -> float:
    """A coordinate of the middle of the mark's circle, px: the mean over a whole turn."""
    one, square = (work.estimate(f"{camera}.{part}.{term}")["value"] for term in ("one", "sin_sin"))
    return float(one + 0.5 * square)


def _off(predictions: dict[str, Any], mark: str, begin: float) -> tuple[Floats, Floats]:
    """How far the mark is from where it is predicted, px: over the time that the fit saw, from `begin` on, and over
    the rest."""
    column, row = (predictions[f"{mark}.{part}"] for part in "uv")

    def error(series: dict[str, Any]) -> Floats:
        recorded, predicted = (np.array(series[key], dtype=float) for key in ("recorded", "predicted"))
        wrong: Floats = recorded - predicted
        return wrong

    off = np.hypot(error(column), error(row))
    times = np.array(column["times"])
    held_out = times >= column["held_out_from"]
    known = np.isfinite(off) & (times >= begin)
    return off[known & ~held_out], off[known & held_out]


def _rms(values: Floats) -> float:
    return float(math.sqrt(np.mean(values**2))) if len(values) else math.nan


def _disc(mark: list[float]) -> Any:
    return package("matplotlib.patches").Circle((mark[0], mark[1]), MARK, color="#d22828", zorder=3)
