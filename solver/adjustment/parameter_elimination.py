"""Stepwise elimination of additional parameters: solve, examine, remove the worst, solve again [K 4.2.2.4]."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Array, IntArray
from .adjustment import AdjustmentOptions, Problem, Solution, State, pose_problem, solve
from .covariance import point_cofactors, point_unknown_cofactors
from .determinability import Evidence, Limits, Removal, examine, point_sigmas, ranks, strongest_correlations
from .network import Network
from .network_weakness import PART, describe
from .problem import NOTHING_ASSUMED, Assumed, assumed_of_model, with_left_out
from .variance_components import scaled

#: Least pivot of a parameter that is taken out of the cofactors, which lose as many digits. Tuned: it is a matter of
#: rounding.
LEAST_PIVOT = 1e-6

#: Sigmas from zero up to which a parameter is taken out of the cofactors. Tuned: how far the observation equations of
#: the others move with it hangs on it, and with that digits of the evidence; not the adjustment, which is made anew.
FAR = 10.0


@dataclass(frozen=True)
class Elimination:
    """Outcome: the adjustment with the determinable parameters, what was removed in which order, what stays in spite of
    a failed criterion (name -> why)."""

    solution: Solution
    removed: tuple[Removal, ...]
    kept: dict[str, str]


def ground_sample_distance(network: Network) -> float:
    """Median pixel size on the ground, metres, over all rays."""
    rays = network.rays
    height = np.abs(rays.position_l[:, 2] - network.approximate_l[rays.point, 2])
    pitch = np.linalg.norm(rays.pitch_mm, axis=1)
    return float(np.median(pitch / rays.focal_length_mm * height))


@dataclass(frozen=True)
class Reduced:
    """A linearised solution whose additional parameters are held at zero one after another.

    With the cofactors ``q`` between a parameter and all unknowns, and its own one ``q_ii``, holding it at zero leaves
    ``x - q x_i / q_ii`` of the unknowns and ``Q - q q^T / q_ii`` of their cofactors, and adds ``x_i^2 / q_ii`` to the
    cost.

    Attributes
    ----------
    solution : with all parameters
    places : (m,) those that are left, among the parameters of the solution
    cofactors : (n_unknowns, m) between all reduced unknowns and these parameters
    to_points : (3 p, m) between coordinates of object points and these parameters
    orientation, of_points : (n_model,) and (3 p,) variances of the orientation and of the coordinates of object points
    theta, points_l : (n_unknowns,) and (3 p,) values
    cost, redundancy : with a-priori values that nobody stated, too
    information : (n_camera,) of the parameters before anything is eliminated
    gsd_m : ground sample distance
    of_model : what is assumed of the trajectory
    """

    solution: Solution
    places: IntArray
    cofactors: Array
    to_points: Array
    orientation: Array
    of_points: Array
    theta: Array
    points_l: Array
    cost: float
    redundancy: int
    information: Array
    gsd_m: float
    of_model: Assumed = NOTHING_ASSUMED

    @classmethod
    def of(cls, solution: Solution) -> Reduced:
        layout = solution.layout
        m, first = layout.n_camera, layout.n_model
        columns = np.arange(first, first + m)
        unit = np.zeros((layout.n_unknowns, m))
        unit[columns, np.arange(m)] = 1.0
        return cls(
            solution,
            np.arange(m),
            solution.factor.solve(unit),
            point_unknown_cofactors(solution, columns).reshape(-1, m),
            solution.factor.variances()[:first],
            np.einsum("pii->pi", point_cofactors(solution)).ravel(),
            solution.state.theta,
            solution.state.points_l.ravel(),
            solution.cost,
            solution.n_observations - solution.n_unknowns,
            own_information(solution)[columns],
            ground_sample_distance(solution.network),
            assumed_of_model(layout, solution.problem.prior, solution.state.theta, solution.factor)
            if solution.problem.wide
            else NOTHING_ASSUMED,
        )

    @property
    def names(self) -> tuple[str, ...]:
        first = self.solution.layout.n_model
        return tuple(self.solution.layout.names[first + k] for k in self.places.tolist())

    @property
    def state(self) -> State:
        """Values without the parameters that are held at zero."""
        layout = self.solution.layout
        gone = layout.n_model + np.setdiff1d(np.arange(layout.n_camera), self.places)
        return State(np.delete(self.theta, gone), self.points_l.reshape(-1, 3))

    @property
    def evidence(self) -> Evidence:
        """What is known of the parameters that are left."""
        layout, columns = self.solution.layout, self.solution.layout.n_model + self.places
        inner = self.cofactors[columns]
        q = np.maximum(np.diagonal(inner), 0.0)
        cross = np.concatenate([self.cofactors[: layout.n_model], self.to_points])
        strongest, r = strongest_correlations(cross, np.concatenate([self.orientation, self.of_points]), q)
        names, assumed = self.names, self._assumed(q)
        redundancy = max(self.redundancy - assumed.number, 0)
        squares = max(self.cost - assumed.squares, 0.0)
        return Evidence(
            names,
            self.theta[columns],
            inner,
            self._pivots(q),
            _partners(self.solution, self.places, strongest),
            r,
            point_sigmas(self.to_points.reshape(len(self.to_points) // 3, 3, len(q)), q),
            float(np.sqrt(squares / redundancy)) if redundancy > 0 else 1.0,
            redundancy,
            self.gsd_m,
            ranks(names, self.solution.network.camera),
        )

    def without(self, name: str) -> Reduced | None:
        """One parameter less; None where the network has to be adjusted anew for that.

        So it is where nothing but the pivot tells a parameter from the other unknowns, and where it is so far from zero
        that observation equations become others without it.
        """
        i, problem = self.names.index(name), self.solution.problem
        column = problem.layout.n_model + int(self.places[i])
        q, value = self.cofactors[column, i], self.theta[column]
        prior = problem.prior.matrix.tocsc()[:, [column]]
        apart = self.solution.factor.undetermined.vectors.shape[1] == 0 and q * self.information[self.places[i]] > 0
        if not apart or 1.0 / (q * self.information[self.places[i]]) < LEAST_PIVOT:
            return None
        if value**2 / q > FAR**2 or problem.prior.value[prior.indices].any():
            return None
        keep = np.arange(len(self.places)) != i
        column_q, point_q = self.cofactors[:, i], self.to_points[:, i]
        share = self.cofactors[column, keep] / q
        return replace(
            self,
            places=self.places[keep],
            cofactors=self.cofactors[:, keep] - column_q[:, None] * share,
            to_points=self.to_points[:, keep] - point_q[:, None] * share,
            orientation=self.orientation - column_q[: len(self.orientation)] ** 2 / q,
            of_points=self.of_points - point_q**2 / q,
            theta=self.theta - column_q * (value / q),
            points_l=self.points_l - point_q * (value / q),
            cost=self.cost + float(value**2 / q),
            redundancy=self.redundancy + 1 - prior.nnz,
        )

    def _assumed(self, q: Array) -> Assumed:
        """What nobody stated of the parameters that are left, with their variances q (m,)."""
        columns = self.solution.layout.n_model + self.places
        mine = np.isin(columns, self.solution.layout.assumed)
        return self.of_model + Assumed.of(self.solution.problem.prior, columns[mine], self.theta, q[mine])

    def _pivots(self, q: Array) -> Array:
        """``1 / (n_ii q_ii)``: what is left of a parameter's own information when all others are free; 0 where
        singular."""
        own = self.information[self.places]
        pivot = np.divide(1.0, own * q, out=np.ones_like(q), where=(own > 0) & (q > 0))
        pivot[own == 0] = 0.0
        null = np.abs(self.solution.factor.undetermined.vectors[self.solution.layout.n_model + self.places])
        pivot[(null > 0.3).any(axis=1)] = 0.0
        return np.minimum(pivot, 1.0)


def eliminate(
    solution: Solution,
    limits: Limits = Limits(),  # noqa: B008  (frozen)
    options: AdjustmentOptions = AdjustmentOptions(),  # noqa: B008  (frozen)
    adapt: Callable[[Problem], Problem] = lambda problem: problem,
    progress: Callable[[Removal], None] | None = None,
    image_factor: float = 1.0,
) -> Elimination:
    """Remove parameters that are not determinable, one at a time, the worst first.

    What is left is computed from the cofactors of the solution as far as that goes, and adjusted and examined again
    when nothing more is to be removed.

    Parameters
    ----------
    solution : with the full set
    limits, options : critical values; how to iterate
    adapt : what was done to the a-priori weights of the problem, for the problems posed anew
    progress : called with every removal
    image_factor : what the sigmas of the image points were multiplied by, which weights that are taken anew need
    """
    removed: list[Removal] = []
    kept: dict[str, str] = {}
    while solution.layout.n_camera:
        left, gone = Reduced.of(solution), list[str]()
        known: Reduced | None = left
        while known is not None:
            left = known
            verdict = examine(known.evidence, limits)
            kept = verdict.kept
            if verdict.removal is None:
                break
            removed.append(verdict.removal)
            if progress:
                progress(verdict.removal)
            gone.append(verdict.removal.name)
            known = known.without(verdict.removal.name)
        if not gone:
            break
        solution = without(left, gone, options, adapt, image_factor)
    return Elimination(solution, tuple(removed), kept)


def without(
    left: Reduced,
    gone: Sequence[str],
    options: AdjustmentOptions,
    adapt: Callable[[Problem], Problem],
    image_factor: float,
) -> Solution:
    """The adjustment without some additional parameters, from the values of what is left."""
    old = left.solution.problem
    assert old.self_calibration is not None
    smaller = old.self_calibration.without(gone)
    network = with_left_out(old.network, old.layout, -1.0)  # it is put in again with the unknowns
    problem = adapt(pose_problem(network, old.model, smaller if smaller.n_unknowns else None, old.layout.platform))
    problem = replace(problem, control=old.control, earlier=old.earlier, wide=old.wide)
    start = left.state
    if last := [k for k, name in enumerate(left.names) if name in gone]:  # it could not be taken out of the cofactors
        start = State(np.delete(start.theta, old.layout.n_model + np.array(last)), start.points_l)
    weight = left.solution.ray_weight
    found = solve(problem, start, weight, options)
    # places and weights of the rays are those of the start; once more where they are now
    found = solve(found.problem, found.state, weight, options)
    return found if image_factor == 1.0 else scaled(found, {"image": image_factor}, options)


def own_information(solution: Solution) -> Array:
    """(n_unknowns,) diagonal of the normal matrix of the rays before anything is eliminated."""
    layout, lin, weight = solution.layout, solution.linearisation, solution.ray_weight
    n = np.zeros(layout.n_unknowns + 1)
    squares = np.einsum("ckn,ckn->kn", lin.orientation, lin.orientation) * weight
    for t, columns in enumerate(layout.columns):
        values = squares[layout.component[t]] * layout.coefficients[layout.node[t]] ** 2
        n += np.bincount(columns + 1, values, layout.n_unknowns + 1)  # place 0 takes the absent ones
    own = n[1:]
    if layout.camera is not None:
        of_ray = layout.camera.columns[layout.camera.pattern]
        squares = np.einsum("csn,csn->sn", lin.camera, lin.camera) * weight
        for s in range(of_ray.shape[1]):
            of_camera = own[layout.n_model : layout.n_model + layout.n_camera]
            of_camera += np.bincount(of_ray[:, s] + 1, squares[s], layout.n_camera + 1)[1:]
    if layout.n_surface and solution.problem.control.surface is not None:
        own[layout.shift_column] = solution.problem.control.surface.weight.sum()
    return own


def _partners(solution: Solution, places: IntArray, strongest: IntArray) -> tuple[str, ...]:
    """Names of the unknowns (m,) that the parameters at places (m,) are most correlated with: of the orientation, then
    coordinates."""
    first, m = solution.layout.n_model, len(strongest)
    names, points = solution.layout.names, solution.network.point_ids
    partner = [
        describe((names[k],), 0) if k < first else f"{'XYZ'[(k - first) % 3]} of point {points[(k - first) // 3]}"
        for k in strongest.tolist()
    ]
    null = solution.factor.undetermined.vectors
    for i in range(m):  # where the system is singular, what the parameter cannot be told from
        own = np.abs(null[first + places[i]])
        if own.max(initial=0.0) > 0.3:
            part = np.abs(null[:, int(np.argmax(own))])
            part[first + places[i]] = 0.0
            members = [k for k in np.argsort(-part, kind="stable")[:3] if part[k] > PART]
            partner[i] = describe(tuple(names[k] for k in members), 0) if members else "nothing"
    return tuple(partner)
