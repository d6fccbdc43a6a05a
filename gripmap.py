"""GripMap under one name: the public names of `edge_agent` and `fleet_service`.

    import gripmap
    log, vehicle = gripmap.simulate_manoeuvre("slalom", mu=0.5)
    bank = gripmap.make_bank("fckf", [vehicle])

The distribution contains four top-level packages with plain names. Another package or folder with
one of these names, for example your own folder `schemas`, hides GripMap's package if it comes first
on Python's search path. Importing this module then raises an error that names the hidden package
and the path of the other one.
"""

from __future__ import annotations

import importlib
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NoReturn

PACKAGES = ("schemas", "edge_agent", "fleet_service", "deploy")
FACES = ("edge_agent", "fleet_service")


def _check_packages() -> None:
    """Raise ImportError if another package hides one of GripMap's packages."""
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


def __getattr__(name: str) -> Any:  # noqa: ANN401 any public object of a package
    """Return a public name of `edge_agent` or `fleet_service`, imported when it is first used."""
    for face in FACES:
        package = importlib.import_module(face)
        if name in package.__all__:
            return getattr(package, name)
    raise AttributeError(f"gripmap has no {name!r}; it has {', '.join(__dir__())}")


def __dir__() -> list[str]:
    """Return all public names of `edge_agent` and `fleet_service`, sorted."""
    return sorted({name for face in FACES for name in importlib.import_module(face).__all__})


def gripmap_main() -> NoReturn:
    """Run the command line `gripmap`, and exit with its exit code."""
    from deploy.cli import main
    from schemas.runtime.process import force_exit

    force_exit(main())


def edge_agent_main() -> NoReturn:
    """Run the command line `edge-agent`, and exit with its exit code."""
    from edge_agent.cli import main
    from schemas.runtime.process import exit_fast

    exit_fast(main())


def fleet_service_main() -> NoReturn:
    """Run the command line `fleet-service`, and exit with its exit code."""
    from fleet_service.cli import main
    from schemas.runtime.process import exit_fast

    exit_fast(main())
