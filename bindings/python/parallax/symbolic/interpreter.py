"""What a function in JAX computes, as formulas: its operations (a jaxpr) done on names instead of numbers.

Arrays are unrolled into their numbers. What does not depend on a name is computed as JAX would; loops must be of known
length.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .expression import UNARY, Expression, Value

__all__ = ["UntraceableError", "formulas"]

Block = np.ndarray[Any, Any]
"""Numbers of an array, or, with the type `object`, formulas."""


class UntraceableError(ValueError):
    """A function that cannot be written down as formulas."""


def formulas(function: Callable[..., Any], *arguments: Any) -> Any:
    """The results of `function(*arguments)` as formulas: a tree of the same shape, with arrays of the type `object`.

    `arguments` are trees whose leaves are arrays: of numbers, or, with the type `object`, of `Expression` and numbers.
    Raises `UntraceableError` when the function does what no formula does, such as a loop that ends by what it computes.
    """
    leaves, shape = jax.tree.flatten(arguments)
    blocks = [np.asarray(leaf) for leaf in leaves]
    with jax.enable_x64(True):
        typed = [jnp.zeros(b.shape, float if b.dtype == object else b.dtype) for b in blocks]
        traced, out = jax.make_jaxpr(lambda *flat: function(*jax.tree.unflatten(shape, flat)), return_shape=True)(
            *typed
        )
        results = _evaluate(traced.jaxpr, [np.asarray(constant) for constant in traced.consts], blocks)
    return jax.tree.unflatten(jax.tree.structure(out), [np.asarray(result) for result in results])


_CALLS = ("jit", "pjit", "closed_call", "core_call", "checkpoint", "remat", "custom_jvp_call", "custom_vjp_call")
"""Operations that are functions of their own."""


def _evaluate(jaxpr: Any, constants: Sequence[Block], arguments: Sequence[Block]) -> list[Block]:
    values: dict[Any, Block] = dict(zip(jaxpr.constvars, constants, strict=True))
    values |= zip(jaxpr.invars, arguments, strict=True)

    def read(variable: Any) -> Block:
        return np.asarray(variable.val) if hasattr(variable, "val") else values[variable]

    for equation in jaxpr.eqns:
        results = _apply(equation, [read(variable) for variable in equation.invars])
        for variable, result in zip(equation.outvars, results, strict=True):
            values[variable] = _settled(result, variable.aval)
    return [read(variable) for variable in jaxpr.outvars]


def _settled(result: Block, aval: Any) -> Block:
    """An array of its shape; of numbers, where no formula is left in it."""
    result = np.asarray(result)
    if result.dtype != object:
        return result
    if any(isinstance(value, Expression) for value in result.flat):
        return result.reshape(aval.shape)
    return result.astype(float).reshape(aval.shape).astype(aval.dtype)


def _apply(equation: Any, inputs: list[Block]) -> Sequence[Block]:
    name, params = equation.primitive.name, equation.params
    if name == "scan":
        return _scan(params, inputs)
    if name == "while":
        return _while(params, inputs)
    if name == "cond":
        return _cond(params, inputs)
    if name in _CALLS:
        return _call(next(params[key] for key in ("jaxpr", "call_jaxpr", "fun_jaxpr") if key in params), inputs)
    if all(variable.aval.size == 0 for variable in equation.outvars):
        return [np.zeros(variable.aval.shape, variable.aval.dtype) for variable in equation.outvars]
    if not any(block.dtype == object for block in inputs):
        return _computed(equation, inputs)
    if name == "scatter-add":
        return [_scatter_add(equation, inputs)]
    if name in _MOVES:
        return [_moved(equation, inputs)]
    kind = equation.outvars[0].aval.dtype.kind
    if name == "div" and kind in "iu":
        return [_each(lambda x, y: _truncated(Expression.of("/", x, y)))(params, *inputs)]
    # A condition is 1 or 0, of which these are a product and the like; of the bits of a number they are not.
    if name in _RULES and (kind == "b" or name not in ("and", "or", "not")):
        return [_RULES[name](params, *inputs)]
    raise UntraceableError(f"the function computes `{name}` of what is to be a name; no formula does that")


def _computed(equation: Any, inputs: Sequence[Block]) -> list[Block]:
    """As JAX computes it; what NumPy does alike is left to it, which has nothing to compile."""
    name, params = equation.primitive.name, equation.params
    if name in _NUMPY:
        return [np.asarray(_NUMPY[name](params, *inputs))]
    # Branches that are not taken may hold what is no number.
    with np.errstate(invalid="ignore"):
        results = equation.primitive.bind(*(jnp.asarray(block) for block in inputs), **params)
    return [np.asarray(r) for r in (results if equation.primitive.multiple_results else [results])]


def _call(jaxpr: Any, inputs: Sequence[Block]) -> list[Block]:
    inner = getattr(jaxpr, "jaxpr", jaxpr)
    return _evaluate(inner, [np.asarray(c) for c in getattr(jaxpr, "consts", ())], inputs)


def _broadcast(params: Any, block: Block) -> Block:
    shape = [1] * len(params["shape"])
    for axis, place in enumerate(params["broadcast_dimensions"]):
        shape[place] = block.shape[axis]
    return np.broadcast_to(block.reshape(shape), params["shape"])


def _slice(params: Any, block: Block) -> Block:
    steps = params["strides"] or [1] * block.ndim
    limits = zip(params["start_indices"], params["limit_indices"], steps, strict=True)
    return block[tuple(slice(*limit) for limit in limits)]


_NUMPY: dict[str, Callable[..., Block]] = {
    "add": lambda _, a, b: a + b,
    "sub": lambda _, a, b: a - b,
    "mul": lambda _, a, b: a * b,
    "lt": lambda _, a, b: a < b,
    "le": lambda _, a, b: a <= b,
    "gt": lambda _, a, b: a > b,
    "ge": lambda _, a, b: a >= b,
    "eq": lambda _, a, b: a == b,
    "ne": lambda _, a, b: a != b,
    "and": lambda _, a, b: a & b,
    "or": lambda _, a, b: a | b,
    "not": lambda _, a: ~a,
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda params, *blocks: np.concatenate(blocks, params["dimension"]),
    "reshape": lambda params, block: block.reshape(params["new_sizes"]),
    "slice": _slice,
    "squeeze": lambda params, block: block.squeeze(params["dimensions"]),
    "transpose": lambda params, block: block.transpose(params["permutation"]),
}
"""What NumPy does as JAX does."""


# --- Loops and branches -----------------------------------------------------------------------------------------------


def _scan(params: Any, inputs: Sequence[Block]) -> list[Block]:
    fixed, carried, length = params["num_consts"], params["num_carry"], params["length"]
    constants, carry, rows = inputs[:fixed], list(inputs[fixed : fixed + carried]), inputs[fixed + carried :]
    order = range(length - 1, -1, -1) if params["reverse"] else range(length)
    made: list[list[Block]] = []
    for index in order:
        results = _call(params["jaxpr"], [*constants, *carry, *(np.asarray(row[index]) for row in rows)])
        carry = results[:carried]
        made.append(results[carried:])
    if params["reverse"]:
        made.reverse()
    if not made:
        raise UntraceableError("the function has a loop without a step")
    return [*carry, *(np.stack(column) for column in zip(*made, strict=True))]


def _while(params: Any, inputs: Sequence[Block]) -> list[Block]:
    of_condition, of_body = params["cond_nconsts"], params["body_nconsts"]
    asked, done = inputs[:of_condition], inputs[of_condition : of_condition + of_body]
    carry = list(inputs[of_condition + of_body :])
    while True:
        (goes_on,) = _call(params["cond_jaxpr"], [*asked, *carry])
        if goes_on.dtype == object:
            raise UntraceableError(
                "the function has a loop that ends by what it computes; formulas need a fixed length"
            )
        if not goes_on:
            return carry
        carry = _call(params["body_jaxpr"], [*done, *carry])


def _cond(params: Any, inputs: Sequence[Block]) -> list[Block]:
    index, *rest = inputs
    branches = params["branches"]
    if index.dtype != object:
        return _call(branches[int(np.clip(index, 0, len(branches) - 1))], rest)
    tried = [_call(branch, rest) for branch in branches]
    return [_select_n({}, index, *cases) for cases in zip(*tried, strict=True)]


# --- What moves numbers and changes none ------------------------------------------------------------------------------

_MOVES = {
    "broadcast_in_dim": (0,),
    "concatenate": None,
    "copy": (0,),
    "dynamic_slice": (0,),
    "dynamic_update_slice": (0, 1),
    "expand_dims": (0,),
    "gather": (0,),
    "pad": (0, 1),
    "reshape": (0,),
    "rev": (0,),
    "scatter": (0, 2),
    "slice": (0,),
    "split": (0,),
    "squeeze": (0,),
    "stack": None,
    "tile": (0,),
    "transpose": (0,),
}
"""Operations that move numbers, and which of their inputs hold what is moved; without a list all."""


def _moved(equation: Any, inputs: Sequence[Block]) -> Block:
    """The operation itself, done on the numbers' places."""
    which = _MOVES[equation.primitive.name] or tuple(range(len(inputs)))
    pool: list[Value] = []
    placed: list[Block] = list(inputs)
    for index, block in enumerate(inputs):
        if index in which:
            placed[index] = np.arange(len(pool), len(pool) + block.size).reshape(block.shape)
            pool.extend(_entries(block))
        elif block.dtype == object:
            raise UntraceableError(
                f"the function takes `{equation.primitive.name}` at places that it computes from names"
            )
    places = _computed(equation, placed)
    if len(places) != 1:
        raise UntraceableError(f"the function computes `{equation.primitive.name}` with several results")
    if places[0].size and (places[0].min() < 0 or places[0].max() >= len(pool)):
        raise UntraceableError(f"the function takes `{equation.primitive.name}` outside an array")
    return _block(pool)[places[0]]


