"""Reference pages of the documentation site, generated from the code: commands, settings, tables,
metrics, and the equations, tables and figures of the papers that the estimators implement.

`deploy/docs/conf.py` writes these pages when the site is built, so they always agree with the code.
The pages are not committed.

    python -m tests.reference_pages FOLDER
"""

from __future__ import annotations

import argparse
import importlib
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final, TypeAlias

from pydantic import BaseModel

import edge_agent.cli
import fleet_service.cli
from edge_agent.app import metrics as agent_metrics
from fleet_service.app import metrics as service_metrics
from fleet_service.app.engine import Engine
from schemas import tables
from schemas.config import AgentConfig, ServiceConfig
from schemas.runtime.metrics import PREFIX, Metric
from tests.elements_page import elements_page

COMMAND_LINES: Final[dict[str, Any]] = {
    "edge-agent": edge_agent.cli,
    "fleet-service": fleet_service.cli,
}
SETTINGS: Final[dict[str, type[BaseModel]]] = {
    "edge-agent": AgentConfig,
    "fleet-service": ServiceConfig,
}
TABLES: Final = {
    "Signal log": (*tables.SIGNAL_LOG, *tables.SIGNAL_LOG_CONTEXT),
    "Estimates": tables.ESTIMATES,
    "Observation, as reported": tables.OBSERVATION,
    "State, as reported": tables.STATE,
    "Observation, as archived": tables.OBSERVATION_KEPT,
    "Map cell": tables.MAP_CELL,
    "Roll-up per cell and hour": tables.CELL_HOUR,
    "Road weather": tables.WEATHER,
}
Shown: TypeAlias = dict[str, list[Metric]]


def command_actions(program: str) -> Iterator[tuple[Any, list[argparse.Action]]]:
    """Yield each command of a program, with the parser actions of its options and arguments."""
    for command in COMMAND_LINES[program].COMMANDS:
        parser = argparse.ArgumentParser(add_help=False)
        importlib.import_module(command.module).add_arguments(parser)
        yield command, list(parser._actions)


def command_page(program: str) -> str:
    """Return the Markdown page of a program's commands and options."""
    parts = [f"# `{program}`: commands\n\nEvery command also accepts `-h`, `-v` and `-q`.\n"]
    for command, actions in command_actions(program):
        parts.append(f"\n## `{command.name}`\n\n{command.help}\n\n```\n{command.example}\n```\n")
        if actions:
            parts.append("\n| option | |\n|---|---|\n")
        for action in actions:
            about = (action.help or "") % {"default": action.default} if action.help else ""
            choices = (
                f" ({', '.join(map(str, action.choices))})"
                if action.choices and not action.metavar
                else ""
            )
            parts.append(
                f"| `{_escape_cell(_action_name(action))}` | {_escape_cell(about + choices)} |\n"
            )
    return "".join(parts)


def _action_name(action: argparse.Action) -> str:
    if action.option_strings:
        return ", ".join(action.option_strings)
    return action.metavar if isinstance(action.metavar, str) else action.dest


def undocumented_options() -> list[str]:
    """Return the commands' options and arguments that have no help text."""
    return [
        f"{program} {command.name} {_action_name(action)}"
        for program in COMMAND_LINES
        for command, actions in command_actions(program)
        for action in actions
        if not action.help
    ]


def settings_rows(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, str, str]]:
    """Yield name, default and description of each setting; nested settings have dotted names."""
    for name, field in model.model_fields.items():
        nested = field.annotation
        if isinstance(nested, type) and issubclass(nested, BaseModel):
            yield from settings_rows(nested, f"{prefix}{name}.")
        else:
            default = (
                "" if field.is_required() else repr(field.get_default(call_default_factory=True))
            )
            yield f"{prefix}{field.alias or name}", default, field.description or ""


def settings_page() -> str:
    """Return the Markdown page of all settings."""
    parts = [
        (
            "# Configuration\n\nSettings are a JSON file, given with `--config`. Unknown names are "
            "refused.\n"
        )
    ]
    for program, model in SETTINGS.items():
        parts.append(f"\n## `{program}`\n\n| setting | default | |\n|---|---|---|\n")
        parts += [
            f"| `{name}` | `{_escape_cell(default)}` | {_escape_cell(about)} |\n"
            for name, default, about in settings_rows(model)
        ]
    return "".join(parts)


def tables_page() -> str:
    """Return the Markdown reference page that lists the columns of all tables in
    `schemas/tables.py`.
    """
    parts = ["# Tables\n\nNames, types, units and meanings come from `schemas/tables.py`.\n"]
    for title, fields in TABLES.items():
        parts.append(f"\n## {title}\n\n| column | type | unit | meaning |\n|---|---|---|---|\n")
        parts += [
            f"| `{f.name}` | {f.type} | {_escape_cell(f.unit)} | {_escape_cell(f.meaning)} |\n"
            for f in fields
        ]
    return "".join(parts)


def all_metrics(root: Path) -> Shown:
    """Return all metrics that an agent and a service export. For this a service is created on a new
    archive in the folder `root`.
    """
    config = ServiceConfig()
    engine = Engine(config, root)
    try:
        pulse = service_metrics.Pulse(turn_age_s=0.0, queued=0, routers=1, clock_lag_s=0.0)
        of_service = service_metrics.collect_metrics(engine, pulse, config, root)
    finally:
        engine.close()
    counts: Any = SimpleNamespace(
        published={},
        acknowledged={},
        rejected={},
        late={},
        resent_batches=0,
        bad_acks=0,
        failures=0,
    )
    status: Any = SimpleNamespace(
        unanswered_records=0,
        clock_behind_s=0.0,
        dropped_records=0,
        damage_counts=(0, 0),
        stranded_records=0,
        unanswered_s=0.0,
        fill_share=0.0,
        links=1,
        link_watches=[],
    )
    publisher: Any = SimpleNamespace(status=status, counts=counts, count_unsettled=lambda: 0)
    progress: Any = SimpleNamespace(late_blocks=0, lag_s=0.0, longest_lag_s=0.0)
    return {"service": of_service, "agent": agent_metrics.agent_metrics(publisher, progress)}


def stored_name(metric: Metric) -> str:
    """Return the name under which Prometheus stores a metric."""
    return f"{PREFIX}{metric.name}{'_total' if metric.kind == 'counter' else ''}"


def metrics_page(found: Shown) -> str:
    """Return the Markdown page of all metrics."""
    parts = [
        (
            "# Metrics\n\nNames as Prometheus stores them.\n\n| metric | of | kind | "
            "|\n|---|---|---|---|\n"
        )
    ]
    for half, metrics in found.items():
        for metric in metrics:
            kind = metric.kind + (metric.label and f", by {metric.label}")
            parts.append(
                f"| `{stored_name(metric)}` | {half} | {kind} | {_escape_cell(metric.help)} |\n"
            )
    return "".join(parts)


def _escape_cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def write_pages(folder: Path) -> None:
    """Write all generated pages of the reference documentation into a folder. The pages list the
    commands, settings, table columns and metrics, and the equations, tables and figures of the
    papers that the estimators implement.
    """
    folder.mkdir(parents=True, exist_ok=True)
    pages = {f"cli-{program}": command_page(program) for program in COMMAND_LINES}
    pages["configuration"] = settings_page()
    pages["tables"] = tables_page()
    pages["paper-elements"] = elements_page()
    with tempfile.TemporaryDirectory() as root:
        pages["metrics"] = metrics_page(all_metrics(Path(root)))
    for name, text in pages.items():
        path = folder / f"{name}.md"
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    write_pages(Path(sys.argv[1]))
