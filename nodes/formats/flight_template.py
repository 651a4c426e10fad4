"""The commented ``flight.toml`` that `triline new flight` writes."""

from __future__ import annotations

from pathlib import Path

from ..errors import UserError
from .flight_folder import FILE, NAVIGATION
from .new_file import new_file

TEMPLATE = """\
# A flight for triline. Files are named relative to this folder. `triline check DIR` says what is missing,
# `triline import DIR -o flight.mcap` makes a recording of it. Lines that begin with # are defaults or examples.

[flight]
name = "{name}"
platform = "aircraft"             # first word of the topics on the bus
crs = "EPSG:32632"                # horizontal CRS of control and results: anything that PROJ understands
vertical_datum = "ellipsoid"      # "ellipsoid", or the vertical CRS of the heights, as "EPSG:5773" for EGM96
#origin_deg = [47.9, 11.1]        # latitude, longitude of a live flight's local frame; else by control or GNSS
#ground_height_m = 300.0          # height of the ground above the ellipsoid; or [dem], control, or:
#above_ground_m = 1200.0          # so high the platform flies above the ground

[camera]
file = "camera.json"              # or: preset = "ads40"

[mounting]                        # body axes forward, right, down
lever_arm_m = [0.0, 0.0, 0.0]     # antenna, seen from the inertial sensor
camera_lever_arm_m = [0.0, 0.0, 0.0]   # perspective centre, seen from the inertial sensor (or from what poses describe)
boresight_deg = [0.0, 0.0, 0.0]   # roll, pitch, heading of the camera against the body

[navigation]
file = "navigation.csv"           # sensor folder, CSV, SBET, POS export, Inertial Explorer, ROS 2 bag, imu_gps.txt ...
#accuracies = "smrmsg_7.out"      # of the poses of an SBET, where they are not beside it under its name
#kind = "csv"                     # where the file does not show it: {kinds}
#images = {{N = "/camera/nadir"}}   # topics of a ROS 2 bag whose images are image lines
#date = 2024-05-17                # day of the flight, for files with GPS seconds of the week
gnss = "code"                     # RTK, PPP or code: slow errors of the positions
imu = "MEMS"                      # tactical or MEMS: slow errors of the attitudes, noise of the sensor

#[trajectory]                     # slow errors left in the trajectory, in place of those of the grades; 1 sigma
#offset_sigma_m = [1.0, 1.0, 2.0]             # constant over a strip
#shift_sigma_deg = [0.05, 0.05, 0.15]
#drift_sigma_deg = [0.02, 0.02, 0.05]         # over a strip
#wander_sigma_m = [0.5, 0.5, 1.0]
#wander_sigma_deg = [0.02, 0.02, 0.05]
#wander_time_s = 60.0
#attitude_wander_time_s = 60.0    # of the attitude's, where it is another one

#[imu]                            # data sheet of the inertial sensor, in place of that of its grade
#gyro_noise_deg_sqrt_h = 0.2
#gyro_bias_deg_h = 20.0
#accel_noise_m_s_sqrt_h = 0.05
#accel_bias_mgal = 2000.0

#[control]
#file = "control.csv"             # point,X_m,Y_m,Z_m,sigma_X_m,sigma_Y_m,sigma_Z_m,role[,target_radius_m]

#[dem]                            # heights of the ground, on which the origin of the local frame is put
#file = "ground.tif"
#crs = "EPSG:5773"                # what they count from, or "ellipsoid", where the file does not say
#sigma_m = 0.5                    # with it the tie points lie on them: of a height at a place
#shift_sigma_m = 0.5              # of the error that all heights share

#[[strips]]                       # one for each strip
#id = "S1"
#images = {{F = "forward.img", N = "nadir.img", B = "backward.img"}}   # ENVI, TIFF, raw; "all.img@2" is band 2
#type = "u2"                      # of raw files without header: u1, u2, >u2 (and samples = 1000)
#line_times = "S1_times.csv"      # line,time; or:
#first_time = 2024-05-17T09:30:00Z
#line_rate_hz = 200.0
#band = "1"                       # number, name, or sum as "2:0.5,3:0.5"
#grey_range = [0.0, 1.0]          # values that become black and white

#[[sensor]]                       # one for each sensor program that `triline fly` starts
#kind = "nmea"                    # nmea, lines, ros2 or stream
#id = "gnss"
#address = "serial:/dev/ttyUSB0"  # or tcp://HOST:PORT, udp://HOST:PORT, file:NAME
#clock_offset_s = 0.0             # its stamps minus UTC
#delay_s = 0.0                    # from the measurement until it is here

#[nodes.matcher]                  # settings of nodes: triline process --config DIR/flight.toml
#image_sigma_px = 0.04            # floor of the sigma of a match, px
"""


def write_template(folder: Path) -> Path:
    """Write a commented flight.toml into a folder, which is made where it is not there.

    Raises
    ------
    UserError : there is one already, or the folder cannot be made
    """
    path = folder / FILE
    if path.exists():
        raise UserError(f"{path}: is there already, and is not overwritten")
    if folder.exists() and not folder.is_dir():
        raise UserError(f"{folder}: is a file, wanted a folder")
    folder.mkdir(parents=True, exist_ok=True)
    name = folder.resolve().name.replace("\\", "").replace('"', "")
    with new_file(path) as part:
        part.write_text(TEMPLATE.format(name=name, kinds=", ".join(NAVIGATION)), encoding="utf-8")
    return path
