"""Recordings and diagnoses for Rerun, read back by its own reader."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest

import parallax as px
from conftest import _program

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


AXIS = """
format = 1
name = "axis"
[parameters]
M = { value = 2.0, unit = "kg", calibrate = [1.0, 4.0] }
b = { value = 1.0, unit = "N s/m", calibrate = [0.0, 10.0] }
[inputs]
u = { signal = "force" }
[state]
q = { derivative = "v", initial = "position" }
v = { derivative = "(u - b*v)/M" }
[outputs]
position = { value = "q", unit = "m" }
[joints]
axis = { position = "q", velocity = "v", inertia = "M", drive = "u" }
"""
LOG = """
format = 1
title = "a slide with dry friction"
[[signal]]
name = "force"
role = "command"
unit = "N"
file = "log.csv"
time = "t"
value = "u"
[[signal]]
name = "position"
role = "measurement"
unit = "m"
file = "log.csv"
time = "t"
value = "q"
"""


@pytest.fixture(scope="module")
def diagnosis(tmp_path_factory):
    """A slide with dry friction of 0.8 N, diagnosed by a system that knows none."""
    folder = tmp_path_factory.mktemp("diagnosis")
    noise = np.random.default_rng(1)
    q, v, rows, dt = 0.0, 0.0, [], 1e-4
    for step in range(120_000):
        t = step * dt
        u = 3.0 * np.sin(2 * np.pi * 0.35 * t) + 2.0 * np.sin(2 * np.pi * 1.1 * t + 1.0)
        if step % 100 == 0:
            rows.append(f"{t:.4f},{u:.6f},{q + 2e-4 * noise.normal():.6f}")
            held = u
        v += dt * (held - 1.0 * v - 0.8 * np.tanh(v / 1e-3)) / 2.0
        q += dt * v
    (folder / "log").mkdir()
    (folder / "log" / "log.csv").write_text("t,u,q\n" + "\n".join(rows) + "\n")
    (folder / "log" / "recording.toml").write_text(LOG)
    (folder / "system.toml").write_text(AXIS)
    command = [_program(), "diagnose", "--system", "system.toml", "log", "--out", "answer"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder / "answer"


def shown(path):
    """Texts and bars of a file, by their place."""
    from rerun.chunk import RrdReader

    found = {}
    for chunk in RrdReader(str(path)).stream().to_chunks():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name in ("TextDocument:text", "BarChart:values"):
                (found[chunk.entity_path],) = batch.column(name).to_pylist()
    return found


def test_a_diagnosis_is_shown_with_its_residuals_and_probabilities(diagnosis, tmp_path):
    command = [sys.executable, "-m", "parallax.rerun", diagnosis, tmp_path / "answer.rrd"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads((diagnosis / "report.json").read_text())
    (position,) = json.loads((diagnosis / "predictions.json").read_text())
    found = curves(tmp_path / "answer.rrd")
    columns = {name: np.array(position[name], float) for name in ("time", "measured", "before", "after")}
    assert len(columns["time"]) > 100
    for name in ("measured", "before", "after"):
        times, values = found.pop(f"/position/{name}")
        np.testing.assert_allclose(times, columns["time"], atol=2e-9)
        np.testing.assert_array_equal(values, columns[name])
    for name in ("before", "after"):
        _, values = found.pop(f"/residuals/position/{name}")
        np.testing.assert_allclose(values * position["noise"], columns["measured"] - columns[name], atol=1e-12)
        # The same errors as those of the report: the root mean square in noise units.
        expected = report["how_far"]["refitted" if name == "before" else "with_effect"]
        assert np.sqrt(np.nanmean(values**2)) == pytest.approx(expected, rel=0.1)
    assert not found
    others = shown(tmp_path / "answer.rrd")
    text = others["/answer"][0]
    assert report["summary"] in text
    assert "`coulomb@joint:axis`" in text
    bars = np.array(others["/probabilities"][0]["buffer"], float)
    assert bars[0] == pytest.approx(report["which"][0]["probability"])
    assert bars.sum() == pytest.approx(1.0, abs=1e-3)


def test_what_is_no_diagnosis_is_said(tmp_path):
    command = [sys.executable, "-m", "parallax.rerun", tmp_path]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2
    assert "report.json" in done.stderr
    assert "parallax diagnose --out" in done.stderr
