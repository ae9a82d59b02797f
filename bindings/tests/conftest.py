"""What the tests share."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import jax
import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def x64():
    """Double precision for one test."""
    with jax.enable_x64(True):
        yield


def _program() -> Path:
    """The command line, built by `cargo build`."""
    target = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"))
    places = [Path(os.environ["PARALLAX_BIN"])] if "PARALLAX_BIN" in os.environ else []
    places += [target / profile / "parallax" for profile in ("debug", "release")]
    for place in places:
        if place.exists():
            return place
    raise FileNotFoundError(f"no `parallax` at {', '.join(map(str, places))}; run `cargo build` first")


@pytest.fixture(scope="session")
def parallax_cli():
    """Runs the command line with these arguments; returns what it prints."""
    program = _program()

    def run(*arguments: str | os.PathLike[str]) -> str:
        done = subprocess.run([program, *arguments], capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    return run


@pytest.fixture(scope="session")
def compiled_once(tmp_path_factory):
    """What was compiled in one test is not compiled again in the next."""
    import parallax

    parallax.use_compilation_cache(tmp_path_factory.mktemp("jax"), 0.0)


@pytest.fixture(scope="session")
def browser():
    """Chromium, without a window."""
    from playwright.sync_api import sync_playwright

    program = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
    assert program, "no chromium; .ci/run installs it (Debian: apt-get install chromium), or name one in CHROMIUM"
    with sync_playwright() as playwright:
        # As root, and in containers, there is no sandbox to be had; the pages are our own.
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        yield browser
        browser.close()
