"""The list of commands. A new one is one line here and a function in a module that imports nothing heavy at its top."""

from __future__ import annotations

import typer

from service.cli.configuration import check_config, schema
from service.cli.demo import demo
from service.cli.discover import discover
from service.cli.effects import effects
from service.cli.errors import errors
from service.cli.exchange import export_campaign, import_campaign
from service.cli.measure import correct, measure
from service.cli.model import model
from service.cli.papers import papers
from service.cli.plan import plan
from service.cli.serve import serve
from service.cli.show import runs, show
from service.cli.simulate import simulate
from service.cli.solve import solve
from service.cli.system import SIM_SETTINGS, sim, version
from service.cli.table import accept_table
from service.cli.vectors import vectors

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
app.command("solve")(solve)
app.command("simulate")(simulate)
app.command("discover")(discover)
app.add_typer(model, name="model")
app.command("effects")(effects)
app.command("errors")(errors)
app.command("correct")(correct)
app.command("serve")(serve)
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
