"""The tasks, whole and small: a machine in real time, identified, trained for, and run."""

from __future__ import annotations

import json
import subprocess
import sys
import tomllib

import numpy as np
import pytest

import parallax
from conftest import _program
from pages import check


def task(*arguments, interpreter=sys.executable):
    command = [_program(), "task", "--interpreter", interpreter, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=500, check=False)


def test_from_a_recording_to_a_policy_that_runs(tmp_path, monkeypatch, browser):
    monkeypatch.setenv("PARALLAX_CACHE", str(tmp_path / "cache"))
    out = tmp_path / "out"
    few = ["--record", "8", "--steps", "4096", "--runs", "1", "--run", "3", "--seed", "11"]
    done = task("pendulum", "--out", out, *few, "--variants", "camera-delays", "full-state-predicted", "--json")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told == json.loads((out / "task.json").read_text())
    found = {estimate["name"]: estimate for estimate in told["identified"]["estimates"]}
    truth = told["truth"]
    assert abs(found["actuator"]["value"] - truth["delay"]) < 2e-3
    assert abs(found["J"]["value"] / truth["inertia"] - 1) < 0.05
    assert abs(found["K"]["value"] / truth["motor"] - 1) < 0.05
    # Nothing that the task could read before its end says what the machine was.
    for file in ("machine.toml", "identify.toml", "fitted.toml", "runs/camera-delays-0.toml"):
        assert str(truth["delay"]) not in (out / file).read_text()
    assert set(told["variants"]) == {"camera-delays", "full-state-predicted"}
    for variant in told["variants"].values():
        assert 0.0 <= variant["upright"][0] <= variant["held"][0] <= 1.0
    # Both filters ran. Which is nearer is no question here: after so short a training the pendulum hardly moves.
    errors = told["variants"]["full-state-predicted"]["errors"]
    assert set(errors) == {"predicted", "filtered"}
    assert all(0.0 < error < 1.0 for each in errors.values() for error in each)
    looking = {f"{side}{name}" for side in ("", "side_") for name in ("film", "mark")} | {"camera", "side"}
    assert set(told["nodes"]) == looking | {"world", "estimator", "agent", "motor"}
    assert told["identified"]["not_written"] == []
    # Nobody told where the cameras stand: a radian moves the mark by some 30 px.
    for camera in ("camera", "side"):
        for term in ("u.one", "u.sin", "v.one", "v.cos"):
            name = f"{camera}.{term}"
            assert abs(found[name]["value"] - truth[name]) < 1.0, name
    # The policy of the camera has its history in the file that the node loaded.
    policy = out / "training" / "camera-delays-4-6" / "policy.safetensors"
    assert b'"past_actions":"6"' in policy.read_bytes()
    page = (out / "report.html").read_text()
    for part in ("What was identified", "Open-loop reconstruction", "Delays", "Training", "in real time", "<svg"):
        assert part in page
    assert "side, rendered" in page
    assert 'src="http' not in page
    check(browser, out / "report.html")

    # More runs of the same machine: only what is not there yet is done.
    first = (out / "runs" / "camera-delays-0.mcap").stat().st_mtime_ns
    few[few.index("--runs") + 1] = "2"
    again = task("pendulum", "--out", out, *few, "--variants", "camera-delays", "--resume", "--json")
    assert again.returncode == 0, again.stderr
    more = json.loads(again.stdout)
    assert more["training"]["camera-delays-4-6"] == told["training"]["camera-delays-4-6"]
    assert more["identified"] == told["identified"]
    assert (out / "runs" / "camera-delays-0.mcap").stat().st_mtime_ns == first
    variant = more["variants"]["camera-delays"]
    assert len(variant["held"]) == len(variant["back"]) == 2
    # The first run begins as the recording did; in the second one it is let go elsewhere, and tapped.
    assert variant["back"][0] is None
    begun = [tomllib.loads((out / f"runs/camera-delays-{number}.toml").read_text()) for number in range(2)]
    worlds = [next(node for node in graph["node"] if node["name"] == "world") for graph in begun]
    assert not worlds[0].get("parameters")
    tap = worlds[1]["parameters"]["taps"][0]
    world = parallax.load(out / "runs/camera-delays-1.mcap")["world"]
    assert abs(world["angle"][0] - worlds[1]["parameters"]["angle"]) < 0.1
    changes = np.diff(world["speed"])
    at = np.searchsorted(world["stamp"], tap["time"]) - 1
    kick = changes[at] - 0.5 * (changes[at - 1] + changes[at + 1])
    assert abs(kick - tap["impulse"] / truth["inertia"]) < 0.7
    assert variant["held"][0] == told["variants"]["camera-delays"]["held"][0]
    stood = sum(share >= 0.9 for share in variant["held"])
    assert (variant["standing"]["runs"], variant["standing"]["of"]) == (stood, 2)
    assert 0.0 <= variant["standing"]["interval"][0] <= stood / 2 <= variant["standing"]["interval"][1] <= 1.0
    few[few.index("--steps") + 1] = "8192"
    other = task("pendulum", "--out", out, *few, "--resume")
    assert other.returncode == 2
    assert "begun with steps 4096" in other.stderr


