"""The list of commands. A new command is one line here and a function in a module that imports nothing heavy at its top."""

from __future__ import annotations

import typer

from abbe.service.cli.administration.alarm import alarm
from abbe.service.cli.administration.audit import audit
from abbe.service.cli.administration.audited import record_all
from abbe.service.cli.administration.backup import backup, restore
from abbe.service.cli.administration.configuration import check_config, schema
from abbe.service.cli.administration.fleet import fleet
from abbe.service.cli.administration.key import key
from abbe.service.cli.administration.serve import serve
from abbe.service.cli.administration.system import SIM_SETTINGS, sim, version
from abbe.service.cli.administration.user import user
from abbe.service.cli.demo import demo
from abbe.service.cli.errors import errors
from abbe.service.cli.listen import listen
from abbe.service.cli.measure import correct, measure
from abbe.service.cli.plan import plan
from abbe.service.cli.reference import papers, vectors
from abbe.service.cli.results.discover import discover
from abbe.service.cli.results.effects import effects
from abbe.service.cli.results.exchange import export_campaign, import_campaign
from abbe.service.cli.results.model import model
from abbe.service.cli.results.report import report
from abbe.service.cli.results.show import runs, show
from abbe.service.cli.results.simulate import simulate
from abbe.service.cli.results.solve import solve
from abbe.service.cli.results.solve_all import solve_all
from abbe.service.cli.results.trend import trend
from abbe.service.cli.tables.comp import comp
from abbe.service.cli.tables.comp_commission import commission
from abbe.service.cli.tables.comp_proposals import approve, diff, propose, reject, show_proposals
from abbe.service.cli.tables.comp_push import push, rollback
from abbe.service.cli.tables.table import accept_table

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
app.command("import")(import_campaign)
app.command("vectors")(vectors)
app.command("papers")(papers)
app.command("schema")(schema)
app.command("sim", context_settings=SIM_SETTINGS, add_help_option=False)(sim)
app.command("version")(version)

record_all(app)
