"""What a network leaves undetermined, in words.

The information on the unknowns is split into what the observations give and what the a-priori weights add. Directions
in which the observations give next to nothing rest on the a-priori weights alone; they are found as eigenvectors and
named: "kappa drift of strip S2", "camera constant with flying height".
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from ..arrays import Array

#: Share of the information below which the observations do not determine a combination.
SHARE = 0.02

#: See `undetermined`.
FREE = 1e5

#: A member's part in a combination, of the largest part, from which on it is named.
PART = 0.35

#: Names that read better than those of the unknowns.
_WORDS = {
    "dc": "camera constant",
    "Z offset": "flying height",
    "k1": "radial distortion k1",
    "k2": "radial distortion k2",
    "k3": "radial distortion k3",
    "p1": "decentring distortion p1",
    "p2": "decentring distortion p2",
}
_PARAMETERS = {
    "xp": "shift along flight",
    "yp": "shift across flight",
    "sy": "scale",
    "th": "inclination",
    "dx": "shift along flight",
    "dy": "shift across flight",
    "b": "bending",
    "s": "scale",
    "dc": "camera constant",
}
_NAME = re.compile(r"^(?P<what>.+?)(?: (?:at|of|in) (?P<node>(?:fix|segment|border) \d+))? of (?P<set>strip .+)$")


@dataclass(frozen=True)
class Combination:
    """A combination of unknowns that the observations do not determine.

    Attributes
    ----------
    words : what it is
    share : of the information on it that comes from the observations, 0 to 1
    unknowns : the main members
    """

    words: str
    share: float
    unknowns: tuple[str, ...]


def undetermined(
    observed: Array, prior: Array, alone: Array, names: Sequence[str], sets: int, share: float = SHARE
) -> list[Combination]:
    """Combinations of unknowns that rest on a-priori weights alone, the least determined first.

    Parameters
    ----------
    observed : (u, u) normal matrix of the observations with the object points eliminated
    prior : (u, u) normal matrix of the a-priori weights
    alone : (u,) information on each unknown if it were the only one; an unknown without a-priori weight counts as
        undetermined where all others leave it a sigma `FREE` times the one it would have alone
    names : (u,)
    sets : number of correction sets, to tell "of all strips" from "of strip S2 and S3"
    """
    u = len(names)
    if u == 0:
        return []
    total = alone + np.diag(prior)
    unit = np.divide(1.0, np.sqrt(total), out=np.ones(u), where=total > 0)
    N, P = observed * unit[:, None] * unit, prior * unit[:, None] * unit
    P[np.diag_indices(u)] += alone * unit**2 / FREE**2
    values, vectors, P = _shares(N, P)
    weak = values < share
    if not weak.any():
        return []
    directions = vectors[:, weak]
    basis = _simple_basis(directions / np.linalg.norm(directions, axis=0))
    found = []
    for y in basis.T:
        part = np.abs(y)
        member = np.flatnonzero(part > PART * part.max())
        member = member[np.argsort(-part[member], kind="stable")]
        s = float(y @ N @ y) / float(y @ (N + P) @ y)
        unknowns = tuple(str(names[i]) for i in member)
        found.append(Combination(describe(unknowns, sets), max(s, 0.0), unknowns))
    found.sort(key=lambda c: c.share)
    merged: list[Combination] = []
    for c in found:
        if c.words not in {m.words for m in merged}:
            merged.append(c)
    return merged


def _shares(N: Array, P: Array) -> tuple[Array, Array, Array]:
    """Eigenvalues of N against N + P, their vectors, and P with what its diagonal needs to make the sum regular."""
    little = 1e-13
    while True:
        padded = P + little * np.eye(len(P))
        try:
            values, vectors = linalg.eigh(N, N + padded)
            return values, vectors, padded
        except linalg.LinAlgError:
            little *= 10.0
            if little > 1.0:
                raise


def _simple_basis(directions: Array) -> Array:
    """Basis (u, d) of the same space as (u, d), with as few members in each vector as elimination can reach."""
    order = np.asarray(linalg.qr(directions.T, pivoting=True, mode="economic")[-1])
    pivots = order[: directions.shape[1]]
    basis = np.linalg.solve(directions[pivots].T, directions.T).T
    return basis / np.abs(basis).max(axis=0)


def describe(unknowns: Sequence[str], sets: int) -> str:
    """Members of a combination as one phrase; the same correction of all sets is said once."""
    found: dict[str, dict[str, list[str]]] = {}  # correction -> set -> fixes or segments
    for name in unknowns:
        match = _NAME.match(name)
        if match is None:
            found.setdefault(name, {})
            continue
        nodes = found.setdefault(match["what"], {}).setdefault(match["set"], [])
        if match["node"]:
            nodes.append(match["node"])
    phrases = [word(what) + _where(places, sets) for what, places in found.items()]
    return " with ".join(phrases[:4]) + (f" and {len(phrases) - 4} more" if len(phrases) > 4 else "")


def _where(places: dict[str, list[str]], sets: int) -> str:
    if not places:
        return ""
    if sets > 1 and len(places) == sets:
        return " of all strips"
    nodes = list(dict.fromkeys(node for of_set in places.values() for node in of_set))
    text = ""
    if nodes:
        numbers = sorted(int(node.split()[1]) for node in nodes)
        text = f" at {nodes[0].split()[0]} " + ", ".join(map(str, numbers[:4])) + (" ..." if len(numbers) > 4 else "")
    first, *more = places
    text += " of " + " and ".join([first, *(w.removeprefix("strip ") for w in more[:3])])
    return text + (f" and {len(more) - 3} more" if len(more) > 3 else "")


def word(name: str) -> str:
    """An unknown as people say it."""
    if name in _WORDS:
        return _WORDS[name]
    kind, _, of = name.partition("_")
    if of and kind == "boresight":
        return f"{kind} {of}"
    if of and kind in _PARAMETERS:
        return f"{_PARAMETERS[kind]} of {'lens' if kind == 'dc' else 'line'} {of}"
    return name
