"""The capture's promises at full size: ``python -m tests.experiments.campaigns.capture load|kills --help``. Exit code 1 when one does not
hold."""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path

from tests.experiments.campaigns.capture_kills import run_kills
from tests.experiments.campaigns.capture_load import Load, run_load

NONE_OF = ("unaccounted", "in_no_ledger", "stored_though_not_sent", "twice")


def main() -> int:
    """Run what the command line names, print the figures."""
    parser = argparse.ArgumentParser(prog="python -m tests.experiments.campaigns.capture", description=__doc__)
    parts = parser.add_subparsers(dest="part", required=True)
    load = parts.add_parser("load", help="a stream under load, against the box's own ledger")
    load.add_argument("--speed", type=float, default=20.0, help="device seconds per second; 20 is 20 kHz (default)")
    load.add_argument("--device-s", type=float, default=600.0, help="length of the stream in device seconds (default 600: 600,000 samples)")
    load.add_argument("--lock-s", type=float, default=30.0, help="a stranger locks the database so long (default 30)")
    load.add_argument("--busy", type=int, default=2, help="processes that only compute (default 2)")
    load.add_argument("--sync-ms", type=float, default=0.0, help="what a slow disk adds to every sync (default 0)")
    kills = parts.add_parser("kills", help="SIGKILL at random instants of a recording process")
    kills.add_argument("--kills", type=int, default=1000, help="how many (default 1000)")
    kills.add_argument("--seed", type=int, default=1, help="of the instants")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if given.part == "load":
            options = Load(given.speed, given.device_s, given.lock_s, given.busy, sync_s=given.sync_ms * 1e-3)
            found = run_load(Path(folder), options, _progress)
            good = not any(found[name] for name in NONE_OF)
        else:
            found = run_kills(Path(folder), given.kills, given.seed, _progress)
            good = not found["violations"]
    _progress("")
    print(json.dumps({k: round(v, 3) if isinstance(v, float) else v for k, v in found.items()}, indent=1))  # noqa: T201
    return 0 if good else 1


def _progress(words: str) -> None:
    if sys.stderr.isatty() or words:
        print(f"\r{words:<70}", end="" if sys.stderr.isatty() else "\n", file=sys.stderr, flush=True)  # noqa: T201


if __name__ == "__main__":
    sys.exit(main())