def _entries(block: Block) -> list[Value]:
    return [value if isinstance(value, Expression) else float(value) for value in block.flat]


def _block(values: Sequence[Value]) -> Block:
    block = np.empty(len(values), object)
    block[:] = values
    return block


# --- Operations on numbers --------------------------------------------------------------------------------------------


def _each(compute: Callable[..., Value]) -> Callable[..., Block]:
    """A rule for arrays from one for numbers."""

    def rule(params: Any, *blocks: Block) -> Block:
        together = np.broadcast_arrays(*blocks)
        values = [compute(*row) for row in zip(*(_entries(block) for block in together), strict=True)]
        return _block(values).reshape(together[0].shape)

    return rule


def _operation(name: str) -> Callable[..., Block]:
    return _each(lambda *values: Expression.of(name, *values))


def _truncated(x: Value) -> Value:
    size = Expression.of("floor", Expression.of("abs", x))
    return Expression.of("*", Expression.of("sign", x), size)


def _power(params: Any, base: Block) -> Block:
    exponent = int(params["y"])

    def power(value: Value) -> Value:
        result: Value = 1.0
        for _ in range(abs(exponent)):
            result = result * value
        return 1.0 / result if exponent < 0 else result

    return _each(power)({}, base) if abs(exponent) <= 4 else _operation("^")({}, base, np.asarray(float(exponent)))


