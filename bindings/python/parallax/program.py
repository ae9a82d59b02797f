"""Programs as JAX functions.

A `Program` is a computation that the Rust side wrote down: a node's model, an integration step, the equations of a
`system.toml`. Here a small interpreter binds its operations to `lax` primitives, so that it works under `jit`, `vmap`,
`grad` and `scan`, on every device, as fast as the same formulas written by hand.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from . import _native, scalar
from .types import Array, Floats, Scalar

__all__ = ["Program"]

UNROLL = 1024
"""Loops of at most this many operations in all are written out: small loops inside a step cost more than they save."""


@dataclass
class _Element:
    """One number of a loop's results, not taken out of its array until something needs it alone."""

    array: Array
    index: int
    value: Array | None = None

    def take(self) -> Array:
        if self.value is None:
            self.value = self.array[self.index]
        return self.value


@dataclass
class _Reciprocal:
    """`1 / of`. A product with it is written as a quotient: XLA fuses products into each of their users and computes
    what comes before, sines included, again for every one; a quotient it computes once."""

    of: Array

    def take(self) -> Array:
        return lax.div(np.asarray(1.0, self.of.dtype), self.of)


class Program:
    """A computation with named inputs and outputs.

    Call it with one number, or one array, per input, in order; it returns a list with one entry per output. Arrays are
    broadcast against each other. Python floats are folded into the computation and do not raise its precision.
    """

    def __init__(self, native: _native.Program) -> None:
        self._native = native
        content = json.loads(native.json())
        self.inputs: list[str] = content["inputs"]
        """The names of the inputs, in order."""
        self.outputs: list[str] = content["outputs"]
        """The names of the outputs, in order."""
        self._functions = [_Function(function, index) for index, function in enumerate(content["functions"])]
        for function in self._functions:
            function.size = function.own_size(self._functions)

    @classmethod
    def from_json(cls, text: str) -> Program:
        """The program that `json` wrote."""
        return cls(_native.Program(text))

    def json(self) -> str:
        """The program as text, which `from_json` reads."""
        return self._native.json()

    @property
    def name(self) -> str:
        """The name of what it computes."""
        return self._functions[-1].name

    def __repr__(self) -> str:
        return f"Program({self.name!r}, {len(self.inputs)} inputs, {len(self.outputs)} outputs)"

    @cached_property
    def needed(self) -> frozenset[int]:
        """The inputs that some output depends on, by place."""
        body = self._functions[-1]
        return frozenset(value for value in body.live(range(len(self.outputs)))[1] if value < len(self.inputs))

    def needed_for(self, outputs: Iterable[int]) -> frozenset[int]:
        """The inputs that these outputs depend on, by place."""
        return frozenset(value for value in self._functions[-1].live(outputs)[1] if value < len(self.inputs))

    def evaluate(self, inputs: Floats) -> Floats:
        """The outputs in f64, computed in Rust: `[n, inputs]` to `[n, outputs]`."""
        return self._native.evaluate(np.ascontiguousarray(inputs, dtype=np.float64))

    def jacobian(self, inputs: Floats, wrt: Sequence[int]) -> Floats:
        """The exact derivatives in f64, computed in Rust: `[outputs, len(wrt)]`."""
        return self._native.jacobian(np.ascontiguousarray(inputs, dtype=np.float64), list(wrt))

    def __call__(self, *inputs: Scalar, outputs: Sequence[int] | None = None) -> list[Scalar]:
        """The outputs (all, or those at these places) at these inputs."""
        if len(inputs) != len(self.inputs):
            raise TypeError(f"{self!r} is called with {len(inputs)} inputs")
        wanted = list(range(len(self.outputs))) if outputs is None else list(outputs)
        values = [value if isinstance(value, float | int) else jnp.asarray(value) for value in inputs]
        shape = jnp.broadcast_shapes(*(np.shape(value) for value in values))
        arrays = [value for value in values if not isinstance(value, float | int)]
        dtype = jnp.result_type(*arrays) if arrays else None
        if dtype is not None and not jnp.issubdtype(dtype, jnp.floating):
            dtype = jnp.result_type(float)
        if dtype is not None:
            values = [v if isinstance(v, float | int) else lax.convert_element_type(v, dtype) for v in values]
        values = [float(v) if isinstance(v, int) else v for v in values]
        run = partial(self._run, wanted=wanted)
        axes = tuple(0 if np.ndim(value) else None for value in values)
        values = [jnp.broadcast_to(value, shape) if np.ndim(value) else value for value in values]
        for _ in shape:
            run = jax.vmap(run, in_axes=axes)
        return run(*values)

    def bind(self, values: Mapping[str, Scalar]) -> dict[str, Scalar]:
        """The outputs by name, from the inputs by name."""
        unknown = values.keys() - set(self.inputs)
        missing = [name for name in self.inputs if name not in values]
        if unknown or missing:
            raise TypeError(f"{self!r}: unknown inputs {sorted(unknown)}, missing inputs {missing}")
        return dict(zip(self.outputs, self(*(values[name] for name in self.inputs)), strict=True))

    def _run(self, *inputs: Scalar, wanted: Sequence[int]) -> list[Scalar]:
        """On scalars of one dtype."""
        dtype = next((value.dtype for value in inputs if not isinstance(value, float)), None)
        machine = _Machine(self._functions, dtype)
        results = machine.run(self._functions[-1], list(inputs), tuple(wanted))
        return [value if isinstance(value, float) else machine.number(value) for value in results]


