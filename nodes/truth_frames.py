"""The local frame in which the truth of a simulation is."""

from __future__ import annotations

from typing import Any

from ..schemas import topics
from . import convert
from .node import Message

_PROJECT = "configuration/project"


class TruthFrames:
    """Tells whether truth is in the local frame of a project: it is in that of the last project of its own source that
    nodes used.

    A project of someone else, which an operator lets in in flight, changes the frame of results, but not of truth.
    """

    def __init__(self) -> None:
        self._said: dict[str, Any] = {}

    def note(self, message: Message) -> None:
        """Keep a project that nodes use; messages come in order of their stamps."""
        if message.topic == _PROJECT:
            self._said[message.source] = message.body

    def is_elsewhere(self, message: Message, project: Any) -> bool:
        """Whether a message is truth in another local frame than that of the project."""
        if topics.find(message.topic).family is not topics.Family.TRUTH:
            return False
        said = self._said.get(message.source)
        return said is not None and project is not None and not convert.same_frame(said, project)
