"""A node that is given messages one after another, as its runners do."""

from __future__ import annotations

from collections.abc import Iterable

from triline.nodes.node import Message, Node


def stepped(node: Node, messages: Iterable[Message]) -> list[Message]:
    """What a node says to messages, and in the end."""
    return [out for message in messages for out in node.step(message)] + list(node.finish())
