"""The examples in the README run."""

from __future__ import annotations

import re
import shutil

import pytest

from conftest import ROOT

BLOCKS = re.findall(r"```python\n(.*?)```", (ROOT / "bindings" / "README.md").read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.parametrize("place", range(len(BLOCKS)))
def test_example(place, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PARALLAX_CACHE", str(tmp_path / "cache"))
    shutil.copy(ROOT / "nodes" / "src" / "pendulum" / "system.toml", tmp_path)
    exec(compile(BLOCKS[place], f"README, example {place + 1}", "exec"), {})


def test_there_are_examples():
    assert len(BLOCKS) >= 4
