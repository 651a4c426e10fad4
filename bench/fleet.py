"""Four aircraft, three routers on the ground, in network namespaces of this machine (Linux, as root).

    python bench/fleet.py [--seconds 200] [--cut 120] [--limit 64000] [--picture FOLDER]

Two ground stations (*east* and *west*, two aircraft each by a link of their own) call the router of an *office*, in
which a recorder, a desk and forgers work: each place is a namespace, each link a pair of virtual interfaces, and all
links are encrypted with bundles of `triline keys`. Each aircraft flies one strip of a block of four that overlap:
`triline replay` of its sensors and tie points into recorder, navigator, adjuster and router. The link of *a1* is taken
away for ``--cut`` seconds; *a2* may send half of what the others may; on the links of *a3* and *a4* the kernel
lets half of their limit through (`tc`, where it is there), so that those links are slower than their routers know.

- *may*, *sent*, *peak*: bytes a second that the router on board may send, and what the interface at the station
  counted, on average until all was there and in the fullest 10 s, kB/s; all headers included
- *live*, *asked*: messages of lossless topics in the recording of the ground: those that came by themselves, and those
  that the ground asked for
- *lost*: messages that the recorder on board has and the ground wants, and has not, or not byte for byte
- *after*: from the end of the cut (for others: of the flight) until all that was recorded on board by then was here, s
- *block*: sigma0 of `triline adjust` on the recording of the ground
- *forged*: publications under the name of the next aircraft by one with this aircraft's certificate that the office
  heard, and of those by a desk; each tries 200 times. "own": as many under its own name, which must be heard.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import frame
from frame import TRILINE

from triline.nodes.bus.downlink import share_of
from triline.nodes.bus.processes import ALLOCATOR
from triline.nodes.node import Message
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.recording.writer import RecordingWriter
from triline.schemas import messages as m

#: Where each aircraft's link ends, and what else there is.
STATIONS = {"a1": "east", "a2": "east", "a3": "west", "a4": "west"}
FORGED = 200
FULLEST_S = 10.0
#: A flight is cut out of the block with so much before and after its strip, s.
LEAD_S = 3.0


def allowed() -> str:
    """Why network namespaces cannot be made here; "" if they can."""
    if not sys.platform.startswith("linux") or shutil.which("ip") is None:
        return "no `ip` of Linux"
    if os.geteuid() != 0:
        return "network namespaces are made by root"
    name = f"tf{os.getpid()}"
    if subprocess.run(["ip", "netns", "add", name], capture_output=True).returncode:
        return "this machine allows no network namespaces"
    subprocess.run(["ip", "netns", "delete", name], capture_output=True)
    return ""


class Network:
    """Places with links between them; ends with the context."""

    def __init__(self, tag: str) -> None:
        self._tag = tag
        self._places: list[str] = []

    def __enter__(self) -> Network:
        return self

    def __exit__(self, *_: object) -> None:
        for place in self._places:
            subprocess.run(["ip", "netns", "delete", self._name(place)], capture_output=True)

    def _name(self, place: str) -> str:
        return f"{self._tag}-{place}"

    def place(self, name: str) -> None:
        """A namespace of its own."""
        _ip("netns", "add", self._name(name))
        self._places.append(name)
        _ip("-n", self._name(name), "link", "set", "lo", "up")

    def link(self, one: str, other: str, net: int) -> None:
        """A link between two places: 10.77.NET.1 at ``other``, .2 at ``one``; the interfaces have the number."""
        ends = f"{one}{net}", f"{other}{net}"
        _ip("link", "add", ends[0], "netns", self._name(one), "type", "veth", "peer", ends[1], "netns",
            self._name(other))  # fmt: skip
        for place, end, host in ((one, ends[0], 2), (other, ends[1], 1)):
            _ip("-n", self._name(place), "addr", "add", f"10.77.{net}.{host}/24", "dev", end)
            _ip("-n", self._name(place), "link", "set", end, "up")

    def set_link(self, place: str, net: int, state: str) -> None:
        """Take a link away (``down``) or bring it back (``up``)."""
        _ip("-n", self._name(place), "link", "set", f"{place}{net}", state)

    def narrow(self, place: str, net: int, bytes_s: float) -> bool:
        """Let the kernel pass so many bytes a second from a place; False where it cannot."""
        if shutil.which("tc") is None:
            return False
        command = ["tc", "qdisc", "add", "dev", f"{place}{net}", "root", "tbf", "rate", f"{bytes_s * 8:.0f}bit",
                   "burst", "16kb", "latency", "300ms"]  # fmt: skip
        return subprocess.run(self.inside(place, command), capture_output=True).returncode == 0

    def inside(self, place: str, command: list[str]) -> list[str]:
        """A command in a place."""
        return ["ip", "netns", "exec", self._name(place), *command]

    def received(self, place: str, net: int) -> int:
        """Bytes that have come in on a link."""
        command = self.inside(place, ["cat", f"/sys/class/net/{place}{net}/statistics/rx_bytes"])
        return int(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True)


def flights(folder: Path, seconds: float) -> dict[str, Path]:
    """A recording of sensors and tie points for each aircraft: a strip each of one block, whose points they share."""
    block = folder / "block.mcap"
    frame.triline("simulate", "-o", str(block), "--sensor", "ads40-small", "--strips", str(len(STATIONS)), "--seconds",
                  str(seconds), "--seed", "4")  # fmt: skip
    messages = list(RecordingReader(block).sorted_messages())
    strips = {x.body.id: x.body for x in messages if x.topic == "configuration/strip"}
    paths = {}
    for aircraft, strip in zip(STATIONS, sorted(strips), strict=True):
        paths[aircraft] = folder / f"{aircraft}-sensors.mcap"
        begin = strips[strip].first_line_time_ns - int(LEAD_S * 1e9)
        end = begin + int((seconds + 2 * LEAD_S) * 1e9)
        with RecordingWriter(paths[aircraft], platform=aircraft) as writer:
            for x in messages:
                kept = _of_strip(x, strip, begin, end)
                if kept is not None:
                    writer.write(kept)
    return paths


def _of_strip(x: Message, strip: str, begin: int, end: int) -> Message | None:
    """A message as the aircraft of a strip has it; None if it has not."""
    of_all = x.topic in ("configuration/project", "configuration/camera", "observation/control")
    if x.topic == "configuration/strip":
        return _numbered(x) if x.body.id == strip else None
    if x.topic == "observation/tie":
        images = [image for image in x.body.images if image.strip == strip]
        if len(images) < 2 or not begin <= x.stamp_ns <= end:
            return None
        body = m.TiePoint()
        body.CopyFrom(x.body)
        del body.images[:]
        body.images.extend(images)
        return Message(x.topic, x.stamp_ns, body, x.source)
    if of_all or (x.topic.startswith("sensor/") and begin <= x.stamp_ns <= end):
        return _numbered(x)
    return None


def _numbered(x: Message) -> Message:
    return Message(x.topic, x.stamp_ns, x.body, x.source)


class Programs:
    """Programs in places, their output in logs; none is left when the context ends."""

    def __init__(self, network: Network, folder: Path) -> None:
        self._network, self._folder = network, folder
        self._running: list[subprocess.Popen[bytes]] = []

    def start(self, place: str, name: str, command: list[str]) -> subprocess.Popen[bytes]:
        environment = {**os.environ, **ALLOCATOR}
        with open(self._folder / f"{name}.log", "ab") as log:
            made = subprocess.Popen(
                self._network.inside(place, command), stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT,
                env=environment, start_new_session=True, cwd=self._folder,
            )  # fmt: skip
        self._running.append(made)
        return made

    def stop(self, *programs: subprocess.Popen[bytes]) -> None:
        for one in programs:
            one.send_signal(2)
        for one in programs:
            try:
                one.wait(30)
            except subprocess.TimeoutExpired:
                one.kill()
                one.wait()

    def __enter__(self) -> Programs:
        return self

    def __exit__(self, *_: object) -> None:
        for one in self._running:
            if one.poll() is None:
                one.kill()
                one.wait()


@contextmanager
def everything(network: Network, folder: Path, limit: float) -> Iterator[tuple[Programs, dict[Any, Any]]]:
    """Places, links, certificates, routers, the ground's recorder, and the nodes of each aircraft."""
    keys = folder / "survey"
    nets = {aircraft: i + 1 for i, aircraft in enumerate(STATIONS)}
    up = {"east": 101, "west": 102}
    for place in ("office", *up, *STATIONS):
        network.place(place)
    for station, net in up.items():
        network.link(station, "office", net)
    for aircraft, station in STATIONS.items():
        network.link(aircraft, station, nets[aircraft])
    frame.triline("keys", "new", str(keys))
    frame.triline(
        "keys", "router", "office", "--authority", str(keys), "--host", "10.77.101.1", "--host", "10.77.102.1"
    )
    for station, net in up.items():
        hosts = [word for a, s in STATIONS.items() if s == station for word in ("--host", f"10.77.{nets[a]}.1")]
        frame.triline("keys", "router", station, "--authority", str(keys), *hosts, "--router", f"10.77.{net}.1")
    for aircraft in STATIONS:
        router = f"10.77.{nets[aircraft]}.1"
        frame.triline("keys", "aircraft", aircraft, "--authority", str(keys), "--router", router)
    frame.triline("keys", "desk", "ann", "--authority", str(keys), "--router", "127.0.0.1")
    with Programs(network, folder) as programs:
        running: dict[Any, Any] = {"nets": nets, "keys": keys}
        for router in ("office", *up):
            running[router] = programs.start(
                router, f"router-{router}", [*TRILINE, "node", "router", "--secure", str(keys / router)]
            )
        ground = [*TRILINE, "node", "ground", "--secure", str(keys / "ann"), "--set", f"output={folder / 'ground'}"]
        running["ground"] = programs.start("office", "ground", ground)
        for aircraft in STATIONS:
            secure = ["--secure", str(keys / aircraft)]
            may = limit / 2 if aircraft == "a2" else limit
            more = {
                "recorder": ["-o", str(folder / f"{aircraft}.mcap")],
                "router": ["--set", f"bytes_s={may}"],
            }
            for node in ("recorder", "navigator", "adjuster", "router"):
                command = [*TRILINE, "node", node, *secure, *more.get(node, [])]
                running[aircraft, node] = programs.start(aircraft, f"{aircraft}-{node}", command)
        yield programs, running


