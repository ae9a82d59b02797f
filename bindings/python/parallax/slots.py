"""The slots of a compiled graph: for each, which columns of the tables say when its node runs and what it reads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .delays import OutputDelay, TrainableDelay
from .tables import Column, TableBuilder

__all__ = ["Input", "Slot", "read_slot"]


@dataclass(frozen=True)
class Input:
    """The columns of one port of one slot; one entry per candidate."""

    port: str
    sender: int
    window: int
    connection: int
    stamps: dict[str, list[Column]]
    read: list[Column]
    trainable: TrainableDelay | None
    from_output: OutputDelay | None


@dataclass(frozen=True)
class Slot:
    """The columns of one slot."""

    node: int
    run: Column
    times: dict[str, Column]
    write: Column
    inputs: list[Input]


def read_slot(slot: Mapping[str, Any], ports: Sequence[str], builder: TableBuilder) -> Slot:
    """A slot of the compiler's, its columns added to the tables."""
    run = slot["run"].astype(bool)
    always = np.ones_like(run)
    inputs = []
    for name, rows in zip(ports, slot["inputs"], strict=bool(slot["inputs"])):
        candidates = range(rows["candidates"])
        trainable, from_output = rows["trainable"], rows["from_output"]
        inputs.append(
            Input(
                name,
                rows["from"],
                rows["window"],
                rows["connection"],
                {
                    "seq": [builder.numbers(rows["seq"][..., i], run) for i in candidates],
                    "sent": [builder.seconds(rows["sent"][..., i], run) for i in candidates],
                    "received": [builder.seconds(rows["received"][..., i], run) for i in candidates],
                },
                [builder.integers(rows["read"][..., i], run) for i in candidates],
                None if trainable is None else TrainableDelay(*trainable),
                None if from_output is None else OutputDelay(*from_output),
            )
        )
    return Slot(
        slot["node"],
        builder.integers(np.ones_like(run) if slot["always"] else run, always),
        {
            "seq": builder.numbers(slot["seq"], run),
            "due": builder.seconds(slot["due"], run),
            "start": builder.seconds(slot["start"], run),
        },
        builder.integers(slot["write"], run),
        inputs,
    )