def _select_n(params: Any, which: Block, *cases: Block) -> Block:
    def chosen(index: Value, *values: Value) -> Value:
        result = values[-1]
        for place in range(len(values) - 2, -1, -1):
            result = Expression.of("select", Expression.of("<=", index, float(place)), values[place], result)
        return result

    if len(cases) == 2:
        return _each(lambda index, no, yes: Expression.of("select", index, yes, no))({}, which, *cases)
    return _each(chosen)({}, which, *cases)


def _convert(params: Any, block: Block) -> Block:
    kind = np.dtype(params["new_dtype"]).kind
    if kind == "b":
        return _each(lambda x: 1.0 - Expression.of("==", x, 0.0))({}, block)
    # A condition is 1 or 0 already; other numbers become whole towards zero.
    return _each(lambda x: x if _is_whole(x) else _truncated(x))({}, block) if kind in "iu" else block


def _is_whole(value: Value) -> bool:
    return isinstance(value, Expression) and value.operation in ("<", "<=", "==", "sign", "floor")


def _reduced(combine: Callable[[Value, Value], Value]) -> Callable[..., Block]:
    def rule(params: Any, block: Block) -> Block:
        axes = tuple(params["axes"])
        kept = tuple(axis for axis in range(block.ndim) if axis not in axes)
        rows = block.transpose(kept + axes).reshape([block.shape[axis] for axis in kept] + [-1])
        return _folded(rows, combine)[..., -1]

    return rule