def compared(board: Path, ground: Path, moment_ns: int) -> tuple[int, int, float]:
    """How many messages of lossless topics the ground should have, how many of them it has not, byte for byte, and how
    long after a moment the last of those came that were recorded on board before it, s."""

    def messages(path: Path) -> dict[Any, tuple[bytes, int]]:
        reader = RecordingReader(path)
        found = {}
        for raw in reader.raws(reader.select()):
            share = share_of(raw.topic)
            if share is not None and share.filled and raw.envelope.sequence % share.every == 0:
                data = b"" if raw.topic.startswith("orthoimage/") else bytes(raw.data)  # tiles come down smaller
                found[raw.topic, raw.envelope] = data, raw.receive_ns
        return found

    there, here = messages(board), messages(ground)
    nothing = b"", 0
    lost = sum(here.get(key, (None, 0))[0] != data for key, (data, _) in there.items())
    came = [here.get(key, nothing)[1] for key, (_, recorded_ns) in there.items() if recorded_ns <= moment_ns]
    return len(there), lost, (max(came, default=moment_ns) - moment_ns) / 1e9


def snapshot(network: Network, keys: Path, seconds: float) -> dict[str, Any]:
    """What `triline monitor --fleet` knows after some seconds."""
    command = [*TRILINE, "monitor", "--fleet", "--secure", str(keys / "ann"), "--json", "--seconds", str(seconds)]
    done = subprocess.run(network.inside("office", command), capture_output=True, text=True)
    return json.loads(done.stdout)


