"""Settings of the trajectory models of an adjustment in one or two steps: of the project and of the options."""

from __future__ import annotations

from collections.abc import Mapping

from ..errors import UserError

#: Option -> the trajectory model that takes it.
OWNERS = {"segments": "ppm", "order": "ppm", "fixes": "lim"}

#: What is said of ``[trajectory.then]`` where one step is asked for.
UNUSED = "project.toml: [trajectory.then] is for a second model (--then MODEL) and was not used"


def sigmas_stated(then: Mapping[str, object]) -> bool:
    """Whether a project's ``[trajectory.then]`` states a-priori sigmas of a second model alone."""
    return any("_sigma" in key for key in then)


def step_settings(
    stated: Mapping[str, object],
    then_stated: Mapping[str, object],
    model: str,
    then: str | None,
    given: Mapping[str, int | None],
) -> tuple[dict[str, object], dict[str, object]]:
    """Settings of the first and of the second model.

    The second step has those of the project's ``[trajectory]``, and where ``[trajectory.then]`` states its own these.
    An option is for the first step, or for the second where only that has a model which takes it; where both take it
    the second step has it too, unless ``[trajectory.then]`` states its own.

    Parameters
    ----------
    stated, then_stated : tables of the project
    model, then : names of the models; ``then`` is None for one step
    given : options by name, a key of `OWNERS`; None where it was not given

    Raises
    ------
    UserError : an option for a model that is not asked for
    """
    first, common, alone = {}, {}, {}
    for option, value in given.items():
        if value is None:
            continue
        owner = OWNERS[option]
        if owner not in (model, then):
            raise UserError(f"--{option} is for the model {owner}; asked for is {model}")
        (alone if owner != model else first)[option] = value
        if owner == model == then:
            common[option] = value
    return {**stated, **first}, {**stated, **common, **then_stated, **alone}
