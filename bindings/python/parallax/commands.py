"""The command line: one process for each thing that is done."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path

__all__ = ["CommandError", "Parallax"]


class CommandError(RuntimeError):
    """A command that could not do what it should, with what it said."""

    def __init__(self, message: str, code: int = 3) -> None:
        super().__init__(message)
        self.code = code


class Parallax:
    """The program `parallax`."""

    def __init__(self, program: str | None = None) -> None:
        """`program`, or `PARALLAX_BIN`, or the one on the path."""
        found = program or os.environ.get("PARALLAX_BIN") or shutil.which("parallax")
        if not found or not Path(found).exists():
            raise CommandError(
                f"the command line is not at `{found}`" if found else "there is no `parallax` on the path", 2
            ) from None
        self.program = found

    def __call__(self, *arguments: str | os.PathLike[str], secret: Mapping[str, str] | None = None) -> str:
        """Runs it; returns what it prints. `secret` are variables of its environment."""
        words = [os.fspath(argument) for argument in arguments]
        with subprocess.Popen(
            [self.program, *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, **(secret or {})},
        ) as process:
            try:
                printed, complained = process.communicate()
            except KeyboardInterrupt:
                # The program was interrupted, too, and writes what it has.
                process.wait()
                raise
        if process.returncode != 0:
            said = (complained or printed).strip()
            code = process.returncode if process.returncode > 0 else 130
            raise CommandError(f"`parallax {' '.join(words)}` said: {said}", code)
        return printed
