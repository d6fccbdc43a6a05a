from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Kind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    KIND_UNSPECIFIED: _ClassVar[Kind]
    KIND_OBSERVATION: _ClassVar[Kind]
    KIND_STATE: _ClassVar[Kind]

class Basis(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    BASIS_UNKNOWN: _ClassVar[Basis]
    BASIS_BOUND: _ClassVar[Basis]
    BASIS_MEASURED: _ClassVar[Basis]
    BASIS_BORROWED: _ClassVar[Basis]
KIND_UNSPECIFIED: Kind
KIND_OBSERVATION: Kind
KIND_STATE: Kind
BASIS_UNKNOWN: Basis
BASIS_BOUND: Basis
BASIS_MEASURED: Basis
BASIS_BORROWED: Basis

class ObservationBatch(_message.Message):
    __slots__ = ("vehicle", "boot", "region", "seq", "first_held", "estimator", "enter_time", "leave_time", "cell", "sector", "latitude", "longitude", "position_std", "yaw", "yaw_std", "speed", "mu", "mu_lower", "mu_upper", "mu_utilised", "log_likelihood", "health", "tyre_season", "air_temperature", "abs_active", "used_longitudinal", "used_lateral", "esc_active", "tcs_active", "wiper")
    VEHICLE_FIELD_NUMBER: _ClassVar[int]
    BOOT_FIELD_NUMBER: _ClassVar[int]
    REGION_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    FIRST_HELD_FIELD_NUMBER: _ClassVar[int]
    ESTIMATOR_FIELD_NUMBER: _ClassVar[int]
    ENTER_TIME_FIELD_NUMBER: _ClassVar[int]
    LEAVE_TIME_FIELD_NUMBER: _ClassVar[int]
    CELL_FIELD_NUMBER: _ClassVar[int]
    SECTOR_FIELD_NUMBER: _ClassVar[int]
    LATITUDE_FIELD_NUMBER: _ClassVar[int]
    LONGITUDE_FIELD_NUMBER: _ClassVar[int]
    POSITION_STD_FIELD_NUMBER: _ClassVar[int]
    YAW_FIELD_NUMBER: _ClassVar[int]
    YAW_STD_FIELD_NUMBER: _ClassVar[int]
    SPEED_FIELD_NUMBER: _ClassVar[int]
    MU_FIELD_NUMBER: _ClassVar[int]
    MU_LOWER_FIELD_NUMBER: _ClassVar[int]
    MU_UPPER_FIELD_NUMBER: _ClassVar[int]
    MU_UTILISED_FIELD_NUMBER: _ClassVar[int]
    LOG_LIKELIHOOD_FIELD_NUMBER: _ClassVar[int]
    HEALTH_FIELD_NUMBER: _ClassVar[int]
    TYRE_SEASON_FIELD_NUMBER: _ClassVar[int]
    AIR_TEMPERATURE_FIELD_NUMBER: _ClassVar[int]
    ABS_ACTIVE_FIELD_NUMBER: _ClassVar[int]
    USED_LONGITUDINAL_FIELD_NUMBER: _ClassVar[int]
    USED_LATERAL_FIELD_NUMBER: _ClassVar[int]
    ESC_ACTIVE_FIELD_NUMBER: _ClassVar[int]
    TCS_ACTIVE_FIELD_NUMBER: _ClassVar[int]
    WIPER_FIELD_NUMBER: _ClassVar[int]
    vehicle: str
    boot: int
    region: int
    seq: int
    first_held: int
    estimator: str
    enter_time: _containers.RepeatedScalarFieldContainer[int]
    leave_time: _containers.RepeatedScalarFieldContainer[int]
    cell: _containers.RepeatedScalarFieldContainer[int]
    sector: _containers.RepeatedScalarFieldContainer[int]
    latitude: _containers.RepeatedScalarFieldContainer[float]
    longitude: _containers.RepeatedScalarFieldContainer[float]
    position_std: _containers.RepeatedScalarFieldContainer[float]
    yaw: _containers.RepeatedScalarFieldContainer[float]
    yaw_std: _containers.RepeatedScalarFieldContainer[float]
    speed: _containers.RepeatedScalarFieldContainer[float]
    mu: _containers.RepeatedScalarFieldContainer[float]
    mu_lower: _containers.RepeatedScalarFieldContainer[float]
    mu_upper: _containers.RepeatedScalarFieldContainer[float]
    mu_utilised: _containers.RepeatedScalarFieldContainer[float]
    log_likelihood: bytes
    health: _containers.RepeatedScalarFieldContainer[int]
    tyre_season: _containers.RepeatedScalarFieldContainer[int]
    air_temperature: _containers.RepeatedScalarFieldContainer[float]
    abs_active: _containers.RepeatedScalarFieldContainer[int]
    used_longitudinal: _containers.RepeatedScalarFieldContainer[float]
    used_lateral: _containers.RepeatedScalarFieldContainer[float]
    esc_active: _containers.RepeatedScalarFieldContainer[int]
    tcs_active: _containers.RepeatedScalarFieldContainer[int]
    wiper: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, vehicle: _Optional[str] = ..., boot: _Optional[int] = ..., region: _Optional[int] = ..., seq: _Optional[int] = ..., first_held: _Optional[int] = ..., estimator: _Optional[str] = ..., enter_time: _Optional[_Iterable[int]] = ..., leave_time: _Optional[_Iterable[int]] = ..., cell: _Optional[_Iterable[int]] = ..., sector: _Optional[_Iterable[int]] = ..., latitude: _Optional[_Iterable[float]] = ..., longitude: _Optional[_Iterable[float]] = ..., position_std: _Optional[_Iterable[float]] = ..., yaw: _Optional[_Iterable[float]] = ..., yaw_std: _Optional[_Iterable[float]] = ..., speed: _Optional[_Iterable[float]] = ..., mu: _Optional[_Iterable[float]] = ..., mu_lower: _Optional[_Iterable[float]] = ..., mu_upper: _Optional[_Iterable[float]] = ..., mu_utilised: _Optional[_Iterable[float]] = ..., log_likelihood: _Optional[bytes] = ..., health: _Optional[_Iterable[int]] = ..., tyre_season: _Optional[_Iterable[int]] = ..., air_temperature: _Optional[_Iterable[float]] = ..., abs_active: _Optional[_Iterable[int]] = ..., used_longitudinal: _Optional[_Iterable[float]] = ..., used_lateral: _Optional[_Iterable[float]] = ..., esc_active: _Optional[_Iterable[int]] = ..., tcs_active: _Optional[_Iterable[int]] = ..., wiper: _Optional[_Iterable[float]] = ...) -> None: ...

