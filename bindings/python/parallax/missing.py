"""Packages that only some of what is here needs; where one is missing, the error says how to get it."""

from __future__ import annotations

import importlib
from typing import Any

__all__ = ["package"]


def package(name: str, extra: str = "train") -> Any:
    """Imports a package of an extra."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(
            f"{error}: `{name.split('.')[0]}` comes with the package's extra `{extra}`; install it by "
            f"`pip install 'parallax[{extra}]'`, from a checkout `pip install './bindings[{extra}]'`"
        ) from error
