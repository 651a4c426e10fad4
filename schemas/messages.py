"""The message classes, made from the committed descriptor set.

A pool of our own keeps them apart from other packages' classes for the same Foxglove messages.
"""

from __future__ import annotations

from importlib.resources import files
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

_SET = descriptor_pb2.FileDescriptorSet.FromString((files("triline.schemas") / "triline.desc").read_bytes())
_POOL = descriptor_pool.DescriptorPool()
for _file in _SET.file:
    _POOL.Add(_file)


def message_class(full_name: str) -> Any:
    """The class of a message type, e.g. ``"triline.TiePoint"``; raises KeyError for a type that is not in the set."""
    return message_factory.GetMessageClass(_POOL.FindMessageTypeByName(full_name))


def new_class(file: descriptor_pb2.FileDescriptorProto) -> Any:
    """The class of the first message type of a file that is not in the set; the types it is made of are."""
    _POOL.Add(file)
    return message_class(f"{file.package}.{file.message_type[0].name}")


LocationFix = message_class("foxglove.LocationFix")
PoseInFrame = message_class("foxglove.PoseInFrame")
RawImage = message_class("foxglove.RawImage")
Log = message_class("foxglove.Log")
Imu = message_class("triline.Imu")
Attitude = message_class("triline.Attitude")
Strip = message_class("triline.Strip")
Camera = message_class("triline.Camera")
Lens = message_class("triline.Lens")
CcdLine = message_class("triline.CcdLine")
Project = message_class("triline.Project")
ImagePoint = message_class("triline.ImagePoint")
TiePoint = message_class("triline.TiePoint")
GroundPoint = message_class("triline.GroundPoint")
TargetLook = message_class("triline.TargetLook")
Progress = message_class("triline.Progress")
Verdict = message_class("triline.Verdict")
AdjustmentReport = message_class("triline.AdjustmentReport")
Pace = message_class("triline.Pace")
RejectedObservation = message_class("triline.RejectedObservation")
BiasedSource = message_class("triline.BiasedSource")
ParameterEstimate = message_class("triline.ParameterEstimate")
ObjectPoint = message_class("triline.ObjectPoint")
RayResidual = message_class("triline.RayResidual")
NodeStatus = message_class("triline.NodeStatus")
Inventory = message_class("triline.Inventory")
TopicStatistics = message_class("triline.TopicStatistics")
Counter = message_class("triline.Counter")
GroundTile = message_class("triline.GroundTile")
