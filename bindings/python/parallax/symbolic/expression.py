"""Formulas of single numbers: sums, products and functions of names, each there once, as `system.toml` writes them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import ClassVar
from weakref import WeakValueDictionary

__all__ = ["Expression", "Formulas", "Value"]

LONGEST = 120
"""A formula of more characters is cut into named parts."""

UNARY = ("sin", "cos", "tan", "asin", "acos", "atan", "exp", "log", "sqrt", "abs", "sign", "tanh", "floor")
"""Functions of one value that a `system.toml` knows."""

_FOLD: dict[str, Callable[..., float]] = {
    **{name: getattr(math, name) for name in UNARY if hasattr(math, name)},
    "abs": abs,
    "sign": lambda x: float((x > 0) - (x < 0)),
    "+": lambda a, b: a + b,
    "-": lambda a, b: a - b,
    "*": lambda a, b: a * b,
    "/": lambda a, b: a / b,
    "^": lambda a, b: a**b,
    "<": lambda a, b: float(a < b),
    "<=": lambda a, b: float(a <= b),
    "==": lambda a, b: float(a == b),
    "min": min,
    "max": max,
    "atan2": math.atan2,
}

_LEVEL = {"<": 0, "<=": 0, "==": 0, "+": 1, "-": 1, "*": 2, "/": 2, "neg": 3, "^": 4}
"""How tightly operators bind."""
_WHOLE = 5


@dataclass(frozen=True, eq=False)
class Expression:
    """A formula: an operation and what it is applied to, or a name. `Expression.of` makes them; equal ones are one."""

    operation: str
    """An operator, a function, or `name`."""
    arguments: tuple[Value, ...]
    """What it is applied to; of a name its text."""
    name: str = ""

    _known: ClassVar[WeakValueDictionary[tuple[str, str, tuple[Value, ...]], Expression]] = WeakValueDictionary()

    @classmethod
    def symbol(cls, name: str) -> Expression:
        """A name."""
        return cls._one("name", (), name)

    @classmethod
    def of(cls, operation: str, *arguments: Value) -> Value:
        """An operation on values: folded where all are numbers, and where it changes nothing.

        A product with zero is zero, whatever the other factor: formulas of machines are finite.
        """
        if all(isinstance(argument, float) for argument in arguments) and operation in _FOLD:
            try:
                return float(_FOLD[operation](*arguments))
            except (ValueError, ZeroDivisionError, OverflowError):
                return math.nan
        simple = _simplified(operation, arguments)
        return cls._one(operation, arguments) if simple is None else simple

    @classmethod
    def _one(cls, operation: str, arguments: tuple[Value, ...], name: str = "") -> Expression:
        key = (operation, name, arguments)
        expression = cls._known.get(key)
        if expression is None:
            expression = cls._known[key] = cls(operation, arguments, name)
        return expression

    def __add__(self, other: Value) -> Value:
        return Expression.of("+", self, _value(other))

    def __radd__(self, other: Value) -> Value:
        return Expression.of("+", _value(other), self)

    def __sub__(self, other: Value) -> Value:
        return Expression.of("-", self, _value(other))

    def __rsub__(self, other: Value) -> Value:
        return Expression.of("-", _value(other), self)

    def __mul__(self, other: Value) -> Value:
        return Expression.of("*", self, _value(other))

    def __rmul__(self, other: Value) -> Value:
        return Expression.of("*", _value(other), self)

    def __truediv__(self, other: Value) -> Value:
        return Expression.of("/", self, _value(other))

    def __rtruediv__(self, other: Value) -> Value:
        return Expression.of("/", _value(other), self)

    def __neg__(self) -> Value:
        return Expression.of("neg", self)


Value = float | Expression
"""A number that is known, or a formula."""


def _value(value: Value) -> Value:
    return value if isinstance(value, Expression) else float(value)


def _simplified(operation: str, arguments: tuple[Value, ...]) -> Value | None:
    """What an operation comes to where it changes nothing; none where it does."""
    a, b = arguments[0], arguments[-1]
    match operation:
        case "neg":
            return a.arguments[0] if isinstance(a, Expression) and a.operation == "neg" else None
        case "+":
            if a == 0.0 or b == 0.0:
                return b if a == 0.0 else a
            if isinstance(b, Expression) and b.operation == "neg":
                return Expression.of("-", a, b.arguments[0])
        case "-":
            if b == 0.0 or a is b:
                return a if b == 0.0 else 0.0
            if a == 0.0:
                return Expression.of("neg", b)
            if isinstance(b, Expression) and b.operation == "neg":
                return Expression.of("+", a, b.arguments[0])
        case "*":
            return _product(a, b)
        case "/":
            if a == 0.0 or b == 1.0:
                return a
            if b == -1.0:
                return Expression.of("neg", a)
            if isinstance(a, Expression) and a.operation == "neg":
                return Expression.of("neg", Expression.of("/", a.arguments[0], b))
        case "^":
            if b == 0.0 or b == 1.0:
                return 1.0 if b == 0.0 else a
        case "min" | "max":
            none = math.inf if operation == "min" else -math.inf
            return a if a is b or b == none else b if a == none else None
        case "<" | "<=":
            if a == -math.inf or b == math.inf:
                return 1.0
            return 0.0 if a == math.inf or b == -math.inf else None
        case "select":
            _, yes, no = arguments
            if isinstance(a, float):
                return yes if a != 0.0 else no
            return yes if yes == no else None
    return None


def _product(a: Value, b: Value) -> Value | None:
    if a == 0.0 or b == 0.0:
        return 0.0
    if a == 1.0 or b == 1.0:
        return b if a == 1.0 else a
    if a == -1.0 or b == -1.0:
        return Expression.of("neg", b if a == -1.0 else a)
    # A sign goes outward, where it may meet another, and numbers go first, where they meet each other.
    for first, second in ((a, b), (b, a)):
        if isinstance(first, Expression) and first.operation == "neg":
            return Expression.of("neg", Expression.of("*", first.arguments[0], second))
    if isinstance(b, float):
        return Expression.of("*", b, a)
    if isinstance(a, float) and b.operation == "*" and isinstance(b.arguments[0], float):
        return Expression.of("*", a * b.arguments[0], b.arguments[1])
    return None


class Formulas:
    """Named formulas as text. What is used more than once, or is long, becomes a named part of its own."""

    def __init__(self, named: Mapping[str, Value], reserved: Iterable[str] = (), prefix: str = "t") -> None:
        """`named` are the formulas, by name; a part gets a name of `prefix` and a number that is not in `reserved`."""
        self.parts: dict[str, str] = {}
        """The parts, each before those that use it."""
        self._taken = {*named, *reserved}
        self._prefix = prefix
        self._texts: dict[int, tuple[str, int]] = {}
        uses: Counter[int] = Counter()
        order = _ordered(named.values(), uses)
        for expression in order:
            text, level = self._text(expression)
            if expression.operation != "name" and (uses[id(expression)] > 1 or len(text) > LONGEST):
                name = self._next()
                self.parts[name] = text
                text, level = name, _WHOLE
            self._texts[id(expression)] = (text, level)
        self.texts: dict[str, str] = {name: self._of(value)[0] for name, value in named.items()}
        """The formulas, by the names given."""

    def _next(self) -> str:
        number = len(self.parts) + 1
        while f"{self._prefix}{number}" in self._taken:
            number += 1
        self._taken.add(f"{self._prefix}{number}")
        return f"{self._prefix}{number}"

    def _of(self, value: Value) -> tuple[str, int]:
        if isinstance(value, Expression):
            return self._texts[id(value)]
        return _number(value), _WHOLE if value >= 0 else _LEVEL["neg"]

    def _text(self, expression: Expression) -> tuple[str, int]:
        operation, parts = expression.operation, [self._of(argument) for argument in expression.arguments]
        if operation == "name":
            return expression.name, _WHOLE
        if operation not in _LEVEL:
            return f"{operation}({', '.join(text for text, _ in parts)})", _WHOLE
        level = _LEVEL[operation]
        if operation == "neg":
            return "-" + _within(parts[0], level), level
        # `a - (b - c)` and `(a ^ b) ^ c` need their parentheses; a comparison stands alone.
        left = level + 1 if operation in ("^", "<", "<=", "==") else level
        right = level if operation in ("+", "*", "^") else level + 1
        space = "" if level > _LEVEL["+"] else " "
        second = _within(parts[1], right)
        second = f"({second})" if second.startswith("-") else second
        return f"{_within(parts[0], left)}{space}{operation}{space}{second}", level


def _within(part: tuple[str, int], level: int) -> str:
    text, own = part
    return text if own >= level else f"({text})"


def _number(value: float) -> str:
    if not math.isfinite(value):
        raise ValueError(
            f"a formula holds {value}: the function divides by zero, or takes the root of a negative number"
        )
    return repr(int(value)) if value == int(value) and abs(value) < 1e15 else repr(value)


def _ordered(values: Iterable[Value], uses: Counter[int]) -> list[Expression]:
    """All formulas, each after its parts; counts who uses each."""
    order: list[Expression] = []
    seen: set[int] = set()
    # Formulas can be thousands deep: no recursion.
    stack: list[tuple[Value, bool]] = [(value, False) for value in reversed(list(values))]
    while stack:
        value, done = stack.pop()
        if not isinstance(value, Expression):
            continue
        if done:
            order.append(value)
            continue
        uses[id(value)] += 1
        if id(value) not in seen:
            seen.add(id(value))
            stack.append((value, True))
            stack.extend((argument, False) for argument in reversed(value.arguments))
    return order
