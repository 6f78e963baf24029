"""What tests of the models share: machines that no solver here can represent, solved once in a run for all workers."""

from __future__ import annotations

from functools import cache

import pytest

from abbe.models.solvers.joint import JointSolution, solve_joint
from tests.built_once import once_per_run
from tests.models.solvers.truth import MACHINE, SolvedTruth, Truth


@pytest.fixture(scope="session")
def solved_truth(tmp_path_factory: pytest.TempPathFactory) -> SolvedTruth:
    """By seed: the machine, and the solution of its campaign with nothing stated."""

    def made(seed: int) -> tuple[Truth, JointSolution]:
        truth = Truth(seed)
        return truth, solve_joint(MACHINE, truth.campaign())

    @cache
    def of(seed: int) -> tuple[Truth, JointSolution]:
        return once_per_run(tmp_path_factory, f"solved-truth-{seed}", lambda _: made(seed))[1]

    return of
