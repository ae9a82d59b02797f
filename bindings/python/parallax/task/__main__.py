"""`python -m parallax.task pendulum`."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from ..cache import use_compilation_cache
from ..commands import CommandError
from .pendulum import VARIANTS, Options, pendulum


def main(arguments: list[str] | None = None) -> int:
    """Does what the arguments say; the exit code is that of `parallax`."""
    parser = argparse.ArgumentParser(prog="parallax task", description="Whole tasks, from a recording to a policy.")
    tasks = parser.add_subparsers(dest="task", required=True)
    own = tasks.add_parser("pendulum", help="swing up a pendulum of which nothing is known but its equations")
    defaults = Options()
    own.add_argument("--out", type=Path, default=Path("out/task/pendulum"), help="the folder for everything")
    own.add_argument("--seed", type=int, default=None, help="which machine; without it, one is drawn")
    own.add_argument("--record", type=float, default=defaults.record, help="how long to record, s")
    own.add_argument("--runs", type=int, default=defaults.runs, help="real-time runs of each variant")
    own.add_argument("--run", type=float, default=defaults.run, help="how long each lasts, s")
    own.add_argument("--steps", type=int, default=defaults.steps, help="steps of environments of each training")
    own.add_argument("--variants", nargs="+", choices=list(VARIANTS), default=list(VARIANTS))
    own.add_argument("--parallax", default=None, help="the command line; without it PARALLAX_BIN, or that on the path")
    own.add_argument("--json", action="store_true", help="print task.json instead of the short answer")
    given = parser.parse_args(arguments)
    use_compilation_cache()
    options = Options(
        out=given.out,
        seed=given.seed,
        record=given.record,
        runs=given.runs,
        run=given.run,
        steps=given.steps,
        variants=tuple(given.variants),
        parallax=given.parallax,
        say=(lambda text: print(text, file=sys.stderr)) if given.json else print,
    )
    try:
        result = pendulum(options)
    except CommandError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.code
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    if given.json:
        print(json.dumps(result.as_dict()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
