"""Configuration of agent and service: every setting with its default, unit and reason."""

from __future__ import annotations

import contextlib
import difflib
import json
from collections import Counter
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Field, SecretStr, ValidationError, field_validator

from schemas.errors import InputError
from schemas.thresholds import NS, SLIPPERY_MU

NAME_PATTERN = r"^[a-z][a-z0-9-]{2,62}$"
REGION_PATTERN = r"^([0-3]{4}|\*)/([0-3]{3}|\*)/([0-3]{3}|\*)$"
PLACE_PATTERN = r"^(/|[a-z][a-z0-9+.-]*://)."
FORMS: Final = {  # pattern -> words for error messages
    NAME_PATTERN: "3 to 63 of a-z, 0-9 and -, a letter first",
    REGION_PATTERN: "4, 3 and 3 digits from 0 to 3, or *, as in 1202/310/*",
    PLACE_PATTERN: "a URI such as s3://bucket/folder, or a folder from /",
}
VehicleName = Annotated[str, Field(pattern=NAME_PATTERN)]
# Shortest time [days] for which rows are kept. A batch may be sent again for thirty days
# (ServiceConfig.oldest_s), and its rows are needed to recognise it.
LEAST_RAW_DAYS: Final = 31
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]


class Settings(BaseModel):
    """Base class of all groups of settings in a configuration file. Unknown names are refused, so
    that a misspelt name is reported.
    """

    model_config = ConfigDict(
        extra="forbid", frozen=True, serialize_by_alias=True
    )  # `serialize_by_alias` writes settings with the names that the reader expects


class ZenohSettings(Settings):
    """Settings of the connection to Zenoh routers. The content of `config` is passed to Zenoh and
    has the same keys as a Zenoh configuration file.
    """

    connect: list[str] = Field(
        default=["tcp/127.0.0.1:7447"], description="router endpoints, tried in turn"
    )
    config: dict[str, Any] = Field(
        default_factory=dict, description="any Zenoh setting; {name} in it is the session's name"
    )

    def with_endpoint(self, connect: str | None) -> ZenohSettings:
        """Return these settings with the router endpoint `connect`; unchanged if it is None."""
        return self if connect is None else self.model_copy(update={"connect": [connect]})


class MonitoringSettings(Settings):
    """Settings of metrics, health checks and log format."""

    metrics_port: int | None = Field(
        default=None,
        ge=0,
        le=65535,
        description="/metrics (OpenMetrics) and /healthz; 0: a free port; null: off",
    )
    metrics_host: str = Field(
        default="127.0.0.1",
        description="listen address for both; every client that reaches it may read",
    )
    log: Literal["text", "json"] = Field(
        default="text", description="form of log lines: text, or JSON"
    )


class AgentConfig(MonitoringSettings):
    """Settings of an edge agent."""

    zenoh: ZenohSettings = ZenohSettings()
    estimator: str = Field(default="aco-fckf", description="estimator by name")
    state_rate_hz: Positive = Field(default=2.0, le=10.0, description="state records per second")
    flush_s: Positive = Field(default=1.0, description="longest time a record waits for its batch")
    batch_rows: int = Field(
        default=50, ge=1, le=50, description="maximum number of records per batch"
    )
    slippery_mu: Positive = Field(
        default=SLIPPERY_MU, description="a visit with an upper bound below this is sent at once"
    )
    position_std: Positive = Field(
        default=1.5,
        le=100.0,
        description="standard deviation of the satellite receiver's position [m]",
    )
    yaw_std: Positive = Field(
        default=0.02,
        le=10.0,
        description="standard deviation of the satellite receiver's course [rad]",
    )
    spool: Path = Field(
        default=Path("spool.sqlite"),
        description="file of the outbox; {name} in it is the vehicle's name",
    )
    spool_mb: Positive = Field(
        default=256.0,
        description="[MB] limit; the oldest states are dropped first, then observations",
    )
    resend_s: Positive = Field(
        default=2.0,
        description="first wait before a batch is sent again; doubles up to 6 s, or to minutes "
        "without any answer",
    )
    trip_end_m: float = Field(
        default=0.0,
        ge=0.0,
        allow_inf_nan=False,
        description="length at both ends of a trip that is not published [m]",
    )
    trip_end_s: float = Field(
        default=0.0,
        ge=0.0,
        allow_inf_nan=False,
        description="time at both ends of a trip that is not published [s]; both limits apply",
    )
    tyre_season: int = Field(
        default=0, ge=0, le=3, description="0 unknown, 1 summer, 2 winter, 3 all-season"
    )

    def spool_of(self, name: str) -> Path:
        """Return the file path of the outbox (stored unsent reports) of the vehicle or process
        `name`. The path is the setting `spool`, in which `{name}` is replaced by that name.
        """
        return Path(str(self.spool).replace("{name}", name))


