"""Sample loop of all filters from papers. For each sample it checks the readings, begins or steps
the filter, and writes the estimates.

The module of each paper defines a record for its filter (`PaperMemory` with further fields) and
three compiled functions: begin, step and report. From these functions, `kernel_of` builds the
function ("kernel") that an estimator bank calls.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated, TypeVar

from edge_agent.dynamics.parameters import Parameter, parameter_table
from edge_agent.estimators import flags
from edge_agent.estimators.bank import Kernel, Part
from edge_agent.estimators.common.inputs import InputTrack, SampleUse, take_sample_in
from edge_agent.estimators.common.motion import sliding_flag
from edge_agent.estimators.common.output import write_quality, write_unknown
from edge_agent.estimators.common.tyre_option import TyreOption, fit_tyres
from edge_agent.estimators.estimates import Column
from schemas.numeric import FloatArray
from schemas.runtime.jit import nogil
from schemas.runtime.records import RecordArray, Records, records
from schemas.vehicle import Vehicle


class PaperMemory:
    """Fields common to the filter records of all papers. A record keeps the state of one vehicle's
    filter between samples.
    """

    row: Annotated[FloatArray, len(Parameter)]  # parameters of the vehicle
    track: InputTrack
    nis: float  # normalised squared innovation, mean over the measurements
    log_likelihood: float  # [nat] of the sample's measurements
    adaptation: float  # [1] largest factor on R


Memory = TypeVar("Memory", bound=PaperMemory)
Context = TypeVar("Context")


def kernel_of(
    begin: Callable[[Memory, Context], None],
    step: Callable[[Memory, Context, float], bool],
    report: Callable[[Memory, Context, FloatArray], float],
) -> Kernel:
    """Return the compiled function (kernel) that `EstimatorBank` calls to process samples with a
    filter.

    Args:
        begin: starts the filter at the current sample, which is in memory.track.
        step: advances the filter by the given seconds to the current sample; returns False if the
            filter has diverged.
        report: writes motion and friction into the output; returns the friction [1] with which the
            loop decides whether a wheel slides.
    """

    @nogil
    def advance_filters(
        filters: Records[Memory],
        contexts: Records[Context],
        t: FloatArray,
        signals: FloatArray,
        outputs: FloatArray,
        part: Part,
    ) -> None:
        share, first, last = part
        context = contexts[share]
        for n in range(first, last):
            memory = filters[n]
            for k in range(t.shape[0]):
                output = outputs[k, n]
                memory.log_likelihood = 0.0
                health, kind, dt = take_sample_in(memory.track, memory.row, t[k, n], signals[k, n])
                if kind == SampleUse.STEPPED and not step(memory, context, dt):
                    health = health | flags.RESET
                    kind = SampleUse.BEGUN
                if kind == SampleUse.BEGUN:
                    memory.nis = 0.0
                    memory.log_likelihood = 0.0
                    memory.adaptation = 1.0
                    begin(memory, context)
                if memory.track.started:
                    mu = report(memory, context, output)
                    write_quality(
                        output,
                        memory.track.excitation.largest,
                        memory.nis,
                        memory.adaptation,
                        memory.log_likelihood,
                    )
                    health |= sliding_flag(
                        memory.row, memory.track, output[Column.VX], output[Column.VY], mu
                    )
                else:
                    write_unknown(output)
                output[Column.HEALTH] = health

    return advance_filters


def new_filters(
    kind: type[PaperMemory], vehicles: Sequence[Vehicle], tyre: TyreOption | None = None
) -> RecordArray:
    """Return an array of records of type `kind`, one per vehicle. The field `row` has the vehicle's
    parameters with the tyre model `tyre`.

    All other fields are zero. From this, the compiled function recognises that no sample has been
    processed.
    """
    filters = records(kind, len(vehicles))
    filters["row"] = parameter_table(vehicles)
    fit_tyres(filters, TyreOption() if tyre is None else tyre)
    return filters
