"""XML metadata, read element by element: errors name file, element and what was wanted."""

from __future__ import annotations

import codecs
import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ....solver.orbit.time_scales import parse_time
from ...errors import UserError


class Element:
    """An element of an XML file.

    Parameters
    ----------
    path : file, for messages
    node : the element
    where : its place, ``Dimap_Document/Data_Strip``
    """

    def __init__(self, path: Path, node: ET.Element, where: str):
        self.path, self.node, self.where = path, node, where

    @property
    def tag(self) -> str:
        return self.node.tag

    def refuse(self, place: str, wanted: str, found: str | None = None) -> UserError:
        """The error for an element that is missing, or holds something else than what was wanted."""
        where = f"{self.where}/{place}" if place else self.where
        what = "missing" if found is None else repr(found if len(found) <= 60 else found[:57] + "...")
        return UserError(f"{self.path}: {where}: {what}, wanted {wanted}")

    def find(self, *places: str) -> Element | None:
        """The first of these places that is there."""
        for place in places:
            node = self.node.find(place)
            if node is not None:
                return Element(self.path, node, f"{self.where}/{place}")
        return None

    def need(self, place: str, wanted: str = "this element", *others: str) -> Element:
        """An element that must be there, in one of several places.

        Raises
        ------
        UserError : it is not there
        """
        found = self.find(place, *others)
        if found is None:
            raise self.refuse(place, wanted)
        return found

    def all(self, place: str, wanted: str = "at least one", *, least: int = 1) -> list[Element]:
        """All elements at a place.

        Raises
        ------
        UserError : fewer than ``least``
        """
        nodes = self.node.findall(place)
        if len(nodes) < least:
            found = None if not nodes else f"{len(nodes)} of them"
            raise self.refuse(place, wanted, found)
        return [Element(self.path, node, f"{self.where}/{place}[{i + 1}]") for i, node in enumerate(nodes)]

    def text(self, place: str = "", *others: str) -> str:
        """Text of an element.

        Raises
        ------
        UserError : missing or empty
        """
        element = self if not place else self.need(place, "a text", *others)
        text = (element.node.text or "").strip()
        if not text:
            raise element.refuse("", "a text", "empty")
        return text

    def number(self, place: str = "", *others: str, default: float | None = None) -> float:
        """A number.

        Raises
        ------
        UserError : missing or not a number
        """
        element = self if not place else self.find(place, *others)
        if element is None:
            if default is not None:
                return default
            raise self.refuse(place, "a number")
        text = (element.node.text or "").strip()
        try:
            value = float_of(text)
        except ValueError:
            value = float("nan")
        if not np.isfinite(value):
            raise element.refuse("", "a number", text)
        return value

    def integer(self, place: str, *others: str, low: int = 0) -> int:
        value = self.number(place, *others)
        if value != int(value) or value < low:
            raise self.refuse(place, f"an integer of at least {low}", f"{value:g}")
        return int(value)

    def numbers(self, place: str = "", count: int | None = None, *others: str) -> NDArray[np.float64]:
        """Several numbers in one element, separated by blanks.

        Raises
        ------
        UserError : missing, not numbers, or not ``count``
        """
        element = self if not place else self.need(place, f"{count or ''} numbers".strip(), *others)
        text = (element.node.text or "").strip()
        try:
            values = np.array([float_of(word) for word in re.split(r"[\s,;]+", text.strip(",; "))])
        except ValueError:
            values = np.empty(0)
        if not len(values) or not np.isfinite(values).all() or (count is not None and len(values) != count):
            raise element.refuse("", f"{count} numbers" if count else "numbers", text)
        return values

    def time(self, place: str = "", *others: str, scale: str = "UTC") -> int:
        """An instant, ``tai_ns``.

        Raises
        ------
        UserError : missing or not a time
        """
        element = self if not place else self.need(place, "a time", *others)
        text = (element.node.text or "").strip()
        try:
            return parse_time(text, scale)
        except ValueError as error:
            raise UserError(f"{element.path}: {element.where}: {error}") from None


def read_xml(path: Path) -> Element:
    """The root element of an XML file.

    Raises
    ------
    UserError : not XML, or broken off, with the line
    """
    data = path.read_bytes()
    before = len(data) - len(
        data.lstrip()
    )  # a declaration must come first; some programs write an empty line before it
    try:
        root = ET.fromstring(data[before:])
    except LookupError as error:  # an encoding that there is not
        raise UserError(f"{path}:1: {error}, wanted XML in UTF-8 or another that is known") from None
    except ET.ParseError as error:
        line = error.position[0] + data[:before].count(b"\n")
        raise UserError(f"{path}:{line}: not whole XML: {error.msg.split(':')[0]}, wanted a whole document") from None
    for node in root.iter():  # names of elements without their namespace
        if isinstance(node.tag, str) and node.tag.startswith("{"):
            node.tag = node.tag.split("}", 1)[1]
    return Element(path, root, root.tag)


def float_of(word: str) -> float:
    """A number, with an exponent as Fortran writes it (``1.5D+03``) too.

    Raises
    ------
    ValueError : not a number
    """
    return float(re.sub(r"(?<=[\d.])[dD](?=[-+\d])", "e", word))


def text_start(head: bytes) -> str:
    """How a text begins, without the mark of its encoding and blanks; empty for bytes that are none."""
    encoding = "utf-16" if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else "utf-8-sig"
    return head.decode(encoding, errors="ignore").lstrip().lstrip("\ufeff").lstrip()


def times_of(elements: Sequence[Element], place: str, *others: str, scale: str = "UTC") -> list[int]:
    """``tai_ns`` of each element."""
    return [element.time(place, *others, scale=scale) for element in elements]
