"""The fuzzy sets of the adaptation as numbers that can be stored, tuned and refused.

Legend
    mismatch    actual over theoretical innovation variance, minus 1 [1]; 0 when R is right, -1 is its lower end
    inputs      peaks of the five triangular sets: much smaller, smaller, equal, larger, much larger (5,)
    outputs     log of the multiplier on R that each set asks for [nat] (5,)
    ln_scales   log of the nominal R relative to the table of constants: wheel speed rows, axle rows [nat] (2,)

Neighbouring triangles meet at each other's peaks, so memberships of a mismatch sum to one and the range is covered.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from schemas.errors import InputError
from schemas.numeric import FloatArray

SETS = 5
CHANNELS = 2  # wheel speed against force; axle slip against lateral force
LARGEST_MISMATCH = 20.0
LARGEST_STEP = 0.7  # [nat] a step of adaptation at most doubles R
LARGEST_SCALE = 1.5  # [nat]
CLOSEST = 0.01  # peaks of neighbouring sets stay apart


@dataclass(frozen=True)
class Memberships:
    """Vertices of the fuzzy sets and the noise scales tuned with them.

    Raises:
        InputError: a vertex is not finite, out of order or out of range; names the field.
    """

    inputs: tuple[float, ...] = (-0.8, -0.4, 0.0, 1.0, 4.0)
    outputs: tuple[float, ...] = (-0.10, -0.04, 0.0, 0.06, 0.20)
    ln_scales: tuple[float, ...] = (0.0, 0.0)

    def __post_init__(self) -> None:
        for name, length in (("inputs", SETS), ("outputs", SETS), ("ln_scales", CHANNELS)):
            value = np.asarray(getattr(self, name), float)
            if value.shape != (length,) or not np.isfinite(value).all():
                raise InputError(f"memberships.{name}", "not a list of finite numbers", f"give {length} numbers")
        if np.any(np.diff(self.inputs) < CLOSEST) or self.inputs[0] < -1.0 or self.inputs[-1] > LARGEST_MISMATCH:
            raise InputError(
                "memberships.inputs",
                "not rising inside the range of the mismatch",
                f"order them in [-1, {LARGEST_MISMATCH:g}]",
            )
        if np.any(np.diff(self.outputs) < 0.0) or max(map(abs, self.outputs)) > LARGEST_STEP:
            raise InputError(
                "memberships.outputs",
                "not rising within a step: R must grow where the actual innovation exceeds the theoretical",
                f"order them in [-{LARGEST_STEP:g}, {LARGEST_STEP:g}]",
            )
        if self.outputs[0] > 0.0 or self.outputs[-1] < 0.0:
            raise InputError("memberships.outputs", "must shrink R at one end and grow it at the other", "bracket zero")
        if max(map(abs, self.ln_scales)) > LARGEST_SCALE:
            raise InputError("memberships.ln_scales", "out of range", f"stay within +-{LARGEST_SCALE:g} nat")

    def to_vector(self) -> FloatArray:
        """Free numbers for an optimiser, shape (12,): inputs, outputs, ln_scales."""
        return np.array([*self.inputs, *self.outputs, *self.ln_scales])

    @classmethod
    def from_vector(cls, vector: FloatArray) -> Memberships:
        """The memberships of a vector (12,) within `bounds`; inputs and outputs are sorted first, so all are valid."""
        v = np.asarray(vector, float)
        if v.shape != (2 * SETS + CHANNELS,):
            raise InputError("memberships", f"a vector of {v.shape} numbers", f"give {2 * SETS + CHANNELS}")
        inputs = np.sort(v[:SETS])
        for k in range(1, SETS):
            inputs[k] = max(inputs[k], inputs[k - 1] + 2.0 * CLOSEST)
        outputs = np.sort(v[SETS : 2 * SETS])
        return cls(tuple(map(float, inputs)), tuple(map(float, outputs)), tuple(map(float, v[2 * SETS :])))

    @staticmethod
    def bounds() -> tuple[FloatArray, FloatArray]:
        """Lower and upper ends of the vector, (12,) each: where an optimiser may look."""
        lower = [-0.95, -0.8, -0.3, 0.1, 1.0, -0.4, -0.2, -0.02, 0.0, 0.02, -1.0, -1.0]
        upper = [-0.5, -0.1, 0.3, 2.0, 10.0, -0.02, 0.0, 0.02, 0.3, 0.6, 1.0, 1.0]
        return np.array(lower), np.array(upper)

    def to_json(self) -> dict[str, list[float]]:
        """A plain dictionary for a JSON file."""
        return {"inputs": list(self.inputs), "outputs": list(self.outputs), "ln_scales": list(self.ln_scales)}

    @classmethod
    def from_json(cls, document: object) -> Memberships:
        """The memberships in a parsed JSON document.

        Raises:
            InputError: a field is missing or is not a list of numbers.
        """
        fields: dict[str, tuple[float, ...]] = {}
        for name in ("inputs", "outputs", "ln_scales"):
            value = document.get(name) if isinstance(document, dict) else None
            if not isinstance(value, list) or not all(isinstance(x, int | float) for x in value):
                raise InputError(
                    f"memberships.{name}", "missing or not a list of numbers", "write it with edge-agent tune"
                )
            fields[name] = tuple(float(x) for x in value)
        return cls(**fields)
