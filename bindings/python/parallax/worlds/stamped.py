"""Simulators in plain Python that integrate to the stamps of the commands.

They do not integrate to their own wake-ups: a command that arrives late still acts from when it was sent, and the
scheduler's jitter does not become a delay of the machine.
"""

from __future__ import annotations

from typing import Any

from ..member import PlainNode
from ..nodes import Step
from ..types import Tree
from .ports import Ports

__all__ = ["StampedWorld"]


class StampedWorld(PlainNode):
    """A simulator that keeps its state as of the last command, and shows what is predicted from there."""

    _ports: Ports

    def _set_ports(self, ports: Ports) -> None:
        self._ports = ports
        self._last = dict.fromkeys(ports, -1)

    def step(self, step: Step) -> Tree:
        """What is shown now, given the commands that have come."""
        self._ports.check(self.name, step.inputs)
        news = []
        for port in self._ports:
            for message in step[port]:
                if message.seq > self._last[port]:
                    self._last[port] = message.seq
                    news.append((message.sent, port, message.message))
        for sent, port, message in sorted(news, key=lambda command: command[0]):
            self._advance(sent)
            for actuator, value in self._ports.driven(port, message):
                self._drive(actuator, float(value))
        return self._predicted(step.start)

    def _advance(self, time: float) -> None:
        """Integrates what is kept to `time` (s), if that is not past."""
        raise NotImplementedError

    def _drive(self, actuator: int, command: float) -> None:
        """Holds a command from now on."""
        raise NotImplementedError

    def _predicted(self, time: float) -> Any:
        """What is shown at `time` (s); what is kept stays."""
        raise NotImplementedError
