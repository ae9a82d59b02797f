"""What a cause is worth in a recording, and what else would look like it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from causes import ONE_SIDED, Cause, Random, causes, draw, scaled
from run import Case

ALIKE = 0.97
"""The cosine from which two signatures are one class."""
LEAST = 4.0
"""A cause that is worth less than this after the best refit leaves no trace: it is drawn again."""


@dataclass(frozen=True)
class Refit:
    """What a refit leaves, in units of noise, and the slopes there: (readings,) and (readings, parameters)."""

    left: np.ndarray
    slopes: np.ndarray


def refit(case: Case, seen: np.ndarray, noise: np.ndarray, other: Cause | None, enough: float = 0.0) -> Refit:
    """The calibrated parameters, and those of another cause, where they leave least of `seen`: Gauss and Newton's
    method, with a step that is halved while it helps nothing. It ends where no more than `enough` is left."""
    free = {name: own.bounds for name, own in case.machine.parameters.items() if own.bounds}
    ranges = dict(free)
    first = {name: case.real[name] for name in free}
    for key, value in other.parameters.items() if other else ():
        ranges[f"cause {key}"] = (1e-6, math.inf) if other.kind in ONE_SIDED else (-math.inf, math.inf)
        first[f"cause {key}"] = value

    def error(at: dict[str, float]) -> np.ndarray:
        own = [replace(other, parameters={key: at[f"cause {key}"] for key in other.parameters})] if other else []
        real = case.real | {name: at[name] for name in free}
        try:
            shown = replace(case, real=real, causes=own).readings()
        except ValueError:
            # A body without mass, or a motion without bounds: the fit goes no such way.
            return np.full(seen.size, 1e9)
        return ((seen - shown) / noise[:, None]).ravel()

    at, left = first, error(first)
    slopes = np.zeros((left.size, len(ranges)))
    for _ in range(6):
        for k, (name, (low, high)) in enumerate(ranges.items()):
            width = 1e-3 * (high - low if math.isfinite(high - low) else max(abs(at[name]), 1e-6))
            slopes[:, k] = (error(at | {name: at[name] + width}) - left) / width
        step, *_ = np.linalg.lstsq(slopes, -left, rcond=None)
        part = 1.0
        for _ in range(5):
            there = {
                name: float(np.clip(at[name] + part * move, low, high))
                for (name, (low, high)), move in zip(ranges.items(), step, strict=True)
            }
            after = error(there)
            if after @ after < left @ left:
                break
            part /= 2
        else:
            break
        gained = left @ left - after @ after
        at, left = there, after
        if gained < 0.01 or left @ left <= enough:
            break
    return Refit(left, slopes)


def judge(case: Case, noise: np.ndarray, random: Random) -> tuple[float, list[str]]:
    """What the cause is worth after the best refit, and its class: what explains as much of that as a signature does
    whose cosine with the true one is `ALIKE`."""
    (cause,) = case.causes
    seen = case.readings()
    nominal = refit(case, seen, noise, None)
    worth = float(nominal.left @ nominal.left)
    if worth < LEAST:
        return worth, [cause.label]
    inside = np.linalg.qr(nominal.slopes)[0]
    class_ = [cause.label]
    held = replace(case, causes=[])
    plain = held.readings()
    enough = (1 - ALIKE**2) * worth
    for kind, place in causes(case.machine):
        if f"{kind}@{place}" == cause.label:
            continue
        other = draw(case.machine, kind, place, random)
        cosine = 0.0
        for _ in range(2):
            try:
                shown = replace(held, causes=[other]).readings()
            except ValueError:
                # A body without mass, or a motion without bounds, is like nothing.
                break
            own = ((shown - plain) / noise[:, None]).ravel()
            own -= inside @ (inside.T @ own)
            size = max(float(np.linalg.norm(own)), 1e-9)
            cosine = float(own @ nominal.left) / size / math.sqrt(worth)
            # A signature bends with its size: next it is compared at that of the true one.
            other = scaled(case.machine, other, math.copysign(math.sqrt(worth) / size, cosine))
        # To first order and about other parameters it may look like it by half; a fit says whether it does.
        if abs(cosine) > 0.5:
            fit = refit(case, seen, noise, other, enough)
            if fit.left @ fit.left <= enough:
                class_.append(other.label)
    return worth, class_
