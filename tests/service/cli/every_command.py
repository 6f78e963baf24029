"""What every command promises: a call that is answered, its exit codes, the next command it names, and an input that it refuses.

`test_every_command.py` proves each promise; ``docs/reference/cli.md`` shows them as a table (`table`).
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

DEVICES = """[devices]
cnc = "modbus+tcp://127.0.0.1:9"
laser = "modbus+tcp://127.0.0.1:9"
ballbar = "socket://127.0.0.1:9"
fixture = "fixture+tcp://127.0.0.1:9"
"""
"""Nobody answers there."""
INIT = ("--name", "m", "--chain", "w-X-Y-b-Z-t", "--strokes", "0..600,0..500,0..400", "--tool", "0,0,-1")


@dataclass(frozen=True)
class Case:
    """``words``: a call that is answered, ``#`` in it is 1, then 2; ``then``: what the next command begins with; ``wrong``: a call that is
    refused with ``error``; ``codes``: exit codes of answers. ``proof``: the test that answers where a machine or minutes are needed.
    """

    words: str
    then: str
    wrong: str
    error: str
    codes: tuple[int, ...] = (0,)
    proof: str = ""
    typed: str = ""


SCENARIOS = "tests/scenarios"
CASES: dict[str, Case] = {
    "demo": Case("demo", "demo --hidden 4", "demo --speed 0", "USE-001", (0,), f"{SCENARIOS}/test_demo.py"),
    "init": Case(f"init new#.toml {' '.join(INIT)}", "doctor", "init x.toml", "CFG-001"),
    "doctor": Case("doctor", "doctor", "doctor -m none.toml", "CFG-001", (0, 1)),
    "check-config": Case("check-config", "doctor", "check-config -m none.toml", "CFG-001"),
    "plan": Case("plan --minutes 8", "plan --minutes 8 --out", "plan --out none/x.toml", "CFG-001"),
    "measure": Case("measure --dry-run", "measure --recipe quick-check", "measure --helix nan,1,1,1", "CFG-001"),
    "listen": Case("listen", "solve", "listen --recipe none.toml", "CFG-001", (0,), f"{SCENARIOS}/test_listen.py"),
    "sim": Case("sim", "doctor", "sim --machine-file abbe.toml", "CFG-001", (0,), "tests/service/cli/test_setting_up.py"),
    "device interferometer": Case(
        "device interferometer t.csv",
        "effects",
        "device interferometer none.csv",
        "FMT-001",
        (0,),
        "tests/service/instrument_files/test_interferometer.py",
    ),
    "device list": Case("device list", "doctor", "device list x", "USE-001"),
    "device show": Case("device show dial-gauge", "device test", "device show none", "DRV-012"),
    "device test": Case("device test", "doctor", "device test nonsense", "DRV-001", (0, 1), "tests/service/cli/test_setting_up.py"),
    "runs": Case("runs", "show c1/", "runs --db nonsense", "STO-001"),
    "show": Case("show june", "solve june", "show none", "STO-002"),
    "solve": Case("solve june", "discover june", "solve none", "STO-002"),
    "solve-all": Case("solve-all june --model rigid6", "runs", "solve-all none", "STO-002", (0, 1)),
    "discover": Case("discover c1", "solve c1", "discover none", "STO-002"),
    "simulate": Case("simulate c1", "discover c1", "simulate none", "STO-002"),
    "model list": Case("model list", "model show --of VMC-1", "model list --db nonsense", "STO-001"),
    "model show": Case("model show --of VMC-1", "model diff 1 2 --of VMC-1", "model show --of none", "DIS-001"),
    "model diff": Case("model diff 1 --of VMC-1", "model show --of VMC-1", "model diff 9 --of VMC-1", "DIS-001"),
    "model revert": Case("model revert # --of VMC-1", "model show --of VMC-1", "model revert 9 --of VMC-1", "DIS-001"),
    "effects": Case("effects backlash", "runs", "effects nonsense", "DIS-002"),
    "errors": Case("errors --errors errors.json --points p.csv", "errors --errors", "errors --errors none --points p.csv", "FMT-001"),
    "report": Case("report june --out june.html", "solve june", "report none", "STO-002"),
    "correct": Case("correct", "report push", "correct june", "CMP-001", (0, 1), f"{SCENARIOS}/test_correct_command.py"),
    "comp formats": Case("comp formats", "runs", "comp formats x", "USE-001"),
    "comp export": Case(
        "comp export SOLUTION --format linuxcnc --out tables# --without-table",
        "comp import tables#",
        "comp export 99 --format linuxcnc --out x",
        "STO-002",
    ),
    "comp import": Case("comp import tables# --format linuxcnc", "measure --recipe", "comp import none --format linuxcnc", "FMT-001"),
    "comp step": Case("comp step --format mach4 --out step#", "comp export", "comp step --format none --out x", "TAB-001"),
    "comp drop": Case("comp drop", "measure --recipe", "comp drop none", "TAB-001", (0,), "tests/service/compensation/test_file_drop.py"),
    "comp commission": Case("comp commission", "runs", "comp commission", "SEQ-011", (0, 1), f"{SCENARIOS}/test_correct_command.py"),
    "comp propose": Case("comp propose", "comp diff", "comp propose none", "STO-002", (0, 1), f"{SCENARIOS}/test_proposals.py"),
    "comp show": Case("comp show", "comp show PROPOSAL", "comp show 99", "STO-002"),
    "comp diff": Case("comp diff PROPOSAL", "comp approve PROPOSAL", "comp diff 99", "STO-002"),
    "comp approve": Case("comp approve PROPOSAL", "comp", "comp approve 99", "STO-002", (0, 1)),
    "comp reject": Case("comp reject PROPOSAL --reason x", "comp", "comp reject 99 --reason x", "STO-002", (0, 1)),
    "comp push": Case("comp push", "report push", "comp push 99", "SEQ-011", (0, 1), f"{SCENARIOS}/test_proposals.py"),
    "comp rollback": Case("comp rollback", "measure", "comp rollback --yes", "DRV-002", (0,), f"{SCENARIOS}/test_unverified.py"),
    "accept-table": Case("accept-table", "measure", "accept-table", "CFG-001", (0,), f"{SCENARIOS}/test_correct_command.py"),
    "serve": Case("serve --once", "trend", "serve -m none.toml", "CFG-001", (0, 1), f"{SCENARIOS}/test_alarm.py"),
    "trend": Case("trend", "alarm list", "trend --after yesterday", "CFG-001"),
    "fleet": Case("fleet", "runs", "fleet --db nonsense", "STO-001"),
    "alarm list": Case("alarm list", "alarm acknowledge", "alarm list -m none.toml", "CFG-001"),
    "alarm acknowledge": Case("alarm acknowledge #", "alarm list", "alarm acknowledge 99", "STO-002"),
    "export": Case("export c1 out#", "solve out#", "export none x", "STO-002"),
    "import": Case("import c1 --db sqlite:///import#.sqlite3", "solve c1", "import none", "FMT-001", (0, 1)),
    "backup": Case("backup copy#", "restore copy#", "backup in", "STO-004"),
    "restore": Case("restore copy# --db sqlite:///restored#.sqlite3", "audit verify", "restore none", "STO-004"),
    "user add": Case("user add bob# viewer", "user list", "user add bob root", "USR-002", typed="correct horse battery staple\n"),
    "user list": Case("user list", "user token list", "user list x", "USE-001"),
    "user role": Case("user role bob1 operator", "user list", "user role nobody viewer", "USR-002"),
    "user password": Case("user password bob1", "user list", "user password nobody", "USR-002", typed="correct horse battery staple 2\n"),
    "user disable": Case("user disable bob2", "user list", "user disable nobody", "USR-002"),
    "user enable": Case("user enable bob2", "user list", "user enable nobody", "USR-002"),
    "user token new": Case("user token new bob1 ci# --scope read", "user token list", "user token new nobody ci --scope read", "USR-002"),
    "user token list": Case("user token list", "user token revoke bob1 ci1", "user token list x", "USE-001"),
    "user token revoke": Case("user token revoke bob1 ci#", "user token list", "user token revoke bob1 none", "USR-002"),
    "key new": Case("key new key#.pem", "check-config", "key new abbe.toml", "SIG-002"),
    "audit show": Case("audit show", "audit verify", "audit show --last 0", "USE-001"),
    "audit verify": Case("audit verify", "backup", "audit verify --db nonsense", "STO-001", (0, 1)),
    "schema": Case("schema schemas#", "check-config", "schema abbe.toml", "CFG-001"),
    "papers": Case("papers --paper wang", "papers --html", "papers --paper none", "USE-001"),
    "vectors": Case("vectors", "papers", "vectors none", "FMT-001", (0, 1), "tests/service/reference/test_vector_results.py"),
    "version": Case("version", "doctor", "version x", "USE-001"),
}


def table() -> str:
    """The promises as a table for the reference page."""
    head = "| command | `--json` | exit codes | completion | next command | refuses, e.g. | proved by |\n|---|---|---|---|---|---|---|\n"
    rows = []
    for name, case in CASES.items():
        codes = ", ".join(map(str, (*case.codes, 2)))
        proof = case.proof or "tests/service/cli/test_every_command.py"
        rows.append(f"| {name} | yes | {codes} | yes | `abbe {case.then} ...` | `abbe {case.wrong}`: {case.error} | `{proof}` |\n")
    return head + "".join(rows)


def filled_folder(factory) -> Path:
    """A folder with a filled database, its machine file, and a file for each command that reads one."""
    from abbe.service.domain.document import document
    from abbe.service.effects.model_book import NewVersion, current
    from abbe.service.storage.store import Store
    from tests.pages_world import filled_once
    from tests.service.conftest import ERRORS, write_json

    filled = filled_once(factory)
    folder = Path(filled.url.removeprefix("sqlite:///")).parent
    with Store.open(filled.url) as store:
        doc = store.machines.get(store.campaigns.find(filled.campaign).machine_id).doc
        first = current(store, "VMC-1")
        assert first is not None
        store.models.add(NewVersion("VMC-1", 1, document(replace(first.book, parent=1, why="the axis was repaired"))))
    lines = [f'name = "{filled.machine}"', f'chain = "{doc["chain"]}"', f"tool_mm = {doc['tool_mm']}", "[stroke_mm]"]
    (folder / "abbe.toml").write_text("\n".join([*lines, *(f"{axis} = {at}" for axis, at in doc["stroke_mm"].items()), DEVICES]))
    (folder / "words.json").write_text(json.dumps({"SOLUTION": filled.solution, "PROPOSAL": filled.proposals[-1]}))
    write_json(folder / "errors.json", ERRORS)
    (folder / "p.csv").write_text("x_mm,y_mm,z_mm\n100,200,50\n")
    return folder
