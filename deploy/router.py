"""`gripmap router [--config FILE] [--listen ENDPOINT]`: run a Zenoh router as a separate process.

The Python package of Zenoh contains the router, so no other program is needed. The router prints
`router: tcp/…` when it listens (with the actual port if port 0 was given) and ends on SIGINT or
SIGTERM.
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from socket import socket, socketpair

import zenoh

from schemas.errors import InputError
from schemas.runtime import commandline
from schemas.runtime.certificates import find_certificate_faults
from schemas.runtime.link_watch import router_metrics
from schemas.runtime.metrics import serve_metrics
from schemas.runtime.process import force_exit
from schemas.runtime.zenoh_session import check_certificates, error_reason

CLOSE_S = 2.0
ENDING = (signal.SIGINT, signal.SIGTERM)
CONFIG = Path(__file__).with_name("router.json5")


def load_configuration(
    config: Path = CONFIG, listen: str | Sequence[str] | None = None
) -> zenoh.Config:
    """Return the router's configuration from the file `config`. If `listen` is given, the router
    listens on these endpoints instead of those in the file.

    Raises:
        InputError: the file is not a Zenoh configuration, or the endpoint is not valid.
    """
    try:
        settings = zenoh.Config.from_file(str(config))
    except zenoh.ZError as error:
        raise InputError(
            "config",
            f"cannot use {config} ({error_reason(error)})",
            "give a Zenoh configuration file",
        ) from error
    if listen is not None:
        endpoints = [listen] if isinstance(listen, str) else list(listen)
        try:
            settings.insert_json5("listen/endpoints", json.dumps(endpoints))
        except zenoh.ZError as error:
            raise InputError(
                "listen",
                f"{', '.join(endpoints)} is not a Zenoh endpoint",
                "write it like tcp/127.0.0.1:7447",
            ) from error
        # The admin space reports the actual port if port 0 was given.
        settings.insert_json5("adminspace/enabled", "true")
    return settings


def open_router(
    config: Path = CONFIG, listen: str | Sequence[str] | None = None
) -> tuple[zenoh.Session, list[str]]:
    """Start a Zenoh router in this process. Return its Zenoh session, and the endpoints on which it
    listens.

    Raises:
        InputError: the configuration is invalid, names a certificate that does not exist, or an
            endpoint is used by another process.
    """
    settings = load_configuration(config, listen)
    check_certificates(settings)
    try:
        session = zenoh.open(settings)
    except zenoh.ZError as error:
        reason = error_reason(error)
        fix = (
            "free the port or choose another"
            if "in use" in reason
            else f"correct the endpoint, or {config}"
        )
        raise InputError("listen", f"the router cannot start ({reason})", fix) from error
    if listen is None:
        return session, list(json.loads(settings.get_json("listen/endpoints")))
    reply = next(iter(session.get(f"@/{session.zid()}/router"))).ok
    if reply is None:
        raise InputError("listen", "the router does not report its endpoints", "give a fixed port")
    return session, list(json.loads(reply.payload.to_string())["locators"])


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `gripmap router`."""
    parser.add_argument(
        "--config", type=Path, default=CONFIG, help="Zenoh configuration file (JSON5)"
    )
    parser.add_argument(
        "--listen",
        nargs="+",
        help="listen endpoints; override the file's; e.g. tcp/127.0.0.1:0 for a free port",
    )
    parser.add_argument(
        "--metrics-port",
        type=commandline.parse_port,
        help="serve /metrics: sessions and links; 0 for a free port",
    )
    parser.add_argument(
        "--metrics-host", default="127.0.0.1", help="listen address of /metrics (default 127.0.0.1)"
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run a router until a signal ends it; parse the options from `argv`."""
    parser = argparse.ArgumentParser(
        prog="deploy.router", description="Run a Zenoh router for GripMap."
    )
    add_arguments(parser)
    return run(parser.parse_args(argv))


def run(args: argparse.Namespace) -> int:
    """Run a router with parsed options until a signal ends it; return the exit code."""
    try:
        with _catch_signals() as signals:
            session, endpoints = open_router(args.config, args.listen)
            with serve_metrics(
                args.metrics_host, args.metrics_port, lambda: router_metrics(session), lambda: ()
            ) as address:
                print(f"router: {' '.join(endpoints)}", flush=True)
                for fault in find_certificate_faults(load_configuration(args.config), time.time()):
                    print(f"warning: {fault}", file=sys.stderr, flush=True)
                if address:
                    print(f"metrics: {address}/metrics", flush=True)
                signals.recv(1)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    closing = threading.Thread(target=session.close, daemon=True)
    closing.start()
    closing.join(CLOSE_S)
    return 0


@contextmanager
def _catch_signals() -> Iterator[socket]:
    """Yield a socket that receives a byte for each SIGINT or SIGTERM, whichever thread of the
    process the signal reaches. At the end, restore the former handling.
    """
    reader, writer = socketpair()
    with reader, writer:
        writer.setblocking(False)
        handlers = [signal.signal(number, lambda *_: None) for number in ENDING]
        descriptor = signal.set_wakeup_fd(writer.fileno())
        try:
            yield reader
        finally:
            signal.set_wakeup_fd(descriptor)
            for number, handler in zip(ENDING, handlers, strict=True):
                signal.signal(number, handler)


if __name__ == "__main__":
    # Zenoh may hang when one of two connected routers closes, at once or when the interpreter ends.
    # A router has nothing to save.
    force_exit(main())
