"""The tables of a compiled graph: what runs, when, and which messages it reads, for every step of every episode.

A table lives outside the carried state and is an argument of compiled functions, not a literal in them. Columns that
nothing reads are left out, columns with one value become constants, equal columns are stored once.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from .types import Array, Scalar

__all__ = ["Column", "Row", "TableBuilder", "Tables"]

NANOSECONDS = 1_000_000_000


class Tables(NamedTuple):
    """Columns of all episodes and steps."""

    floats: Array
    """Times in seconds and sequence numbers, `[episode, step, column]`."""
    integers: Array
    """Flags and places, `[episode, step, column]`."""


@dataclass(frozen=True)
class Column:
    """One column of the tables, or the one value that it always has."""

    values: tuple[int, ...]
    """For a column of integers: the values that occur, in order."""
    place: int = -1
    """Its place in the table; −1 for a constant."""
    constant: float | int | None = None
    is_float: bool = False


class Row:
    """One step of one episode."""

    def __init__(self, floats: Array, integers: Array) -> None:
        self.floats = floats
        self.integers = integers

    def __getitem__(self, column: Column) -> Scalar:
        if column.place < 0:
            return column.constant
        return (self.floats if column.is_float else self.integers)[column.place]


@dataclass
class TableBuilder:
    """Collects columns."""

    episodes: int
    steps: int
    _floats: list[NDArray[np.float64]] = field(default_factory=list)
    _integers: list[NDArray[np.int32]] = field(default_factory=list)
    _known: dict[tuple[bool, bytes], Column] = field(default_factory=dict)

    def integers(self, values: NDArray[Any], run: NDArray[np.bool_]) -> Column:
        """A column of flags or places; what it holds where `run` is false does not matter."""
        values = values.astype(np.int32)
        occurring = np.unique(values[run]) if run.any() else np.zeros(1, np.int32)
        if len(occurring) == 1:
            return Column((int(occurring[0]),), constant=int(occurring[0]))
        values = np.where(run, values, occurring[0])
        return self._add(values, tuple(int(value) for value in occurring), False)

    def numbers(self, values: NDArray[Any], run: NDArray[np.bool_]) -> Column:
        """A column of plain numbers, as `integers`."""
        values = values.astype(np.float64)
        if not run.any() or np.all(values[run] == values[run][0]):
            return Column((), constant=float(values[run][0]) if run.any() else 0.0, is_float=True)
        return self._add(np.where(run, values, 0.0), (), True)

    def seconds(self, nanoseconds: NDArray[Any], run: NDArray[np.bool_]) -> Column:
        """A column of times."""
        return self.numbers(nanoseconds.astype(np.float64) / NANOSECONDS, run)

    def _add(self, values: NDArray[Any], occurring: tuple[int, ...], is_float: bool) -> Column:
        key = (is_float, values.tobytes())
        if key not in self._known:
            columns: list[Any] = self._floats if is_float else self._integers
            self._known[key] = Column(occurring, place=len(columns), is_float=is_float)
            columns.append(values)
        return self._known[key]

    def tables(self) -> Tables:
        """What was collected, in the precision that JAX is set to."""
        shape = (self.episodes, self.steps, 0)
        floats = np.stack(self._floats, axis=-1) if self._floats else np.zeros(shape)
        integers = np.stack(self._integers, axis=-1) if self._integers else np.zeros(shape, np.int32)
        return Tables(jnp.asarray(floats, float), jnp.asarray(integers, jnp.int32))
