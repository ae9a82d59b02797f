"""The reference of the package has everything that is public, and says what the sources say."""

from __future__ import annotations

import importlib.util
import re
import sys

import pytest

import parallax
from conftest import ROOT

PAGE = (ROOT / "docs" / "python-api.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def reference():
    spec = importlib.util.spec_from_file_location("reference", ROOT / "bindings" / "reference.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["reference"] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules["reference"]


def sections():
    """The text below each heading of a name, by module and name."""
    found = {}
    for part in re.split(r"^## ", PAGE, flags=re.MULTILINE)[1:]:
        module = part.split("`")[1]
        for entry in re.split(r"^### ", part, flags=re.MULTILINE)[1:]:
            found[module, entry.split("`")[1]] = entry.split("\n", 1)[1].strip()
    return found


def test_the_page_says_what_the_sources_say(reference):
    assert reference.page() == PAGE, "docs/python-api.md is out of date; write it: python bindings/reference.py"


def test_nothing_public_is_missing_and_nothing_is_unexplained(reference):
    found = sections()
    for module in reference.MODULES:
        for name in getattr(importlib.import_module(module), "__all__", []):
            if name != "__version__":
                assert len(found.pop((module, name), "")) > 10, f"{module}.{name}"
    assert not found, "names that are no longer there"
    # The same members as the classes themselves have.
    for name in parallax.__all__:
        owner = getattr(parallax, name)
        if isinstance(owner, type) and not issubclass(owner, Exception):
            written = re.findall(r"^- `([A-Za-z_]\w*)", sections()["parallax", name], re.MULTILINE)
            for member, value in vars(owner).items():
                if not member.startswith("_") and (callable(value) or isinstance(value, property)):
                    assert member in written, f"{name}.{member}"


def test_every_module_that_the_pages_use_is_there(reference):
    pages = [
        *(ROOT / "docs").glob("*.md"),
        ROOT / "bindings" / "README.md",
        *(ROOT / "examples" / "python").rglob("*.py"),
    ]
    used = set()
    for page in pages:
        text = page.read_text(encoding="utf-8")
        used |= set(re.findall(r"^\s*from (parallax[\w.]*) import", text, re.MULTILINE))
    known = set(reference.MODULES)
    assert {"parallax", "parallax.worlds"} <= used
    assert used <= known, used - known