def forge(config: Path, name: str, platform: str) -> None:
    """Publish under a name that may not be this certificate's, with no access list of one's own."""
    import zenoh

    from triline.nodes import convert
    from triline.schemas import codec
    from triline.schemas.envelope import Envelope, pack

    settings = zenoh.Config.from_file(config)
    settings.insert_json5("access_control/enabled", "false")
    body = codec.encode(convert.attitude_message(10**18, (0.1, 0.2, 0.3), (1e-4, 1e-4, 2e-4)))
    with zenoh.open(settings) as session:
        publishers = [session.declare_publisher(f"triline/{p}/sensor/gnss") for p in (platform, name)]
        time.sleep(1.0)
        for number in range(FORGED):
            for publisher in publishers:
                publisher.put(body, attachment=pack(Envelope(10**18, f"forger-{name}", number, 1)))
            time.sleep(0.005)
        time.sleep(1.0)


def listen(config: Path, seconds: float) -> None:
    """Count what forgers got through, by forger and platform."""
    import zenoh

    from triline.schemas.envelope import unpack

    heard: Counter[str] = Counter()

    def take(sample: Any) -> None:
        source = unpack(sample.attachment.to_bytes()).source if sample.attachment is not None else ""
        if source.startswith("forger-"):
            heard[f"{source.removeprefix('forger-')} as {str(sample.key_expr).split('/')[1]}"] += 1

    with zenoh.open(zenoh.Config.from_file(config)) as session:
        subscriber = session.declare_subscriber("triline/*/sensor/gnss", take)
        print("listening", flush=True)
        time.sleep(seconds)
        subscriber.undeclare()
    print(json.dumps(heard))


