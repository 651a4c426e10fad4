"""What Zenoh says of an error, as one line for the user."""

from __future__ import annotations

import difflib
import re

#: Keys that Zenoh knows are told where they are no more than so many.
MOST_KNOWN = 6


def _unknown_word(text: str) -> str:
    """Which key or value of a configuration Zenoh does not know, where, and what may be meant; "" for another error."""
    found = re.search(r"unknown (field|variant) `([^`]*)`, expected (?:one of )?((?:`[^`]*`(?:, | or )?)+)", text)
    if found is None:
        return ""
    known = re.findall(r"`([^`]*)`", found[3])
    near = difflib.get_close_matches(found[2], known, n=1) or (known if len(known) <= MOST_KNOWN else [])
    wanted = " or ".join(filter(None, (", ".join(near[:-1]), *near[-1:])))
    more = f"one of {len(known)}: {', '.join(sorted(known)[:MOST_KNOWN])} .."
    line = re.search(r"\bline:? (\d+)", text[found.end() :])
    kind = "key" if found[1] == "field" else "value"
    return f"{f'line {line[1]}: ' if line else ''}unknown {kind} {found[2]!r}, wanted {wanted or more}"


def one_line(error: Exception) -> str:
    """What Zenoh says, without the place in its own source and the picture of the line."""
    text = str(error)
    if said := _unknown_word(text):
        return said
    found = re.search(r"JSON error: Message \{ msg: \"(.*?)\", location: Some\(Location \{ line: (\d+)", text)
    if found:
        return f"line {found[2]}: {found[1]}"[:300]
    text = re.sub(r"\s+at /\S+\.rs:\d+\.?", "", text)
    picture = re.search(r"--> (\d+):(\d+)\n.*\n\s*=\s*(.*)", text, re.DOTALL)
    if picture:
        text = f"line {picture[1]}, column {picture[2]}: {picture[3]}"
    return " ".join(text.split())[:300]
