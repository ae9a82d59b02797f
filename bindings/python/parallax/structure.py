"""Messages between interpreters: what a pytree of arrays is as numbered leaves, and back.

A message in Parallax is a list of named numbers. A node in Python sends any pytree of arrays that is made of
dictionaries, lists, tuples, named tuples and dataclasses; a `Structure` says how its numbers are named and what the
pytree is that they make. It stands in the graph as data (`Structure.json`), so that a receiver in another process sees
what the sender sent, and what a compiled graph hands over.

The names are those of Rust's trees: `{"position": {"x": 1.0}, "motor": zeros(2)}` has the leaves `position.x`,
`motor_0` and `motor_1`; what has no name of its own is called `value`.
"""

from __future__ import annotations

import dataclasses
import importlib
import itertools
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .types import Scalar, Tree

__all__ = ["Structure", "class_place", "found_class", "named"]

_ALONE = "value"
"""What a leaf without a name is called."""
_KINDS = "dictionaries with text as keys, lists, tuples, named tuples and dataclasses"


@dataclass(frozen=True)
class _Leaf:
    """One array."""

    name: str
    shape: tuple[int, ...]
    dtype: str

    def names(self) -> list[str]:
        """The names of its numbers, row by row."""
        if not self.shape:
            return [self.name]
        return ["_".join([self.name, *map(str, index)]) for index in itertools.product(*map(range, self.shape))]


class Structure:
    """The structure of a pytree of arrays, and the names of its numbers."""

    def __init__(self, description: Any) -> None:
        """`description` is what `json` gives."""
        self._description = description
        self._leaves: list[_Leaf] = []
        self._collect(description, "")
        self.names: list[str] = [name for leaf in self._leaves for name in leaf.names()]
        """The names of the numbers, in the order in which a pytree has them."""
        twice = sorted({name for name in self.names if self.names.count(name) > 1})
        if twice:
            raise TypeError(f"two numbers of the message would be called {', '.join(twice)}; rename one of them")

    @classmethod
    def of(cls, tree: Tree) -> Structure:
        """That of an example: arrays, numbers, or what has a shape and a type (`jax.eval_shape`)."""
        return cls(_describe(tree))

    def json(self) -> Any:
        """As data: `float32` or `float32[3]` for an array, an object for a dictionary, a list that begins with `list`,
        `tuple` or a class for the others."""
        return self._description

    @property
    def is_plain(self) -> bool:
        """Whether it is a (nested) dictionary of single floating-point numbers, as the messages of Rust are."""
        return isinstance(self._description, dict) and _plain(self._description)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Structure) and self._description == other._description

    def __hash__(self) -> int:
        return hash(repr(self._description))

    @property
    def integers(self) -> list[str]:
        """The names of the numbers that are whole or logical, for which single precision is not enough."""
        return [
            name
            for leaf in self._leaves
            if not jnp.issubdtype(np.dtype(leaf.dtype), jnp.floating)
            for name in leaf.names()
        ]

    def build(self, number: Callable[[str], Scalar], traced: bool) -> Tree:
        """The pytree whose numbers `number` gives by their names: of JAX arrays, or else of numpy arrays and numbers of
        Python."""

        def leaf(about: _Leaf) -> Any:
            values = [number(name) for name in about.names()]
            if traced:
                # A number of Python, which is of double precision, is what JAX takes it for.
                dtype = jax.dtypes.canonicalize_dtype(about.dtype)
                if not about.shape:
                    return jnp.asarray(values[0], dtype)
                if not values:
                    return jnp.zeros(about.shape, dtype)
                return jnp.stack([jnp.asarray(value) for value in values]).reshape(about.shape).astype(dtype)
            array = np.asarray(values, np.float64).reshape(about.shape).astype(about.dtype)
            return array if about.shape else array.item()

        leaves = iter(self._leaves)
        return self._made(self._description, lambda: leaf(next(leaves)))

    def columns(self, table: np.ndarray, names: Sequence[str]) -> Tree:
        """The pytree with a leading axis `[message]`, from a table `[message, number]` whose columns have these names.

        Its arrays are views of the table wherever their numbers are `float64` and lie side by side, which they do in a
        message that a node in Python sends.
        """
        place = {name: index for index, name in enumerate(names)}

        def leaf(about: _Leaf) -> Any:
            columns = [place[name] for name in about.names()]
            first = columns[0] if columns else 0
            side_by_side = columns == list(range(first, first + len(columns)))
            values = table[:, first : first + len(columns)] if side_by_side else table[:, columns]
            shaped = values.reshape((len(table), *about.shape)) if about.shape else values[:, 0]
            return shaped.astype(about.dtype, copy=False) if about.dtype not in ("float32", "float64") else shaped

        leaves = iter(self._leaves)
        return self._made(self._description, lambda: leaf(next(leaves)))

    def _collect(self, description: Any, name: str) -> None:
        match description:
            case "none":
                pass
            case str():
                dtype, _, shape = description.rstrip("]").partition("[")
                sizes = tuple(int(size) for size in shape.split(",") if size)
                self._leaves.append(_Leaf(name or _ALONE, sizes, dtype))
            case dict():
                for key, part in description.items():
                    self._collect(part, f"{name}.{key}" if name else key)
            case ["list" | "tuple", *parts]:
                for index, part in enumerate(parts):
                    self._collect(part, f"{name or _ALONE}_{index}")
            case [str(), dict(fields), *_]:
                self._collect(fields, name)
            case _:
                raise TypeError(f"{description!r} describes no pytree")

    def _made(self, description: Any, leaf: Callable[[], Any]) -> Tree:
        match description:
            case "none":
                return None
            case str():
                return leaf()
            case dict():
                return {key: self._made(part, leaf) for key, part in description.items()}
            case ["list", *parts]:
                return [self._made(part, leaf) for part in parts]
            case ["tuple", *parts]:
                return tuple(self._made(part, leaf) for part in parts)
            case [place, fields, *rest]:
                made = {key: self._made(part, leaf) for key, part in fields.items()}
                return found_class(place)(**made, **(rest[0] if rest else {}))
            case _:
                raise TypeError(f"{description!r} describes no pytree")


