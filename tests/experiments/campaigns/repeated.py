"""Does a second and a third correction do good, or harm? Simulated machines are corrected again and again over their wires.

``python -m tests.experiments.campaigns.repeated --machines 10 --rounds 3 [--first 1] [--speed 30] [--jobs 1] [--json FILE]``

Every round measures the full identification and a verification with the table that is in force, and orders a correction. Judged is the
sealed truth of the simulator: rms of the error over the volume, rigid motion removed, beside what the best nine tables leave. A line for
each round tells what a person was told: kept, rolled back, or refused, with the reason. It ends with 1 if a machine became worse.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import multiprocessing
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from abbe.drivers.errors import DriverError
from abbe.service.campaigns.measure import measure
from abbe.service.compensation.correct import correct
from abbe.service.compensation.gate import PushContext
from abbe.service.compensation.proposals import load_runs
from abbe.service.demo.demo import demo_site
from abbe.service.demo.simulator_process import running_simulators, sealed_truth
from abbe.service.devices.session import Session, open_session
from abbe.service.domain.progress import ignore_progress
from abbe.service.errors import TableRefused, TakenBack
from abbe.service.sequences.recipes.campaigns import identification, verification
from abbe.service.sequences.steps import CampaignPlan
from abbe.service.site import Site
from abbe.service.storage.store import Store
from tests.pretended import as_if_commissioned

RATE_HZ = 10
TRIES = 6
"""How often a measurement that this computer was too slow for is begun."""
WORSE = 1.02
"""A machine is worse if its true error grew by more than this factor: the last digit of a table is worth less."""


@dataclass(frozen=True)
class Round:
    """One correction, µm: true rms before and after, what the best nine tables leave; largest measured body diagonal before and after.

    ``end``: kept, rolled back or refused; ``why``: what the person was told.
    """

    seed: int
    number: int
    before_um: float
    after_um: float
    best_um: float
    diagonal_um: tuple[float, float] | None
    end: str
    why: str

    @property
    def worse(self) -> bool:
        """Whether the true error grew."""
        return self.after_um > WORSE * self.before_um

    @property
    def line(self) -> str:
        """As a row under `HEAD`."""
        told = "" if self.diagonal_um is None else "{:.1f} → {:.1f}".format(*self.diagonal_um)
        figures = f"{self.before_um:7.2f} {self.after_um:7.2f} {self.best_um:7.2f} {self.after_um / self.best_um:6.2f}"
        return f"{self.seed:4d} {self.number:5d} {figures}  {told:14s} {self.end}: {self.why}"


HEAD = "seed round  before   after    best  ratio  diagonal       what the person was told (true rms over the volume, µm)"


async def corrected(session: Session, store: Store, site: Site, number: int) -> tuple[str, str, tuple[float, float] | None]:
    """Measure with the table in force and order a correction: how it ended, why, and the largest body diagonal before and after, µm."""

    def identify(name: str) -> CampaignPlan:
        return identification(site.machine, rate_hz=RATE_HZ, name=name)

    def verify(name: str) -> CampaignPlan:
        return verification(site.machine, rate_hz=RATE_HZ, name=name)

    campaign = f"identify-{number}"
    name, _ = await measured(session, store, site, identify, campaign)
    _, ids = await measured(session, store, site, verify, f"before-{number}")
    before = await load_runs(store, ids)
    for left in reversed(range(TRIES)):
        try:
            found = await correct(PushContext(session, store, site, rate_hz=RATE_HZ), name, before)
        except TableRefused as no:
            return "refused", f"{no.detail} ({no.remedy})", None
        except TakenBack as no:
            return "rolled back", no.detail, None
        except DriverError:
            if not left:
                raise
        else:
            diagonals = found.before.worst.value_mm * 1e3, found.after.worst.value_mm * 1e3
            return "kept" if found.decision.keep else "rolled back", found.decision.text, diagonals
    raise AssertionError


async def measured(session: Session, store: Store, site: Site, plan: Callable[[str], CampaignPlan], name: str) -> tuple[str, list[int]]:
    """Measure a campaign, anew under another name where this computer was too slow for its simulated instruments."""
    for number in range(1, TRIES):
        try:
            return name, await measure(session, store, site, plan(name), progress=ignore_progress)
        except DriverError:
            name = f"{name.partition(' ')[0]} {number}"
    return name, await measure(session, store, site, plan(name), progress=ignore_progress)


async def rounds_of(seed: int, rounds: int, speed: float, folder: Path) -> list[Round]:
    """Correct one machine again and again."""
    machine = ["--seed", str(seed)]
    out: list[Round] = []
    truth = await sealed_truth(machine, None)
    async with running_simulators([*machine, "--speed", f"{speed:g}", "--link-dir", str(folder)]) as simulator:
        site = demo_site(simulator)
        with Store.open(f"sqlite:///{folder / 'abbe.sqlite3'}") as store:
            async with open_session(site.urls) as session:
                await as_if_commissioned(session.controller, store, site)
                for number in range(1, rounds + 1):
                    end, why, diagonals = await corrected(session, store, site, number)
                    bank = folder / "bank.bin"
                    status = await session.controller.comp_status()
                    bank.write_bytes(await session.controller.read_bank(status.active_bank))
                    after = await sealed_truth(machine, bank)
                    values = (t.volumetric_rms_um for t in (truth, after))
                    out.append(Round(seed, number, *values, truth.best_nine_tables_rms_um, diagonals, end, why))
                    truth = after
    return out


def one(seed: int, rounds: int, speed: float) -> list[Round]:
    """The same in a folder of its own, for another process."""
    with tempfile.TemporaryDirectory() as name:
        return asyncio.run(rounds_of(seed, rounds, speed, Path(name)))


def summary(found: Sequence[Round]) -> list[str]:
    """What all machines say together."""
    lines = []
    for number in sorted({r.number for r in found}):
        of = [r for r in found if r.number == number]
        ends = ", ".join(f"{sum(r.end == end for r in of)} {end}" for end in ("kept", "rolled back", "refused"))
        ratios = sorted(r.after_um / r.best_um for r in of)
        lines.append(
            f"after round {number}: {ends}; true rms over that of the best nine tables: median {ratios[len(ratios) // 2]:.2f}, "
            f"largest {ratios[-1]:.2f}"
        )
    return [*lines, f"made worse: {sum(r.worse for r in found)} of {len(found)}"]


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--machines", type=int, default=10)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--speed", type=float, default=30.0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    found: list[Round] = []
    print(HEAD, flush=True)  # noqa: T201
    with multiprocessing.get_context("spawn").Pool(arguments.jobs) as pool:
        work = partial(one, rounds=arguments.rounds, speed=arguments.speed)
        for each in pool.imap(work, range(arguments.first, arguments.first + arguments.machines)):
            found += each
            print("\n".join(r.line for r in each), flush=True)  # noqa: T201
    print("\n".join(summary(found)))  # noqa: T201
    if arguments.json is not None:
        arguments.json.write_text(json.dumps([asdict(r) for r in found], indent=1, ensure_ascii=False))
    return int(any(r.worse for r in found))


if __name__ == "__main__":
    sys.exit(main())