def _folded(rows: Block, combine: Callable[[Value, Value], Value]) -> Block:
    """What has been combined so far, along the last axis."""
    if rows.shape[-1] == 0:
        raise UntraceableError("the function reduces an array without elements")
    result = rows.astype(object)
    for index in range(1, rows.shape[-1]):
        pairs = zip(_entries(result[..., index - 1]), _entries(rows[..., index]), strict=True)
        result[..., index] = _block([combine(a, b) for a, b in pairs]).reshape(rows.shape[:-1])
    return result


def _cumulative(combine: Callable[[Value, Value], Value]) -> Callable[..., Block]:
    def rule(params: Any, block: Block) -> Block:
        rows = np.moveaxis(block, params["axis"], -1)
        if params["reverse"]:
            return np.moveaxis(_folded(rows[..., ::-1], combine)[..., ::-1], -1, params["axis"])
        return np.moveaxis(_folded(rows, combine), -1, params["axis"])

    return rule


def _sum(a: Value, b: Value) -> Value:
    return Expression.of("+", a, b)


def _dot(params: Any, left: Block, right: Block) -> Block:
    ((contract_left, contract_right), (batch_left, batch_right)) = params["dimension_numbers"]
    free_left = [axis for axis in range(left.ndim) if axis not in (*contract_left, *batch_left)]
    free_right = [axis for axis in range(right.ndim) if axis not in (*contract_right, *batch_right)]
    a = left.transpose(*batch_left, *free_left, *contract_left)
    b = right.transpose(*batch_right, *free_right, *contract_right)
    batch, rows = a.shape[: len(batch_left)], a.shape[len(batch_left) : len(batch_left) + len(free_left)]
    columns = b.shape[len(batch_right) : len(batch_right) + len(free_right)]
    depth = math.prod(left.shape[axis] for axis in contract_left)
    a = a.reshape(math.prod(batch), math.prod(rows), depth)
    b = b.reshape(math.prod(batch), math.prod(columns), depth)
    sums = []
    for of_left, of_right in zip(a, b, strict=True):
        for row in of_left:
            for column in of_right:
                total: Value = 0.0
                for x, y in zip(_entries(row), _entries(column), strict=True):
                    total = _sum(total, Expression.of("*", x, y))
                sums.append(total)
    return _block(sums).reshape((*batch, *rows, *columns))


def _scatter_add(equation: Any, inputs: Sequence[Block]) -> Block:
    """Where each update goes is what the operation does with it alone."""
    operand, indices, updates = inputs
    if indices.dtype == object:
        raise UntraceableError("the function takes `scatter-add` at places that it computes from names")
    kind = equation.outvars[0].aval.dtype
    alone = jnp.eye(updates.size, dtype=kind).reshape(updates.size, *updates.shape)
    zeros = jnp.zeros(operand.shape, kind)
    places = np.asarray(
        jax.vmap(lambda one: equation.primitive.bind(zeros, jnp.asarray(indices), one, **equation.params))(alone)
    )
    result = _block(_entries(operand))
    for one, value in zip(places.reshape(updates.size, -1), _entries(updates), strict=True):
        for place in np.flatnonzero(one):
            result[place] = _sum(result[place], value)
    return result.reshape(operand.shape)


def _cholesky(params: Any, block: Block) -> Block:
    """The lower factor, by columns (Golub and Van Loan, "Matrix Computations", algorithm 4.2.1)."""
    size = block.shape[-1]
    result = np.zeros(block.shape, object)
    for matrix, factor in zip(block.reshape(-1, size, size), result.reshape(-1, size, size), strict=True):
        for j in range(size):
            for i in range(j, size):
                value = _entries(matrix[i : i + 1, j])[0]
                for k in range(j):
                    value = value - factor[i, k] * factor[j, k]
                factor[i, j] = Expression.of("sqrt", value) if i == j else value / factor[j, j]
    return result


