"""The navigator: sensors in, measured trajectory of the camera out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ...solver.geometry.frames import LocalFrame
from ...solver.geometry.rotation import R_ENU_NED
from ...solver.navigation.attitude_jumps import AttitudeJumps
from ...solver.navigation.clock_check import LARGEST_DELAY_S, ClockCheck, offset_in_words
from ...solver.navigation.clock_offset import OffsetWatch
from ...solver.navigation.gnss_fix import local_fix
from ...solver.navigation.inertial_data import GnssData
from ...solver.navigation.inertial_navigator import InertialNavigator
from ...solver.navigation.kinematic import KinematicFilter
from ...solver.navigation.online_poses import OnlineOptions
from ...solver.navigation.pose import NavigationPose
from .. import convert
from ..node import Message, Node
from .engines import InertialUnit, inertial_engine, kinematic_engine, stated_noise

#: A measurement cannot be so much later than its message, s: one clock that runs away must not stop the filter.
AHEAD_S = 1.0
#: Fixes that stand so far before the first attitude are of another clock, s: nobody waits on the ground for so long
#: with one sensor and without the other.
EARLY_S = 900.0
#: Attitudes that have not changed in any digit for so long, s, are those of a sensor that hangs (tuned: sensors that
#: round to 0.01 deg repeat themselves for some samples).
FROZEN_S = 1.0
#: Jumps of the attitude are told again after so long, s: those of a heading that is not known yet may be many.
JUMP_TOLD_S = 60.0
#: Fixes that lie so far from the origin of the project, km over ground, are told: no block is as large, the project is
#: that of another place, or latitude and longitude are exchanged.
FAR_KM = 500.0
#: Largest correction of GNSS times on an operator's word, s.
LARGEST_CORRECTION_S = 100.0
#: Attitudes and inertial data that are so far behind the newest ones, s, for so long, s, are of a clock that was set
#: back (tuned: networks delay less, or hold up single messages).
SET_BACK_S, SET_BACK_FOR_S = 2.0, 1.0
#: Numbers of fixes that are missing without time going on: the clock was set back.
FEW_NUMBERS = 5


class Navigator(Node):
    """Runs a navigation engine.

    Attitude and GNSS go through the kinematic filter. With the first raw inertial sample the inertial filter takes
    over; measured attitudes are then counted and left aside. Poses carry the stamp of the message that made them
    possible; the time they are valid for stands in the body.

    Parameters
    ----------
    filtered_s : least distance of filtered poses, s; 0 = all of them, which those who want them at once need
    smooth_every_s : from inertial data smoothed poses come so often, s
    gnss_clock_s : GNSS times are behind by so much; it is added to them. A verdict on ``sensor/gnss`` changes it
    camera_lever_arm_m : perspective centre from the inertial sensor, body axes; measured attitudes need none
    gyro_bias_deg_h, accel_bias_mgal, bias_time_s, gyro_scale_ppm, accel_scale_ppm : of the inertial sensor's data
        sheet; biases of 0 are those that are usual for its noise
    """

    name = "navigator"
    inputs = ("configuration/project", "sensor/imu", "sensor/attitude", "sensor/gnss", "observation/verdict")
    outputs = ("trajectory/filtered", "trajectory/smoothed", "event/log")

    def __init__(
        self,
        *,
        filtered_s: float = 0.0,
        smooth_every_s: float = OnlineOptions.smooth_every_s,
        gnss_clock_s: float = 0.0,
        camera_lever_arm_m: Sequence[float] = (0.0, 0.0, 0.0),
        gyro_bias_deg_h: float = 0.0,
        accel_bias_mgal: float = 0.0,
        bias_time_s: float = 0.0,
        gyro_scale_ppm: float = 0.0,
        accel_scale_ppm: float = 0.0,
    ) -> None:
        super().__init__()
        if not 0.0 <= filtered_s <= 1.0:
            raise ValueError(f"filtered_s is {filtered_s:g}, wanted 0 to 1 s")
        if not 0.0 < smooth_every_s <= 10.0:
            raise ValueError(f"smooth_every_s is {smooth_every_s:g}, wanted more than 0 and at most 10 s")
        if not abs(gnss_clock_s) <= LARGEST_CORRECTION_S:
            raise ValueError(f"gnss_clock_s is {gnss_clock_s:g}, wanted at most {LARGEST_CORRECTION_S:g} s either way")
        self._unit = InertialUnit(
            camera_lever_arm_m, gyro_bias_deg_h, accel_bias_mgal, bias_time_s, gyro_scale_ppm, accel_scale_ppm
        )
        self._correction_s = float(gnss_clock_s)
        self._offset = OffsetWatch()
        self._filtered_s, self._smooth_every_s = filtered_s, smooth_every_s
        self._engine: KinematicFilter | InertialNavigator | None = None
        self._configuration: Any = None
        self._reference_ns = 0
        self._seen: Counter[str] = Counter()
        self._stamp_ns = 0
        self._project = b""
        self._notes: list[Message] = []
        self._frame = LocalFrame(0.0, 0.0, 0.0)
        self._same = 0, (np.nan, np.nan, np.nan)  # since when the attitude has been the same
        self._jumps, self._told_jump_ns = AttitudeJumps(), -(1 << 62)
        self._covariance_key: tuple[float, ...] = ()
        self._covariance = np.zeros((3, 3))
        self._clock = ClockCheck()
        self._newest_ns, self._other = 0, "attitude"
        self._behind_since_ns: int | None = None
        self._inertial_came = False
        self._early_fix_ns = 0  # newest fix before the first attitude or inertial sample
        self._last_fix, self._period_s = (-1, 0), 0.0
        self._suspect: int | None = None
        self._set_back: int | None = None

    def step(self, message: Message) -> Iterable[Message]:
        self._stamp_ns = max(self._stamp_ns, message.stamp_ns)
        try:
            if message.topic in ("sensor/imu", "sensor/attitude"):
                self._check_time(message)
            if message.topic == "sensor/imu":
                poses = self._inertial(message.body)
            elif message.topic == "sensor/attitude":
                poses = self._attitude(message.body)
            elif message.topic == "sensor/gnss":
                poses = self._gnss(message)
            elif message.topic == "observation/verdict":
                self._verdict(message)
                poses = []
            else:
                return self._configure(message)
        except ValueError as error:
            self.refuse("malformed", f"{message.topic}: {error}")
            return ()
        return self._messages(poses)

    def finish(self) -> Iterable[Message]:
        if self._engine is None:
            return ()
        return self._messages(self._engine.finish())

    def state(self) -> str:
        if self._engine is None:
            return "waiting for configuration/project"
        state = self._engine.status if isinstance(self._engine, InertialNavigator) else "running"
        # so long the clock of GNSS can be off by tenths of a second, and control alone would show it
        return state if self._offset.seen or not self._newest_ns else f"{state}, GNSS clock not seen: no turn yet"

    def _configure(self, message: Message) -> Iterable[Message]:
        content = message.body.SerializeToString(deterministic=True)
        if content == self._project:
            return ()
        try:
            self._engine = kinematic_engine(message.body, self._filtered_s)
            self._configuration = message.body
        except ValueError as error:
            self.problem("bad configuration", f"{message.topic}: {error}")
            return (self._log(message.stamp_ns, f"configuration/project cannot be used: {error}", warning=True),)
        self._frame = convert.local_frame(message.body)
        self._seen = Counter()
        self._project = content
        self._reference_ns = self._reference_ns or message.stamp_ns  # what the clocks have shown is told by these times
        return ()

    def _verdict(self, message: Message) -> None:
        """An operator says by how much GNSS times are to be corrected."""
        body = message.body
        if body.topic != "sensor/gnss" or not body.HasField("clock_s"):
            return
        if not abs(body.clock_s) <= LARGEST_CORRECTION_S:
            raise ValueError(f"GNSS times are not corrected by {body.clock_s:g} s")
        by = body.by or "an operator"
        self._correction_s, self._clock, self._offset = body.clock_s, ClockCheck(), OffsetWatch()
        self.alarms.pop("clock", None)
        self._start_anew()
        text = f"sensor/gnss is corrected by {body.clock_s:+.3f} s from now on ({by})"
        self._notes.append(self._log(self._stamp_ns, text))

    def _start_anew(self) -> None:
        """Forget what fixes of another time have made of the state."""
        if self._configuration is None:
            return
        self._engine = kinematic_engine(self._configuration, self._filtered_s)
        self._seen = Counter()

    def _time_ns(self, fix: Any) -> int:
        """Time of a fix, as corrected on an operator's word."""
        return convert.time_ns(fix.timestamp) + round(self._correction_s * convert.SECOND_NS)

    def _check_time(self, message: Message) -> None:
        body = message.body
        time_ns = self._time_ns(body) if message.topic == "sensor/gnss" else body.time_ns
        ahead = (time_ns - message.stamp_ns) * 1e-9
        if ahead > AHEAD_S:
            raise ValueError(f"measured {ahead:.3f} s after the stamp of its message")

    def _right_clock(self, message: Message) -> bool:
        """Whether a fix has the time that attitude and inertial data have; the operator is told where it has not."""
        time_ns = self._time_ns(message.body)
        if self._renumbered(message.sequence, time_ns):
            return False
        if not self._newest_ns:
            self._early_fix_ns = time_ns
            return True
        was = self._clock.offset_s
        right = self._clock.fix(time_ns * 1e-9, self._newest_ns * 1e-9)
        now = self._clock.offset_s
        if now is not None:
            self.counters["gnss of another clock"] += 1
            if was is None or abs(now - was) > LARGEST_DELAY_S:
                self._wrong_clock(offset_in_words(now, self._other))
        elif was is not None:
            self.alarms.pop("clock", None)
            self._notes.append(self._log(self._stamp_ns, "GNSS clock agrees again: fixes are used"))
        return right

    def _wrong_clock(self, words: str, remedy: str = "") -> None:
        text = f"{words}: GNSS is left out{'; ' if remedy else ''}{remedy}"
        self.alarms["clock"] = text
        self.problem("clock", f"sensor/gnss: {text}")
        self._notes.append(self._log(self._stamp_ns, text, warning=True))

    def _renumbered(self, number: int, time_ns: int) -> bool:
        """Whether a fix is from after the receiver's clock was set back: in the order of stamps its number is too high.

        Live such fixes come late, and `ClockCheck` sees them; a recording is sorted by stamps.
        """
        last, last_ns = self._last_fix
        if self._set_back is not None and number >= self._set_back:
            self.counters["gnss of another clock"] += 1
            return True
        if number == last + 1 and last >= 0:
            self._period_s = (time_ns - last_ns) * 1e-9
        elif number > last + FEW_NUMBERS and last >= 0 and 0 <= time_ns - last_ns < convert.SECOND_NS:
            self._suspect = number
        elif self._suspect is not None and number < self._suspect:  # numbers go on from before
            self._set_back, self._suspect = self._suspect, None
            back_s = (self._set_back - number) * self._period_s  # 0 = of two fixes that follow each other none came yet
            self._wrong_clock("GNSS clock was set back" + (f" by about {back_s:.0f} s" if back_s else ""))
        self._last_fix = number, time_ns
        return False

    def _note_time(self, time_ns: int, other: str) -> None:
        """How far attitude or inertial data have come."""
        if not self._newest_ns and self._early_fix_ns:
            off_s = (time_ns - self._early_fix_ns) * 1e-9
            if abs(off_s) > EARLY_S:  # no fix since: those before were of another time
                self._wrong_clock(offset_in_words(off_s, other))
        self._tell_set_back(time_ns, other)
        self._newest_ns, self._other = max(self._newest_ns, time_ns), other

    def _tell_set_back(self, time_ns: int, other: str) -> None:
        """Tell an operator that nothing is navigated while attitude or inertial data tell times that have passed."""
        if self._newest_ns - time_ns <= SET_BACK_S * convert.SECOND_NS:
            self._behind_since_ns = None
            if self.alarms.pop("set back", ""):
                self._notes.append(self._log(self._stamp_ns, f"{other} is used again, its times go on"))
            return
        self._behind_since_ns = time_ns if self._behind_since_ns is None else self._behind_since_ns
        if "set back" not in self.alarms and time_ns - self._behind_since_ns > SET_BACK_FOR_S * convert.SECOND_NS:
            behind_s = (self._newest_ns - self._behind_since_ns) * 1e-9
            text = f"the clock of {other} was set back by {behind_s:.0f} s: nothing is navigated until it is past that"
            self._notes.append(self._log(self._stamp_ns, text, warning=True))
            self.alarms["set back"] = text

    def _inertial(self, body: Any) -> list[NavigationPose]:
        if self._engine is None:
            self.refuse("before configuration", "sensor/imu came before configuration/project")
            return []
        self._note_time(body.time_ns, "inertial")
        force, rate = (body.force_x, body.force_y, body.force_z), (body.rate_x, body.rate_y, body.rate_z)
        interval_ns = body.interval_ns
        first, self._inertial_came = not self._inertial_came, True
        if first and not interval_ns:
            return []  # of a bag: nobody knows since when it measured, and the next one measured since then
        convert.check_inertial(interval_ns, force, rate)
        if not isinstance(self._engine, InertialNavigator):
            self._engine = inertial_engine(
                self._configuration, body, self._unit,
                filtered_s=self._filtered_s, smooth_every_s=self._smooth_every_s,
            )  # fmt: skip
            self._seen = Counter()
            self._offset.settings = self._engine.settings
            wrong = stated_noise(body)[2]
            if wrong:
                self.problem("inertial noise", f"sensor/imu: {wrong}")
                self._notes.append(self._log(self._stamp_ns, f"sensor/imu: {wrong}", warning=True))
        time_s, interval_s = self._seconds(body.time_ns), interval_ns * 1e-9
        self._offset.sample(time_s, interval_s, *force, *rate)
        return self._engine.add_inertial(time_s, interval_s, force, rate)

    def _attitude(self, body: Any) -> list[NavigationPose]:
        if self._engine is None:
            self.refuse("before configuration", "sensor/attitude came before configuration/project")
            return []
        if isinstance(self._engine, InertialNavigator):
            self.counters["attitude beside inertial data"] += 1
            return []
        self._note_time(body.time_ns, "attitude")
        rpy = (body.roll, body.pitch, body.heading)
        convert.check_angles(*rpy)
        if self._is_frozen(body.time_ns, rpy) or self._has_jumped(body.time_ns, rpy):
            return []
        self._offset.sample(self._seconds(body.time_ns), *rpy)
        return self._engine.add_attitude(self._seconds(body.time_ns), rpy, self._attitude_covariance(body.covariance))

    def _is_frozen(self, time_ns: int, rpy: tuple[float, float, float]) -> bool:
        """Whether an attitude has been the same for long: then it is no measurement."""
        if rpy != self._same[1]:
            if self.alarms.pop("frozen", ""):
                self._notes.append(self._log(self._stamp_ns, "attitude changes again"))
            self._same = time_ns, rpy
            return False
        for_s = (time_ns - self._same[0]) * 1e-9
        if for_s <= FROZEN_S:
            return False
        self.counters["attitude frozen"] += 1
        text = f"attitude has been the same for {for_s:.1f} s: the sensor hangs, and is not used"
        if "frozen" not in self.alarms:
            self._notes.append(self._log(self._stamp_ns, text, warning=True))
        self.alarms["frozen"] = text
        return True

    def _has_jumped(self, time_ns: int, rpy: tuple[float, float, float]) -> bool:
        """Whether no aircraft can have turned to an attitude: then it is no measurement."""
        left_out = self._jumps.is_left_out(self._seconds(time_ns), rpy)
        if left_out:
            text = f"attitude jumps by {self._jumps.by_deg:.1f} deg: left out until it goes on from before, or stays so"
            self.problem("attitude jump", f"sensor/attitude: {text}")
            if time_ns > self._told_jump_ns + JUMP_TOLD_S * convert.SECOND_NS:
                self._notes.append(self._log(self._stamp_ns, text, warning=True))
                self._told_jump_ns = time_ns
        return left_out

    def _attitude_covariance(self, values: Any) -> Any:
        """(3, 3); the array of the last message again if it had the same values, so that nothing is computed twice."""
        key = tuple(values)
        if key != self._covariance_key:
            if len(key) != 9 or not np.isfinite(key).all() or min(key[0], key[4], key[8]) <= 0:
                raise ValueError(f"attitude covariance {list(key)}, wanted 9 values with a positive diagonal")
            self._covariance_key, self._covariance = key, np.array(key).reshape(3, 3)
        return self._covariance

    def _gnss(self, message: Message) -> list[NavigationPose]:
        body = message.body
        if self._engine is None:
            self.refuse("before configuration", "sensor/gnss came before configuration/project")
            return []
        convert.check_place(body.latitude, body.longitude, body.altitude)
        geodetic = np.array([body.latitude, body.longitude, body.altitude])
        covariance = np.array(body.position_covariance)
        if covariance.shape != (9,) or not np.isfinite(covariance).all() or covariance[::4].min() <= 0:
            raise ValueError("position covariance: wanted 9 values with a positive diagonal")
        if not self._right_clock(message):
            self.refusals += 1
            return []
        self._check_time(message)
        frame = self._frame
        self._tell_far(body.latitude, body.longitude)
        antenna_l = frame.from_geodetic(*geodetic)
        R_l_enu = frame.R_ln_at(geodetic[0], geodetic[1]) @ R_ENU_NED
        time_s = self._seconds(self._time_ns(body))
        covariance_l = R_l_enu @ covariance.reshape(3, 3) @ R_l_enu.T
        velocity_l, velocity_covariance_l = self._velocity(body, R_l_enu)
        fix = local_fix(frame, time_s, antenna_l, covariance_l, velocity_l, velocity_covariance_l)
        if not self._in_step(fix):
            self.refusals += 1
            return []
        if isinstance(self._engine, KinematicFilter):
            return self._engine.add_gnss(time_s, antenna_l, covariance_l)
        return self._engine.add_fix(fix)

    def _tell_far(self, latitude: float, longitude: float) -> None:
        """Tell an operator when fixes are where the project is not: whatever is computed of them is nonsense."""
        away_km = _ground_km(self._frame, latitude, longitude) if self._frame.is_placed else 0.0
        if away_km < FAR_KM:
            self.alarms.pop("far", None)
            return
        text = (
            f"GNSS is {away_km:.0f} km away from the origin of the project ({self._frame.lat_deg:.4f}, "
            f"{self._frame.lon_deg:.4f}), at {latitude:.4f}, {longitude:.4f}: is the project that of another flight?"
        )
        if "far" not in self.alarms:
            self._notes.append(self._log(self._stamp_ns, text, warning=True))
            self.problem("far from project", f"sensor/gnss: {text}")
            self.alarms["far"] = text

    def _in_step(self, fix: GnssData) -> bool:
        """Whether motion says that a fix has the time of the other sensors, as far as motion has shown it."""
        changed, offset = self._offset.fix(fix), self._offset.offset
        out = offset is not None and offset.is_too_large
        if out:
            self.counters["gnss of another clock"] += 1
        if not changed:
            return not out
        if offset is None:
            self.alarms.pop("clock", None)
            self._notes.append(self._log(self._stamp_ns, "GNSS clock agrees again: fixes are used"))
            return True
        words = f"{offset_in_words(offset.offset_s, self._other)}, +- {offset.sigma_s:.2f} s"
        remedy = f"'triline confirm sensor/gnss --clock {self._correction_s + offset.offset_s:.3f}' corrects it"
        if out:
            self._wrong_clock(words, remedy)
            self._start_anew()
        else:
            self.alarms.pop("clock", None)
            self._notes.append(self._log(self._stamp_ns, f"{words}: GNSS is used; {remedy}", warning=True))
        return not out

    @staticmethod
    def _velocity(body: Any, R_l_enu: Any) -> tuple[Any, Any]:
        """Velocity (3,) and its covariance (3, 3) in the local frame; None, None where the receiver gives none."""
        covariance = np.array(body.velocity_covariance)
        velocity = np.array([body.velocity_enu.x, body.velocity_enu.y, body.velocity_enu.z])
        if covariance.shape != (9,) or not np.isfinite(covariance).all() or covariance[::4].min() <= 0:
            return None, None
        if not np.isfinite(velocity).all():
            raise ValueError(f"velocity {velocity.tolist()} is not finite")
        return R_l_enu @ velocity, R_l_enu @ covariance.reshape(3, 3) @ R_l_enu.T

    def _seconds(self, time_ns: int) -> float:
        return (time_ns - self._reference_ns) * 1e-9

    def _messages(self, poses: list[NavigationPose]) -> list[Message]:
        engine = self._engine
        if engine is None:
            return []
        self.alarms["gnss"] = engine.alarm if isinstance(engine, InertialNavigator) else ""
        for kind, n in engine.counters.items():
            self.counters[kind] += n - self._seen[kind]
            self._seen[kind] = n
        if not (poses or self._notes or engine.has_events):  # after most samples
            return []
        out = [
            Message(
                "trajectory/smoothed" if p.smoothed else "trajectory/filtered",
                self._stamp_ns,
                convert.pose_message(
                    self._reference_ns + round(p.time_s * 1e9), p.position_l, p.angles, p.covariance,
                    quaternion=p.quaternion, valid=p.valid, reason=p.reason, velocity_l=p.velocity_l,
                    noise_time_s=p.noise_time_s,
                ),
            )
            for p in poses
        ]  # fmt: skip
        out += self._notes
        self._notes = []
        for event in engine.take_events():
            out.append(self._log(self._reference_ns + round(event.time_s * 1e9), event.text))
        return out

    def _log(self, time_ns: int, text: str, warning: bool = False) -> Message:
        return Message("event/log", self._stamp_ns, convert.log_line(self.name, text, time_ns, warning))


def _ground_km(frame: LocalFrame, latitude: float, longitude: float) -> float:
    """Distance of a place from the origin of a frame along the ground of a round Earth, km."""
    a, b = np.radians([frame.lat_deg, latitude])
    turn = np.radians(longitude - frame.lon_deg)
    cosine = np.sin(a) * np.sin(b) + np.cos(a) * np.cos(b) * np.cos(turn)
    return float(6371.0 * np.arccos(np.clip(cosine, -1.0, 1.0)))