class _Function:
    """A list of operations, and what is known of it before it runs."""

    def __init__(self, content: Mapping[str, Any], index: int) -> None:
        self.index = index
        self.name: str = content["name"]
        self.inputs: int = content["inputs"]
        self.outputs: list[int] = content["outputs"]
        self.ops: list[tuple[str, Any]] = [next(iter(op.items())) for op in content["ops"]]
        self.size = 0
        self._live: dict[tuple[int, ...], tuple[list[bool], frozenset[int]]] = {}
        self._guarded: list[bool] | None = None
        self.firsts: list[int] = []

    def own_size(self, functions: list[_Function]) -> int:
        """How many operations one run takes; also numbers the operations' results."""
        size, value = 0, self.inputs
        for name, op in self.ops:
            self.firsts.append(value)
            count, cost = 1, 1
            if name == "call":
                callee = functions[op["function"]]
                count, cost = len(callee.outputs), callee.size
            elif name in ("scan", "map"):
                callee = functions[op["function"]]
                carry = len(op.get("carry", ()))
                count, cost = carry + (len(callee.outputs) - carry) * op["length"], callee.size * op["length"]
            value += count
            size += cost
        self.firsts.append(value)
        return size

    def live(self, wanted: Iterable[int]) -> tuple[list[bool], frozenset[int]]:
        """For the outputs at these places: which operations must run, and which values are read."""
        key = tuple(wanted)
        if key not in self._live:
            read = {self.outputs[place] for place in key}
            run = [False] * len(self.ops)
            for place in range(len(self.ops) - 1, -1, -1):
                if any(value in read for value in range(self.firsts[place], self.firsts[place + 1])):
                    run[place] = True
                    read.update(_operands(*self.ops[place]))
            self._live[key] = run, frozenset(read)
        return self._live[key]

    def guarded(self) -> list[bool]:
        """Which operations a `select` may leave out: their derivatives must be finite."""
        if self._guarded is None:
            chosen: set[int] = set()
            self._guarded = [False] * len(self.ops)
            for place in range(len(self.ops) - 1, -1, -1):
                name, op = self.ops[place]
                if name == "select":
                    chosen.update(op[1:])
                if any(value in chosen for value in range(self.firsts[place], self.firsts[place + 1])):
                    self._guarded[place] = True
                    chosen.update(_operands(name, op))
        return self._guarded


def _operands(name: str, op: Any) -> list[int]:
    match name:
        case "constant":
            return []
        case "unary":
            return [op[1]]
        case "binary" | "compare":
            return [op[1], op[2]]
        case "powi":
            return [op[0]]
        case "not":
            return [op]
        case "and" | "or" | "select":
            return list(op)
        case "call":
            return list(op["inputs"])
        case _:
            return [*op.get("carry", ()), *op["xs"], *op["captures"]]


