"""Configuration of the agent and the service: every setting with its default, unit and reason, in one place."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from schemas.errors import InputError

NAME_PATTERN = r"^[a-z][a-z0-9-]{2,62}$"
VehicleName = Annotated[str, Field(pattern=NAME_PATTERN)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]


class Settings(BaseModel):
    """Base of every settings table: unknown names are refused, so that a misspelt one is not silently ignored."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class ZenohSettings(Settings):
    """How to reach the routers; `config` is handed to Zenoh as it is (same keys as a Zenoh configuration file)."""

    connect: list[str] = Field(default=["tcp/127.0.0.1:7447"], description="router endpoints, tried in turn")
    config: dict[str, Any] = Field(default_factory=dict, description="any Zenoh setting, e.g. transport/link/tls")


class AgentConfig(Settings):
    """Settings of an edge agent."""

    zenoh: ZenohSettings = ZenohSettings()
    estimator: str = Field(default="aco-fckf", description="estimator by name")
    state_rate_hz: Positive = Field(default=2.0, le=10.0, description="state records per second")
    flush_s: Positive = Field(default=1.0, description="longest time a record waits for its batch")
    batch_rows: int = Field(default=50, ge=1, le=50, description="records per batch at the most")
    slippery_mu: Positive = Field(default=0.4, description="a visit whose upper bound is below is sent at once")
    position_std: Positive = Field(default=1.5, description="[m] of the satellite receiver")
    yaw_std: Positive = Field(default=0.02, description="[rad] of the satellite receiver")
    spool: Path = Field(default=Path("spool.sqlite"), description="what is not yet acknowledged")
    spool_mb: Positive = Field(
        default=256.0, description="[MB] at the most; oldest state goes first, then observations"
    )
    resend_s: Positive = Field(default=2.0, description="first wait before a batch is sent again; doubles up to 6 s")
    trip_end_m: float = Field(
        default=0.0, ge=0.0, allow_inf_nan=False, description="[m] at both ends of a trip of which nothing is told"
    )
    trip_end_s: float = Field(
        default=0.0, ge=0.0, allow_inf_nan=False, description="[s] likewise; both must have passed"
    )
    tyre_season: int = Field(default=0, ge=0, le=3, description="0 unknown, 1 summer, 2 winter, 3 all-season")


class ServiceConfig(Settings):
    """Settings of a fleet service."""

    zenoh: ZenohSettings = ZenohSettings()
    name: VehicleName = Field(default="shard-0", description="name of this service; part of its segment names")
    regions: list[str] = Field(
        default=["*/*/*"],
        min_length=1,
        max_length=8,
        description="region key expressions of this service's share (quadkey chunks of 4, 3, 3 digits)",
    )
    segment_s: Positive = Field(default=0.5, le=1.0, description="longest time an admitted row waits for its segment")
    put_s: Positive = Field(default=1.0, description="shortest time between two puts of one tile")
    lateness_s: Positive = Field(default=120.0, description="later observations are archived, not fused")
    public_vehicles: int = Field(
        default=1, ge=1, description="answers and tiles show only cells of so many distinct vehicles (privacy)"
    )
    clock_ahead_s: Positive = Field(default=30.0, description="records further in the future are refused")
    oldest_s: Positive = Field(default=30 * 86400.0, description="records older than this are refused")
    queue_batches: int = Field(
        default=20_000, ge=1, description="batches waiting at the most; more wait unacknowledged"
    )


Model = TypeVar("Model", bound=BaseModel)


def load(path: Path | str | None, model: type[Model]) -> Model:
    """Read a configuration file (JSON) into `model`; None gives the defaults.

    Raises:
        InputError: the file cannot be read, or a setting is unknown or out of range.
    """
    if path is None:
        return model()
    try:
        return model.model_validate_json(Path(path).read_bytes())
    except OSError as error:
        raise InputError("config", f"cannot read {path} ({error.strerror})", "give the path of a JSON file") from error
    except ValidationError as error:
        raise explain(error, f"configuration {path}") from error


def explain(error: ValidationError, where: str) -> InputError:
    """The first complaint of pydantic as an error that names the field and the fix."""
    first = error.errors(include_url=False)[0]
    field = ".".join(str(part) for part in first["loc"]) or "content"
    given = json.dumps(first["input"], default=str)
    shown = given if len(given) <= 60 else given[:57] + "..."
    problem = (
        "is missing" if first["type"] == "missing" else f"{first['msg'][0].lower()}{first['msg'][1:]} (got {shown})"
    )
    return InputError(field, problem, f"correct it in the {where}")