def screen(bundle: Path, folder: Path) -> None:
    """What `triline monitor --fleet` shows after 8 s, as ``fleet.svg`` and ``fleet.txt``."""
    from rich.console import Console

    from triline.nodes.bus.bundle import load_bundle
    from triline.nodes.bus.session import Bus
    from triline.nodes.monitor import fleet

    stop = threading.Event()
    threading.Timer(8.0, stop.set).start()
    with Bus(fleet.FLEET, source="monitor", secure=load_bundle(bundle)) as bus:
        overview = fleet.watch(bus, stop, "fleet", quiet=True)
    with open(os.devnull, "w") as nowhere:
        console = Console(record=True, width=100, force_terminal=True, file=nowhere)
        console.print(fleet.screen(overview, "fleet"))
        (folder / "fleet.svg").write_text(console.export_svg(title="triline monitor --fleet", clear=False))
        (folder / "fleet.txt").write_text(console.export_text())


def forgeries(network: Network, programs: Programs, keys: Path, folder: Path) -> Counter[str]:
    """What forgers in aircraft and at a desk get through to the office."""
    here = [sys.executable, __file__]
    log = folder / "listener.log"
    desk_config = str(keys / "ann" / "zenoh.json5")
    listener = programs.start("office", "listener", [*here, "--role", "listen", desk_config, "25"])
    while "listening" not in log.read_text():
        time.sleep(0.1)
    names = list(STATIONS)
    forgers = []
    for i, name in enumerate(names):
        config = str(keys / name / "ground.json5")
        command = [*here, "--role", "forge", config, name, names[(i + 1) % len(names)]]
        forgers.append(programs.start(name, f"forger-{name}", command))
    desk = [*here, "--role", "forge", desk_config, "ann", "a1"]
    forgers.append(programs.start("office", "forger-ann", desk))
    for one in (*forgers, listener):
        one.wait()
    return Counter(json.loads(log.read_text().splitlines()[-1]))


