"""Trainable delays: which messages a step sees follows from a number that gradients may move."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp

from .nodes import Message
from .types import Array, Scalar, Tree

__all__ = ["TrainableDelay", "select_messages"]


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


def _pick(arrived: Sequence[Array], choices: Sequence[Scalar], first: int) -> Scalar:
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

    return [
        Message(lambda name, index=index: stamp(name, index), lambda index=index: payload(index))
        for index in range(window)
    ]
