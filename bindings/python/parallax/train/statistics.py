"""Running means and variances."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp

from ..types import Array

__all__ = ["Moments"]


@partial(jax.tree_util.register_dataclass, data_fields=["count", "mean", "variance"], meta_fields=[])
@dataclass(frozen=True)
class Moments:
    """Of everything that was seen so far."""

    count: Array
    """How many."""
    mean: Array
    """`[...]`"""
    variance: Array
    """`[...]`"""

    @classmethod
    def none(cls, shape: tuple[int, ...]) -> Moments:
        """Before anything was seen: as if of mean 0 and variance 1, which the first numbers outweigh."""
        return cls(jnp.asarray(1e-4, float), jnp.zeros(shape, float), jnp.ones(shape, float))

    def updated(self, batch: Array) -> Moments:
        """With a batch `[many, ...]` (T. F. Chan, G. H. Golub and R. J. LeVeque, *Updating formulae and a pairwise
        algorithm for computing sample variances*, 1979)."""
        many = batch.shape[0]
        mean, variance = jnp.mean(batch, axis=0), jnp.var(batch, axis=0)
        total = self.count + many
        between = mean - self.mean
        squares = self.variance * self.count + variance * many + between**2 * (self.count * many / total)
        return Moments(total, self.mean + between * (many / total), squares / total)

    @property
    def std(self) -> Array:
        """Standard deviations; never zero, so that a constant may be divided by it."""
        return jnp.sqrt(self.variance + 1e-8)