class StateBatch(_message.Message):
    __slots__ = ("vehicle", "boot", "region", "seq", "first_held", "estimator", "time", "latitude", "longitude", "position_std", "yaw", "vx", "vy", "yaw_rate", "sideslip", "mu", "mu_lower", "mu_upper", "health", "p_slippery")
    VEHICLE_FIELD_NUMBER: _ClassVar[int]
    BOOT_FIELD_NUMBER: _ClassVar[int]
    REGION_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    FIRST_HELD_FIELD_NUMBER: _ClassVar[int]
    ESTIMATOR_FIELD_NUMBER: _ClassVar[int]
    TIME_FIELD_NUMBER: _ClassVar[int]
    LATITUDE_FIELD_NUMBER: _ClassVar[int]
    LONGITUDE_FIELD_NUMBER: _ClassVar[int]
    POSITION_STD_FIELD_NUMBER: _ClassVar[int]
    YAW_FIELD_NUMBER: _ClassVar[int]
    VX_FIELD_NUMBER: _ClassVar[int]
    VY_FIELD_NUMBER: _ClassVar[int]
    YAW_RATE_FIELD_NUMBER: _ClassVar[int]
    SIDESLIP_FIELD_NUMBER: _ClassVar[int]
    MU_FIELD_NUMBER: _ClassVar[int]
    MU_LOWER_FIELD_NUMBER: _ClassVar[int]
    MU_UPPER_FIELD_NUMBER: _ClassVar[int]
    HEALTH_FIELD_NUMBER: _ClassVar[int]
    P_SLIPPERY_FIELD_NUMBER: _ClassVar[int]
    vehicle: str
    boot: int
    region: int
    seq: int
    first_held: int
    estimator: str
    time: _containers.RepeatedScalarFieldContainer[int]
    latitude: _containers.RepeatedScalarFieldContainer[float]
    longitude: _containers.RepeatedScalarFieldContainer[float]
    position_std: _containers.RepeatedScalarFieldContainer[float]
    yaw: _containers.RepeatedScalarFieldContainer[float]
    vx: _containers.RepeatedScalarFieldContainer[float]
    vy: _containers.RepeatedScalarFieldContainer[float]
    yaw_rate: _containers.RepeatedScalarFieldContainer[float]
    sideslip: _containers.RepeatedScalarFieldContainer[float]
    mu: _containers.RepeatedScalarFieldContainer[float]
    mu_lower: _containers.RepeatedScalarFieldContainer[float]
    mu_upper: _containers.RepeatedScalarFieldContainer[float]
    health: _containers.RepeatedScalarFieldContainer[int]
    p_slippery: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, vehicle: _Optional[str] = ..., boot: _Optional[int] = ..., region: _Optional[int] = ..., seq: _Optional[int] = ..., first_held: _Optional[int] = ..., estimator: _Optional[str] = ..., time: _Optional[_Iterable[int]] = ..., latitude: _Optional[_Iterable[float]] = ..., longitude: _Optional[_Iterable[float]] = ..., position_std: _Optional[_Iterable[float]] = ..., yaw: _Optional[_Iterable[float]] = ..., vx: _Optional[_Iterable[float]] = ..., vy: _Optional[_Iterable[float]] = ..., yaw_rate: _Optional[_Iterable[float]] = ..., sideslip: _Optional[_Iterable[float]] = ..., mu: _Optional[_Iterable[float]] = ..., mu_lower: _Optional[_Iterable[float]] = ..., mu_upper: _Optional[_Iterable[float]] = ..., health: _Optional[_Iterable[int]] = ..., p_slippery: _Optional[_Iterable[float]] = ...) -> None: ...