def _plain(description: Any) -> bool:
    if isinstance(description, dict):
        return all(_plain(part) for part in description.values())
    return description in ("float32", "float64")


def _describe(tree: Any) -> Any:
    match tree:
        case None:
            return "none"
        case dict():
            for key in tree:
                if not isinstance(key, str) or not key or "." in key:
                    raise TypeError(f"a message cannot have the key {key!r}; keys are text without dots")
            # As JAX flattens it.
            return {key: _describe(tree[key]) for key in sorted(tree)}
        case list():
            return ["list", *map(_describe, tree)]
        case tuple() if hasattr(tree, "_fields"):
            return [class_place(type(tree)), {field: _describe(getattr(tree, field)) for field in tree._fields}]
        case tuple():
            return ["tuple", *map(_describe, tree)]
    if dataclasses.is_dataclass(tree) and not isinstance(tree, type):
        return _describe_dataclass(tree)
    if not jax.tree_util.all_leaves([tree]):
        raise TypeError(f"a message cannot hold a {type(tree).__qualname__}; messages are made of {_KINDS}")
    shaped = tree if hasattr(tree, "shape") and hasattr(tree, "dtype") else np.asarray(tree)
    if not (jnp.issubdtype(shaped.dtype, jnp.number) or shaped.dtype == jnp.bool_):
        raise TypeError(f"a message cannot hold an array of {shaped.dtype}; it is made of real numbers")
    if jnp.issubdtype(shaped.dtype, jnp.complexfloating):
        raise TypeError("a message cannot hold complex numbers; send their real and imaginary parts")
    sizes = f"[{','.join(map(str, shaped.shape))}]" if shaped.shape else ""
    return f"{shaped.dtype.name}{sizes}"


def _describe_dataclass(tree: Any) -> Any:
    children = jax.tree_util.tree_leaves_with_path(tree, is_leaf=lambda part: part is not tree)
    if any(child is tree for _, child in children):
        name = type(tree).__qualname__
        raise TypeError(f"{name} is no pytree; register it with jax.tree_util.register_dataclass")
    # A field that holds nothing has no leaf, and is none of the static ones either.
    data = {getattr(path[0], "name", None) for path, _ in children}
    fields = {field.name: getattr(tree, field.name) for field in dataclasses.fields(tree) if field.init}
    parts = {name: _describe(value) for name, value in fields.items() if name in data or value is None}
    static = {name: value for name, value in fields.items() if name not in parts}
    return [class_place(type(tree)), parts, *([static] if static else [])]


def class_place(kind: type) -> str:
    """Where another interpreter finds a class: `module:Class`."""
    module = kind.__module__
    if module == "__main__":
        module = _main_module(kind)
    if "<locals>" in kind.__qualname__:
        raise TypeError(
            f"{kind.__qualname__} is defined inside a function, where no other process finds it; define it at the top "
            "level of a module"
        )
    return f"{module}:{kind.__qualname__}"


def _main_module(kind: type) -> str:
    main = sys.modules["__main__"]
    spec = getattr(main, "__spec__", None)
    if spec is not None and spec.name:
        return str(spec.name)
    file = getattr(main, "__file__", None)
    if file is None:
        raise TypeError(
            f"{kind.__qualname__} is defined in a notebook or at a prompt, where no other process finds it; write it "
            "into a module (%%writefile nodes.py) and import it; the simulated clock needs no other process"
        )
    return Path(file).stem


def found_class(place: str) -> Any:
    """The class at `module:Class`."""
    module, _, name = place.partition(":")
    found: Any = importlib.import_module(module)
    for part in name.split("."):
        found = getattr(found, part)
    return found


def named(tree: Tree) -> dict[str, Scalar]:
    """The numbers of a pytree by their names."""
    if isinstance(tree, Mapping) and all(isinstance(value, int | float) for value in tree.values()):
        return dict(tree)
    result: dict[str, Scalar] = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        name = _path_name(path) or _ALONE
        shape = np.shape(leaf)
        if not shape:
            result[name] = leaf
            continue
        for index in itertools.product(*map(range, shape)):
            result["_".join([name, *map(str, index)])] = leaf[index]
    return result


def _path_name(path: Sequence[Any]) -> str:
    name = ""
    for part in path:
        index = getattr(part, "idx", None)
        if index is not None:
            name = f"{name or _ALONE}_{index}"
        else:
            key = part.key if hasattr(part, "key") else part.name
            name = f"{name}.{key}" if name else str(key)
    return name
