"""A recording for Rerun, read back by its own reader."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

import parallax as px

rerun = pytest.importorskip("rerun")


def curves(path):
    """Times (s) and values of every curve of a file."""
    from rerun.chunk import RrdReader

    found: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for chunk in RrdReader(str(path)).stream().to_chunks():
        batch = chunk.to_record_batch()
        if "Scalars:scalars" not in batch.schema.names:
            continue
        times = batch.column("time").cast("int64").to_numpy() / 1e9
        values = np.concatenate(batch.column("Scalars:scalars").to_pylist())
        before = found.get(chunk.entity_path, (np.zeros(0), np.zeros(0)))
        found[chunk.entity_path] = (np.append(before[0], times), np.append(before[1], values))
    return found


def test_every_leaf_is_a_curve(tmp_path):
    recording = px.Graph("pendulum-simulated").simulate(tmp_path / "run.mcap", 1.0, seed=1)
    command = [sys.executable, "-m", "parallax.rerun", tmp_path / "run.mcap"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    found = curves(tmp_path / "run.rrd")
    for name, node in recording.nodes.items():
        for leaf in node.leaves:
            times, values = found.pop(f"/{name}/{leaf}")
            order = np.argsort(times, kind="stable")
            np.testing.assert_allclose(times[order], node.sent, atol=2e-9)
            np.testing.assert_array_equal(values[order], node[leaf])
        times, values = found.pop(f"/steps/{name}/computation")
        assert len(times) == len(node.end)
    assert not found


def test_what_is_no_recording_is_said(tmp_path):
    command = [sys.executable, "-m", "parallax.rerun", tmp_path / "none.mcap"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2
    assert "there is no such file" in done.stderr
    assert not (tmp_path / "none.rrd").exists()
