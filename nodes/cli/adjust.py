"""``triline adjust``: batch adjustment of a block folder or a recording."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ...solver.adjustment.adjustment import Iteration
from ...solver.adjustment.block_data import BlockData, network_from_block
from ...solver.adjustment.determinability import Limits, Removal
from ...solver.adjustment.job import Event, Job, NotAdjustableError, Phase, Pose, refuse_in_parts
from ...solver.adjustment.job import run as run_job
from ...solver.adjustment.joined_block import JoinedBlock, join_blocks
from ...solver.adjustment.options_by_strip import OptionsByStrip, options_of_strip
from ...solver.adjustment.robust import WEIGHT_FUNCTIONS
from ...solver.adjustment.snooping import Round
from ...solver.adjustment.straightened import straightened
from ...solver.adjustment.surface_control import SurfaceControl
from ...solver.camera.self_calibration import LEFT, SELF_CALIBRATIONS, SelfCalibration
from ...solver.geometry.ellipsoid import WGS84
from ...solver.location.refraction import Refraction
from ...solver.models import MODELS
from ...solver.models.base import ModelOptions
from ...solver.models.lim import FEWEST_FIXES
from ...solver.models.platform import MOST_CLOCK_S, MOST_LEVER_ARM_M, USUAL_PLATFORM, PlatformErrors
from ...solver.partitioned.engine import Engine
from ...solver.partitioned.part import RAYS
from ..batch.adjustment_result import (
    CAMERA,
    HOPELESS,
    PER_LINE,
    PLOTS,
    RESULT,
    TABLES,
    Adjustment,
    result_of,
    where_to_look,
)
from ..batch.adjustment_summary import Content, summary_lines
from ..batch.adjustment_tables import oriented_lines, write_tables
from ..batch.partition_runner import DaskRunner, FolderStore, ProcessRunner
from ..batch.scene_adjustment import SETS
from ..batch.two_steps import OWNERS, UNUSED, sigmas_stated, step_settings
from ..errors import UserError
from ..first_of import first_of
from ..formats.block_folder import is_block_folder, read_block
from ..formats.block_recording import TOPICS, block_from_messages
from ..formats.camera_json import read_camera_instead, write_camera
from ..formats.dem import surface_control
from ..formats.importable import refuse_importable
from ..formats.json_text import json_text
from ..formats.line_orientation import write_oriented_lines
from ..formats.new_file import new_file, new_files, refuse_unless_folder
from ..formats.scene_block import is_scene_block
from ..recording.reader import RecordingReader
from ..recording.remote import path_of
from ..recording.summary import OF_RECORDING, damage_lines, in_brackets, left_out_lines, unfit_lines
from ..terminal import drawing, plain, redraws, width
from ..voices import RecordedVoices
from .adjust_scenes import run_scenes
from .common_options import refuse_less
from .dem_options import add_dem_options, dem_settings
from .location_options import refraction_of
from .navigated import navigated
from .outputs import refuse_folder_of_inputs

EXAMPLE = """triline adjust block/ --model dgr --selfcal tls18 --snoop -o result
  triline adjust flight.mcap --model dgr --then lim --fixes 12 --plots -o result
  triline adjust flight.mcap --camera result/camera.json -o again
  triline adjust flight.mcap --dem ground.tif --dem-sigma 0.5 --dem-crs EPSG:5773 --per-line -o result
  triline adjust day1.mcap day2.mcap --workers 4 --snoop -o result"""

#: Renamed strips that a note lists.
RENAMED_SHOWN = 6

#: Fewest rays of a partition: below, reading and writing it costs more than its work.
LEAST_RAYS = 100

#: Up to so many segments or fixes a strip are not checked against the number of rays.
FEW = 20

#: Note where the image sigma is asked for by itself before it is asked for with the others.
REWEIGHTED_TWICE = (
    "--reweight beside --variance-components: these estimate the image sigma, too, and begin with one that took what "
    "is wrong with the others; wanted --variance-components alone"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "input", nargs="+", metavar="INPUT",
        help="block folder, block of satellite scenes, or recording (URLs, too); several recordings or folders of one "
        "camera are adjusted as one block: points of the same name tie them",
    )  # fmt: skip
    parser.add_argument("-o", "--output", metavar="DIR", help="folder for result.json, points.csv, residuals.csv, ...")
    group = parser.add_argument_group("model")
    group.add_argument(
        "--model", choices=sorted(MODELS), help="trajectory model (dgr; wander if the project states one)"
    )
    group.add_argument("--then", choices=sorted(MODELS), help="a second model on the orientation the first one refined")
    group.add_argument("--segments", type=int, metavar="N", help="segments a strip, for ppm")
    group.add_argument("--order", type=int, choices=(1, 2), help="of the polynomials of ppm (2)")
    group.add_argument("--sets", choices=SETS, help="satellite scenes: corrections a lens, or a scene (lens)")
    group.add_argument("--fixes", type=int, metavar="N", help="orientation fixes a strip, for lim")
    group.add_argument(
        "--clock-sigma", type=float, metavar="S",
        help="clocks of poses and image lines differ by an unknown constant, beforehand known to S seconds (0; with "
        "--variance-components 0.001)",
    )  # fmt: skip
    group.add_argument(
        "--lever-arm-sigma", type=float, default=0.0, metavar="M",
        help="each component of the lever arm is off by an unknown constant, beforehand known to M metres (0)",
    )  # fmt: skip
    selfcal = ["none", *SELF_CALIBRATIONS]
    group.add_argument(
        "--selfcal", choices=selfcal,
        help="additional parameters of the camera (none; with --variance-components calibrated)",
    )  # fmt: skip
    group.add_argument(
        "--camera", type=Path, metavar="FILE",
        help="camera.json in place of that of each input: one that an adjustment with --selfcal wrote",
    )  # fmt: skip
    group.add_argument("--free", action="store_true", help="additional parameters without a-priori weight")
    group.add_argument(
        "--keep",
        choices=("significant", "all", "determinable"),
        help="what the determinability tests of --selfcal do: keep a parameter that is significant though correlated "
        "(significant, the default), remove whatever fails a test (determinable), remove nothing (all)",
    )
    group = parser.add_argument_group("observations")
    group.add_argument("--snoop", action="store_true", help="data snooping: test and leave out outliers")
    group.add_argument("--critical", type=float, default=3.29, metavar="W", help="critical value of |w| (3.29)")
    group.add_argument("--robust", choices=sorted(WEIGHT_FUNCTIONS), help="robust estimation; with --snoop its start")
    group.add_argument("--reweight", action="store_true", help="re-estimate the image sigma")
    group.add_argument(
        "--variance-components", action="store_true",
        help="estimate sigmas of image, control, position and attitude; question clock and calibration of the camera",
    )  # fmt: skip
    add_dem_options(group)
    group.add_argument(
        "--refraction", nargs="*", type=float, metavar="VALUE", help="take the bending of rays in the air off: as in "
        "'triline locate'; behind the input",
    )  # fmt: skip
    group.add_argument(
        "--iterations", type=int, metavar="N",
        help="steps of an adjustment, at most (30, and where they do not do as many again); the result counts those of "
        "all: a second model, data snooping and sigmas that are estimated adjust anew",
    )  # fmt: skip
    group = parser.add_argument_group("large blocks")
    group.add_argument(
        "--workers", type=int, metavar="N",
        help="adjust in partitions on N processes here; the answers are those of one process",
    )  # fmt: skip
    group.add_argument("--scheduler", metavar="ADDRESS", help="in partitions on a Dask cluster, tcp://HOST:PORT")
    group.add_argument(
        "--scratch", type=Path, metavar="DIR",
        help="folder for the partitions, which all workers see (a temporary one)",
    )  # fmt: skip
    group.add_argument("--partition-rays", type=int, metavar="N", help=f"rays of a partition ({RAYS})")
    parser.add_argument(
        "--per-line", action="store_true", help="refined orientation of every image line: orientation_lines.csv (-o)"
    )
    parser.add_argument("--plots", action="store_true", help="pictures of residuals, check points and corrections (-o)")


def run(args: argparse.Namespace) -> int:
    dem = _refuse_options(args)
    paths = [path_of(path) for path in args.input]
    args.input = args.input[0]
    scenes = next((path for path in paths if path.is_dir() and is_scene_block(path)), None)
    if scenes is not None:
        _options_of_scenes(args, scenes, len(paths))
        content = run_scenes(args)
    else:
        _options_of_camera_and_clock(args, len(paths))
        content = _run_block(args, paths, dem)
    if args.json:
        print(json_text(content))
    else:
        for line in summary_lines(content, verbose=args.verbose):
            print(line)
        if args.output and not args.quiet:
            print(f"written to {args.output}")
    return 0


def _refuse_options(args: argparse.Namespace) -> dict[str, Any]:
    """Refuse options that go with no input; the settings of a terrain model."""
    if args.plots and not args.output:
        raise UserError("--plots needs a folder for the pictures: -o DIR")
    if args.per_line and not args.output:
        raise UserError("--per-line needs a folder for the table: -o DIR")
    dem = dem_settings(args)
    if not args.critical > 0:
        raise UserError(f"--critical {args.critical:g}, wanted more than 0")
    refuse_less(args, 1, "iterations", "segments")
    refuse_less(args, FEWEST_FIXES, "fixes")
    if args.output:
        refuse_unless_folder(Path(args.output))
        refuse_folder_of_inputs(Path(args.output))
    refuse_worker_options(args)
    return dem


def _options_of_scenes(args: argparse.Namespace, scenes: Path, inputs: int) -> None:
    """Refuse options that do not go with satellite scenes, and say what is estimated where that is not said."""
    if args.clock_sigma:
        raise UserError("--clock-sigma does not go with satellite scenes")
    if args.lever_arm_sigma:
        raise UserError("--lever-arm-sigma does not go with satellite scenes")
    if args.camera is not None:
        raise UserError("--camera does not go with satellite scenes")
    if args.keep is not None:
        raise UserError("--keep does not go with satellite scenes: their parameters are not tested")
    if args.per_line:
        raise UserError("--per-line does not go with satellite scenes: trajectory_refined.csv has their poses")
    if inputs > 1:
        raise UserError(f"{scenes}: a block of satellite scenes is adjusted alone")
    if args.workers or args.scheduler:
        raise UserError("--workers and --scheduler do not go with satellite scenes")
    args.selfcal = args.selfcal or "none"
    _refuse_free(args)


def _options_of_camera_and_clock(args: argparse.Namespace, inputs: int) -> None:
    """Refuse options that do not go with flights, and say what is estimated where that is not said."""
    if args.sets is not None:
        raise UserError("--sets goes with a block of satellite scenes (project.toml with [scenes])")
    if inputs > 1 and args.clock_sigma:
        raise UserError("--clock-sigma goes with one recording: each has a clock of its own")
    questions = args.variance_components
    args.selfcal = args.selfcal or (LEFT if questions else "none")
    _refuse_free(args)
    if args.keep is not None and args.selfcal in ("none", LEFT):
        tested = ", ".join(name for name in SELF_CALIBRATIONS if name != LEFT)
        raise UserError(f"--keep goes with additional parameters that are tested, wanted --selfcal, one of {tested}")
    if args.clock_sigma is None:
        args.clock_sigma = USUAL_PLATFORM.clock_sigma_s if questions and inputs == 1 else 0.0


def _run_block(args: argparse.Namespace, paths: Sequence[Path], dem: Mapping[str, Any]) -> Content:
    """Adjust flights and write the result; its content."""
    recordings = [read_input(path) for path in paths]
    of_camera: list[str] = []
    if args.camera is not None:  # before they are joined, since each may have another one
        of_camera = [f"camera of {args.camera}"]
        for i, own in enumerate(recordings):
            camera = read_camera_instead(args.camera, own.camera, notes=None if i else of_camera)
            recordings[i] = replace(own, camera=camera)
    joined = join_inputs(recordings, paths) if len(paths) > 1 else None
    block = recordings[0] if joined is None else joined.block
    block = replace(block, notes=(*block.notes, *of_camera))
    surface = None
    if dem:
        raster, crs = Path(dem["dem"]), dem.get("dem_crs")
        surface = surface_control(raster, block.frame, crs, dem["dem_sigma_m"], dem.get("dem_shift_sigma_m"))
    air = None
    if args.refraction is not None:
        air = refraction_of(args.refraction, WGS84, str(args.input))
        block = replace(block, notes=(*block.notes, "refraction taken off the image points"))
    if block.apriori.then and args.then is None:
        block = replace(block, notes=(*block.notes, UNUSED))
    tested = args.selfcal not in ("none", LEFT)  # between the two, with the image sigma that the first one found
    if args.reweight and args.variance_components and not tested and args.then is None:
        block = replace(block, notes=(*block.notes, REWEIGHTED_TWICE))
    job = job_of(args, block)
    if joined is not None:
        jobs = [job_of(args, own) for own in recordings]
        job = replace(job, model=by_recording(joined, [own.model for own in jobs]))
        if job.then is not None:
            job = replace(job, then=by_recording(joined, [own.then or job.then for own in jobs]))
    del recordings
    with partitions_of(args) as pose:
        adjustment = adjust_block(block, job, _ProgressLines(args), surface, air, pose)
    content = result_of(adjustment)
    if args.output:
        write_result(
            adjustment, content, Path(args.output), plots=args.plots, per_line=args.per_line, camera=args.camera
        )
    return content


def _refuse_free(args: argparse.Namespace) -> None:
    if args.free and args.selfcal == "none":
        raise UserError("--free goes with additional parameters, wanted --selfcal")


def read_input(path: Path) -> BlockData:
    """The block in a folder or a recording.

    Raises
    ------
    UserError : neither, or one that cannot be adjusted
    """
    if path.is_dir():
        if not is_block_folder(path):
            refuse_importable(path)
        return read_block(path)
    if not path.exists():
        raise UserError(f"{path}: no such file or folder")
    refuse_importable(path)
    reader = RecordingReader(path, by_ranges=True)
    voices, notes = RecordedVoices(), list[str]()
    try:
        with navigated(reader, path.name, notes) as oriented:
            block = block_from_messages(voices.all_used(oriented.sorted_messages(TOPICS)), path.name)
    except UserError as error:
        raise UserError(f"{error}{in_brackets(left_out_lines(reader))}") from None
    damage = (f"{OF_RECORDING}{line}" for line in damage_lines(reader))
    return replace(block, notes=(*damage, *unfit_lines(reader), *notes, *voices.lines(), *block.notes))


def refuse_worker_options(args: argparse.Namespace) -> None:
    """Raise UserError for numbers of workers and rays, and for options, that do not go."""
    refuse_less(args, 1, "workers")
    if args.workers is not None and args.scheduler:
        raise UserError("--workers and --scheduler: wanted one of them")
    refuse_less(args, LEAST_RAYS, "partition_rays")
    for option, value in (("--scratch", args.scratch), ("--partition-rays", args.partition_rays)):
        if value is not None and not (args.workers or args.scheduler):
            raise UserError(f"{option} goes with --workers or --scheduler")


@contextmanager
def partitions_of(args: argparse.Namespace) -> Iterator[Pose | None]:
    """What takes a block to partitions, and these while they are worked on; None where it stays here."""
    if not (args.workers or args.scheduler):
        yield None
        return
    if args.scratch is not None:
        refuse_unless_folder(args.scratch)
        args.scratch.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix="triline-", dir=args.scratch) as folder:
        store = FolderStore(Path(folder).resolve() / "partitions")
        runner = DaskRunner(store, args.scheduler) if args.scheduler else ProcessRunner(store, args.workers)
        try:
            yield Engine(runner, args.partition_rays or RAYS).pose
        finally:
            runner.close()


def join_inputs(blocks: Sequence[BlockData], paths: Sequence[Path]) -> JoinedBlock:
    """Several recordings as one block, whose notes say what joins them.

    Raises
    ------
    UserError : recordings that cannot be joined
    """
    if len({os.path.realpath(str(path)) for path in paths}) < len(paths):
        raise UserError("a recording is given twice")
    names = [path.stem for path in paths]
    if len(set(names)) < len(names):
        names = [str(path) for path in paths]
    try:
        joined = join_blocks(blocks, names)
    except ValueError as error:
        raise UserError(str(error)) from None
    for one, other, number in joined.repeated:
        raise UserError(
            f"{other} holds {number} of the image points of {one}, which would count twice: is it the same flight, "
            "as recorded and as processed? (of parts of a flight `triline recover` makes one recording)"
        )
    notes = joining_notes(joined, names)
    return replace(joined, block=replace(joined.block, notes=(*notes, *joined.block.notes)))


def joining_notes(joined: JoinedBlock, names: Sequence[str]) -> list[str]:
    """What was joined by what, in words."""
    of = ", ".join(
        f"{name} ({strips} strips, {points} image points)"
        for name, strips, points in zip(names, joined.strips, joined.image_points, strict=True)
    )
    notes = [f"{len(names)} recordings as one block: {of}"]
    if joined.ties + joined.ground:
        notes.append(
            f"joined by {joined.ties} tie points and {joined.ground} known points that more than one of them measured"
        )
    else:
        notes.append("no point was measured in more than one recording: they are adjusted side by side")
    if joined.elsewhere:
        notes.append(f"{joined.elsewhere} tie points have a name that comes again at another place, and are kept apart")
    if joined.restated:
        of = first_of([f"{point} (those of {name} count)" for point, name in joined.restated], RENAMED_SHOWN)
        notes.append(f"known points with sigmas that are not the same in all recordings: {of}")
    if joined.renamed:
        shown = first_of([f"{id} of {name} is {new}" for name, id, new in joined.renamed], RENAMED_SHOWN)
        notes.append(f"strips of the same name: {shown}")
    notes.append(
        "corrections and a-priori sigmas of the trajectory are those of each recording, camera and sigma factors common"
    )
    return notes


def by_recording(joined: JoinedBlock, models: Sequence[ModelOptions]) -> ModelOptions:
    """The model with the settings of each recording; one for all where they say the same."""
    if all(model == models[0] for model in models):
        return models[0]
    before = {name: strip for _, strip, name in joined.renamed}
    return OptionsByStrip({s: options_of_strip(models[i], before.get(s, s)) for s, i in joined.recording.items()})


def job_of(args: argparse.Namespace, block: BlockData) -> Job:
    """The job that the options ask for."""
    model = args.model or ("wander" if wanders(block.apriori.trajectory) else "dgr")
    first, second = models_of(block, model, args.then, {option: getattr(args, option) for option in OWNERS})
    limits = Limits(keep_significant=args.keep in (None, "significant"))
    robust = WEIGHT_FUNCTIONS[args.robust]() if args.robust else None
    return Job(
        first,
        second,
        _self_calibration(args, block),
        args.keep != "all",
        limits,
        args.snoop,
        args.critical,
        robust,
        args.reweight,
        args.variance_components,
        max_iterations=args.iterations,
        platform=_platform(args),
        then_stated=sigmas_stated(block.apriori.then),
        wide=block.apriori.wide,
    )


def models_of(
    block: BlockData, model: str, then: str | None, given: Mapping[str, int | None]
) -> tuple[ModelOptions, ModelOptions | None]:
    """The trajectory models of one or two steps, with the project's settings and the options ``given`` by name.

    Raises
    ------
    UserError : settings that a model does not take, more segments or fixes than the rays of a strip can determine
    """
    steps = step_settings(block.apriori.trajectory, block.apriori.then, model, then, given)
    first, second = (
        None if name is None else _model_of_strips(name, settings, block)
        for name, settings in zip((model, then), steps, strict=True)
    )
    assert first is not None
    return first, second


def _platform(args: argparse.Namespace) -> PlatformErrors:
    if not 0 <= args.clock_sigma < MOST_CLOCK_S:
        raise UserError(f"--clock-sigma {args.clock_sigma:g}, wanted 0 or more, and less than {MOST_CLOCK_S:g} s")
    arm = args.lever_arm_sigma
    if not 0 <= arm < MOST_LEVER_ARM_M:
        raise UserError(f"--lever-arm-sigma {arm:g}, wanted 0 or more, and less than {MOST_LEVER_ARM_M:g} m")
    return PlatformErrors(args.clock_sigma, arm)


def wanders(settings: Mapping[str, object]) -> bool:
    """Whether the project states a sigma for wandering errors of the trajectory."""
    return any(np.any(np.asarray(settings.get(key, 0.0), float)) for key in ("wander_sigma_m", "wander_sigma_deg"))


def _refuse_more_than_rays_carry(settings: Mapping[str, object], name: str, block: BlockData) -> None:
    """Raise UserError for more segments or fixes than rays can determine: a segment has 18 unknowns, a ray 2 equations.

    Fixes with too few rays are merged, up to a limit.
    """
    rays = np.bincount(block.image.strip[block.image.strip >= 0], minlength=1)
    most, strip = int(rays.max()), block.strips[int(rays.argmax())].id
    for option, model, share in (("segments", "ppm", 9), ("fixes", "lim", 2)):
        number, limit = settings.get(option), max(most // share, FEW)
        if model == name and isinstance(number, int) and number > limit:
            raise UserError(
                f"--{option} {number}: more than the image points carry, wanted at most {limit} "
                f"(strip {strip} has the most image points, {most})"
            )


def _model_of_strips(name: str, settings: Mapping[str, object], block: BlockData) -> ModelOptions:
    """The model with what strips have of their own."""
    usual, of_strip = _model(name, settings, block), block.apriori.of_strip
    if not of_strip:
        return usual
    own = {strip: _model(name, {**settings, **differs}, block) for strip, differs in of_strip.items()}
    return OptionsByStrip({strip.id: own.get(strip.id, usual) for strip in block.strips})


def _model(name: str, settings: Mapping[str, object], block: BlockData) -> ModelOptions:
    _refuse_more_than_rays_carry(settings, name, block)
    try:
        return MODELS[name].from_settings(settings)
    except ValueError as error:
        raise UserError(f"model {name}: {error}") from None


def _self_calibration(args: argparse.Namespace, block: BlockData) -> SelfCalibration | None:
    if args.selfcal == "none":
        return None
    try:
        parameters = SELF_CALIBRATIONS[args.selfcal](block.camera)
    except ValueError as error:
        raise UserError(f"--selfcal {args.selfcal}: {error}") from None
    return parameters.free() if args.free else parameters


def adjust_block(
    block: BlockData,
    job: Job,
    tell: Any = None,
    surface: SurfaceControl | None = None,
    refraction: Refraction | None = None,
    pose: Pose | None = None,
) -> Adjustment:
    """Adjust a block as a job asks.

    Parameters
    ----------
    tell : is called with what happens
    surface : on which tie points lie
    refraction : is taken off the image points
    pose : takes the block to partitions, where it is adjusted in these (`partitions_of`)

    Raises
    ------
    UserError : a block from which nothing can be computed
    """
    start = time.perf_counter()
    try:
        with np.errstate(all="ignore"):  # results that are not finite are refused below
            network = replace(network_from_block(block), surface=surface)
            if refraction is not None:
                network = straightened(network, block.frame, refraction)
            if pose is not None:
                refuse_in_parts(network, job)
            result = run_job(network, job, tell, pose)
    except NotAdjustableError as error:
        raise UserError(f"{block.name}: {error}") from None
    except ValueError as error:
        raise UserError(f"{block.name}: cannot be adjusted: {error}") from None
    finally:
        if isinstance(tell, _ProgressLines):
            tell.close()
    adjustment = Adjustment(block, job, result, time.perf_counter() - start)
    sigma0 = result.test.sigma0 * result.image_factor  # of the image sigma that was stated, not of what was made of it
    if not result.solution.converged and sigma0 > HOPELESS:
        raise UserError(f"{block.name}: does not converge (sigma0 {sigma0:.3g}); {where_to_look(adjustment)}")
    return adjustment


def write_result(
    adjustment: Adjustment, content: Mapping[str, Any], folder: Path, *, plots: bool = False, per_line: bool = False,
    camera: Path | None = None,
) -> None:  # fmt: skip
    """Write the tables, the calibrated camera and ``result.json``; pictures and the table of lines on request.

    A ``camera`` that the user gave goes with the tables, calibrated anew or as it is. ``result.json`` comes last: where
    it is, all is there. The result of an earlier run stays until all of this one is written.
    """
    refuse_unless_folder(folder)
    earlier = any((folder / name).exists() for name in (RESULT, TABLES[0]))
    with new_files(folder, RESULT, (*TABLES, *PLOTS, CAMERA, PER_LINE) if earlier else ()) as new:
        write_tables(adjustment, new)
        used = adjustment.camera() or (None if camera is None else adjustment.block.camera)
        if used is not None:
            write_camera(new / CAMERA, used)
        if per_line:
            with new_file(new / PER_LINE) as part:
                write_oriented_lines(part, oriented_lines(adjustment), adjustment.block.frame)
        if plots:
            from ..report.adjustment_plots import write_plots

            write_plots(adjustment, new)
        with new_file(new / RESULT) as part:
            part.write_text(json_text(content) + "\n")


class _ProgressLines:
    """Progress on standard error: one line that is written over on a terminal, plain lines elsewhere."""

    def __init__(self, args: argparse.Namespace):
        self.silent = args.quiet or (args.json and not args.verbose)
        self.terminal = redraws(sys.stderr)
        self.phase = ""

    def __call__(self, event: Event) -> None:
        if self.silent:
            return
        if isinstance(event, Phase):
            self.phase = event.name
            if not self.terminal:
                return
        text = f"{self.phase}: {_words(event)}" if not isinstance(event, Phase) else f"{self.phase} ..."
        if self.terminal:
            print(f"\r\x1b[K{plain(text)[: width()]}", end="", file=drawing(sys.stderr), flush=True)
        else:
            print(text, file=sys.stderr)

    def close(self) -> None:
        if self.terminal and not self.silent:
            print("\r\x1b[K", end="", file=drawing(sys.stderr), flush=True)


def _words(event: Iteration | Round | Removal | Phase) -> str:
    if isinstance(event, Iteration):
        fate = "" if event.accepted else ", step refused"
        damping = f", damping {event.damping:.0e}" if event.damping else ""
        return f"iteration {event.number}, vTPv {event.cost_before:.6g} -> {event.cost:.6g}{damping}{fate}"
    if isinstance(event, Round):
        back = f", {event.returned} returned" if event.returned else ""
        return f"round {event.number}, largest w {event.largest_w:.2f}, {event.left_out} left out{back}"
    if isinstance(event, Removal):
        return f"{event.name} removed, {event.reason}"
    return event.name
