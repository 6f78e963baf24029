"""The list of commands. A new command is one line here and a function in a module that imports nothing heavy at its top."""

from __future__ import annotations

import typer

from abbe.service.cli.administration.audit import audit, record_all
from abbe.service.cli.administration.backup import backup, restore
from abbe.service.cli.administration.checks import alarm, fleet, trend
from abbe.service.cli.administration.serve import serve
from abbe.service.cli.administration.system import SIM_SETTINGS, check_config, schema, sim, version
from abbe.service.cli.administration.user import key, user
from abbe.service.cli.demo import demo
from abbe.service.cli.measure import correct, listen, measure
from abbe.service.cli.plan import plan
from abbe.service.cli.reference import papers, vectors
from abbe.service.cli.results.discover import discover
from abbe.service.cli.results.import_files import import_files
from abbe.service.cli.results.model import effects, model
from abbe.service.cli.results.report import report
from abbe.service.cli.results.show import export_campaign, runs, show
from abbe.service.cli.results.simulate import errors, simulate
from abbe.service.cli.results.solve import solve, solve_all
from abbe.service.cli.tables.comp import comp
from abbe.service.cli.tables.comp_proposals import approve, diff, propose, reject, show_proposals
from abbe.service.cli.tables.comp_push import accept_table, commission, push, rollback

app = typer.Typer(
    name="abbe",
    help="Measures how a 3-axis machine really moves, identifies its errors and corrects them.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

app.command("demo")(demo)
app.command("plan")(plan)
app.command("measure")(measure)
app.command("listen")(listen)
app.command("solve")(solve)
app.command("solve-all")(solve_all)
app.command("simulate")(simulate)
app.command("discover")(discover)
app.add_typer(model, name="model")
app.command("effects")(effects)
app.command("errors")(errors)
app.command("correct")(correct)
comp.command("commission")(commission)
comp.command("propose")(propose)
comp.command("show")(show_proposals)
comp.command("diff")(diff)
comp.command("approve")(approve)
comp.command("reject")(reject)
comp.command("push")(push)
comp.command("rollback")(rollback)
app.add_typer(comp, name="comp")
app.command("report")(report)
app.command("serve")(serve)
app.command("trend")(trend)
app.command("fleet")(fleet)
app.add_typer(alarm, name="alarm")
app.add_typer(key, name="key")
app.add_typer(user, name="user")
app.add_typer(audit, name="audit")
app.command("backup")(backup)
app.command("restore")(restore)
app.command("accept-table")(accept_table)
app.command("check-config")(check_config)
app.command("runs")(runs)
app.command("show")(show)
app.command("export")(export_campaign)
app.command("import")(import_files)
app.command("vectors")(vectors)
app.command("papers")(papers)
app.command("schema")(schema)
app.command("sim", context_settings=SIM_SETTINGS, add_help_option=False)(sim)
app.command("version")(version)

record_all(app)