def campaign(args: argparse.Namespace, folder: Path) -> int:
    paths = flights(folder, args.seconds)
    with ExitStack() as stack:
        network = stack.enter_context(Network(f"tf{os.getpid() % 10_000}"))
        programs, running = stack.enter_context(everything(network, folder, args.limit))
        nets, keys = running["nets"], running["keys"]
        narrowed = [network.narrow(a, nets[a], args.limit / 2) for a in ("a3", "a4")]
        print(f"kernel limit on the links of a3 and a4: {'yes' if all(narrowed) else 'no tc here'}", flush=True)
        while sum(row["link"] == "linked" for row in snapshot(network, keys, 3.0)["aircraft"]) < len(STATIONS):
            pass
        forged = forgeries(network, programs, keys, folder)
        replays, counts, begun = {}, {a: [(time.monotonic(), 0)] for a in STATIONS}, time.monotonic()
        base = {a: network.received(STATIONS[a], nets[a]) for a in STATIONS}
        for aircraft, path in paths.items():
            command = [*TRILINE, "replay", str(path), "--rate", "1", "--secure", str(keys / aircraft)]
            replays[aircraft] = programs.start(aircraft, f"{aircraft}-replay", command)
        cut_at, cut_end, state = begun + 30.0, begun + 30.0 + args.cut, "up"
        picture: dict[str, Any] = {}
        back_ns = 0
        pictures = _pictures(network, programs, keys, folder, args) if args.picture else None
        while any(replay.poll() is None for replay in replays.values()):
            time.sleep(0.5)
            now = time.monotonic()
            for aircraft in STATIONS:
                counts[aircraft].append((now, network.received(STATIONS[aircraft], nets[aircraft]) - base[aircraft]))
            wanted = "down" if cut_at <= now < cut_end else "up"
            if wanted != state:
                network.set_link("a1", nets["a1"], state := wanted)
                back_ns = time.time_ns()
                print(f"{now - begun:4.0f} s: the link of a1 is {'cut' if state == 'down' else 'back'}", flush=True)
            if not picture and now > cut_at + 0.7 * args.cut:
                picture = snapshot(network, keys, 8.0)
                if args.picture:
                    place = [sys.executable, __file__, "--role", "screen", str(keys / "ann"), str(args.picture)]
                    programs.start("office", "screen", place)
        flown_ns = time.time_ns()
        network.set_link("a1", nets["a1"], "up")
        for node in ("navigator", "adjuster"):
            programs.stop(*(running[a, node] for a in STATIONS))

        def count() -> None:
            for a in STATIONS:
                counts[a].append((time.monotonic(), network.received(STATIONS[a], nets[a]) - base[a]))

        _wait_until_filled(network, keys, count)
        if pictures is not None:
            programs.stop(*pictures)
        for node in ("recorder", "router"):
            programs.stop(*(running[a, node] for a in STATIONS))
        programs.stop(running["ground"])
    moments = {a: back_ns if a == "a1" else flown_ns for a in STATIONS}
    return _table(args, folder, counts, forged, moments, picture)


def _pictures(network: Network, programs: Programs, keys: Path, folder: Path, args: argparse.Namespace) -> Any:
    command = [*TRILINE, "view", "--fleet", "--secure", str(keys / "ann"), "--rrd", str(args.picture / "fleet.rrd")]
    return (programs.start("office", "view", command),)


def _wait_until_filled(network: Network, keys: Path, count: Callable[[], None]) -> None:
    """Wait until nothing of any aircraft is missing, and some more inventories find no more."""
    nothing, until = 0, time.monotonic() + 900.0
    while nothing < 4 and time.monotonic() < until:
        rows = snapshot(network, keys, 3.0)["aircraft"]
        count()
        here = [row["missing"] == 0 for row in rows if row["name"] in STATIONS]
        nothing = nothing + 1 if len(here) == len(STATIONS) and all(here) else 0


