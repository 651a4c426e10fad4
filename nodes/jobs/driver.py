"""Drives the jobs of many flights: what can begin is given out, what was lost is given out again, the rest is told."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from .plan import Job, Plan
from .pools import Pool
from .records import is_finished
from .steps import STEPS
from .work import Outcome

_PLACE = {name: -k for k, name in enumerate(STEPS)}


@dataclass
class Progress:
    """How far the jobs are.

    Attributes
    ----------
    total : jobs that were not finished when the run began
    earlier : jobs that were
    outcomes : of those that have ended, by flight and step
    blocked : jobs that cannot begin, because one before them failed
    running : given out and not ended
    """

    total: int
    earlier: int
    outcomes: dict[tuple[str, str], Outcome] = field(default_factory=dict)
    blocked: set[tuple[str, str]] = field(default_factory=set)
    running: int = 0

    @property
    def ended(self) -> int:
        return len(self.outcomes) + len(self.blocked)

    @property
    def failed(self) -> list[Outcome]:
        return [outcome for outcome in self.outcomes.values() if not outcome.good]


def progress_of(plans: Sequence[Plan]) -> Progress:
    """How far the jobs are before any is given out."""
    jobs, finished = sum(len(plan.jobs) for plan in plans), sum(len(plan.finished) for plan in plans)
    return Progress(jobs - finished, finished)


def add_recorded(plans: Sequence[Plan], progress: Progress) -> None:
    """Count the jobs that were finished, and not looked at before `drive` was left, by their records."""
    for plan in plans:
        for step, job in plan.jobs.items():
            known = step in plan.finished or job.key in progress.outcomes
            if not known and is_finished(Path(job.folder), step, job.made_of):
                progress.outcomes[job.key] = Outcome(*job.key, good=True)


def drive(
    plans: Sequence[Plan], pool: Pool, retries: int, progress: Progress, told: Callable[[Outcome | None], None]
) -> None:
    """Do all jobs that are not finished; returns when each has ended or cannot begin.

    Parameters
    ----------
    pool : who does them; stays open
    retries : how often a job is given out again that was killed, or whose store was away
    progress : is kept up to date
    told : called with every job that has ended for good, and with None a few times a second
    """
    done = {(plan.source.name, step) for plan in plans for step in plan.finished}
    waiting = {job.key: job for plan in plans for step, job in plan.jobs.items() if step not in plan.finished}
    after = {(plan.source.name, step): first for plan in plans for step, first in plan.after.items()}
    following: dict[tuple[str, str], list[Job]] = {}
    attempts: Counter[tuple[str, str]] = Counter()
    given: dict[tuple[str, str], Job] = {}

    def give(job: Job) -> None:
        attempts[job.key] += 1
        given[job.key] = job
        progress.running = len(given)
        pool.submit(job, attempts[job.key], _PLACE[job.step])

    for key, job in waiting.items():
        first = [(job.flight, step) for step in after[key] if (job.flight, step) not in done]
        if first:
            following.setdefault(first[0], []).append(job)
        else:
            give(job)
    while given:
        outcomes = pool.ended(0.2)
        for outcome in outcomes:
            key = outcome.flight, outcome.step
            job = given.pop(key)
            if not outcome.good and outcome.again and attempts[key] <= retries:
                give(job)
                continue
            progress.outcomes[key] = outcome = replace(outcome, attempts=attempts[key])
            for next_job in following.pop(key, ()):
                if outcome.good:
                    give(next_job)
                else:
                    progress.blocked.add(next_job.key)
            progress.running = len(given)
            told(outcome)
        told(None)
