"""Delays that are known only at run time: chosen by a number that gradients may move, or by the sender's output."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
from jax import lax

from .nodes import Message
from .trees import flat
from .types import Array, Scalar, Tree

__all__ = ["OutputDelay", "TrainableDelay", "select_by_output", "select_messages"]

NANOSECONDS = 1e9


@dataclass(frozen=True)
class TrainableDelay:
    """A delay `min + alpha (max - min)` of which `alpha`, from 0 to 1, is a parameter of the compiled graph."""

    min: float
    """The shortest delay, s."""
    max: float
    """The longest, s."""
    interpolation: Literal["hold", "linear"]
    """Whether a message holds until the next, or payloads are interpolated between the two."""
    skip: bool = False
    """Whether a message that arrives exactly at the start is left for the next step."""

    def seconds(self, alpha: Scalar) -> Scalar:
        """The delay at `alpha`, s."""
        return self.min + jnp.clip(alpha, 0.0, 1.0) * (self.max - self.min)


@dataclass(frozen=True)
class OutputDelay:
    """The sender's step takes `offset + scale * leaf`, within bounds, and the message then travels for `travel`."""

    leaf: str
    """The leaf of the sender's output."""
    offset: float
    """Delay where the leaf is zero, s."""
    scale: float
    """Delay for each unit of the leaf, s."""
    min: float
    """The shortest, s."""
    max: float
    """The longest, s; also that of a leaf that is not a number."""
    travel: float
    """How long the message travels, s."""
    skip: bool = False
    """Whether a message that arrives exactly at the start is left for the next step."""

    def seconds(self, message: Tree) -> Array:
        """How long the step took that sent `message`, s: whole nanoseconds, as everywhere; the derivative is that
        before rounding."""
        (leaf,) = flat([self.leaf], message, "the output from which its node's delay follows")
        exact = self.offset + self.scale * jnp.asarray(leaf, float)
        exact = jnp.where(jnp.isnan(exact), self.max, jnp.clip(exact, self.min, self.max))
        return exact + lax.stop_gradient(_nanoseconds(exact) / NANOSECONDS - exact)


def _swapped(function: Callable[[str, int], Scalar], index: int, name: str) -> Scalar:
    return function(name, index)


def _nanoseconds(seconds: Scalar) -> Array:
    """Rounded to the nearest."""
    return jnp.floor(jnp.asarray(seconds, float) * NANOSECONDS + 0.5)


def _pick(arrived: Mapping[int, Array] | Sequence[Array], choices: Sequence[Scalar], first: int) -> Scalar:
    """`choices[count - first]`, where `count` is how many of the candidates, oldest first, have arrived."""
    result = choices[0]
    for place, choice in enumerate(choices[1:], start=first):
        result = jnp.where(arrived[place], choice, result)
    return result


def select_messages(
    delay: TrainableDelay,
    alpha: Scalar,
    start: Scalar,
    window: int,
    stamps: dict[str, list[Scalar]],
    payloads: Sequence[Callable[[], Tree]],
) -> list[Message]:
    """The window that a step at `start` (s) sees under the delay.

    `stamps` holds `seq`, `sent` and `received` of all candidates, oldest first, `payloads` reads their messages.
    Derivatives with respect to `alpha` pass through payloads that are interpolated; which messages are seen, and
    their stamps, have none.
    """
    seconds = delay.seconds(alpha)
    count = len(payloads)
    until = start - seconds

    def has_arrived(place: int) -> Array:
        sent, seq = stamps["sent"][place], stamps["seq"][place]
        on_time = sent < until if delay.skip else sent <= until
        return jnp.asarray(on_time | (jnp.asarray(seq) < 0))

    arrived = [has_arrived(place) for place in range(count)]

    def stamp(name: str, index: int) -> Scalar:
        choices = [stamps[name][index + offset] for offset in range(count - window + 1)]
        if name == "received":
            known = [stamps["seq"][index + offset] for offset in range(count - window + 1)]
            sent = [stamps["sent"][index + offset] for offset in range(count - window + 1)]
            choices = [jnp.where(jnp.asarray(s) < 0, 0.0, t + seconds) for s, t in zip(known, sent, strict=True)]
        return _pick(arrived, choices, window)

    def payload(index: int) -> Tree:
        trees = [payloads[index + offset]() for offset in range(count - window + 1)]
        held = jax.tree.map(lambda *leaves: _pick(arrived, leaves, window), *trees)
        if delay.interpolation == "hold":
            return held
        # The message after the held one, and where between the two the step looks.
        last = len(payloads) - 1
        later = [min(index + offset + 1, last) for offset in range(count - window + 1)]
        after = jax.tree.map(lambda *leaves: _pick(arrived, leaves, window), *(payloads[place]() for place in later))
        sent = stamp("sent", index)
        sent_after = _pick(arrived, [stamps["sent"][place] for place in later], window)
        look = until - (stamp("sent", window - 1) - sent)
        gap = jnp.asarray(sent_after - sent)
        share = jnp.where(gap > 0, (look - sent) / jnp.where(gap > 0, gap, 1.0), 0.0)
        # Before the first message and after the last it holds; initial messages are not interpolated.
        share = jnp.where(jnp.asarray(stamp("seq", index)) < 0, 0.0, jnp.clip(share, 0.0, 1.0))
        return jax.tree.map(lambda a, b: a + share * (b - a), held, after)

    return [Message(partial(_swapped, stamp, index), partial(payload, index)) for index in range(window)]


def select_by_output(
    delay: OutputDelay,
    start: Scalar,
    window: int,
    stamps: dict[str, list[Scalar]],
    payloads: Sequence[Callable[[], Tree]],
) -> list[Message]:
    """The window that a step at `start` (s) sees where the sender's outputs decide when they arrive.

    As `select_messages`, but that `sent` holds when the sender's steps started. In double precision arrivals are
    compared in whole nanoseconds, as the executor does: of the same outputs it sees the same messages, those included
    that arrive exactly at the start. In single precision, times of some seconds are known to a microsecond, and so are
    arrivals.
    """
    count = len(payloads)
    travel = round(delay.travel * NANOSECONDS)

    def has_arrived(place: int) -> Array:
        took = _nanoseconds(delay.seconds(payloads[place]())) + travel
        age = _nanoseconds(start - stamps["sent"][place])
        on_time = took < age if delay.skip else took <= age
        return jnp.asarray(on_time | (jnp.asarray(stamps["seq"][place]) < 0))

    # As many as the window holds are there under the longest delay.
    arrived = {place: has_arrived(place) for place in range(window, count)}

    def sent(place: int) -> Scalar:
        time = stamps["sent"][place] + delay.seconds(payloads[place]())
        return jnp.where(jnp.asarray(stamps["seq"][place]) < 0, 0.0, time)

    def received(place: int) -> Scalar:
        return jnp.where(jnp.asarray(stamps["seq"][place]) < 0, 0.0, sent(place) + delay.travel)

    known: dict[str, Callable[[int], Scalar]] = {
        "seq": lambda place: stamps["seq"][place],
        "sent": sent,
        "received": received,
    }

    def stamp(name: str, index: int) -> Scalar:
        return _pick(arrived, [known[name](index + offset) for offset in range(count - window + 1)], window)

    def payload(index: int) -> Tree:
        trees = [payloads[index + offset]() for offset in range(count - window + 1)]
        return jax.tree.map(lambda *leaves: _pick(arrived, leaves, window), *trees)

    return [Message(partial(_swapped, stamp, index), partial(payload, index)) for index in range(window)]