def test_a_quadrotor_from_a_recording_to_a_flight(tmp_path, monkeypatch, browser):
    monkeypatch.setenv("PARALLAX_CACHE", str(tmp_path / "cache"))
    out = tmp_path / "out"
    few = ["--record", "15", "--steps", "8192", "--runs", "1", "--run", "4", "--seed", "5"]
    done = task("quadrotor", "--out", out, *few, "--variants", "delay-0.5", "--json")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    estimates = told["identified"]["estimates"]
    found = {estimate["name"]: estimate["value"] for estimate in estimates}
    intervals = {estimate["name"]: estimate["interval"] for estimate in estimates}
    truth = told["truth"]
    assert abs(found["mass"] / truth["mass"] - 1) < 0.03
    assert abs(found["gain"] / found["time"] * truth["attitude_time"] / truth["attitude_gain"] - 1) < 0.05
    # The data tell the two ways from a command to what is seen of it, and nothing of the single delays.
    for way in (("actuator", "sensor"), ("actuator", "feedback")):
        assert abs(sum(found[name] - truth[name] for name in way)) < 4e-3
        for name in way:
            low, high = intervals[name]
            assert low <= truth[name] <= high
            assert high - low > 0.01
    for file in ("machine.toml", "identify.toml", "fitted.toml", "runs/delay-0.5-0.toml"):
        assert str(truth["actuator"]) not in (out / file).read_text()
    (flight,) = told["variants"].values()
    assert len(flight["speed"]) == len(flight["error"]) == 1
    assert flight["error"][0] >= 0.0
    assert told["nodes"]["pid"]["rate"] == 50.0
    page = (out / "report.html").read_text()
    for part in ("quadrotor", "What was identified", "Nodes", "in real time", "delay-0.5", "<svg"):
        assert part in page
    check(browser, out / "report.html")


def test_what_is_missing_is_said(tmp_path):
    done = task("pendulum", interpreter="/no/such/python")
    assert done.returncode == 2
    assert "a task trains its policies in Python" in done.stderr
    assert "--interpreter" in done.stderr
    done = task("pendulum", "--variants", "nobody")
    assert done.returncode == 2
    assert "full-state" in done.stderr
    done = task("pendulum", "--out", tmp_path, "--parallax", "/no/such/program")
    assert done.returncode == 2
    assert "/no/such/program" in done.stderr
    done = task("pendulum", "--out", tmp_path / "nothing", "--resume")
    assert done.returncode == 2
    assert "nothing was begun" in done.stderr


@pytest.mark.parametrize(("arguments", "says"), [(["quadrotor", "--help"], "no-delay-0.5"), (["--help"], "quadrotor")])
def test_help_helps(arguments, says):
    done = task(*arguments)
    assert done.returncode == 0
    assert says in "".join(done.stdout.split())
