"""Writes the reference of the Python package, `docs/python-api.md`, from what its sources say.

python bindings/reference.py            # writes the page anew
python bindings/reference.py --check    # whether it is what the sources say

The sources are read and not imported, so that no extra has to be installed.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

HERE = Path(__file__).resolve().parent
PACKAGE = HERE / "python" / "parallax"
PAGE = HERE.parent / "docs" / "python-api.md"

MODULES = {
    "parallax": "",
    "parallax.symbolic": "",
    "parallax.worlds": "mujoco`, `mjx`, `brax`, `drake",
    "parallax.train": "train",
    "parallax.train.gym": "gym",
    "parallax.train.gymnax": "gymnax",
    "parallax.rerun": "rerun",
}
"""The public modules, and the extras that they need."""

HEAD = """\
# Reference of the Python package

<!-- Written by `python bindings/reference.py` from the docstrings in bindings/python/parallax; a test compares. -->

Every public class and function. Times are seconds since the run's start and everything is in SI units, unless a name
or a sentence says otherwise; `[message, leaf]` is the shape of an array. How it all goes together:
[a graph in Python](python.md), [nodes in Python](python-nodes.md), [training](training.md).
"""

Definition = ast.ClassDef | ast.FunctionDef


def source(module: str) -> Path:
    """The file of a module."""
    place = PACKAGE.parent.joinpath(*module.split("."))
    return next(
        path for path in (place / "__init__.py", place.with_suffix(".py"), place.with_suffix(".pyi")) if path.exists()
    )


def public(tree: ast.Module) -> list[str]:
    """What a module lists in `__all__`."""
    for node in tree.body:
        if isinstance(node, ast.Assign) and any(isinstance(t, ast.Name) and t.id == "__all__" for t in node.targets):
            return [name for name in ast.literal_eval(node.value) if name != "__version__"]
    return []


def found(module: str, name: str) -> tuple[ast.AST, str]:
    """Where a name of a module is defined, and what is written below it if that is a docstring of its own."""
    tree = ast.parse(source(module).read_text(encoding="utf-8"))
    for place, node in enumerate(tree.body):
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name == name:
            return node, ast.get_docstring(node) or ""
        if assigned(node) == name:
            match node:
                case ast.Assign(value=ast.Attribute(value=ast.Name(id="_native"), attr=native)):
                    return found("parallax._native", native)[0], below(tree.body, place)
            return node, below(tree.body, place)
        if isinstance(node, ast.ImportFrom):
            for alias in node.names:
                if (alias.asname or alias.name) == name:
                    parts = module.split(".")
                    if source(module).name != "__init__.py":
                        parts = parts[:-1]
                    parts = parts[: len(parts) + 1 - node.level]
                    return found(".".join([*parts, *(node.module or "").split(".")]).strip("."), alias.name)
    raise LookupError(f"{module} has no {name}")


def assigned(node: ast.AST) -> str | None:
    """The name that a statement gives a value."""
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    match targets:
        case [ast.Name(id=name)]:
            return name
        case [ast.Attribute(value=ast.Name(id="self"), attr=name)]:
            return name
    return None


def below(body: list[ast.stmt], place: int) -> str:
    """The text below a statement."""
    match body[place + 1 : place + 2]:
        case [ast.Expr(value=ast.Constant(value=str(text)))]:
            lines = text.splitlines()
            rest = [line.strip() for line in lines[1:]]
            return "\n".join([lines[0].strip(), *rest]).strip()
    return ""


def signature(function: ast.FunctionDef, name: str) -> str:
    """As it is called."""
    arguments = function.args
    if arguments.args and arguments.args[0].arg in ("self", "cls"):
        arguments.args = arguments.args[1:]
    text = ast.unparse(arguments)
    returns = f" -> {ast.unparse(function.returns)}" if function.returns and name[:1].islower() else ""
    return f"{name}({text}){returns}"


def text(docstring: str) -> str:
    """A docstring on the page; its examples are shown and not run."""
    return docstring.replace("```python", "```py")


def members(owner: ast.ClassDef) -> Iterator[tuple[str, str, str]]:
    """Attributes first, then methods: the name, as it is written, and what is said of it."""
    seen: list[tuple[str, str, str]] = []
    bodies = [owner.body]
    bodies += [node.body for node in owner.body if isinstance(node, ast.FunctionDef) and node.name == "__init__"]
    for body in bodies:
        for place, node in enumerate(body):
            name = assigned(node)
            if name is None or name.startswith("_") or any(name == other for other, *_ in seen):
                continue
            own = body is owner.body
            if own or below(body, place):
                kind = f": {ast.unparse(node.annotation)}" if isinstance(node, ast.AnnAssign) else ""
                seen.append((name, f"{name}{kind}", below(body, place)))
    methods = []
    for node in owner.body:
        if not isinstance(node, ast.FunctionDef):
            continue
        decorators = {ast.unparse(decorator) for decorator in node.decorator_list}
        said = ast.get_docstring(node) or ""
        if "property" in decorators and not node.name.startswith("_"):
            returns = f": {ast.unparse(node.returns)}" if node.returns else ""
            seen.append((node.name, f"{node.name}{returns}", said))
        elif (not node.name.startswith("_") and not any("setter" in decorator for decorator in decorators)) or (
            node.name in ("__getitem__", "__call__", "__len__") and said
        ):
            methods.append((node.name, signature(node, node.name), said))
    yield from seen
    yield from methods


def described(module: str, name: str) -> Iterator[str]:
    """One name of a module."""
    node, said = found(module, name)
    yield f"### `{name}`\n"
    match node:
        case ast.ClassDef():
            made = next((n for n in node.body if isinstance(n, ast.FunctionDef) and n.name == "__init__"), None)
            bases = [ast.unparse(base) for base in node.bases if not ast.unparse(base).startswith("Generic")]
            if made is not None:
                yield f"`class {signature(made, name)}`" + (f", a `{bases[0]}`\n" if bases else "\n")
            elif bases:
                yield f"`class {name}`, a `{bases[0]}`\n"
            yield f"{text(said)}\n"
            if made is not None and (of_init := ast.get_docstring(made)):
                yield f"{text(of_init)}\n"
            for _, written, about in members(node):
                yield f"- `{written}`" + (f": {indented(text(about))}" if about else "")
            yield ""
        case ast.FunctionDef():
            yield f"`{signature(node, name)}`\n"
            yield f"{text(said)}\n"
        case _:
            value = node.value if isinstance(node, ast.Assign | ast.AnnAssign) else None
            if isinstance(value, ast.Constant | ast.Call):
                yield f"`{name} = {ast.unparse(value)}`\n"
            yield f"{text(said)}\n"


def indented(said: str) -> str:
    """Below the item of a list."""
    return re.sub(r"\n(?=[^\n])", "\n  ", said)


def page() -> str:
    """The whole page."""
    lines = [HEAD]
    for module, extra in MODULES.items():
        tree = ast.parse(source(module).read_text(encoding="utf-8"))
        lines.append(f"## `{module}`\n")
        lines.append(f"{text(ast.get_docstring(tree) or '')}\n")
        if extra:
            lines.append(f"Needs the extra `{extra}`.\n" if "`" not in extra else f"Extras: `{extra}`.\n")
        for name in sorted(public(tree), key=str.lower):
            lines += described(module, name)
    return re.sub(r"\n{3,}", "\n\n", "\n".join(lines)).rstrip() + "\n"


def main() -> int:
    """The command; gives the exit status."""
    if sys.argv[1:] == ["--check"]:
        same = PAGE.exists() and PAGE.read_text(encoding="utf-8") == page()
        print(f"{PAGE.name} is {'what' if same else 'not what'} the sources say")
        return 0 if same else 1
    PAGE.write_text(page(), encoding="utf-8")
    print(f"{PAGE} written")
    return 0


if __name__ == "__main__":
    sys.exit(main())
