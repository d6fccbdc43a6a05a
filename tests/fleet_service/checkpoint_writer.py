"""Writing of a checkpoint (saved state) of a service without network, as the service itself does
it.
"""

from __future__ import annotations

import threading

from fleet_service.app.engine import Engine


def save_checkpoint(engine: Engine) -> None:
    """Save a checkpoint of an engine, which is a service without network. A background thread
    requests it, and the calling thread acts as the worker, which writes segments (files of new
    rows) meanwhile.
    """
    saved: list[bool] = []
    stop = threading.Event()
    thread = threading.Thread(target=lambda: saved.append(engine.save_checkpoint(stop)))
    thread.start()
    try:
        while thread.is_alive():
            engine.settlement.flush()
            thread.join(0.01)
    finally:
        stop.set()
        thread.join()
    assert saved == [True]
