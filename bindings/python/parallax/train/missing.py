"""Packages that only training needs."""

from __future__ import annotations

from ..missing import package

__all__ = ["optax", "package"]

optax = package("optax")