class SeqRange(_message.Message):
    __slots__ = ("first", "last")
    FIRST_FIELD_NUMBER: _ClassVar[int]
    LAST_FIELD_NUMBER: _ClassVar[int]
    first: int
    last: int
    def __init__(self, first: _Optional[int] = ..., last: _Optional[int] = ...) -> None: ...

class Rejection(_message.Message):
    __slots__ = ("seq", "row", "reason")
    SEQ_FIELD_NUMBER: _ClassVar[int]
    ROW_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    seq: int
    row: int
    reason: str
    def __init__(self, seq: _Optional[int] = ..., row: _Optional[int] = ..., reason: _Optional[str] = ...) -> None: ...

class StreamAck(_message.Message):
    __slots__ = ("boot", "kind", "region", "durable", "rejected", "late")
    BOOT_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    REGION_FIELD_NUMBER: _ClassVar[int]
    DURABLE_FIELD_NUMBER: _ClassVar[int]
    REJECTED_FIELD_NUMBER: _ClassVar[int]
    LATE_FIELD_NUMBER: _ClassVar[int]
    boot: int
    kind: Kind
    region: int
    durable: _containers.RepeatedCompositeFieldContainer[SeqRange]
    rejected: _containers.RepeatedCompositeFieldContainer[Rejection]
    late: _containers.RepeatedCompositeFieldContainer[SeqRange]
    def __init__(self, boot: _Optional[int] = ..., kind: _Optional[_Union[Kind, str]] = ..., region: _Optional[int] = ..., durable: _Optional[_Iterable[_Union[SeqRange, _Mapping]]] = ..., rejected: _Optional[_Iterable[_Union[Rejection, _Mapping]]] = ..., late: _Optional[_Iterable[_Union[SeqRange, _Mapping]]] = ...) -> None: ...

class Ack(_message.Message):
    __slots__ = ("vehicle", "streams", "time")
    VEHICLE_FIELD_NUMBER: _ClassVar[int]
    STREAMS_FIELD_NUMBER: _ClassVar[int]
    TIME_FIELD_NUMBER: _ClassVar[int]
    vehicle: str
    streams: _containers.RepeatedCompositeFieldContainer[StreamAck]
    time: int
    def __init__(self, vehicle: _Optional[str] = ..., streams: _Optional[_Iterable[_Union[StreamAck, _Mapping]]] = ..., time: _Optional[int] = ...) -> None: ...

