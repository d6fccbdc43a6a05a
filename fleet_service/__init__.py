"""The fleet service: it fuses the reports of many vehicles into one map of road friction.

    import fleet_service
    print(fleet_service.ask_archive("archive", "worst").to_pandas())
    print(fleet_service.ask_map("tcp/127.0.0.1:7447", bbox=(11.9, 57.6, 12.1, 57.8)).to_pandas())

Other programs may rely on the names in `__all__`. Each is loaded at its first use.
"""

from __future__ import annotations

import gripmap  # noqa: F401 names another installed package that hides one of ours
from schemas.runtime import lazy_exports

_FACE = {
    "QUESTIONS": "fleet_service.analytics.questions",
    "Question": "fleet_service.analytics.questions",
    "QueryEngine": "fleet_service.analytics.engines",
    "ask_archive": "fleet_service.analytics.library",
    "ask_map": "fleet_service.client.library",
    "decode_tile": "schemas.wire.tile",
    "map_of_archive": "fleet_service.analytics.library",
    "write_answer": "fleet_service.analytics.library",
}
__all__, __getattr__, __dir__ = lazy_exports.lazy_exports(__name__, _FACE)
