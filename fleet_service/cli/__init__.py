"""`fleet-service run | query | watch | compact | certs | evaluate`.

Heavy imports wait until a command needs them, so that help comes at once.
"""

from __future__ import annotations

import argparse
import gc
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from fleet_service.cli import analyze as analytics_cli
from fleet_service.cli import archive as archive_cli
from fleet_service.cli import certs
from schemas.errors import InputError
from schemas.runtime.process import end_now, limit_memory, line_logger, log_as

if TYPE_CHECKING:
    from fleet_service.app.service import Service

SWITCH_S = 0.0005  # after which a busy worker lets an answer go first; ten times that is Python's own
# 25 MB that a running service's libraries load where they find them: for matrix products in kernels, of which there are
# none, and for file systems that only a compaction writes to, which is a process of its own.
UNUSED = ("scipy", "pyarrow._s3fs", "pyarrow._gcsfs", "pyarrow._azurefs", "pyarrow._hdfs")
LEAVE_AT_LAST_S = 2.7  # after a signal; the process is to be gone within 3 s


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    Returns:
        0, or 2 after a one-line error that names the field and the fix.
    """
    arguments = _parser().parse_args(argv)
    if argv is None and arguments.command is _run:
        limit_memory(*UNUSED)
    try:
        return int(arguments.command(arguments))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # the reader of our output left: nobody to tell
        sys.stderr.close()
        return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("fleet-service", description="One live map of grip from many vehicles.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    run = commands.add_parser("run", help="take observations in, serve the map, keep the archive")
    run.add_argument("--config", metavar="FILE", help="JSON; every setting has a default")
    run.add_argument("--archive", metavar="DIR", type=Path, required=True, help="one service per archive")
    run.add_argument("--weather", metavar="FILE", type=Path, help="Parquet of road weather to begin with")
    run.set_defaults(command=_run)

    query = commands.add_parser("query", help="ask the map once")
    query.add_argument("--bbox", metavar="W,S,E,N", help="degrees; without it, everything")
    query.add_argument("--route", metavar="LON,LAT|LON,LAT", help="the cells ahead, in their order")
    query.add_argument("--min-vehicles", metavar="K", help="only cells of K vehicles or more")
    query.add_argument("--at", metavar="TIME", help="the map as it was, e.g. 2026-01-31T07:00:00Z; UTC without a zone")
    query.add_argument("--basis", metavar="borrowed", help="also cells that only neighbours speak for")
    query.add_argument("--format", metavar="arrow|geojson|json", help="arrow (default) prints a table")
    query.add_argument("--out", metavar="FILE", type=Path, help="write the answer there")
    _connection(query)
    query.set_defaults(command=_query)

    watch = commands.add_parser("watch", help="print tiles and alerts as they change, until Ctrl-C")
    watch.add_argument("--bbox", metavar="W,S,E,N", help="only tiles that touch this box")
    _connection(watch)
    watch.set_defaults(command=_watch)

    archive_cli.add_commands(commands)
    analytics_cli.add_command(commands)
    certs.add_command(commands)

    evaluate = commands.add_parser("evaluate", help="simulated fleets, beside truth and simple rules")
    evaluate.add_argument("--out", metavar="DIR", type=Path, required=True, help="figures, table and plots go there")
    evaluate.add_argument("--quick", action="store_true", help="one seed, to see that it works; judges nothing")
    way = evaluate.add_mutually_exclusive_group()
    way.add_argument("--skip-whole-way", action="store_true", help="leave the vehicles with real estimators out")
    way.add_argument("--whole-way", action="store_true", help="those alone, in a level town and on hills")
    evaluate.set_defaults(command=_evaluate)
    return parser


def _connection(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--connect", metavar="ENDPOINT", help="router, e.g. tcp/127.0.0.1:7447")
    parser.add_argument("--config", metavar="FILE", help="JSON with a `zenoh` section, as for run")


def _run(arguments: argparse.Namespace) -> int:
    from fleet_service.app.service import Service
    from schemas.config import ServiceConfig, load

    stop = stop_on_signals()
    config = load(arguments.config, ServiceConfig)
    log_as(config.log, sys.stderr, service=config.name)
    if arguments.weather is not None:
        config = config.model_copy(update={"weather": arguments.weather})
    try:
        say = line_logger(config.log, sys.stdout, service=config.name)
        service = Service(config, arguments.archive, say)
    except OSError as error:
        problem = f"cannot use {error.filename} ({error.strerror})"
        raise InputError("archive", problem, "give a folder you may read and write") from error
    sys.setswitchinterval(SWITCH_S)
    gc.collect()
    gc.freeze()  # what came from the archive stays: looking through it takes longer than an alert may
    gone = threading.Event()
    threading.Thread(target=_leave_at_last, args=(stop, gone, service, say), daemon=True).start()
    service.run(stop)
    gone.set()
    return 0


def _leave_at_last(stop: threading.Event, gone: threading.Event, service: Service, say: Callable[[str], None]) -> None:
    """A session that hangs on a frozen router, or a long compaction, must not keep a stopped service.

    Whatever it was doing may end at any instant: what is not acknowledged its senders keep. The exit code is the one
    that it would have ended with.
    """
    stop.wait()
    if not gone.wait(LEAVE_AT_LAST_S):
        say("left at last: a session or a job did not end in time")
        if service.failure is not None:
            traceback.print_exception(service.failure)
        end_now(service.exit_code)


def _query(arguments: argparse.Namespace) -> int:
    from fleet_service.client import map_client

    asked = {name: getattr(arguments, name) for name in ("bbox", "route", "min_vehicles", "at", "basis", "format")}
    parameters = {name: value for name, value in asked.items() if value is not None}
    answer = map_client.ask(map_client.settings(arguments.connect, arguments.config), parameters)
    if arguments.out is not None:
        map_client.write(answer, arguments.out)
    else:
        print(map_client.text(answer))
    return 0


def _watch(arguments: argparse.Namespace) -> int:
    from fleet_service.client import map_client

    stop = stop_on_signals()
    map_client.watch(
        map_client.settings(arguments.connect, arguments.config), arguments.bbox, stop, lambda s: print(s, flush=True)
    )
    return 0


def _evaluate(arguments: argparse.Namespace) -> int:
    from fleet_service.lab import campaign
    from schemas.runtime import figures

    drives = {} if arguments.skip_whole_way else campaign.whole_ways(arguments.quick)

    def tell(line: str) -> None:
        print(line, flush=True)

    try:
        found = campaign.run(arguments.out, arguments.quick, drives, tell, alone=arguments.whole_way)
    except OSError as error:
        raise InputError("out", f"cannot write {error.filename} ({error.strerror})", "give another folder") from error
    print(f"\n{figures.markdown([figure for figure in found if figure.bar is not None])}\n")
    return 0 if arguments.quick or campaign.holds(found) else 1


def stop_on_signals() -> threading.Event:
    """An event that SIGTERM and Ctrl-C set."""
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    return stop