def _table(
    args: argparse.Namespace, folder: Path, counts: dict[str, list[tuple[float, int]]], forged: Counter[str],
    moments: dict[str, int], picture: dict[str, Any],
) -> int:  # fmt: skip
    log = (folder / "ground.log").read_text()
    names, good = list(STATIONS), True
    for row in picture.get("aircraft", []):
        heard = "-" if row["heard_s"] is None else f"{row['heard_s']:.0f} s ago"
        print(f"monitor in the cut: {row['name']} {row['light']}, {row['link']}, heard {heard}")
    print(f"{'aircraft':<9} {'may':>6} {'sent':>6} {'peak':>6} {'live':>7} {'asked':>7} {'lost':>12} {'after':>8} "
          f"{'block':>6}  {'forged':>7} {'own':>5}")  # fmt: skip
    for i, name in enumerate(names):
        may = args.limit / 2 if name == "a2" else args.limit
        wanted, lost, after = compared(folder / f"{name}.mcap", folder / "ground" / f"{name}.mcap", moments[name])
        asked = int(next(line for line in log.splitlines() if line.startswith(f"{name}: ") and "asked for; " in line)
                    .split("mcap, ")[-1].split()[0])  # fmt: skip
        (t0, _), (t1, total) = counts[name][0], counts[name][-1]
        peak = max(_rates(counts[name]))
        result = json.loads(frame.triline("adjust", str(folder / "ground" / f"{name}.mcap"), "--json"))
        through, own = forged[f"{name} as {names[(i + 1) % len(names)]}"], forged[f"{name} as {name}"]
        good = good and not lost and not through and own == FORGED and peak <= 1.1 * may
        print(f"{name:<9} {may / 1e3:>6.1f} {total / (t1 - t0) / 1e3:>6.1f} {peak / 1e3:>6.1f} {wanted - asked:>7} "
              f"{asked:>7} {lost:>5} of {wanted:<6} {after:>6.0f} {result['sigma0']:>6.2f}  {through:>7} "
              f"{own:>5}")  # fmt: skip
    desk = sum(n for key, n in forged.items() if key.startswith("ann as"))
    good = good and not desk
    points = [_points(folder / "ground" / f"{name}.mcap") for name in names]
    shared = [len(a & b) for a, b in pairwise(points)]
    print(f"forged by the desk: {desk}; points that neighbours share on the ground: {', '.join(map(str, shared))}")
    return frame.verdict(good)


def _rates(counts: list[tuple[float, int]]) -> Iterator[float]:
    """Bytes a second of each stretch of `FULLEST_S` or a little more."""
    for begin, first in counts:
        found = next(((moment, n) for moment, n in counts if moment >= begin + FULLEST_S), None)
        if found is not None:
            yield (found[1] - first) / (found[0] - begin)


def _points(path: Path) -> set[str]:
    return {x.body.point for x in RecordingReader(path).messages(["observation/tie"])}


def main() -> int:
    if len(sys.argv) > 2 and sys.argv[1] == "--role":
        if sys.argv[2] == "forge":
            forge(Path(sys.argv[3]), sys.argv[4], sys.argv[5])
        elif sys.argv[2] == "screen":
            screen(Path(sys.argv[3]), Path(sys.argv[4]))
        else:
            listen(Path(sys.argv[3]), float(sys.argv[4]))
        return 0
    parser = frame.parser(__doc__)
    parser.add_argument("--seconds", type=float, default=200.0, help="of a strip, and of the flights")
    parser.add_argument("--cut", type=float, default=120.0, help="of the link of a1, s; it begins after 30 s")
    parser.add_argument("--limit", type=float, default=64_000.0, help="bytes a second that a router may send")
    parser.add_argument(
        "--picture", type=Path, help="folder for a Rerun file of the flight, and the monitor in the cut"
    )
    parser.add_argument("--folder", type=Path, help="keep recordings and logs there")
    args = parser.parse_args()
    if args.picture is not None:
        args.picture = args.picture.resolve()
        args.picture.mkdir(parents=True, exist_ok=True)
    why = allowed()
    if why:
        sys.exit(f"bench/fleet.py: {why}")
    if args.folder is not None:
        args.folder.mkdir(parents=True, exist_ok=True)
        return campaign(args, args.folder.resolve())
    with tempfile.TemporaryDirectory(prefix="triline-fleet-") as folder:
        return campaign(args, Path(folder))


if __name__ == "__main__":
    raise SystemExit(main())