class ArchiveSettings(Settings):
    """Settings of the archive: its folder, and the bucket of its second copy."""

    path: Path | None = Field(
        default=None, description="folder, one service per archive; `--archive` takes precedence"
    )
    second: str | None = Field(
        default=None,
        alias="copy",
        description="bucket that holds a copy, e.g. s3://bucket/folder; reports are acknowledged "
        "only after they are in the copy",
    )
    store: dict[str, SecretStr] = Field(
        default_factory=dict,
        description="how obstore reaches the bucket: endpoint, region, access_key_id, "
        "secret_access_key …; missing options come from the environment (AWS_…)",
    )

    @property
    def options(self) -> dict[str, str]:
        """Return the options, by name, with which the archive's bucket (object store) is opened.
        They come from the setting `store`; secrets among them are in plain text.
        """
        return {name: value.get_secret_value() for name, value in self.store.items()}


class ServiceConfig(MonitoringSettings):
    """Settings of a fleet service."""

    zenoh: ZenohSettings = ZenohSettings()
    name: VehicleName = Field(
        default="shard-0", description="name of this service; part of its segment names"
    )
    regions: list[Annotated[str, Field(pattern=REGION_PATTERN)]] = Field(
        default=["*/*/*"],
        min_length=1,
        max_length=8,
        description="region key expressions of this service's share (quadkey chunks of 4, 3, 3 "
        "digits)",
    )
    archive: ArchiveSettings = Field(
        default=ArchiveSettings(), description="location of the archive and of its copy"
    )
    standby: bool = Field(
        default=False,
        description="run as standby: take over when the active service on this replica stops",
    )
    lease_s: Positive = Field(
        default=5.0, ge=1.0, description="time after which a standby may replace a silent service"
    )
    segment_s: Positive = Field(
        default=0.5, le=1.0, description="longest time an admitted row waits for its segment"
    )
    put_s: Positive = Field(
        default=1.0, description="minimum time between two publications of one tile"
    )
    lateness_s: Positive = Field(
        default=120.0,
        description="observations older than this count as late: the fusion ages them",
    )
    weather: Path | None = Field(
        default=None,
        description="Parquet file of road weather to read at the start; reports over Zenoh are "
        "added",
    )
    public_vehicles: int = Field(
        default=1,
        ge=1,
        description="minimum number of vehicles of a visible cell; from 2 on, within the last 12 "
        "to 24 h (privacy)",
    )
    clock_ahead_s: Positive = Field(
        default=30.0, description="records further in the future are refused"
    )
    # At its start the service reads the identities of the batches of the last 31 days. It would
    # accept an older batch a second time.
    oldest_s: Positive = Field(
        default=30 * 86400.0,
        le=30 * 86400.0,
        description="records older than this are refused; at most 30 days",
    )
    compact_s: float = Field(
        default=3600.0,
        ge=0.0,
        allow_inf_nan=False,
        description="time between two compactions of the archive; 0: never",
    )
    checkpoint_s: float = Field(
        default=300.0,
        ge=0.0,
        allow_inf_nan=False,
        description="time between two checkpoints, from which a restart begins",
    )
    snapshot_s: float = Field(
        default=3600.0,
        ge=0.0,
        allow_inf_nan=False,
        description="time between two snapshots of the map; 0: never",
    )
    raw_days: int = Field(
        default=0,
        ge=0,
        description=f"number of days for which raw rows are kept, at least {LEAST_RAW_DAYS}; "
        "roll-ups are always kept; 0: keep all",
    )
    put_to: str | None = Field(
        default=None,
        pattern=PLACE_PATTERN,
        description="URI to which compacted files are copied, e.g. s3://bucket/a",
    )
    queue_batches: int = Field(
        default=20_000,
        ge=1,
        description="maximum number of waiting batches; further ones stay unacknowledged with "
        "their senders",
    )
    vehicle_kb_s: Positive = Field(
        default=40.0,
        description="long-run rate at which a vehicle may send [kB/s], 250 records; more waits in "
        "the vehicle",
    )
    vehicle_burst_kb: Positive = Field(
        default=2000.0,
        ge=64.0,
        description="amount that a vehicle may send at once [kB], e.g. after an outage of an hour; "
        "at least the largest batch",
    )
    publishers: list[VehicleName] = Field(
        default=[],
        description="senders that report many places at once and have no path, such as the "
        "witness of `fleet-service cits`",
    )
    publisher_kb_s: Positive = Field(
        default=2000.0,
        description="long-run rate at which each of `publishers` may send [kB/s]; it may send more "
        "at once than a vehicle by the same factor",
    )
    fleet: Path | None = Field(
        default=None,
        description="enrolment file; reports of other vehicles are ignored, and an enrolled "
        "vehicle has full weight from its first report",
    )

    @field_validator("raw_days")
    @classmethod
    def _check_raw_days(cls, days: int) -> int:
        if 0 < days < LEAST_RAW_DAYS:
            raise ValueError(f"should be 0 or at least {LEAST_RAW_DAYS}")
        return days

    @field_validator("archive", mode="before")
    @classmethod
    def _check_folder(cls, given: object) -> object:
        if given == "":
            raise ValueError("should be a folder, or left out")
        return {"path": given} if isinstance(given, str | Path) else given


