"""GripMap under one name: the public faces of `edge_agent` and `fleet_service`.

    import gripmap
    log, vehicle = gripmap.simulate_manoeuvre("slalom", mu=0.5)
    bank = gripmap.make_bank("fckf", [vehicle])

The distribution brings four top-level packages with plain names. Another package of such a name, a
folder `schemas` of one's own for instance, may come first on the path and hide one of them:
importing this module tells which and where.
"""

from __future__ import annotations

import importlib
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NoReturn

PACKAGES = ("schemas", "edge_agent", "fleet_service", "deploy")
FACES = ("edge_agent", "fleet_service")


def _check_packages() -> None:
    """ImportError where another package hides one of ours."""
    here = Path(__file__).resolve().parent
    for name in PACKAGES:
        spec = find_spec(name)
        found = Path(spec.origin).resolve() if spec is not None and spec.origin else None
        if found != here / name / "__init__.py":
            raise ImportError(
                f"{name}: {found or 'nothing'} stands where GripMap's own package {here / name} "
                "should be found; "
                "rename it, start from another folder, or keep the two in environments of their "
                "own",
                name=name,
            )


_check_packages()


def __getattr__(name: str) -> Any:  # noqa: ANN401 whatever a face holds
    """A name of a face, loaded when it is first asked for."""
    for face in FACES:
        package = importlib.import_module(face)
        if name in package.__all__:
            return getattr(package, name)
    raise AttributeError(f"gripmap has no {name!r}; it has {', '.join(__dir__())}")


def __dir__() -> list[str]:
    """Every name of the faces."""
    return sorted({name for face in FACES for name in importlib.import_module(face).__all__})


def gripmap_main() -> NoReturn:
    """Run `gripmap`."""
    from deploy.cli import main
    from schemas.runtime.process import force_exit

    force_exit(main())


def edge_agent_main() -> NoReturn:
    """Run `edge-agent`."""
    from edge_agent.cli import main
    from schemas.runtime.process import exit_fast

    exit_fast(main())


def fleet_service_main() -> NoReturn:
    """Run `fleet-service`."""
    from fleet_service.cli import main
    from schemas.runtime.process import exit_fast

    exit_fast(main())
