"""Parameters of the fuzzy sets that adapt the measurement noise R, with conversions for files and
optimisers.

Legend
    mismatch    actual over theoretical innovation variance, minus 1 [1]; 0 if R is right, -1 is
                its smallest value
    inputs      peaks of the five triangular sets: much smaller, smaller, equal, larger, much larger
                (5,)
    outputs     ln of the multiplier on R for each set [nat] (5,)
    ln_scales   ln of the nominal R relative to the table of constants: for wheel speeds and for
                axle forces [nat] (2,)

Each triangle ends at its neighbours' peaks. Therefore the memberships of a mismatch sum to one, and
the sets cover the whole range.

The other fields belong to the rules of the default estimator (`rule_base.py`):

    shares      ln of the share of a block's evidence on friction that is used [nat]: one value
                for each combination of three inputs (12,)
    strained    term added to `shares` if the estimated states of the car are far from their
                prior [nat] (2,): while no wheel slides, and while a wheel slides

The inputs of `shares` are a wheel's slide (no, yes), the force over load (low, middle, high) and
the change of forces (unchanged, changed). The last input varies fastest in the list.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from schemas.errors import InputError
from schemas.numeric import FloatArray

MISMATCH_PEAKS = (-0.8, -0.4, 0.0, 1.0, 4.0)  # [1] upper vertices of the fuzzy sets of the mismatch
STEP_PEAKS = (-0.10, -0.04, 0.0, 0.06, 0.20)  # [nat] upper vertices of the fuzzy sets of the step
SETS = len(MISMATCH_PEAKS)
CHANNELS = 2  # groups of measurements: wheels (longitudinal), axles (lateral)
LARGEST_MISMATCH = 20.0  # [1] limit of `inputs`
LARGEST_STEP = math.log(2.0)  # [nat] limit of `outputs`: one adaptation at most doubles R
# [nat] limit of `ln_scales`, and of an increase of ln R by adaptation
LARGEST_SCALE = 2.5
NOISE = 2 * SETS + CHANNELS  # number of parameters that concern R alone
LENGTHS = {
    "inputs": SETS,
    "outputs": SETS,
    "ln_scales": CHANNELS,
    "shares": 12,
    "strained": 2,
}
# Fields of older files, which are ignored
RETIRED = ("stretched", "lately", "far", "consequents")
LEAST_SHARE = -8.0  # [nat] smallest ln of a share of evidence
SHARE_REACH = 1.5  # [nat] largest change of `shares` and `strained` by an optimiser
CLOSEST = 0.01  # [1] smallest distance of neighbouring peaks, and smallest overlap of two sets


def _require(is_valid: bool | np.bool_, field: str, problem: str, fix: str) -> None:
    """Raise an InputError about a field of the memberships if it is not valid."""
    if not is_valid:
        raise InputError(f"memberships.{field}", problem, fix)


@dataclass(frozen=True)
class Memberships:
    """Vertices (corners) of the fuzzy sets, and the scales of measurement noise that are tuned with
    them.

    Raises:
        InputError: a vertex is not finite, out of order or out of range; the error names the field.
    """

    inputs: tuple[float, ...] = MISMATCH_PEAKS
    outputs: tuple[float, ...] = STEP_PEAKS
    ln_scales: tuple[float, ...] = (0.0, 0.0)
    shares: tuple[float, ...] = (
        -5.0,
        -3.1,
        -2.6,
        0.0,
        -0.7,
        0.0,
        -5.0,
        -1.6,
        -2.6,
        0.0,
        -1.0,
        0.0,
    )
    strained: tuple[float, ...] = (-0.9, -0.4)

    def __post_init__(self) -> None:
        for name, length in LENGTHS.items():
            value = np.asarray(getattr(self, name), float)
            is_complete = value.shape == (length,) and np.isfinite(value).all()
            _require(is_complete, name, "not a list of finite numbers", f"give {length} numbers")
        _require(
            np.all(np.diff(self.inputs) >= CLOSEST)
            and self.inputs[0] >= -1.0
            and self.inputs[-1] <= LARGEST_MISMATCH,
            "inputs",
            "not rising inside the range of the mismatch",
            f"order them in [-1, {LARGEST_MISMATCH:g}]",
        )
        _require(
            np.all(np.diff(self.outputs) >= 0.0) and max(map(abs, self.outputs)) <= LARGEST_STEP,
            "outputs",
            "not rising within a step: R must grow where the actual innovation exceeds the "
            "theoretical",
            f"order them in [-{LARGEST_STEP:g}, {LARGEST_STEP:g}]",
        )
        _require(
            self.outputs[0] <= 0.0 <= self.outputs[-1],
            "outputs",
            "must shrink R at one end and grow it at the other",
            "bracket zero",
        )
        is_in_range = max(map(abs, self.ln_scales)) <= LARGEST_SCALE
        _require(is_in_range, "ln_scales", "out of range", f"stay within +-{LARGEST_SCALE:g} nat")
        for name in ("shares", "strained"):
            is_in_range = all(LEAST_SHARE <= value <= 0.0 for value in getattr(self, name))
            _require(is_in_range, name, "out of range", f"stay within {LEAST_SHARE:g} and 0 nat")

    def to_vector(self) -> FloatArray:
        """Return the parameters of the fuzzy sets as a vector (26,) for an optimiser: all fields,
        one after the other.
        """
        return np.array([number for name in LENGTHS for number in getattr(self, name)])

    @classmethod
    def from_vector(cls, vector: FloatArray) -> Memberships:
        """Convert the vector (26,) of an optimiser to memberships (fuzzy sets). The vector must lie
        within `bounds`.

        The function sorts the peaks `inputs` and the levels `outputs`, so every vector within the
        bounds is valid. A vector (12,) contains only the fields up to `ln_scales`; the other fields
        keep their untuned values.
        """
        v = np.asarray(vector, float)
        if v.shape == (NOISE,):
            v = np.append(v, cls().to_vector()[NOISE:])
        if v.shape != (sum(LENGTHS.values()),):
            raise InputError(
                "memberships", f"the vector has {v.shape} numbers", f"give {sum(LENGTHS.values())}"
            )
        inputs = np.sort(v[:SETS])
        for k in range(1, SETS):
            inputs[k] = max(inputs[k], inputs[k - 1] + 2.0 * CLOSEST)
        outputs = np.sort(v[SETS : 2 * SETS])
        fields = {"inputs": inputs, "outputs": outputs}
        first = 0
        for name, length in LENGTHS.items():
            fields.setdefault(name, v[first : first + length])
            first += length
        return cls(**{name: tuple(map(float, value)) for name, value in fields.items()})

    @staticmethod
    def bounds() -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper limits of the optimiser's vector, (26,) each."""
        lower = [-0.95, -0.8, -0.3, 0.1, 1.0, -0.4, -0.2, -0.02, 0.0, 0.02, -0.1, -0.1]
        upper = [-0.5, -0.1, 0.3, 2.0, 10.0, -0.02, 0.0, 0.02, 0.3, 0.6, 0.1, 0.1]
        for value in (*Memberships.shares, *Memberships.strained):
            lower.append(max(value - SHARE_REACH, LEAST_SHARE))
            upper.append(min(value + SHARE_REACH, 0.0))
        return np.array(lower), np.array(upper)

    def to_json(self) -> dict[str, list[float]]:
        """Return the memberships as a dictionary for a JSON file."""
        return {name: list(getattr(self, name)) for name in LENGTHS}

    @classmethod
    def from_json(cls, document: object) -> Memberships:
        """Read the memberships from a parsed JSON document, and return them. If the document has no
        rules, the untuned rules are used.

        Raises:
            InputError: a field is missing or is not a list of numbers.
        """
        fields: dict[str, tuple[float, ...]] = {}
        for name in LENGTHS:
            value = document.get(name) if isinstance(document, dict) else None
            if value is None and name not in ("inputs", "outputs", "ln_scales"):
                continue
            if not isinstance(value, list) or not all(isinstance(x, int | float) for x in value):
                raise InputError(
                    f"memberships.{name}",
                    "missing or not a list of numbers",
                    "write the file with edge-agent tune",
                )
            fields[name] = tuple(float(x) for x in value)
        return cls(**fields)
