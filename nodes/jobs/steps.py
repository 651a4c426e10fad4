"""The steps of a flight: which commands run over a recording, in which order, and where their results go."""

from __future__ import annotations

from dataclasses import dataclass

#: What `process` makes; the steps that come after it read it in place of the recording.
PROCESSED = "processed.mcap"


@dataclass(frozen=True)
class Step:
    """A command over one recording.

    Attributes
    ----------
    name : of the command
    output : file or folder that it writes, in the folder of the flight
    after : the step whose result it reads where that is asked for, too; "" reads the recording
    options : that it always gets: words behind input and output
    """

    name: str
    output: str
    after: str = ""
    options: tuple[str, ...] = ()

    def words(self, source: str, options: tuple[str, ...] = ()) -> list[str]:
        """The words behind ``triline``, for an input and options of the user."""
        return [self.name, source, "-o", self.output, "--json", *self.options, *options]


#: By name, in the order in which they are done. A job is one process: as many run side by side as there are workers.
STEPS = {
    step.name: step
    for step in (
        Step("process", PROCESSED, options=("--processes", "1")),
        Step("navigate", "navigation"),
        Step("adjust", "adjustment", after="process"),
        Step("rectify", "ortho.tif", after="process"),
        Step("analyze", "report.html", after="process"),
    )
}
#: What is done where nothing else is asked for.
USUAL = ("process", "analyze")
