"""A recording for the viewer Rerun: every leaf of every node's messages as a curve, and how long its steps took.

```sh
python -m parallax.rerun out/run.mcap out/run.rrd     # then: rerun out/run.rrd
```

Needs the package `rerun-sdk`: `pip install './bindings[rerun]'`.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import Any

from ._native import ParallaxError
from .recording import Recording, load

__all__ = ["export"]

_TIMELINE = "time"
"""Seconds since the run's start, as everywhere."""


def export(recording: Recording | str | os.PathLike[str], path: str | os.PathLike[str]) -> int:
    """Writes `path` (`.rrd`); gives the number of curves.

    `NODE/LEAF` holds a leaf of a node's messages when they were sent, `steps/NODE/computation` how long its steps took,
    s, when they ended. Raises `ImportError` without the package, `ParallaxError` for a recording that cannot be read.
    """
    rerun = _package()
    run = recording if isinstance(recording, Recording) else load(recording)
    stream = rerun.RecordingStream(f"parallax {run.graph['name']}")
    stream.save(str(path))
    curves = 0

    def curve(place: str, times: Any, values: Any) -> None:
        nonlocal curves
        columns = rerun.Scalars.columns(scalars=values)
        stream.send_columns(place, indexes=[rerun.TimeColumn(_TIMELINE, duration=times)], columns=columns)
        curves += 1

    for name, node in run.nodes.items():
        for leaf, values in node.messages.items():
            curve(f"{name}/{leaf.replace('.', '/')}", node.sent, values)
        curve(f"steps/{name}/computation", node.end, node.end - node.start)
    stream.flush()
    stream.disconnect()
    return curves


def _package() -> Any:
    try:
        import rerun
    except ImportError as error:
        raise ImportError("this needs the package `rerun-sdk`: pip install './bindings[rerun]'") from error
    return rerun


def main(arguments: list[str] | None = None) -> int:
    """The command; gives the exit status."""
    parser = argparse.ArgumentParser(prog="python -m parallax.rerun", description="A recording for the viewer Rerun.")
    parser.add_argument("recording", help="the recording (.mcap)")
    parser.add_argument("out", nargs="?", help="the file to write (.rrd); beside the recording, if not said")
    given = parser.parse_args(arguments)
    out = given.out or str(Path(given.recording).with_suffix(".rrd"))
    try:
        curves = export(given.recording, out)
    except (ImportError, ParallaxError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{curves} curves written to {out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
