"""`python -m parallax.worlds MODEL.xml`: a model of MuJoCo as a `system.toml`, for `parallax new system --mjcf`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from .._native import ParallaxError
from .equations import write_mjcf_system


def main(arguments: list[str] | None = None) -> int:
    """Does what the arguments say; 2 when the model cannot be written down."""
    parser = argparse.ArgumentParser(prog="parallax.worlds", description="A model of MuJoCo as a system.toml.")
    parser.add_argument("model", help="the model, MJCF or MJB")
    parser.add_argument("--out", type=Path, default=Path("system.toml"), help="the file to write")
    parser.add_argument("--name", help="the name of the system")
    parser.add_argument(
        "--signal",
        action="append",
        default=[],
        metavar="NAME=SIGNAL",
        help="the recorded signal of an actuator or an output",
    )
    parser.add_argument(
        "--output",
        action="append",
        default=[],
        metavar="NAME=WHAT",
        help="what is read: position:JOINT, velocity:JOINT or sensor:SENSOR",
    )
    parser.add_argument(
        "--calibrate", type=float, default=0.0, metavar="SHARE", help="how far parameters may be refitted"
    )
    given = parser.parse_args(arguments)
    try:
        signals, outputs = _pairs(given.signal, "--signal"), _pairs(given.output, "--output")
        left_out = write_mjcf_system(
            given.out, given.model, signals=signals, outputs=outputs or None, calibrate=given.calibrate, name=given.name
        )
    except (ValueError, ImportError, ParallaxError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    for what in left_out:
        print(f"left out: {what}")
    return 0


def _pairs(texts: Sequence[str], option: str) -> dict[str, str]:
    pairs = [text.partition("=") for text in texts]
    wrong = [name for name, equals, value in pairs if not (name and equals and value)]
    if wrong:
        raise ValueError(f"{option} {wrong[0]}: it must look like NAME=VALUE")
    return {name: value for name, _, value in pairs}


if __name__ == "__main__":
    sys.exit(main())
