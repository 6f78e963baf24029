"""Each function against scipy.stats, far into the tails, and with infinite and fractional degrees of freedom."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from abbe.models import probability as ours

P = np.array([1e-250, 1e-12, 1e-4, 0.025, 0.3, 0.5, 0.9, 0.975, 1 - 1e-9])
Z = np.array([-30.0, -6.0, -1.0, -1e-9, 0.0, 0.5, 3.0, 9.0, 35.0])
DOF = [1.0, 2.0, 2.5, 3.0, 11.0, 137.6, 4000.0]
X = np.array([1e-9, 0.1, 1.0, 3.0, 40.0, 900.0])


def test_normal() -> None:
    assert_allclose(ours.normal_below(Z), stats.norm.cdf(Z), rtol=1e-12)
    assert_allclose(ours.normal_above(Z), stats.norm.sf(Z), rtol=1e-12)
    assert_allclose(ours.normal_limit(P), stats.norm.isf(P), rtol=1e-12)
    assert ours.normal_limit(0.0) == np.inf


@pytest.mark.parametrize("dof", [*DOF, np.inf])
def test_student(dof: float) -> None:
    assert_allclose(ours.t_quantile(P[1:], dof), stats.t.ppf(P[1:], dof), rtol=1e-8)
    assert_allclose(ours.t_above(Z, dof), stats.t.sf(Z, dof), rtol=1e-9)


@pytest.mark.parametrize("dof", DOF)
def test_chi_square(dof: float) -> None:
    assert_allclose(ours.chi2_quantile(P[1:], dof), stats.chi2.ppf(P[1:], dof), rtol=1e-9)
    assert_allclose(ours.chi2_above(X, dof), stats.chi2.sf(X, dof), rtol=1e-10)
    assert ours.chi2_above(-1.0, dof) == stats.chi2.sf(-1.0, dof) == 1.0


@pytest.mark.parametrize("below", DOF)
@pytest.mark.parametrize("dof", [1.0, 2.0, 7.3, 200.0])
def test_f(dof: float, below: float) -> None:
    assert_allclose(ours.f_above(X, dof, below), stats.f.sf(X, dof, below), rtol=1e-9)
    p = P[2:]
    assert_allclose(ours.f_limit(p, dof, below), stats.f.isf(p, dof, below), rtol=1e-8)
    assert ours.f_above(-1.0, dof, below) == 1.0


def test_no_command_and_no_service_imports_scipy_stats() -> None:
    """Half of a start's processor time went there."""
    code = (
        "import sys, abbe.service.serve, abbe.service.compensation.correct, abbe.service.discovery.discover\n"
        "sys.exit('scipy.stats' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False, cwd=Path(__file__).parents[2]).returncode == 0
