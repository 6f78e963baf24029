"""The list of commands. A new command is a function in a module that imports nothing heavy at its top, an import and a line here, and a
line in `abbe.service.cli.administration.audit`, which says whether it changes anything."""

from __future__ import annotations

import typer

from abbe.service.cli.administration.audit import audit, record_all
from abbe.service.cli.administration.backup import backup, restore
from abbe.service.cli.administration.checks import alarm, fleet, trend
from abbe.service.cli.administration.serve import serve
from abbe.service.cli.administration.setting_up import doctor, init
from abbe.service.cli.administration.system import SIM_SETTINGS, check_config, schema, sim, version
from abbe.service.cli.administration.user import key, user
from abbe.service.cli.common import CORRECT, MANAGE, MEASURE, UNDERSTAND, WATCH, give_form
from abbe.service.cli.demo import demo
from abbe.service.cli.device import device
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
from abbe.service.cli.tables.comp_drop import drop
from abbe.service.cli.tables.comp_proposals import approve, diff, propose, reject, show_proposals
from abbe.service.cli.tables.comp_push import accept_table, commission, push, rollback

app = typer.Typer(
    name="abbe",
    help="Measures how a 3-axis machine really moves, identifies its errors and corrects them.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

app.command("demo", rich_help_panel=MEASURE)(demo)
app.command("init", rich_help_panel=MEASURE)(init)
app.command("doctor", rich_help_panel=MEASURE)(doctor)
app.command("check-config", rich_help_panel=MEASURE)(check_config)
app.add_typer(device, name="device", rich_help_panel=MEASURE)
app.command("plan", rich_help_panel=MEASURE)(plan)
app.command("measure", rich_help_panel=MEASURE)(measure)
app.command("listen", rich_help_panel=MEASURE)(listen)
app.command("sim", rich_help_panel=MEASURE, context_settings=SIM_SETTINGS, add_help_option=False)(sim)
app.command("runs", rich_help_panel=MEASURE)(runs)
app.command("show", rich_help_panel=MEASURE)(show)
app.command("solve", rich_help_panel=UNDERSTAND)(solve)
app.command("solve-all", rich_help_panel=UNDERSTAND)(solve_all)
app.command("discover", rich_help_panel=UNDERSTAND)(discover)
app.command("simulate", rich_help_panel=UNDERSTAND)(simulate)
app.add_typer(model, name="model", rich_help_panel=UNDERSTAND)
app.command("effects", rich_help_panel=UNDERSTAND)(effects)
app.command("errors", rich_help_panel=UNDERSTAND)(errors)
app.command("report", rich_help_panel=UNDERSTAND)(report)
app.command("correct", rich_help_panel=CORRECT)(correct)
comp.command("drop")(drop)
comp.command("commission")(commission)
comp.command("propose")(propose)
comp.command("show")(show_proposals)
comp.command("diff")(diff)
comp.command("approve")(approve)
comp.command("reject")(reject)
comp.command("push")(push)
comp.command("rollback")(rollback)
app.add_typer(comp, name="comp", rich_help_panel=CORRECT)
app.command("accept-table", rich_help_panel=CORRECT)(accept_table)
app.command("serve", rich_help_panel=WATCH)(serve)
app.command("trend", rich_help_panel=WATCH)(trend)
app.add_typer(alarm, name="alarm", rich_help_panel=WATCH)
app.command("fleet", rich_help_panel=WATCH)(fleet)
app.command("export", rich_help_panel=MANAGE)(export_campaign)
app.command("import", rich_help_panel=MANAGE)(import_files)
app.command("backup", rich_help_panel=MANAGE)(backup)
app.command("restore", rich_help_panel=MANAGE)(restore)
app.add_typer(user, name="user", rich_help_panel=MANAGE)
app.add_typer(key, name="key", rich_help_panel=MANAGE)
app.add_typer(audit, name="audit", rich_help_panel=MANAGE)
app.command("schema", rich_help_panel=MANAGE)(schema)
app.command("papers", rich_help_panel=MANAGE)(papers)
app.command("vectors", rich_help_panel=MANAGE)(vectors)
app.command("version", rich_help_panel=MANAGE)(version)

record_all(app)
give_form(app)
