"""Several recordings of one block (days, aircraft) as one block.

Points with the same name are one point: known points as they are; tie points only where the rays of one recording meet
near those of the other, and about as far off, in the same direction, as at the points around. A matcher gives its names
again for other points, which lie near each other where a flight line is flown twice. Strips keep their own corrections,
and the a-priori sigmas of their recording.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..arrays import Array, Bools, IntArray
from ..geometry.frames import LocalFrame
from ..geometry.rotation import matrix_from_quaternion, quaternion_from_matrix
from ..geometry.trajectory import Trajectory
from .block_data import BlockData, ImagePoints, KnownPoints, network_from_block
from .network import Strip

#: Tie points of one name farther apart than this share of the height above ground are different points. Measured
#: orientation errs by less, and a single look says no more; a name that comes again by chance lies anywhere.
APART = 0.05
#: Where orientation errs, neighbouring points are off by much the same: where names mean the same, by hundredths of
#: APART more or less (0.02 with half a degree of boresight); where they come again by chance, by about APART. It is
#: chance where the middle difference is above this share of APART, or less than this share of the points near. Tuned.
UNLIKE, MOSTLY = 0.3, 0.5
#: Known coordinates of one name differ by less than this, m, or somebody is wrong; so do their sigmas, or it is told.
SAME_M = 1e-3


@dataclass(frozen=True)
class JoinedBlock:
    """Recordings as one block.

    Attributes
    ----------
    block : all of them
    recording : which of them each strip is of, by its name in the block
    strips, image_points : how many each recording has
    ground, ties : known points, and tie points, that more than one recording has looks at
    renamed : strips of which there were several, as (recording, name, name in the block)
    elsewhere : tie points whose name comes again at another place, and were kept apart
    restated : known points of which a later recording states other sigmas, as (point, recording that counts); the first
        that has the point counts
    repeated : pairs of recordings that hold the same measurements, which would count twice, and how many of them
    """

    block: BlockData
    recording: Mapping[str, int]
    strips: tuple[int, ...]
    image_points: tuple[int, ...]
    ground: int
    ties: int
    renamed: tuple[tuple[str, str, str], ...]
    elsewhere: int
    restated: tuple[tuple[str, str], ...] = ()
    repeated: tuple[tuple[str, str, int], ...] = ()


def join_blocks(blocks: Sequence[BlockData], names: Sequence[str]) -> JoinedBlock:
    """Join blocks; coordinates are in the frame of the first.

    Parameters
    ----------
    blocks : with the same camera
    names : of the recordings, for names of strips and points that come twice, and for errors; all different

    Raises
    ------
    ValueError : cameras, kinds of attitude or coordinates of a known point that differ
    """
    first = blocks[0]
    for block, name in zip(blocks[1:], names[1:], strict=True):
        if not _same_camera(first, block):
            raise ValueError(f"{name} has another camera than {names[0]}; blocks of one camera are adjusted together")
        if block.heading != first.heading:
            raise ValueError(f"the attitude of {name} is of another kind than that of {names[0]}")
    blocks = [first, *(_in_frame(block, first) for block in blocks[1:])]
    ground, known, restated = _known_points(blocks, names)
    strips, recording, renamed = _strips(blocks, names)
    point_ids, places, elsewhere = _point_names(blocks, names, known)
    first_strip = np.cumsum([0, *(len(b.strips) for b in blocks)])
    image = _image(blocks, places, first_strip)
    seen = np.zeros((len(blocks), len(point_ids)), dtype=bool)
    for i, (block, place) in enumerate(zip(blocks, places, strict=True)):
        seen[i, place[block.image.point]] = True
    common = seen.sum(axis=0) > 1
    notes = tuple(f"{name}: {note}" for block, name in zip(blocks, names, strict=True) for note in block.notes)
    joined = replace(
        first,
        name=first.name,
        strips=strips,
        point_ids=point_ids,
        ground=ground,
        image=image,
        apriori=replace(first.apriori, wide=any(block.apriori.wide for block in blocks)),
        notes=notes,
        refused=frozenset[str]().union(*(block.refused for block in blocks)),
    )
    of_ground = int(common[: len(ground)].sum())
    return JoinedBlock(
        joined,
        recording,
        tuple(len(b.strips) for b in blocks),
        tuple(len(b.image) for b in blocks),
        of_ground,
        int(common.sum()) - of_ground,
        renamed,
        elsewhere,
        restated,
        _repeated(blocks, names),
    )


def _repeated(blocks: Sequence[BlockData], names: Sequence[str]) -> tuple[tuple[str, str, int], ...]:
    """Recordings that hold image points of the same name, line, sample and time."""
    codes: dict[str, int] = {}
    parts = []
    for i, block in enumerate(blocks):
        code = np.array([codes.setdefault(id, len(codes)) for id in block.point_ids], dtype=float)
        image = block.image
        microseconds = np.round(1e6 * image.time_s)
        columns = [np.full(len(image), i), microseconds, image.sample, image.line, image.ccd, code[image.point]]
        parts.append(np.stack(columns)[:, np.isfinite(microseconds)])
    looks = np.concatenate(parts, axis=1)
    looks = looks[:, np.lexsort(looks)]
    same = (looks[1:, 1:] == looks[1:, :-1]).all(axis=0) & (looks[0, 1:] != looks[0, :-1])
    pairs = Counter(zip(looks[0, :-1][same].astype(int).tolist(), looks[0, 1:][same].astype(int).tolist(), strict=True))
    return tuple((names[a], names[b], number) for (a, b), number in sorted(pairs.items()))


def _same_camera(a: BlockData, b: BlockData) -> bool:
    left, right = a.camera, b.camera
    return (
        [line.id for line in left.lines] == [line.id for line in right.lines]
        and len(left.lenses) == len(right.lenses)
        and np.allclose(left.focal_length_mm, right.focal_length_mm, rtol=0.0, atol=1e-9)
        and np.allclose(left.principal_point_mm, right.principal_point_mm, rtol=0.0, atol=1e-9)
        and all(
            x.xy_mm.shape == y.xy_mm.shape and np.allclose(x.xy_mm, y.xy_mm, rtol=0.0, atol=1e-9)
            for x, y in zip(left.lines, right.lines, strict=True)
        )
    )


def _in_frame(block: BlockData, first: BlockData) -> BlockData:
    """A block with times that count from, and coordinates in the frame of, another one."""
    shift_s = (block.time_reference_ns - first.time_reference_ns) * 1e-9
    turn, offset = _between(block.frame, first.frame)
    if shift_s == 0.0 and turn is None:
        return block
    strips = tuple(_moved(strip, shift_s, turn, offset) for strip in block.strips)
    ground = block.ground
    if turn is not None:
        covariance = turn @ ground.covariance @ turn.T
        ground = replace(ground, xyz_l=ground.xyz_l @ turn.T + offset, covariance=covariance)
    image = replace(block.image, time_s=block.image.time_s + shift_s)
    return replace(
        block,
        strips=strips,
        ground=ground,
        image=image,
        frame=first.frame,
        time_reference_ns=first.time_reference_ns,
    )


def _between(frame: LocalFrame, other: LocalFrame) -> tuple[Array | None, Array]:
    """Rotation and offset from a frame to another; None where they are the same."""
    same = (frame.lat_deg, frame.lon_deg, frame.height_m) == (other.lat_deg, other.lon_deg, other.height_m)
    if same:
        return None, np.zeros(3)
    return other.R_el.T @ frame.R_el, (frame.origin_e - other.origin_e) @ other.R_el


def _moved(strip: Strip, shift_s: float, turn: Array | None, offset: Array) -> Strip:
    """A strip at other times and in another frame; the noise of its angles stays, frames are turned by little."""
    t, noise = strip.trajectory, strip.noise
    position, quaternion = t.position_l, t.quaternion
    if turn is not None:
        position = position @ turn.T + offset
        quaternion = quaternion_from_matrix(turn @ matrix_from_quaternion(quaternion))
        if noise is not None:
            whole = np.eye(6)
            whole[:3, :3] = turn
            noise = whole @ noise @ whole.T
    lines = None if strip.line_time_s is None else strip.line_time_s + shift_s
    return replace(
        strip,
        trajectory=Trajectory(t.time_s + shift_s, position, quaternion),
        first_line_time_s=strip.first_line_time_s + shift_s,
        line_time_s=lines,
        noise=noise,
    )


def _known_points(
    blocks: Sequence[BlockData], names: Sequence[str]
) -> tuple[KnownPoints, dict[str, int], tuple[tuple[str, str], ...]]:
    """Known points of all blocks, each once; their places; those with sigmas that differ, and whose count.

    Without those that an operator refused in one of the blocks, since the others state the same coordinates.
    """
    refused = frozenset[str]().union(*(block.refused for block in blocks))
    place: dict[str, int] = {}
    rows: list[tuple[int, int]] = []
    restated: dict[str, str] = {}
    for i, block in enumerate(blocks):
        for k, id in enumerate(block.ground.id):
            if id in refused:
                continue
            if id not in place:
                place[id] = len(rows)
                rows.append((i, k))
                continue
            j, m = rows[place[id]]
            apart = float(np.abs(block.ground.xyz_l[k] - blocks[j].ground.xyz_l[m]).max())
            if apart > SAME_M or block.ground.role[k] != blocks[j].ground.role[m]:
                raise ValueError(
                    f"known point {id}: {names[i]} and {names[j]} do not say the same "
                    f"({block.ground.role[k]} and {blocks[j].ground.role[m]}, {apart:.3f} m apart)"
                )
            sigma_m, counts_m = (
                np.sqrt(np.diagonal(b.ground.covariance[of])) for b, of in ((block, k), (blocks[j], m))
            )
            if np.abs(sigma_m - counts_m).max() > SAME_M:
                restated[id] = names[j]
    radius = tuple(
        blocks[i].ground.target_radius_m[k] if blocks[i].ground.target_radius_m else 0.0 for i, k in rows
    )  # fmt: skip
    ground = KnownPoints(
        tuple(blocks[i].ground.id[k] for i, k in rows),
        np.array([blocks[i].ground.xyz_l[k] for i, k in rows]).reshape(-1, 3),
        np.array([blocks[i].ground.covariance[k] for i, k in rows]).reshape(-1, 3, 3),
        tuple(blocks[i].ground.role[k] for i, k in rows),
        radius if any(block.ground.target_radius_m for block in blocks) else (),
    )
    return ground, place, tuple(restated.items())


def _strips(
    blocks: Sequence[BlockData], names: Sequence[str]
) -> tuple[tuple[Strip, ...], dict[str, int], tuple[tuple[str, str, str], ...]]:
    """Strips of all blocks with names of their own, the recording of each, and which were renamed."""
    count = Counter(strip.id for block in blocks for strip in block.strips)
    strips, recording, renamed = [], {}, []
    for i, (block, name) in enumerate(zip(blocks, names, strict=True)):
        for strip in block.strips:
            id = strip.id
            if count[id] > 1:
                base = id if strip.lens is None else id.removesuffix(f"/{strip.lens}")
                id = f"{base}@{name}" if strip.lens is None else f"{base}@{name}/{strip.lens}"
                renamed.append((name, strip.id, id))
            strips.append(replace(strip, id=id))
            recording[id] = i
    return tuple(strips), recording, tuple(renamed)


def _point_names(
    blocks: Sequence[BlockData], names: Sequence[str], known: Mapping[str, int]
) -> tuple[tuple[str, ...], list[IntArray], int]:
    """Names of all points, known ones first; places among them of each block's points; how many were kept apart."""
    count = Counter(id for block in blocks for id in block.point_ids if id not in known)
    shared = {id for id, n in count.items() if n > 1}
    at: dict[str, Array] = {}
    place, places, elsewhere = dict(known), [], 0
    for i, block in enumerate(blocks):
        own, reach = _positions(block, shared) if shared else ({}, 0.0)
        of_kind: dict[str, list[str]] = {}  # those who give names number them: S1-M1, S1-M2
        for id in own:
            if id in at:
                of_kind.setdefault(id.rstrip("0123456789"), []).append(id)
        others = set[str]()
        for ids in of_kind.values():
            apart = other_points(np.array([own[id] for id in ids]), np.array([at[id] for id in ids]), reach)
            others.update(id for id, other in zip(ids, apart.tolist(), strict=True) if other)
        at |= {id: xyz for id, xyz in own.items() if id not in at}
        elsewhere += len(others)
        named = [f"{id}@{names[i]}" if id in others else id for id in block.point_ids]
        places.append(np.array([place.setdefault(id, len(place)) for id in named], dtype=np.int64))
    return tuple(place), places, elsewhere


