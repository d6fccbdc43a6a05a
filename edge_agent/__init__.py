"""The software of one vehicle: computes evidence on road friction from sensor signals.

    import edge_agent
    log, vehicle = edge_agent.read_log("drive.parquet"), edge_agent.load_vehicle("drive.json")
    print(edge_agent.estimate(log, vehicle).to_pandas()[["t", "mu", "mu_lower", "mu_upper"]])

The names of `__all__` are the public interface; each is loaded on first access.
"""

from __future__ import annotations

import gripmap  # noqa: F401 reports another installed package that hides one of this project
from schemas.runtime import lazy_exports

_FACE = {
    "ESTIMATORS": "edge_agent.estimators",
    "Estimates": "edge_agent.estimators",
    "EstimatorBank": "edge_agent.estimators",
    "GripWarning": "schemas.wire.ahead",
    "Lookout": "edge_agent.ahead.lookout",
    "Memberships": "edge_agent.adaptation.memberships",
    "Pose": "edge_agent.ahead.path",
    "SignalLog": "edge_agent.inputs.signal_log",
    "Vehicle": "schemas.vehicle",
    "InputError": "schemas.errors",
    "CHANNELS": "schemas.signals",
    "Block": "edge_agent.inputs.block",
    "estimate": "edge_agent.app.library",
    "known_estimators": "edge_agent.app.library",
    "load_memberships": "edge_agent.app.library",
    "load_vehicle": "edge_agent.app.library",
    "make_bank": "edge_agent.app.library",
    "plot": "edge_agent.app.library",
    "read_log": "edge_agent.app.library",
    "read_route": "edge_agent.ahead.route_file",
    "simulate_manoeuvre": "edge_agent.lab.simulation",
    "to_table": "edge_agent.app.library",
}
__all__, __getattr__, __dir__ = lazy_exports.lazy_exports(__name__, _FACE)
