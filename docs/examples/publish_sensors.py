"""Publish a camera's image lines, attitude or inertial data, and GNSS onto the bus, without triline.

    python publish_sensors.py FOLDER --platform aircraft [--port 17447] [--desc triline.desc]

Needs eclipse-zenoh, protobuf and numpy. FOLDER stands for the drivers: gnss.csv (time_s,lat_deg,lon_deg,height_m,
sigma_m), imu.csv (time_s,interval_s,fx,fy,fz,wx,wy,wz), attitude.csv (time_s,roll,pitch,heading,sigma_rad), and for
each CCD line lines_<ccd>.npy (lines x pixels, uint8 or uint16) with lines.csv (first_time_s,rate_hz), from now on.
"""

import argparse
import json
import struct
import time
from pathlib import Path

import numpy as np
import zenoh
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

parser = argparse.ArgumentParser()
parser.add_argument("folder", type=Path)
parser.add_argument("--platform", default="aircraft")
parser.add_argument("--port", type=int, default=17447)
parser.add_argument("--desc", type=Path, default=Path(__file__).parents[2] / "schemas" / "triline.desc")
args = parser.parse_args()

# 1. The message classes, from the descriptor set (schemas/*.proto compiled).
pool = descriptor_pool.DescriptorPool()
for file in descriptor_pb2.FileDescriptorSet.FromString(args.desc.read_bytes()).file:
    pool.Add(file)
LocationFix, RawImage, Imu, Attitude = (
    message_factory.GetMessageClass(pool.FindMessageTypeByName(name))
    for name in ("foxglove.LocationFix", "foxglove.RawImage", "triline.Imu", "triline.Attitude")
)

# 2. The bus: a Zenoh peer on loopback that meets the others at the port, and never drops what it sends.
config = zenoh.Config()
config.insert_json5("scouting/multicast/enabled", "false")
config.insert_json5("listen/endpoints", json.dumps(["tcp/127.0.0.1:0"]))
config.insert_json5("connect/endpoints", json.dumps([f"tcp/127.0.0.1:{args.port}"]))
session = zenoh.open(config)
publishers, numbers, run = {}, {}, time.time_ns()


def publisher(topic):
    if topic not in publishers:
        key = f"triline/{args.platform}/{topic}"
        publishers[topic] = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
    return publishers[topic]


def publish(topic, stamp_ns, body):
    """Send a message; its envelope is the attachment: version, stamp, number, start of this run, name."""
    numbers[topic] = numbers.get(topic, -1) + 1
    envelope = struct.pack("<Bqqq", 1, stamp_ns, numbers[topic], run) + b"my_driver"
    publisher(topic).put(body.SerializeToString(), attachment=envelope)


# 3. What the drivers measure: (UTC in ns at which it is known, topic, message).
def gnss(t, lat, lon, height, sigma):
    fix = LocationFix(latitude=lat, longitude=lon, altitude=height, position_covariance_type=2)
    fix.timestamp.seconds, fix.timestamp.nanos = divmod(t, 10**9)
    fix.position_covariance.extend(np.diag([sigma**2] * 3).ravel())  # east, north, up, m^2
    return t, "sensor/gnss", fix


def imu(t, interval, fx, fy, fz, wx, wy, wz):  # forward, right, down; m/s^2 and rad/s
    force, rate = {"force_x": fx, "force_y": fy, "force_z": fz}, {"rate_x": wx, "rate_y": wy, "rate_z": wz}
    return t, "sensor/imu", Imu(time_ns=t, interval_ns=round(interval * 1e9), **force, **rate)


def attitude(t, roll, pitch, heading, sigma):  # rad
    covariance = np.diag([sigma**2] * 3).ravel()
    return t, "sensor/attitude", Attitude(time_ns=t, roll=roll, pitch=pitch, heading=heading, covariance=covariance)


def lines(ccd, first, pixels, t, period_ns, strip):  # a block of them, known when the last one has been read
    kind = {1: "mono8", 2: "mono16"}[pixels.itemsize]
    block = RawImage(
        width=pixels.shape[1], height=len(pixels), encoding=kind, step=pixels[0].nbytes, data=pixels.tobytes(),
        frame_id=ccd, strip=strip, first_line=first, line_period_ns=period_ns,
    )  # fmt: skip
    block.timestamp.seconds, block.timestamp.nanos = divmod(t, 10**9)
    return t + (len(pixels) - 1) * period_ns, f"sensor/lines/{ccd}", block


def measured(start_ns):
    """All of FOLDER, as drivers would have it, in the order of time."""
    found = []
    for name, make in (("gnss", gnss), ("imu", imu), ("attitude", attitude)):
        if (path := args.folder / f"{name}.csv").exists():
            for time_s, *values in np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2).tolist():
                found.append(make(start_ns + round(time_s * 1e9), *values))
    for path in sorted(args.folder.glob("lines_*.npy")):
        first_s, rate = np.loadtxt(args.folder / "lines.csv", delimiter=",", skiprows=1).tolist()
        image, period_ns, size = np.load(path), round(1e9 / rate), max(round(rate / 10), 1)
        strip = time.strftime("S%H%M%S", time.gmtime(start_ns // 10**9))  # a name of its own for each strip
        for n in range(0, len(image), size):
            t = start_ns + round(first_s * 1e9) + n * period_ns
            found.append(lines(path.stem[6:], n, image[n : n + size], t, period_ns, strip))
    return sorted(found, key=lambda entry: entry[0])


# 4. Send each thing when it is known. A driver's loop does the same with what its device gives.
while not publisher("sensor/gnss").matching_status.matching:  # nobody listens yet
    time.sleep(0.1)
time.sleep(2.0)  # the links with all who listen come up
for stamp_ns, topic, body in measured(time.time_ns() + 10**9):
    time.sleep(max(stamp_ns - time.time_ns(), 0) / 1e9)
    publish(topic, stamp_ns, body)
time.sleep(0.5)
session.close()
print(json.dumps({topic: number + 1 for topic, number in numbers.items()}))