def other_points(xyz: Array, known: Array, reach: float) -> Bools:
    """Which points of a recording are others than those of the same name in the recordings before it.

    Parameters
    ----------
    xyz, known : (N, 3) where each of them lies in the recording, and in those before, m
    reach : points farther apart are others anyhow, m

    Returns
    -------
    (N,) truth values
    """
    from scipy.spatial import cKDTree

    off = xyz - known
    near = np.linalg.norm(off, axis=1) <= reach
    if near.sum() < MOSTLY * len(near):
        return np.ones(len(near), dtype=bool)
    if near.sum() > 2:
        _, pairs = cKDTree(known[near]).query(known[near], k=2)
        if np.median(np.linalg.norm(np.diff(off[near][pairs], axis=1), axis=2)) > UNLIKE * reach:
            return np.ones(len(near), dtype=bool)
    return ~near


def _positions(block: BlockData, wanted: set[str]) -> tuple[dict[str, Array], float]:
    """Where the measured rays of some points meet, and how far away another recording may see them."""
    some = np.array([id in wanted for id in block.point_ids], dtype=bool)
    rows = np.flatnonzero(some[block.image.point])
    if not len(rows):
        return {}, 0.0
    image = block.image
    of_sample = None if image.sigma_sample_px is None else image.sigma_sample_px[rows]
    few = ImagePoints(
        image.point[rows], image.strip[rows], image.ccd[rows], image.line[rows], image.sample[rows],
        image.sigma_px[rows], image.time_s[rows], {}, of_sample,
    )  # fmt: skip
    try:
        network = network_from_block(replace(block, image=few))
    except ValueError:  # no ray that could be used
        return {}, 0.0
    above = float(np.median(network.rays.position_l[:, 2] - network.approximate_l[network.rays.point, 2]))
    places = {id: network.approximate_l[k] for k, id in enumerate(network.point_ids) if id in wanted}
    return places, APART * max(above, 0.0)


def _image(blocks: Sequence[BlockData], places: Sequence[IntArray], first_strip: IntArray) -> ImagePoints:
    """Image points of all blocks, one block after the other."""
    first_row = np.cumsum([0, *(len(b.image) for b in blocks)])

    def joined(name: str) -> Any:
        return np.concatenate([getattr(block.image, name) for block in blocks])

    of_sample = [b.image.sigma_px if b.image.sigma_sample_px is None else b.image.sigma_sample_px for b in blocks]
    strip = [np.where(b.image.strip >= 0, b.image.strip + f, -1) for b, f in zip(blocks, first_strip, strict=False)]
    return ImagePoints(
        np.concatenate([place[b.image.point] for b, place in zip(blocks, places, strict=True)]),
        np.concatenate(strip),
        joined("ccd"),
        joined("line"),
        joined("sample"),
        joined("sigma_px"),
        joined("time_s"),
        {
            row + int(f): words
            for b, f in zip(blocks, first_row, strict=False)
            for row, words in b.image.unknown.items()
        },
        np.concatenate(of_sample),
    )