class Alert(_message.Message):
    __slots__ = ("cell", "sector", "raised", "time", "mu", "mu_lower", "mu_upper", "p_slippery", "vehicles", "latitude", "longitude", "reason")
    CELL_FIELD_NUMBER: _ClassVar[int]
    SECTOR_FIELD_NUMBER: _ClassVar[int]
    RAISED_FIELD_NUMBER: _ClassVar[int]
    TIME_FIELD_NUMBER: _ClassVar[int]
    MU_FIELD_NUMBER: _ClassVar[int]
    MU_LOWER_FIELD_NUMBER: _ClassVar[int]
    MU_UPPER_FIELD_NUMBER: _ClassVar[int]
    P_SLIPPERY_FIELD_NUMBER: _ClassVar[int]
    VEHICLES_FIELD_NUMBER: _ClassVar[int]
    LATITUDE_FIELD_NUMBER: _ClassVar[int]
    LONGITUDE_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    cell: int
    sector: int
    raised: bool
    time: int
    mu: float
    mu_lower: float
    mu_upper: float
    p_slippery: float
    vehicles: int
    latitude: float
    longitude: float
    reason: str
    def __init__(self, cell: _Optional[int] = ..., sector: _Optional[int] = ..., raised: _Optional[bool] = ..., time: _Optional[int] = ..., mu: _Optional[float] = ..., mu_lower: _Optional[float] = ..., mu_upper: _Optional[float] = ..., p_slippery: _Optional[float] = ..., vehicles: _Optional[int] = ..., latitude: _Optional[float] = ..., longitude: _Optional[float] = ..., reason: _Optional[str] = ...) -> None: ...

class StandingAlerts(_message.Message):
    __slots__ = ("alerts",)
    ALERTS_FIELD_NUMBER: _ClassVar[int]
    alerts: _containers.RepeatedCompositeFieldContainer[Alert]
    def __init__(self, alerts: _Optional[_Iterable[_Union[Alert, _Mapping]]] = ...) -> None: ...

class Warning(_message.Message):
    __slots__ = ("id", "state", "time", "distance_m", "length_m", "time_s", "mu", "mu_lower", "p_slippery", "age_s", "safe_speed", "way", "sure", "reason")
    ID_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    TIME_FIELD_NUMBER: _ClassVar[int]
    DISTANCE_M_FIELD_NUMBER: _ClassVar[int]
    LENGTH_M_FIELD_NUMBER: _ClassVar[int]
    TIME_S_FIELD_NUMBER: _ClassVar[int]
    MU_FIELD_NUMBER: _ClassVar[int]
    MU_LOWER_FIELD_NUMBER: _ClassVar[int]
    P_SLIPPERY_FIELD_NUMBER: _ClassVar[int]
    AGE_S_FIELD_NUMBER: _ClassVar[int]
    SAFE_SPEED_FIELD_NUMBER: _ClassVar[int]
    WAY_FIELD_NUMBER: _ClassVar[int]
    SURE_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    id: str
    state: str
    time: int
    distance_m: float
    length_m: float
    time_s: float
    mu: float
    mu_lower: float
    p_slippery: float
    age_s: float
    safe_speed: float
    way: str
    sure: bool
    reason: str
    def __init__(self, id: _Optional[str] = ..., state: _Optional[str] = ..., time: _Optional[int] = ..., distance_m: _Optional[float] = ..., length_m: _Optional[float] = ..., time_s: _Optional[float] = ..., mu: _Optional[float] = ..., mu_lower: _Optional[float] = ..., p_slippery: _Optional[float] = ..., age_s: _Optional[float] = ..., safe_speed: _Optional[float] = ..., way: _Optional[str] = ..., sure: _Optional[bool] = ..., reason: _Optional[str] = ...) -> None: ...

