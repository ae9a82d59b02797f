"""The operations of a `Program` on JAX numbers, with the values and derivatives that Parallax defines.

Where JAX's own derivative is infinite or not a number, the ones here follow the Rust side: zero for the root at zero,
for the arcsine at one, for the angle of the origin. Reverse-mode differentiation multiplies the zero cotangent of the
branch that a `select` left out by that branch's derivative; the operations marked *guarded* therefore take a derivative
that is no finite number as zero, and a left-out branch never spoils a gradient.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from .types import Scalar

__all__ = ["COMPARE", "FOLD_BINARY", "FOLD_UNARY", "binary", "powi", "unary"]


def _finite(slope: jax.Array) -> jax.Array:
    return jnp.where(jnp.isfinite(slope), slope, 0.0)


def _with_slope(value: Callable[..., jax.Array], *slopes: Callable[..., jax.Array]) -> Callable[..., jax.Array]:
    """A function whose derivative with respect to each argument is `slope(result, *arguments)`, or zero where that is
    not finite."""

    function = jax.custom_jvp(value)

    @function.defjvp
    def _jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
        result = function(*primals)
        total = None
        for slope, tangent in zip(slopes, tangents, strict=True):
            term = _finite(slope(result, *primals)) * tangent
            total = term if total is None else total + term
        return result, total

    return function


def _arc_slope(x: jax.Array) -> jax.Array:
    return lax.rsqrt(1.0 - x * x)


# Derivatives that differ from JAX's at single points.
_sqrt = _with_slope(lax.sqrt, lambda y, x: 0.5 / y)
_abs = _with_slope(lax.abs, lambda y, x: lax.sign(x))
_asin = _with_slope(lax.asin, lambda y, x: _arc_slope(x))
_acos = _with_slope(lax.acos, lambda y, x: -_arc_slope(x))
_atan2 = _with_slope(lax.atan2, lambda r, y, x: x / (x * x + y * y), lambda r, y, x: -y / (x * x + y * y))


def _power_slope(r: jax.Array, x: jax.Array, y: jax.Array) -> jax.Array:
    at_zero = jnp.where(y == 1.0, 1.0, 0.0)
    return jnp.where(x == 0.0, at_zero, y * lax.pow(x, y - 1.0))


_pow = _with_slope(lax.pow, _power_slope, lambda r, x, y: jnp.where(x > 0.0, r * jnp.log(x), 0.0))

# Guarded forms of operations whose derivative may overflow in a branch that is not taken.
_div = _with_slope(lax.div, lambda r, a, b: 1.0 / b, lambda r, a, b: -r / b)
_ln = _with_slope(lax.log, lambda y, x: 1.0 / x)
_exp = _with_slope(lax.exp, lambda y, x: y)
_tan = _with_slope(lax.tan, lambda y, x: 1.0 + y * y)

_UNARY: dict[str, Callable[[jax.Array], jax.Array]] = {
    "neg": lax.neg,
    "sin": lax.sin,
    "cos": lax.cos,
    "tan": lax.tan,
    "asin": _asin,
    "acos": _acos,
    "atan": lax.atan,
    "exp": lax.exp,
    "ln": lax.log,
    "sqrt": _sqrt,
    "tanh": lax.tanh,
    "abs": _abs,
    "sign": lax.sign,
    "floor": lax.floor,
}
_UNARY_GUARDED = _UNARY | {"ln": _ln, "exp": _exp, "tan": _tan}

_BINARY: dict[str, Callable[[jax.Array, jax.Array], jax.Array]] = {
    "add": lax.add,
    "sub": lax.sub,
    "mul": lax.mul,
    "div": lax.div,
    "atan2": _atan2,
    "powf": _pow,
}
_BINARY_GUARDED = _BINARY | {"div": _div}

COMPARE: dict[str, Callable[[Scalar, Scalar], Scalar]] = {
    "lt": lambda a, b: a < b,
    "le": lambda a, b: a <= b,
    "eq": lambda a, b: a == b,
}


def unary(name: str, guarded: bool) -> Callable[[jax.Array], jax.Array]:
    """The function of one number called `name`."""
    return (_UNARY_GUARDED if guarded else _UNARY)[name]


def binary(name: str, guarded: bool) -> Callable[[jax.Array, jax.Array], jax.Array]:
    """The function of two numbers called `name`."""
    return (_BINARY_GUARDED if guarded else _BINARY)[name]


def powi(x: jax.Array, exponent: int) -> jax.Array:
    """`x` to a whole power."""
    return lax.integer_pow(x, exponent)


def _ieee_div(a: float, b: float) -> float:
    if b == 0.0:
        return math.nan if a == 0.0 or math.isnan(a) else math.copysign(math.inf, a) * math.copysign(1.0, b)
    return a / b


# What is folded at tracing time when all operands are known; what Python would refuse (the logarithm of a negative
# number) is left to JAX, which gives NaN.
FOLD_UNARY: dict[str, Callable[[float], float]] = {
    "neg": lambda a: -a,
    "sin": math.sin,
    "cos": math.cos,
    "tan": math.tan,
    "asin": math.asin,
    "acos": math.acos,
    "atan": math.atan,
    "exp": math.exp,
    "ln": math.log,
    "sqrt": math.sqrt,
    "tanh": math.tanh,
    "abs": abs,
    "sign": lambda a: a if a == 0.0 or math.isnan(a) else math.copysign(1.0, a),
    "floor": lambda a: float(math.floor(a)),
}
FOLD_BINARY: dict[str, Callable[[float, float], float]] = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "div": _ieee_div,
    "atan2": math.atan2,
    "powf": math.pow,
}
