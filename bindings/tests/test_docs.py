"""The page about graphs in Python does what it says: its modules are written, and its blocks are run, one after the
other."""

from __future__ import annotations

import os
import re
import subprocess
import sys

from conftest import ROOT


def test_the_page_runs(tmp_path):
    page = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    lines = []
    for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        first = block.splitlines()[0].removeprefix("# ")
        if re.fullmatch(r"\w+\.py", first):
            (tmp_path / first).write_text(block)
        else:
            lines += block.splitlines()
    assert len(lines) > 60
    indented = "\n".join(f"    {line}" if line else "" for line in lines)
    (tmp_path / "page.py").write_text(f'if __name__ == "__main__":\n{indented}\n')
    done = subprocess.run(
        [sys.executable, "page.py"], cwd=tmp_path, capture_output=True, text=True, timeout=300, env=os.environ
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"^\(1000, \d+\)", done.stdout, re.MULTILINE), done.stdout
