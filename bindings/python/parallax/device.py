"""Where a node's step runs: a device of JAX, said as text, so that it can stand in a graph."""

from __future__ import annotations

import os
from typing import Any

import jax

__all__ = ["choose_platform", "device_text", "found_device"]


def device_text(device: Any) -> str:
    """`gpu:0` for a device of JAX; text stays what it is."""
    if isinstance(device, str):
        return device
    if isinstance(device, jax.Device):
        # Its place among its kind, and not its id, which is global where there are several processes.
        return f"{device.platform}:{jax.devices(device.platform).index(device)}"
    raise TypeError(f"{device!r} is no device: give one of jax.devices(), or text such as 'cpu' or 'gpu:0'")


def found_device(device: str | None, node: str) -> jax.Device | None:
    """The device called so here; raises `ValueError` naming `node` and the devices that there are."""
    if device is None:
        return None
    platform, _, index = device.partition(":")
    try:
        return jax.devices(platform)[int(index or 0)]
    except (RuntimeError, IndexError, ValueError) as error:
        there = ", ".join(f"{known.platform}:{place}" for place, known in enumerate(jax.devices()))
        raise ValueError(f"node `{node}` is to step on `{device}`, and JAX finds {there} here ({error})") from None


def choose_platform(device: str | None) -> None:
    """Keeps the process of a node from the accelerators that it does not use; before JAX is used for the first time.

    A step without a device runs on the processor, and one on a GPU takes of its memory what it needs.
    """
    if device is None or device.partition(":")[0] == "cpu":
        settings: Any = jax.config
        settings.update("jax_platforms", "cpu")
    else:
        os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
