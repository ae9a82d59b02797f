"""Functions in JAX as formulas: what a function computes, number by number, written down as a `system.toml` would."""

from .expression import Expression, Formulas
from .interpreter import UntraceableError, formulas

__all__ = ["Expression", "Formulas", "UntraceableError", "formulas"]
