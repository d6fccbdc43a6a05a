"""`fleet-service run`: run the service until a signal arrives."""

from __future__ import annotations

import argparse
import faulthandler
import gc
import logging
import os
import sys
import threading
import traceback
from collections.abc import Callable, Sequence
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

from fleet_service.cli.common import stop_on_signals
from schemas.errors import InputError
from schemas.runtime import progress_messages
from schemas.runtime.logs import event_logger, log_warnings
from schemas.runtime.process import force_exit

if TYPE_CHECKING:
    from fleet_service.app.service import Service
    from fleet_service.replication.ownership import Ownership
    from schemas.config import ServiceConfig

# File mode mask: only the service and its group may read data about vehicles.
PRIVATE = 0o027
# [s] Time after which a busy worker lets another thread run; a tenth of Python's default.
SWITCH_S = 0.0005
LEAVE_AT_LAST_S = 2.5  # [s] after a signal; the process must end within 3 s
FREEING_S = 0.4  # [s] part of this time that is reserved to release the lease in the bucket


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `fleet-service run`."""
    parser.add_argument(
        "--config", metavar="FILE", help="configuration file (JSON); every setting has a default"
    )
    parser.add_argument(
        "--archive",
        metavar="DIR",
        type=Path,
        help="folder of the archive, one service per archive (default: the configuration's)",
    )
    parser.add_argument(
        "--standby",
        action="store_true",
        help="run as standby: take over when the active service on this replica stops",
    )
    parser.add_argument(
        "--weather",
        metavar="FILE",
        type=Path,
        help="Parquet file of road weather to read at the start",
    )


def run(arguments: argparse.Namespace) -> int:
    """Run a fleet service; return its exit code."""
    with progress_messages.show_status("loading"):
        from fleet_service.app.native_library import use_service_library

        use_service_library()
        import fleet_service.app.service  # noqa: F401 loads the kernels behind the status line

    stop = stop_on_signals()
    os.umask(os.umask(0o077) | PRIVATE)
    config = _read_config(arguments)
    log_warnings(config.log, sys.stderr, service=config.name)
    root = arguments.archive or config.archive.path
    if root is None:
        raise InputError(
            "archive", "is missing", "give --archive DIR, or archive.path in the configuration"
        )
    events = event_logger("service", config.log, sys.stdout, service=config.name)
    try:
        service = _start_service(config, root, stop, events)
    except OSError as error:
        problem = f"cannot use {error.filename or root} ({error.strerror or error})"
        raise InputError("archive", problem, "give a folder that you may read and write") from error
    if service is None:
        return 0
    sys.setswitchinterval(SWITCH_S)
    gc.collect()
    # Objects loaded from the archive are never garbage. A collection over them would delay alerts.
    gc.freeze()
    stopped = threading.Event()
    threading.Thread(
        target=_force_exit_when_stuck, args=(stop, stopped, service, events.info), daemon=True
    ).start()
    service.run(stop)
    stopped.set()
    return service.exit_code


def _read_config(arguments: argparse.Namespace) -> ServiceConfig:
    """Return the configuration, with the settings that the command's options replace."""
    from schemas.config import ServiceConfig, load_config

    config = load_config(arguments.config, ServiceConfig)
    _check_regions(config.regions)
    if arguments.standby:
        config = config.model_copy(update={"standby": True})
    if arguments.weather is not None:
        config = config.model_copy(update={"weather": arguments.weather})
    return config


def _check_regions(expressions: Sequence[str]) -> None:
    """Raise InputError if two region expressions overlap: each message from their common regions
    would arrive twice.
    """
    from schemas import regions

    for one, other in combinations(expressions, 2):
        if regions.overlap(one, other):
            raise InputError("regions", f"{one} and {other} overlap", "leave one of them out")


def _start_service(
    config: ServiceConfig, root: Path, stop: threading.Event, events: logging.Logger
) -> Service | None:
    """Wait until the archive in the folder `root` is available, and return a service with this
    archive; return None if `stop` is set first.
    """
    from fleet_service.app.precompile import warm_up
    from fleet_service.app.service import Service

    if config.standby:
        with progress_messages.show_status("compiling"):
            warm_up()  # so that a take-over does not wait for compilation
    holding = _open_archive(config, root, stop, events.info)
    if holding is None:
        return None
    try:
        with progress_messages.show_status("starting"):
            return Service(config, root, events, holding)
    except BaseException:
        holding.close()
        raise


def _open_archive(
    config: ServiceConfig, root: Path, stop: threading.Event, log_line: Callable[[str], None]
) -> Ownership | None:
    """Wait until the archive is available, and open it; return None if `stop` is set first. A
    standby (waiting service) serves its metrics while it waits.
    """
    from fleet_service.app.metrics import standby_metrics
    from fleet_service.replication.ownership import acquire_archive
    from fleet_service.shards.serving import standby_signs
    from schemas.runtime import watchdog
    from schemas.runtime.metrics import serve_metrics

    if not config.standby:
        return acquire_archive(config, root, stop, log_line)
    latest = [""]

    def log_status(line: str) -> None:
        latest[0] = line
        log_line(f"{line}, {address}" if address else line)

    with (
        serve_metrics(
            config.metrics_host,
            config.metrics_port,
            lambda: standby_metrics(config),
            lambda: [line for line in latest if "cannot" in line],
        ) as address,
        standby_signs(config, stop, watchdog.notify_waiting()) as signs,
    ):
        return None if stop.is_set() else acquire_archive(config, root, stop, log_status, signs)


def _force_exit_when_stuck(
    stop: threading.Event,
    stopped: threading.Event,
    service: Service,
    log_line: Callable[[str], None],
) -> None:
    """End the process if the shutdown of the service hangs, for example because of a frozen router
    or a long compaction (move of new rows into sorted files).

    Every running operation may be interrupted, because vehicles keep each report until it is
    acknowledged. The lease (ownership of the archive) is released, because a standby would
    otherwise wait until it expires.
    """
    stop.wait()
    if not stopped.wait(LEAVE_AT_LAST_S):
        log_line("shutdown incomplete: a session or a job did not end in time")
        faulthandler.dump_traceback()  # shows where each thread hangs
        if service.failure is not None:
            traceback.print_exception(service.failure)
        code = service.exit_code
        if code == 0:
            freeing = threading.Thread(target=service.engine.holding.release, daemon=True)
            freeing.start()
            freeing.join(FREEING_S)
        force_exit(code)
