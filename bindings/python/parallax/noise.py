"""Standard normal numbers of a step, from a key and the step's number alone.

The hash pcg4d (M. Jarzynski and M. Olano, *Hash functions for GPU rendering*, 2020) turns two words of key, the step's
number and a counter into four random words; two of them give two normal numbers by the method of Box and Muller. It is
a few multiplications that fuse with what uses them, where JAX's own generator takes longer than a whole step of a small
robot. It is not for cryptography, and a JAX node that wants another generator has a key of its own (`Step.key`).
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import DTypeLike

from .types import Array, Scalar

__all__ = ["normals", "words"]

SALT = 0x70617261
"""Keeps streams apart from the numbers that they give."""


def pcg4d(words: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
    """Four random words from four words, uint32."""
    x, y, z, w = (word * np.uint32(1664525) + np.uint32(1013904223) for word in words)
    for last in (False, True):
        x = x + y * w
        y = y + z * x
        z = z + x * y
        w = w + y * z
        if not last:
            x, y, z, w = (word ^ lax.shift_right_logical(word, np.uint32(16)) for word in (x, y, z, w))
    return x, y, z, w


def words(key: Array, stream: int) -> tuple[Array, Array]:
    """The two words of a stream, uint32, from a key of any kind."""
    data = jax.random.key_data(key).reshape(-1)
    first, second, _, _ = pcg4d((data[0], data[-1], jnp.full_like(data[0], stream), jnp.full_like(data[0], SALT)))
    return first, second


def normals(stream: tuple[Array, Array], seq: Scalar, count: int) -> list[Array]:
    """`count` numbers of the step `seq`."""
    step = jnp.asarray(seq).astype(jnp.uint32)
    dtype = jnp.result_type(float)
    result: list[Array] = []
    for four in range((count + 3) // 4):
        hashed = pcg4d((stream[0], stream[1], step, jnp.full_like(step, four)))
        for first, second in (hashed[:2], hashed[2:]):
            # 24 bits are what a float32 holds; the uniform number is never zero.
            uniform = (_upper(first).astype(dtype) + 1.0) * 2.0**-24
            radius = jnp.sqrt(-2.0 * jnp.log(uniform))
            cos, sin = _direction(second, dtype)
            result += [radius * cos, radius * sin]
    return result[:count]


def _upper(word: Array) -> Array:
    """The upper 24 bits, as a signed number: its conversion to floating point is one instruction."""
    return lax.shift_right_logical(word, np.uint32(8)).astype(jnp.int32)


def _direction(word: Array, dtype: DTypeLike) -> tuple[Array, Array]:
    """A point on the unit circle, uniformly: an angle within 45 degrees by its series, turned by whole quarters."""
    angle = (_upper(word).astype(dtype) - 2.0**23) * (math.pi / 4 * 2.0**-23)
    square = angle * angle
    sin = angle * (1.0 + square * (-1 / 6 + square * (1 / 120 - square / 5040)))
    cos = 1.0 + square * (-1 / 2 + square * (1 / 24 + square * (-1 / 720 + square / 40320)))
    swap = (word & np.uint32(1)) != 0
    sign = jnp.where((word & np.uint32(2)) != 0, -1.0, 1.0).astype(dtype)
    return sign * jnp.where(swap, -sin, cos), sign * jnp.where(swap, cos, sin)
