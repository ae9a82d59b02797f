"""Ctrl-C that Python drops comes again.

Python raises `KeyboardInterrupt` wherever the main thread happens to be. Where that is a callback of the garbage
collector, of which JAX has one, or a finaliser, Python prints "Exception ignored in" and goes on as if nobody had
interrupted it: a run or a training would go on for ever. Importing this module has such a signal sent again, until
somebody hears it.
"""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from typing import Any

_LATER = 0.02
"""After so long, s. One that falls into a callback again is sent again."""


def _again() -> None:
    main = threading.main_thread().ident
    # Whoever has another handler by now gets it there, like any Ctrl-C.
    if main is not None and threading.main_thread().is_alive():
        signal.pthread_kill(main, signal.SIGINT)


def _install() -> None:
    before = sys.unraisablehook

    def hook(unraisable: Any) -> None:
        if issubclass(unraisable.exc_type, KeyboardInterrupt):
            later = threading.Timer(_LATER, _again)
            later.daemon = True
            # An interpreter that is ending starts no thread, and needs no interrupt.
            with contextlib.suppress(RuntimeError):
                later.start()
            return
        before(unraisable)

    sys.unraisablehook = hook


_install()
