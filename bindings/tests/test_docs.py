"""The pages about Python do what they say: their modules are written, their commands and their blocks are run, one
after the other. A line that says `# not run: WHY` is left out. tests/docs.rs runs the other pages."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import textwrap
import tomllib
from pathlib import Path

import pytest

from conftest import ROOT, _program

# What each page prints that shows it went well.
PAGES = {
    "README.md": None,
    "docs/python.md": r"^\(1000, \d+\)",
    "docs/python-nodes.md": r"agent +\d+ +\d+",
    "docs/training.md": None,
    "docs/tasks.md": None,
    "docs/identification.md": None,
    "docs/policy.md": r"upright for \d+% of 10 s",
}
# Training shows that it works in fewer steps.
SHORT = """
    from parallax import train as pt
    changed = pt.PPO.changed
    pt.PPO.changed = lambda settings, **values: changed(settings, **values | {"total_steps": 20_000})
    pt.PENDULUM = pt.PENDULUM.changed(total_steps=20_000)
"""


def script(page: str, folder: Path) -> str:
    """The page as one program: modules of their own are written to the folder, commands are run where they stand."""
    lines: list[str] = []
    for language, block in re.findall(r"^```(python|sh)\n(.*?)^```", page, re.DOTALL | re.MULTILINE):
        first = block.splitlines()[0]
        if language == "sh":
            commands = [line for line in block.splitlines() if line and "# not run: " not in line]
            lines += [f"subprocess.run({command!r}, shell=True, check=True)" for command in commands]
        elif re.fullmatch(r"# \w+\.py", first):
            (folder / first.removeprefix("# ")).write_text(block)
        elif not first.startswith("# not run here: "):
            lines += block.splitlines()
    return "\n".join(lines)


@pytest.mark.parametrize("page", PAGES)
def test_the_page_runs(page, tmp_path):
    text = (ROOT / page).read_text(encoding="utf-8")
    if page == "README.md":  # Its commands are run by tests/docs.rs.
        text = re.sub(r"^```sh\n.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    body = script(text, tmp_path)
    if "pt." in body:
        body = textwrap.dedent(SHORT) + body
    (tmp_path / "page.py").write_text(
        "import subprocess\n\nif __name__ == '__main__':\n" + textwrap.indent(body or "pass", "    ") + "\n"
    )
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    environment = os.environ | {
        "PATH": f"{_program().parent}:{os.environ['PATH']}",
        "VIRTUAL_ENV": sys.prefix,
        "PARALLAX_CACHE": str(tmp_path / "cache"),
    }
    done = subprocess.run(
        [sys.executable, "page.py"], cwd=tmp_path, capture_output=True, text=True, timeout=900, env=environment
    )
    assert done.returncode == 0, done.stdout + done.stderr
    if PAGES[page]:
        assert re.search(PAGES[page], done.stdout, re.MULTILINE), done.stdout


@pytest.mark.parametrize("page", ["docs/python-nodes.md", "docs/training.md"])
def test_nodes_on_pages_are_nodes(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    for block in re.findall(r"^```toml\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
        (node,) = tomllib.loads(block)["node"]
        assert {"name", "kind", "rate", "parameters"} == set(node)


def test_the_example_of_training_runs(tmp_path):
    command = [sys.executable, ROOT / "examples/python/swing_up.py", "--out", tmp_path / "out", "--steps", "20000"]
    environment = os.environ | {"PARALLAX_CACHE": str(tmp_path / "cache")}
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, env=environment)
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search("upright", done.stdout), done.stdout
    assert (tmp_path / "out" / "policy.safetensors").exists()


@pytest.mark.parametrize("path", sorted((ROOT / "examples").rglob("*.toml")), ids=lambda path: path.stem)
def test_systems_among_the_examples_are_systems(path):
    import parallax as px

    content = tomllib.loads(path.read_text())
    if {"format", "outputs", "inputs"} <= set(content) and "task" not in content:
        system = px.System(path)
        assert system.outputs == list(content["outputs"])


def test_a_new_node_in_python_runs(tmp_path):
    """`parallax new node --python`, as a stranger would: both clocks, and it does what it is for."""
    environment = {name: value for name, value in os.environ.items() if name != "VIRTUAL_ENV"}
    environment["VIRTUAL_ENV"] = sys.prefix

    def parallax(folder: Path, *arguments: str) -> str:
        done = subprocess.run(
            [_program(), *arguments], cwd=folder, capture_output=True, text=True, timeout=120, env=environment
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    said = parallax(tmp_path, "new", "node", "my_policy", "--python")
    assert "parallax sim graph.toml" in said, said
    folder = tmp_path / "my_policy"
    parallax(folder, "sim", "graph.toml", "--duration", "10", "--out", "sim.mcap")
    parallax(folder, "run", "graph.toml", "--duration", "2", "--out", "run.mcap")

    import numpy as np

    import parallax as px

    camera = px.load(folder / "sim.mcap")["camera"]
    angle = camera.payload[:, camera.leaves.index("angle")]
    assert np.abs(angle[-100:]).max() < 0.4, "it never stood"
