"""Withheld cases whose bodies MuJoCo moves: sealed, then diagnosed and scored by the command line."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys

import pytest

from conftest import ROOT, _program

TRUTH = ROOT / "benches/withheld/mujoco/truth.py"


def truth(*arguments):
    return subprocess.run([sys.executable, TRUTH, *map(str, arguments)], capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """One machine that has something and one that has nothing."""
    out = tmp_path_factory.mktemp("withheld") / "run"
    done = truth("--singles", 1, "--nulls", 1, "--dev-seed", 4, "--out", out)
    assert done.returncode == 0, done.stderr
    seal = done.stdout.split()[-1]
    answers = (out / "answers.json").read_bytes()
    assert seal == hashlib.sha256(answers).hexdigest()
    return out, json.loads(answers)["cases"]


def test_a_case_says_nothing_of_its_cause(run):
    out, cases = run
    assert sorted(path.name for path in (out / "cases").iterdir()) == sorted(cases)
    (single,) = (each["answer"] for each in cases.values() if each["answer"]["set"] == "single")
    (effect,) = single["effects"]
    assert single["detectability"] >= 4.0
    assert f"{effect['name']}@{effect['place']}" == single["class"][0]
    for name, sealed in cases.items():
        for file in (out / "cases" / name).iterdir():
            text = file.read_text()
            assert str(sealed["seed"]) not in text
            assert all(f"{value:.5g}" not in text for value in effect["parameters"].values())


def test_the_command_line_diagnoses_and_scores_it(run):
    out, cases = run
    program = [_program(), "withheld", "--resume", "--separate", "0", "--out", out, "--json"]
    done = subprocess.run(program, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    scores = json.loads(done.stdout)
    assert scores["development"]
    results = [json.loads(line) for line in (out / "results-1-of-1.jsonl").read_text().splitlines() if line]
    detected = {each["case"]: each["found"]["detected"] for each in results}
    # The equations of the file are those of MuJoCo's bodies: where nothing was added, nothing is found.
    assert detected == {name: each["answer"]["set"] == "single" for name, each in cases.items()}


def test_wrong_words_are_told(run, tmp_path):
    done = truth("--singles", 0, "--nulls", 0, "--out", tmp_path / "none")
    assert done.returncode == 2
    assert "no case is asked for" in done.stderr
    assert not (tmp_path / "none").exists()
    done = truth("--singles", 1, "--nulls", 0, "--out", run[0])
    assert done.returncode == 2
    assert "there already" in done.stderr
