"""Recordings with a known cause whose bodies MuJoCo moves: a sealed run for `parallax withheld --resume`.

    pip install mujoco numpy
    python benches/withheld/mujoco/truth.py --singles 45 --nulls 15 --out out/withheld-mujoco
    parallax withheld --resume --separate 0 --out out/withheld-mujoco

Rigid bodies, joints, dry friction, springs, stops and armatures are MuJoCo's own (Todorov, Erez, Tassa, 2012), with
its soft constraints and its integrator; nothing of Parallax is used. Commands go through a queue before, readings come
late or biased after. One folder a case crosses over, with a nominal `system.toml`; the answers are sealed before
anything is diagnosed. Seeds are drawn by the system unless `--dev-seed` states one.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import secrets
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from causes import Random, causes, draw
from judge import LEAST, judge
from machines import MACHINES
from run import COMMANDS, READINGS, Case, Diverged, excitation

TRIES = 20
"""How often a cause that leaves no trace, or with which the machine runs away, is drawn."""
SOFT = {"end_stop": "stiffness"}
"""What is not compared with what a diagnosis finds."""
REPORTED = 1 << 63
"""Seeds of reported runs have this bit, those of development do not."""


def write(case: Case, readings: np.ndarray, noise: np.ndarray, declared: bool, folder: Path) -> None:
    """The folder that the diagnosis reads."""
    machine = case.machine
    folder.mkdir(parents=True)
    text = f'format = 1\ntitle = "{machine.name}"\n'

    def signal(name: str, role: str, unit: str, file: str) -> str:
        return (
            f'\n[[signal]]\nname = "{name}"\nrole = "{role}"\nunit = "{unit}"\nfile = "{file}"\ntime = "t"\n'
            f'value = "{name}"\n'
        )

    signals = [signal_ for signal_, _, _ in machine.inputs.values()]
    for name, unit, _ in machine.inputs.values():
        text += signal(name, "command", unit, "commands.csv")
    rows = [",".join(["t", *signals])]
    rows += [",".join([f"{k / COMMANDS:.6f}", *(f"{u:.7f}" for u in tick)]) for k, tick in enumerate(case.commands.T)]
    (folder / "commands.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    equations = machine.equations
    for k, (name, (unit, _, _)) in enumerate(machine.outputs.items()):
        text += signal(name, "measurement", unit, f"{name}.csv")
        rows = [f"t,{name}", *(f"{i / READINGS:.6f},{y:.8f}" for i, y in enumerate(readings[k]))]
        (folder / f"{name}.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
        equations = equations.replace(f"@{name}@", f", noise = {noise[k]:.3e}" if declared else "")
    (folder / "recording.toml").write_text(text, encoding="utf-8")
    system = f'format = 1\nname = "{machine.name}"\n[parameters]\n'
    for name, own in machine.parameters.items():
        bounds = f", calibrate = [{own.bounds[0]}, {own.bounds[1]}]" if own.bounds else ""
        system += f'{name} = {{ value = {own.value}, unit = "{own.unit}"{bounds} }}\n'
    (folder / "system.toml").write_text(system + equations, encoding="utf-8")
    (folder / "options.json").write_text('{"exclude":[]}', encoding="utf-8")


def plans(count: int, random: Random) -> Iterator[tuple[int, int]]:
    """Machines take turns, and within a machine kinds do."""
    orders = []
    for machine in MACHINES:
        every = causes(machine)
        order = random.permutation(len(every)).tolist()
        turn = [sum(every[k][0] == every[i][0] for k in order[:at]) for at, i in enumerate(order)]
        orders.append([i for _, i in sorted(zip(turn, order, strict=True), key=lambda pair: pair[0])])
    for i in range(count):
        own = orders[i % len(orders)]
        yield i % len(orders), own[i // len(orders) % len(own)]


def make(which_machine: int, which: int | None, seed: int, folder: Path) -> dict[str, object]:
    """One case; its answer, as `parallax withheld` opens it."""
    machine = MACHINES[which_machine]
    random = np.random.default_rng(seed)
    noise = np.array([low * (high / low) ** random.random() for _, low, high in machine.outputs.values()])
    real = {}
    for name, own in machine.parameters.items():
        value = own.value * (1 + own.spread * random.uniform(-1, 1))
        real[name] = float(np.clip(value, *own.bounds)) if own.bounds else value
    commands = np.stack([excitation(machine, size, random) for _, _, size in machine.inputs.values()])
    case, worth, class_ = Case(machine, real, commands, []), 0.0, []
    if which is not None:
        kind, place = causes(machine)[which]
        for _ in range(TRIES):
            case = replace(case, causes=[draw(machine, kind, place, random)])
            try:
                worth, class_ = judge(case, noise, random)
            except Diverged:
                continue
            if worth >= LEAST:
                break
        else:
            raise RuntimeError(f"{kind}@{place} of {machine.name} left no trace in {TRIES} draws")
    seen = case.readings()
    seen = seen + noise[:, None] * random.standard_normal(seen.shape)
    write(case, seen, noise, bool(random.random() < 0.5), folder)
    effects = [
        {
            "name": cause.kind,
            "place": cause.place,
            "form": "MuJoCo's own" if cause.place.startswith("joint") else "before and after MuJoCo",
            # Within a soft stop MuJoCo scales all other forces as well: its stiffness is not that of a spring.
            "parameters": {key: value for key, value in cause.parameters.items() if key != SOFT.get(cause.kind)},
        }
        for cause in case.causes
    ]
    return {
        "set": "null" if which is None else "single",
        "system": machine.name,
        "effects": effects,
        "outside": None,
        "detectability": worth,
        "class": class_,
    }


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--singles", type=int, default=45, help="cases of one effect (default: 45)")
    parser.add_argument("--nulls", type=int, default=15, help="cases without an effect (default: 15)")
    parser.add_argument("--out", type=Path, required=True, help="the run's folder; it must not be there yet")
    parser.add_argument("--dev-seed", type=int, default=None, help="a seed for development; without it one is drawn")
    given = parser.parse_args()
    if min(given.singles, given.nulls) < 0 or given.singles + given.nulls == 0:
        parser.error("no case is asked for; state --singles or --nulls, such as --singles 10")
    if given.out.exists():
        parser.error(f"{given.out} is there already; name another --out")
    development = given.dev_seed is not None
    seed = given.dev_seed % REPORTED if development else secrets.randbits(63) | REPORTED
    random = np.random.default_rng(seed)
    drafts: list[tuple[int, int | None]] = [*plans(given.singles, random)]
    drafts += [(k % len(MACHINES), None) for k in range(given.nulls)]
    names = random.permutation(len(drafts))
    offset = int(random.integers(1 << 28))
    jobs = []
    for k, (machine, which) in enumerate(drafts):
        # Names that say nothing: in their order, kinds are mixed. An odd factor maps different numbers to others.
        name = f"{(int(names[k]) + offset) * 0x9E3779B1 % (1 << 32):08x}"
        own = int(random.integers(1 << 62)) | (seed & REPORTED)
        jobs.append((machine, which, own, given.out / "cases" / name))
    cases = {}
    with ProcessPoolExecutor() as pool:
        for (machine, which, own, folder), answer in zip(jobs, pool.map(make, *zip(*jobs, strict=True)), strict=True):
            plan = {"set": answer["set"], "system": machine, "effect": which or 0}
            cases[folder.name] = {"answer": answer, "left_out": False, "plan": plan, "seed": own}
            print(f"\r{len(cases)} of {len(jobs)} cases", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    text = json.dumps({"seed": seed, "development": development, "cases": cases}, indent=2)
    (given.out / "answers.json").write_text(text, encoding="utf-8")
    seal = hashlib.sha256(text.encode()).hexdigest()
    (given.out / "answers.sha256").write_text(f"{seal}  answers.json\n", encoding="utf-8")
    print(f"answers sealed, SHA-256 {seal}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