class _Machine:
    """Runs functions on JAX numbers of one dtype; numbers that are known stay Python floats."""

    def __init__(self, functions: list[_Function], dtype: Any, guard: bool = False) -> None:
        self.functions = functions
        self.dtype = dtype
        self.guard = guard

    def number(self, value: Scalar) -> Array:
        """As a number of the common dtype."""
        if isinstance(value, _Element | _Reciprocal):
            return value.take()
        if isinstance(value, float):
            return np.asarray(value, self.dtype)  # type: ignore[return-value]
        return value

    def run(self, function: _Function, inputs: list[Scalar], wanted: tuple[int, ...] | None = None) -> list[Scalar]:
        values: list[Scalar] = list(inputs)
        outputs = range(len(function.outputs)) if wanted is None else wanted
        live, _ = function.live(outputs)
        guarded = function.guarded()
        for place, (name, op) in enumerate(function.ops):
            if not live[place]:
                values.extend([None] * (function.firsts[place + 1] - function.firsts[place]))
                continue
            guard = self.guard or guarded[place]
            match name:
                case "constant":
                    values.append(float(op))
                case "unary":
                    values.append(self.unary(op[0], values[op[1]], guard))
                case "binary":
                    values.append(self.binary(op[0], values[op[1]], values[op[2]], guard))
                case "powi":
                    values.append(self.powi(values[op[0]], op[1]))
                case "compare":
                    values.append(self.compare(op[0], values[op[1]], values[op[2]]))
                case "and":
                    values.append(self.mask(lambda a, b: a & b, values[op[0]], values[op[1]]))
                case "or":
                    values.append(self.mask(lambda a, b: a | b, values[op[0]], values[op[1]]))
                case "not":
                    mask = values[op]
                    values.append(not mask if isinstance(mask, bool) else lax.bitwise_not(mask))
                case "select":
                    values.append(self.select(*(values[operand] for operand in op)))
                case "call":
                    values.extend(
                        self.inner(guard).run(self.functions[op["function"]], [values[i] for i in op["inputs"]])
                    )
                case "scan":
                    values.extend(self.inner(guard).scan(op, values))
                case "map":
                    values.extend(self.inner(guard).map(op, values))
        return [values[function.outputs[place]] for place in outputs]

    def inner(self, guard: bool) -> _Machine:
        return self if guard == self.guard else _Machine(self.functions, self.dtype, guard)

    def unary(self, name: str, a: Scalar, guard: bool) -> Scalar:
        if isinstance(a, float):
            try:
                return scalar.FOLD_UNARY[name](a)
            except (ValueError, OverflowError):
                a = np.asarray(a, self.dtype or np.float64)
                return lax.convert_element_type(scalar.unary(name, guard)(a), a.dtype)
        return scalar.unary(name, guard)(self.number(a))

    def binary(self, name: str, a: Scalar, b: Scalar, guard: bool) -> Scalar:
        if isinstance(a, float) and isinstance(b, float):
            try:
                return scalar.FOLD_BINARY[name](a, b)
            except (ValueError, OverflowError):
                dtype = self.dtype or np.float64
                return scalar.binary(name, guard)(np.asarray(a, dtype), np.asarray(b, dtype))  # type: ignore[arg-type]
        if name == "div" and isinstance(a, float) and a == 1.0 and not guard:
            return _Reciprocal(self.number(b))
        if name == "mul" and isinstance(b, _Reciprocal) and not isinstance(a, _Reciprocal):
            return lax.div(self.number(a), b.of)
        if name == "mul" and isinstance(a, _Reciprocal) and not isinstance(b, _Reciprocal):
            return lax.div(self.number(b), a.of)
        return scalar.binary(name, guard)(self.number(a), self.number(b))

    def powi(self, a: Scalar, exponent: int) -> Scalar:
        if isinstance(a, float) and not (a == 0.0 and exponent < 0):
            return a**exponent
        return scalar.powi(self.number(a), exponent)

    def compare(self, name: str, a: Scalar, b: Scalar) -> Scalar:
        if not (isinstance(a, float) and isinstance(b, float)):
            a, b = self.number(a), self.number(b)
        return scalar.COMPARE[name](a, b)

    def mask(self, combine: Any, a: Scalar, b: Scalar) -> Scalar:
        return combine(a, b)

    def select(self, mask: Scalar, then: Scalar, otherwise: Scalar) -> Scalar:
        if isinstance(mask, bool):
            return then if mask else otherwise
        return lax.select(mask, self.wide(then, mask), self.wide(otherwise, mask))

    def wide(self, value: Scalar, mask: Scalar) -> Array:
        value = self.number(value)
        return jnp.asarray(value, self.dtype if np.ndim(value) == 0 else None)

    def rows(self, operands: list[int], values: list[Scalar], length: int) -> Array | Floats | None:
        """Numbers for all steps of a loop as an array `[length, n]`."""
        if not operands:
            return None
        numbers = [values[operand] for operand in operands]
        first = numbers[0]
        if isinstance(first, _Element) and all(
            isinstance(number, _Element) and number.array is first.array and number.index == first.index + offset
            for offset, number in enumerate(numbers)
        ):
            run = first.array[first.index : first.index + len(numbers)]
            return run.reshape(length, -1)
        if all(isinstance(number, float) for number in numbers):
            return np.asarray(numbers, self.dtype).reshape(length, -1)
        return jnp.stack([jnp.asarray(self.number(number)) for number in numbers]).reshape(length, -1)

    def scan(self, op: Mapping[str, Any], values: list[Scalar]) -> list[Scalar]:
        function, length = self.functions[op["function"]], op["length"]
        carry = [values[operand] for operand in op["carry"]]
        captures = [values[operand] for operand in op["captures"]]
        nc = len(carry)
        if length == 0:
            return carry
        if function.size * length <= UNROLL or self.dtype is None:
            nx = len(op["xs"]) // length
            ys: list[Scalar] = []
            for step in range(length):
                xs = [values[operand] for operand in op["xs"][step * nx : (step + 1) * nx]]
                results = self.run(function, [*carry, *xs, *captures])
                carry = results[:nc]
                ys.extend(results[nc:])
            return [*carry, *ys]
        fixed = [capture if isinstance(capture, float) else self.number(capture) for capture in captures]

        def body(carry: tuple[Array, ...], x: Any) -> tuple[tuple[Array, ...], Array | None]:
            xs = [] if x is None else [x[place] for place in range(x.shape[0])]
            results = [
                jnp.asarray(self.number(value), self.dtype) for value in self.run(function, [*carry, *xs, *fixed])
            ]
            return tuple(results[:nc]), jnp.stack(results[nc:]) if len(results) > nc else None

        start = tuple(jnp.asarray(self.number(value), self.dtype) for value in carry)
        last, stacked = lax.scan(body, start, self.rows(op["xs"], values, length), length=length)
        return [*last, *_elements(stacked)]

    def map(self, op: Mapping[str, Any], values: list[Scalar]) -> list[Scalar]:
        function, length = self.functions[op["function"]], op["length"]
        captures = [values[operand] for operand in op["captures"]]
        if length == 0:
            return []
        nx = len(op["xs"]) // length
        if function.size * length <= UNROLL or self.dtype is None or not op["xs"]:
            ys: list[Scalar] = []
            for step in range(length):
                xs = [values[operand] for operand in op["xs"][step * nx : (step + 1) * nx]]
                ys.extend(self.run(function, [*xs, *captures]))
            return ys
        fixed = [capture if isinstance(capture, float) else self.number(capture) for capture in captures]

        def body(x: Any) -> Array:
            results = self.run(function, [*(x[place] for place in range(nx)), *fixed])
            return jnp.stack([jnp.asarray(self.number(value), self.dtype) for value in results])

        return _elements(jax.vmap(body)(self.rows(op["xs"], values, length)))


def _elements(stacked: Array | None) -> list[Scalar]:
    """The numbers of `[length, n]`, row after row."""
    if stacked is None:
        return []
    flat = stacked.reshape(-1)
    return [_Element(flat, index) for index in range(flat.shape[0])]
