"""Stepwise elimination of additional parameters, criterion by criterion."""

from dataclasses import replace

import numpy as np
import pytest

from triline.solver.adjustment.determinability import Criterion, Evidence, Limits, examine, group_of


def evidence(**changes):
    base = Evidence(
        names=("k1", "k2", "th_F"),
        values=np.array([10.0, 10.0, 10.0]),
        cofactors=np.eye(3),
        pivot=np.ones(3),
        partner=("X offset of strip S1",) * 3,
        correlation=np.array([0.1, 0.2, 0.3]),
        point_sigma_m=np.zeros((3, 3)),
        sigma0=1.0,
        redundancy=1000,
        gsd_m=0.1,
        rank=np.array([0, 1, 0]),
    )
    return replace(base, **changes)


def test_nothing_to_remove():
    assert examine(evidence()).removal is None


def test_no_parameters_at_all():
    e = evidence(names=(), values=np.empty(0), cofactors=np.empty((0, 0)), pivot=np.empty(0), rank=np.empty(0, int))
    assert examine(e).removal is None


def test_pivot_comes_before_everything():
    e = evidence(pivot=np.array([1.0, 1e-12, 1e-10]), values=np.array([0.0, 10.0, 10.0]))
    removal = examine(e).removal
    assert removal is not None
    assert removal.name == "k2" and removal.criterion is Criterion.PIVOT and removal.figure == 1e-12


def test_correlation_removes_the_worst_insignificant_parameter():
    e = evidence(correlation=np.array([0.95, -0.97, 0.3]), values=np.array([0.1, 0.1, 10.0]))
    removal = examine(e).removal
    assert removal is not None and removal.name == "k2" and removal.criterion is Criterion.CORRELATION
    assert "-0.970" in removal.reason and "X offset of strip S1" in removal.reason


def test_correlated_but_significant_parameter_stays_and_says_so():
    e = evidence(correlation=np.array([0.95, 0.1, 0.1]))
    verdict = examine(e)
    assert verdict.removal is None
    assert "kept" in verdict.kept["k1"] and "t = 10.0" in verdict.kept["k1"]
    strict = examine(e, Limits(keep_significant=False)).removal
    assert strict is not None and strict.name == "k1"


def test_correlation_near_one_removes_even_a_significant_parameter():
    removal = examine(evidence(correlation=np.array([0.99995, 0.1, 0.1]))).removal
    assert removal is not None and removal.name == "k1"


def test_of_two_correlated_parameters_the_less_significant_goes():
    Q = np.eye(3)
    Q[0, 1] = Q[1, 0] = 0.96
    removal = examine(evidence(cofactors=Q, values=np.array([1.5, 1.0, 10.0]))).removal
    assert removal is not None and removal.name == "k2" and "k1" in removal.reason


def test_reference_line_and_higher_power_go_first_within_a_group():
    Q = np.eye(3)
    Q[0, 1] = Q[1, 0] = 0.96
    for rank, gone in (([0, 1, 0], "k2"), ([1, 0, 0], "k1")):
        removal = examine(evidence(cofactors=Q, values=np.array([1.5, 1.6, 10.0]), rank=np.array(rank))).removal
        assert removal is not None and removal.name == gone


def test_trace_check_against_the_gsd():
    effect = np.zeros((3, 3))
    effect[0, 2], effect[2, 1] = 0.03, 0.05
    removal = examine(evidence(point_sigma_m=effect, values=np.array([0.5, 10.0, 0.5]))).removal
    assert removal is not None
    assert removal.name == "th_F" and removal.criterion is Criterion.TRACE
    assert removal.figure == pytest.approx(0.5) and "sigma of Y" in removal.reason


def test_student_removes_the_smallest_t():
    removal = examine(evidence(values=np.array([10.0, 10.0, -1.0]))).removal
    assert removal is not None and removal.name == "th_F" and removal.criterion is Criterion.STUDENT
    assert removal.figure == pytest.approx(1.0) and removal.limit == pytest.approx(1.962, abs=1e-3)


def test_fisher_is_the_reason_where_the_whole_group_fails():
    removal = examine(evidence(values=np.array([0.5, 0.1, 10.0]))).removal
    assert removal is not None and removal.name == "k2" and removal.criterion is Criterion.FISHER


def test_group_significant_together_loses_only_its_weakest():
    # strongly correlated pair: no single t is significant, their sum is
    Q = np.array([[1.0, -0.89, 0.0], [-0.89, 1.0, 0.0], [0.0, 0.0, 1.0]])
    removal = examine(evidence(values=np.array([1.5, 1.4, 10.0]), cofactors=Q)).removal
    assert removal is not None and removal.name == "k2" and removal.criterion is Criterion.STUDENT
    assert "significant" in removal.reason


def test_groups_are_those_of_the_dissertation():
    assert [group_of(n) for n in ("k1", "k3", "p2", "xp_B", "th_N", "dc")] == ["k", "k", "p", "xp", "th", "dc"]
