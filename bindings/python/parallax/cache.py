"""Compiled programs, kept between processes."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import jax

__all__ = ["use_compilation_cache"]


def use_compilation_cache(folder: str | os.PathLike[str] | None = None, least_seconds: float = 0.1) -> Path:
    """Keeps what JAX compiles in `folder`, so that the next process finds it there; returns the folder.

    Without one it is `PARALLAX_CACHE`, or `parallax/jax` in the user's cache folder. Programs that compile in less than
    `least_seconds` are not kept. Call it before the first computation.
    """
    if folder is None:
        user = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = os.environ.get("PARALLAX_CACHE") or Path(user) / "parallax" / "jax"
    path = Path(folder).expanduser()
    path.mkdir(parents=True, exist_ok=True)
    update: Callable[[str, object], None] = jax.config.update
    update("jax_compilation_cache_dir", str(path))
    update("jax_persistent_cache_min_compile_time_secs", least_seconds)
    update("jax_persistent_cache_min_entry_size_bytes", -1)
    return path