class Ahead(_message.Message):
    __slots__ = ("vehicle", "time", "way", "warnings", "here_mu", "here_mu_lower", "here_mu_upper", "start_m", "end_m", "cell", "sector", "mu", "mu_lower", "mu_upper", "p_slippery", "age_s", "basis", "safe_speed")
    VEHICLE_FIELD_NUMBER: _ClassVar[int]
    TIME_FIELD_NUMBER: _ClassVar[int]
    WAY_FIELD_NUMBER: _ClassVar[int]
    WARNINGS_FIELD_NUMBER: _ClassVar[int]
    HERE_MU_FIELD_NUMBER: _ClassVar[int]
    HERE_MU_LOWER_FIELD_NUMBER: _ClassVar[int]
    HERE_MU_UPPER_FIELD_NUMBER: _ClassVar[int]
    START_M_FIELD_NUMBER: _ClassVar[int]
    END_M_FIELD_NUMBER: _ClassVar[int]
    CELL_FIELD_NUMBER: _ClassVar[int]
    SECTOR_FIELD_NUMBER: _ClassVar[int]
    MU_FIELD_NUMBER: _ClassVar[int]
    MU_LOWER_FIELD_NUMBER: _ClassVar[int]
    MU_UPPER_FIELD_NUMBER: _ClassVar[int]
    P_SLIPPERY_FIELD_NUMBER: _ClassVar[int]
    AGE_S_FIELD_NUMBER: _ClassVar[int]
    BASIS_FIELD_NUMBER: _ClassVar[int]
    SAFE_SPEED_FIELD_NUMBER: _ClassVar[int]
    vehicle: str
    time: int
    way: str
    warnings: _containers.RepeatedCompositeFieldContainer[Warning]
    here_mu: float
    here_mu_lower: float
    here_mu_upper: float
    start_m: _containers.RepeatedScalarFieldContainer[float]
    end_m: _containers.RepeatedScalarFieldContainer[float]
    cell: _containers.RepeatedScalarFieldContainer[int]
    sector: _containers.RepeatedScalarFieldContainer[int]
    mu: _containers.RepeatedScalarFieldContainer[float]
    mu_lower: _containers.RepeatedScalarFieldContainer[float]
    mu_upper: _containers.RepeatedScalarFieldContainer[float]
    p_slippery: _containers.RepeatedScalarFieldContainer[float]
    age_s: _containers.RepeatedScalarFieldContainer[float]
    basis: _containers.RepeatedScalarFieldContainer[Basis]
    safe_speed: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, vehicle: _Optional[str] = ..., time: _Optional[int] = ..., way: _Optional[str] = ..., warnings: _Optional[_Iterable[_Union[Warning, _Mapping]]] = ..., here_mu: _Optional[float] = ..., here_mu_lower: _Optional[float] = ..., here_mu_upper: _Optional[float] = ..., start_m: _Optional[_Iterable[float]] = ..., end_m: _Optional[_Iterable[float]] = ..., cell: _Optional[_Iterable[int]] = ..., sector: _Optional[_Iterable[int]] = ..., mu: _Optional[_Iterable[float]] = ..., mu_lower: _Optional[_Iterable[float]] = ..., mu_upper: _Optional[_Iterable[float]] = ..., p_slippery: _Optional[_Iterable[float]] = ..., age_s: _Optional[_Iterable[float]] = ..., basis: _Optional[_Iterable[_Union[Basis, str]]] = ..., safe_speed: _Optional[_Iterable[float]] = ...) -> None: ...

class Weather(_message.Message):
    __slots__ = ("time", "air_temperature", "road_temperature", "precipitation", "prior")
    TIME_FIELD_NUMBER: _ClassVar[int]
    AIR_TEMPERATURE_FIELD_NUMBER: _ClassVar[int]
    ROAD_TEMPERATURE_FIELD_NUMBER: _ClassVar[int]
    PRECIPITATION_FIELD_NUMBER: _ClassVar[int]
    PRIOR_FIELD_NUMBER: _ClassVar[int]
    time: int
    air_temperature: float
    road_temperature: float
    precipitation: float
    prior: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, time: _Optional[int] = ..., air_temperature: _Optional[float] = ..., road_temperature: _Optional[float] = ..., precipitation: _Optional[float] = ..., prior: _Optional[_Iterable[float]] = ...) -> None: ...