_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def parse_moment(text: str, field: str) -> int:
    """Convert `text`, an ISO 8601 date with or without a time of day, to nanoseconds since 1970. A
    time without a zone is UTC. Error messages call the parameter `field`.

    Raises:
        InputError: `text` is not a time, or lies outside the range of 64-bit nanoseconds.
    """
    try:
        found = to_nanoseconds(datetime.fromisoformat(text))
    except ValueError as error:
        raise InputError(
            field, f"{text[:60]!r} is not a time", "write it like 2026-01-31T07:00:00Z"
        ) from error
    if not 0 <= found < 1 << 63:
        raise InputError(
            field, f"{text[:60]!r} lies before 1970 or after 2261", "give a time between"
        )
    return found


def to_nanoseconds(time: datetime) -> int:
    """Return a datetime as ns since 1970, without rounding; a datetime without a zone is UTC."""
    since = (time if time.tzinfo else time.replace(tzinfo=UTC)) - _EPOCH
    return (since.days * 86_400 + since.seconds) * NS + since.microseconds * 1_000


Model = TypeVar("Model", bound=BaseModel)


def load_config(path: Path | str | None, model: type[Model], field: str = "config") -> Model:
    """Read a configuration file (JSON), and return its settings as an object of the class `model`.
    If `path` is None, return the default settings. Error messages about the file call it `field`.

    Raises:
        InputError: the file cannot be read, or a setting is unknown, out of range or given twice.
    """
    if path is None:
        return model()
    try:
        text = Path(path).read_bytes()
        require_unique_names(text, f"configuration {path}")
        return model.model_validate_json(text)
    except OSError as error:
        raise InputError(
            field, f"cannot read {path} ({error.strerror})", "give the path of a JSON file"
        ) from error
    except ValidationError as error:
        raise explain_validation_error(error, f"configuration {path}", model) from error


def require_unique_names(text: bytes, where: str) -> None:
    """Raise InputError if an object in a JSON text has a name twice, because a parser silently
    takes the last value. `where` is the source of the text. Invalid JSON is left to the parser.
    """
    repeated: list[str] = []

    def collect_names(pairs: list[tuple[str, object]]) -> None:
        counts = Counter(name for name, _ in pairs)
        repeated.extend(name for name, count in counts.items() if count > 1)

    with contextlib.suppress(ValueError, RecursionError):
        json.loads(text, object_pairs_hook=collect_names)
    if repeated:
        raise InputError(repeated[0][:60], "is given more than once", f"keep one in the {where}")


def explain_validation_error(
    error: ValidationError, where: str, model: type[BaseModel]
) -> InputError:
    """Convert an unknown name, or else the first validation error that pydantic reports, to an
    InputError. It names the wrong field, and asks for a correction in `where` (source of the values
    of the class `model`). For a misspelt name it proposes the most similar name.
    """
    found = error.errors(include_url=False)
    first = next((one for one in found if one["type"] == "extra_forbidden"), found[0])
    field = ".".join(str(part) for part in first["loc"]) or "content"
    if first["type"] == "extra_forbidden":
        known = list(_known_names(model, first["loc"][:-1]))
        similar = difflib.get_close_matches(str(first["loc"][-1]), known, 1)
        fix = f"write {similar[0]!r}" if similar else f"remove it, or use one of {', '.join(known)}"
        return InputError(field, "is not a known name", f"{fix} in the {where}")
    secret = "store" in first["loc"]
    given = "…" if secret else json.dumps(first["input"], default=str)
    shown = given if len(given) <= 60 else given[:57] + "..."
    text = first["msg"].removeprefix("Value error, ")
    problem = f"{text[0].lower()}{text[1:]}"
    if (form := FORMS.get(first.get("ctx", {}).get("pattern", ""))) is not None:
        problem = f"should be {form}"
    if first["type"] == "missing":
        problem = "is missing"
    elif first["loc"]:  # otherwise the input is the whole file
        problem += f" (got {shown})"
    return InputError(field, problem, f"correct it in the {where}")


def _known_names(model: type[BaseModel], path: Sequence[int | str]) -> Iterator[str]:
    """Yield the names that a JSON file may use at `path` (names and indices from the outermost
    object to the inner one). Parts of the path that are no field, such as indices, are skipped.
    """
    for part in path:
        fields = {field.alias or name: field for name, field in model.model_fields.items()}
        if part in fields:
            model = next(_models_of(fields[str(part)].annotation), model)
    for name, field in model.model_fields.items():
        yield field.alias or name


def _models_of(annotation: object) -> Iterator[type[BaseModel]]:
    """Yield the classes of settings within a type annotation, such as `dict[str, Settings]`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from _models_of(part)