def _triangular_solve(params: Any, matrix: Block, right: Block) -> Block:
    """`x` of `a x = b` or `x a = b`, by substitution."""
    size = matrix.shape[-1]
    lower, turned = params["lower"], params["transpose_a"]
    if not params["left_side"]:
        return np.swapaxes(
            _triangular_solve(
                {**params, "left_side": True, "transpose_a": not turned}, matrix, np.swapaxes(right, -1, -2)
            ),
            -1,
            -2,
        )
    if turned:
        matrix, lower = np.swapaxes(matrix, -1, -2), not lower
    result = right.astype(object)
    for a, x in zip(matrix.reshape(-1, size, size), result.reshape(-1, size, right.shape[-1]), strict=True):
        for i in range(size) if lower else range(size - 1, -1, -1):
            for column in range(x.shape[-1]):
                value = _entries(x[i : i + 1, column])[0]
                for k in range(i) if lower else range(i + 1, size):
                    value = value - a[i, k] * x[k, column]
                x[i, column] = value if params["unit_diagonal"] else value / _entries(a[i : i + 1, i])[0]
    return result


def _of_one(compute: Callable[[Value], Value]) -> Callable[..., Block]:
    return _each(compute)


_RULES: dict[str, Callable[..., Block]] = {
    **{name: _operation(name) for name in UNARY},
    "add": _operation("+"),
    "add_any": _operation("+"),
    "sub": _operation("-"),
    "mul": _operation("*"),
    "div": _operation("/"),
    "pow": _operation("^"),
    "neg": _operation("neg"),
    "max": _operation("max"),
    "min": _operation("min"),
    "atan2": _operation("atan2"),
    "rem": _each(lambda x, y: Expression.of("-", x, Expression.of("*", y, _truncated(Expression.of("/", x, y))))),
    "clamp": _each(lambda low, x, high: Expression.of("min", Expression.of("max", x, low), high)),
    "integer_pow": _power,
    "square": _of_one(lambda x: Expression.of("*", x, x)),
    "rsqrt": _of_one(lambda x: Expression.of("/", 1.0, Expression.of("sqrt", x))),
    "log1p": _of_one(lambda x: Expression.of("log", 1.0 + x)),
    "expm1": _of_one(lambda x: Expression.of("-", Expression.of("exp", x), 1.0)),
    "logistic": _of_one(lambda x: 1.0 / (1.0 + Expression.of("exp", Expression.of("neg", x)))),
    "sinh": _of_one(lambda x: (Expression.of("exp", x) - Expression.of("exp", Expression.of("neg", x))) / 2.0),
    "cosh": _of_one(lambda x: (Expression.of("exp", x) + Expression.of("exp", Expression.of("neg", x))) / 2.0),
    "round": _of_one(lambda x: Expression.of("floor", x + 0.5)),
    "ceil": _of_one(lambda x: Expression.of("neg", Expression.of("floor", Expression.of("neg", x)))),
    "is_finite": _of_one(lambda x: 1.0),
    "stop_gradient": _of_one(lambda x: x),
    "convert_element_type": _convert,
    "reduce_precision": _of_one(lambda x: x),
    "optimization_barrier": _of_one(lambda x: x),
    "lt": _operation("<"),
    "le": _operation("<="),
    "eq": _operation("=="),
    "gt": _each(lambda x, y: Expression.of("<", y, x)),
    "ge": _each(lambda x, y: Expression.of("<=", y, x)),
    "ne": _each(lambda x, y: 1.0 - Expression.of("==", x, y)),
    "and": _operation("*"),
    "or": _operation("max"),
    "not": _of_one(lambda x: 1.0 - x),
    "select_n": _select_n,
    "reduce_sum": _reduced(_sum),
    "reduce_prod": _reduced(lambda a, b: Expression.of("*", a, b)),
    "reduce_max": _reduced(lambda a, b: Expression.of("max", a, b)),
    "reduce_min": _reduced(lambda a, b: Expression.of("min", a, b)),
    "reduce_and": _reduced(lambda a, b: Expression.of("*", a, b)),
    "reduce_or": _reduced(lambda a, b: Expression.of("max", a, b)),
    "cumsum": _cumulative(_sum),
    "dot_general": _dot,
    "cholesky": _cholesky,
    "triangular_solve": _triangular_solve,
}
"""What operations do with formulas."""
