"""A recording as NumPy arrays and pandas tables, for notebooks and scripts.

>>> import triline
>>> flight = triline.open("flight.mcap")
>>> flight.table("adjustment/report")[["sigma0", "redundancy"]]
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ...schemas import messages as m
from ...schemas import topics
from ...schemas.image_lines import LineBlock
from ...solver.camera.line_camera import LineCamera
from ...solver.geometry.frames import LocalFrame
from .. import convert
from ..errors import UserError
from ..node import Message
from .reader import RecordingReader
from .summary import lacking, topic_summaries

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.floating]


@dataclass(frozen=True)
class PoseTable:
    """PoseTable of a topic as arrays, one row a message.

    Attributes
    ----------
    time_ns : (n,) int64, time of validity, ns since the Unix epoch
    position_l : (n, 3) m, local frame
    quaternion : (n, 4) ``R_lc``, xyzw
    angles : (n, 3) omega, phi, kappa, rad
    covariance : (n, 6, 6) X, Y, Z, omega, phi, kappa; m, rad; NaN where a message has none
    valid : (n,) bool
    strip : (n,) names
    """

    time_ns: NDArray[np.int64]
    position_l: Array
    quaternion: Array
    angles: Array
    covariance: Array
    valid: NDArray[np.bool_]
    strip: NDArray[Any]

    def one_a_time(self, keep_first: bool = False) -> PoseTable:
        """Rows in order of time: of several about one time the last, which replaces the others, or the first."""
        time = self.time_ns if keep_first else self.time_ns[::-1]
        rows = np.unique(time, return_index=True)[1]
        rows = rows if keep_first else len(time) - 1 - rows
        return self.part(rows)

    def part(self, rows: NDArray[Any]) -> PoseTable:
        """Some rows, by number or by whether."""
        return PoseTable(*(values[rows] for values in vars(self).values()))


class Recording:
    """A recording, opened for reading.

    Parameters
    ----------
    path : of an MCAP file, or its URL (`s3://bucket/flight.mcap`), of which is fetched what is asked for; a damaged one
        gives what can be read of it

    Raises
    ------
    UserError : no such file, or not an MCAP file
    """

    def __init__(self, path: str | Path) -> None:
        try:
            self.reader = RecordingReader(path, by_ranges=True)
        except IsADirectoryError:
            raise UserError(f"{path}: is a folder, wanted a recording") from None
        except OSError as error:
            raise UserError(f"{path}: {(error.strerror or str(error)).lower()}") from None

    def __repr__(self) -> str:
        return f"Recording({str(self.reader.path)!r}, {len(self.reader.channel_of)} messages)"

    def topics(self) -> pd.DataFrame:
        """One row a topic: messages, first and last stamp, rate (NaN where none is known), sources, gaps."""
        import pandas as pd  # takes longer to import than all the rest

        rows = topic_summaries(self.reader)
        table = pd.DataFrame([vars(row) for row in rows], columns=pd.Index(vars(rows[0]) if rows else ["topic"]))
        return table.astype({"rate_hz": float} if rows else {}).set_index("topic")

    def messages(self, *wanted: str) -> Iterator[Message]:
        """Decoded messages of some topics (of all where none are named) in the order of their stamps."""
        for name in wanted:
            self._check(name)
        return self.reader.sorted_messages(wanted or None)

    def table(self, topic: str) -> pd.DataFrame:
        """A topic with one row a message and one column a field.

        Fields of parts are named ``part.field``, values of a list of numbers ``field_0`` and so on; lists of parts, and
        lists whose length differs from message to message, stay one object column. ``stamp_ns``, ``sequence`` and
        ``source`` are the envelope's; times of type Timestamp become int64 ns.
        """
        import pandas as pd  # takes longer to import than all the rest

        rows = []
        for message in self.messages(topic):
            row: dict[str, Any] = {
                "stamp_ns": message.stamp_ns, "sequence": message.sequence, "source": message.source,
            }  # fmt: skip
            if isinstance(message.body, LineBlock):
                row.update({name: getattr(message.body, name) for name in LineBlock.__slots__})
            else:
                _flatten(message.body, "", row)
            rows.append(row)
        if not rows:
            return pd.DataFrame(columns=pd.Index(["stamp_ns", "sequence", "source"]))
        return _spread(pd.DataFrame(rows))

    def poses(self, topic: str = "orientation/final") -> PoseTable:
        """The poses of a topic that carries PoseInFrame messages, as arrays.

        Those that are in another local frame, which a project before in the same flight had, are left out.
        """
        if topics.find(self._check(topic)).type is not m.PoseInFrame:
            raise UserError(f"{self.reader.path}: {topic} carries {topics.find(topic).type_name}, not poses")
        bodies = [message.body for message in self.reader.in_frame(self.messages(topic))]
        poses = [convert.plain_pose(body) for body in bodies]  # arrays are made of all at once
        n = len(poses)
        none = [np.nan] * 36
        quaternion = np.array([pose.quaternion for pose in poses]).reshape(n, 4)
        return PoseTable(
            time_ns=np.array([pose.time_ns for pose in poses], dtype=np.int64),
            position_l=np.array([pose.position_l for pose in poses]).reshape(n, 3),
            quaternion=quaternion,
            angles=convert.angles_of(quaternion).reshape(n, 3) if n else np.empty((0, 3)),
            covariance=np.array([pose.covariance or none for pose in poses]).reshape(n, 6, 6),
            valid=np.array([pose.valid for pose in poses], dtype=bool),
            strip=np.array([body.strip for body in bodies], dtype=object),
        )

    def camera(self) -> LineCamera:
        """The camera, as it was stated last."""
        return convert.camera_from(self._last("configuration/camera"))

    def project(self) -> Any:
        """The Project message, as it was stated last: frame, mounting, a-priori accuracies."""
        return self._last("configuration/project")

    def frame(self) -> LocalFrame:
        """The local frame of the project, with its CRS."""
        return convert.local_frame(self.project())

    def true_world(self) -> str:
        """By what the world of a simulation differs from what is stated; "" where it does not, or is not known."""
        body = self.reader.first("truth/world")
        return "" if body is None else body.message

    def last_strips(self) -> dict[str, Any]:
        """The strips by name, each as its last message has it, in the order in which they began."""
        return {message.body.id: message.body for message in self.messages("configuration/strip")}

    def strips(self) -> pd.DataFrame:
        """One row a strip: first line time, line rate, number of lines as known last."""
        import pandas as pd  # takes longer to import than all the rest

        columns = ["id", "first_line_time_ns", "line_rate_hz", "lines", "ended"]
        rows = [[getattr(body, name) for name in columns] for body in self.last_strips().values()]
        return pd.DataFrame(rows, columns=pd.Index(columns)).set_index("id")

    def _last(self, topic: str) -> Any:
        body = self.reader.last(self._check(topic))
        if body is None:
            raise lacking(self.reader, f"no {topic} in it")
        return body

    def _check(self, topic: str) -> str:
        known = any(topic == row.name or row.matches(topic) for row in topics.TOPICS)
        if not known:
            held = sorted({channel.topic for channel in self.reader.channels.values() if channel.known})
            raise UserError(f"{self.reader.path}: no topic {topic!r}; it holds {', '.join(held)}")
        return topic


def _flatten(body: Any, prefix: str, row: dict[str, Any]) -> None:
    for field in body.DESCRIPTOR.fields:
        name, value = prefix + field.name, getattr(body, field.name)
        if field.message_type is None:
            row[name] = value if not _repeated(value) else np.array(value)
        elif field.message_type.full_name == "google.protobuf.Timestamp":
            row[name + "_ns"] = convert.time_ns(value)
        elif _repeated(value):
            row[name] = list(value)
        else:
            _flatten(value, name + ".", row)


def _repeated(value: Any) -> bool:
    return hasattr(value, "append") or hasattr(value, "add")


def _spread(table: pd.DataFrame) -> pd.DataFrame:
    """Columns of equally long number lists become one column a value."""
    import pandas as pd  # takes longer to import than all the rest

    columns: dict[str, Any] = {}
    for name in table.columns:
        values = table[name]
        lists = [v for v in values if isinstance(v, np.ndarray) and v.ndim == 1]
        sizes = {len(v) for v in lists}
        if len(lists) == len(values) and len(sizes) == 1 and (size := sizes.pop()) and size <= 36:
            matrix = np.stack(lists)
            columns.update({f"{name}_{i}": matrix[:, i] for i in range(size)})
        else:
            columns[str(name)] = values
    return pd.DataFrame(columns)
