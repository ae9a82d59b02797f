"""`python -m parallax.task pendulum`, and `quadrotor`."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from ..cache import use_compilation_cache
from ..commands import CommandError
from ..xla import fuse_nothing_on_cpus
from .pendulum import DEFAULTS as PENDULUM
from .pendulum import pendulum
from .quadrotor import DEFAULTS as QUADROTOR
from .quadrotor import quadrotor
from .work import Options, Result

TASKS: dict[str, tuple[str, Callable[[Options], Result], Options]] = {
    "pendulum": ("swing up a pendulum of which nothing is known but its equations", pendulum, PENDULUM),
    "quadrotor": ("fly circles with a quadrotor of which nothing is known but its equations", quadrotor, QUADROTOR),
}


def main(arguments: list[str] | None = None) -> int:
    """Does what the arguments say; the exit code is that of `parallax`."""
    parser = argparse.ArgumentParser(prog="parallax task", description="Whole tasks, from a recording to a policy.")
    tasks = parser.add_subparsers(dest="task", required=True)
    for name, (about, _, defaults) in TASKS.items():
        own = tasks.add_parser(name, help=about, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
        own.add_argument("--out", type=Path, default=defaults.out, help="the folder for everything")
        own.add_argument("--seed", type=int, default=None, help="which machine; without it, one is drawn")
        own.add_argument("--record", type=float, default=defaults.record, help="how long to record, s")
        own.add_argument("--runs", type=int, default=defaults.runs, help="real-time runs of each variant")
        own.add_argument("--run", type=float, default=defaults.run, help="how long each lasts, s")
        own.add_argument("--steps", type=int, default=defaults.steps, help="steps of environments of each training")
        choices = list(defaults.variants)
        own.add_argument("--variants", nargs="+", choices=choices, default=choices, metavar="NAME", help="some of them")
        own.add_argument("--real-time", action="store_true", help="run the machine before all ordinary programs")
        own.add_argument(
            "--parallax", default=None, help="the command line; without it PARALLAX_BIN, or that on the path"
        )
        own.add_argument(
            "--resume", action="store_true", help="go on in the folder: nothing that is there is done again"
        )
        own.add_argument("--json", action="store_true", help="print task.json instead of the short answer")
    given = parser.parse_args(arguments)
    fuse_nothing_on_cpus()
    use_compilation_cache()
    _, task, defaults = TASKS[given.task]
    names = ("out", "seed", "record", "runs", "run", "steps", "real_time", "resume", "parallax")
    say: Callable[[str], None] = (lambda text: print(text, file=sys.stderr)) if given.json else print
    options = replace(
        defaults, variants=tuple(given.variants), say=say, **{name: getattr(given, name) for name in names}
    )
    try:
        result = task(options)
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
