"""The findings (faults) of the signal doctor as text lines for a terminal, and as one
self-contained HTML page with plots. The signal doctor is an automatic check of the signals.
"""

from __future__ import annotations

from dataclasses import asdict
from html import escape
from typing import Final

import numpy as np

from edge_agent.inputs.doctor.diagnosis import Diagnosis
from edge_agent.inputs.doctor.identities import Fit
from schemas.numeric import FloatArray

AXES: Final = {
    "lateral": ("v · yaw rate [m/s²]", "ay [m/s²]"),
    "longitudinal": ("dv/dt of the wheels [m/s²]", "ax [m/s²]"),
    "steering": ("L · yaw rate [m/s]", "v · delta [m/s]"),
    "axle": ("yaw rate [rad/s]", "of the wheels [rad/s]"),
    "ground": ("speed of the wheels [m/s]", "speed over ground [m/s]"),
    "turning": ("yaw rate [rad/s]", "of the course [rad/s]"),
}
# Properties of a fitted identity in the machine-readable report.
SHOWN: Final = (
    "gain",
    "offset",
    "correlation",
    "lag_s",
    "excited_s",
)
POINTS: Final = 600
SIDE: Final = 260  # width and height of a plot [pixel]
EDGE: Final = 36
STYLE: Final = (
    "body{font:15px/1.5 system-ui,sans-serif;max-width:60em;margin:2em auto;padding:0 "
    "1em;color:#222}"
    "table{border-collapse:collapse;margin-bottom:1.5em}td,th{padding:.2em .8em;border-bottom:1px "
    "solid #ddd;text-align:left}"
    "figure{display:inline-block;margin:.5em}figcaption{font-size:13px;color:#555}"
    ".bad{color:#b00020}"
)


def report_lines(diagnosis: Diagnosis) -> list[str]:
    """Return the diagnosis of a log as text lines: one for each fault, each unknown channel, each
    measured lag and each channel without fault.
    """
    lines = [f"{'FAULT':<8} {f.channel:<10} {f.kind:<24} {f.words}" for f in diagnosis.findings]
    lines += [
        f"{'unknown':<8} {channel:<10} this drive gives no evidence"
        for channel in diagnosis.unknown
    ]
    lines += [
        f"{'lag':<8} {name:<10} {lag:+.3f} s behind the inertial unit"
        for name, lag in diagnosis.lags.items()
    ]
    lines += [
        f"{'note':<8} {'omega':<10} the {axle} wheels turn as one: locked differential?"
        for axle in diagnosis.locked
    ]
    return [*lines, *(f"{'sound':<8} {channel}" for channel in diagnosis.sound)]


def report_document(diagnosis: Diagnosis) -> dict[str, object]:
    """Return the diagnosis of a log as a JSON-compatible document for programs. To correct a
    channel, a program applies scale, offset and delay of its finding (fault), in this order.
    """
    return {
        "passed": diagnosis.is_passed,
        "advice": publishing_advice(diagnosis),
        "sound": diagnosis.sound,
        "unknown": diagnosis.unknown,
        "lags_s": {name: round(lag, 4) for name, lag in diagnosis.lags.items()},
        "findings": [
            {name: _finite_or_none(value) for name, value in asdict(finding).items()}
            for finding in diagnosis.findings
        ],
        "identities": {
            name: {field: _finite_or_none(getattr(fit, field)) for field in SHOWN}
            for name, fit in diagnosis.fits.items()
        },
    }


def _finite_or_none(value: object) -> object:
    return None if isinstance(value, float) and not np.isfinite(value) else value


def publishing_advice(diagnosis: Diagnosis) -> str:
    """Return one line with the verdict of the signal doctor (automatic check of the signals). The
    line states that the log may be published, or lists the steps that are necessary before.
    """
    if diagnosis.is_passed:
        return "passed: units, signs, clocks and offsets agree with each other"
    if diagnosis.findings:
        return "not passed: correct the profile (--fix writes it), import again"
    return (
        "not passed: drive half a minute with turns and some braking, or publish the log unchecked "
        "with edge-agent replay --publish --trust"
    )


def report_page(diagnosis: Diagnosis, title: str) -> str:
    """Return an HTML page with the verdict on a log, the findings (faults), and a plot of each
    identity (two quantities that are equal by physics). `title` is the title of the page.
    """
    rows = [
        f"<tr class='bad'><td>{escape(f.channel)}<td>{escape(f.kind)}<td>{escape(f.words)}"
        for f in diagnosis.findings
    ]
    rows += [
        f"<tr><td>{escape(channel)}<td>unknown<td>this drive gives no evidence"
        for channel in diagnosis.unknown
    ]
    rows += [f"<tr><td>{escape(channel)}<td>sound<td>" for channel in diagnosis.sound]
    plots = "".join(
        _scatter_plot(name, fit) for name, fit in diagnosis.fits.items() if len(fit.right)
    )
    return (
        f"<!doctype html><meta charset='utf-8'><title>{escape(title)}</title><style>{STYLE}</style>"
        f"<h1>{escape(title)}</h1><p>{escape(publishing_advice(diagnosis))}</p>"
        f"<table><tr><th>channel<th>finding<th>evidence{''.join(rows)}</table>"
        f"{_identity_table(diagnosis.fits)}<p>Each plot compares two quantities that are equal by "
        f"physics, without offset. Grey line: equal; red line: as recorded.</p>{plots}\n"
    )


def _identity_table(fits: dict[str, Fit]) -> str:
    rows = [
        f"<tr><td>{name}<td>{fit.gain:.3g}<td>{fit.offset:.3g}<td>{fit.correlation:.2f}"
        f"<td>{fit.excited_s:.0f}<td>{fit.lag_s:+.2f} ± {fit.lag_error_s:.2f}"
        for name, fit in fits.items()
        if len(fit.right)
    ]
    return (
        "<table><tr><th>identity<th>gain<th>offset<th>correlation<th>excited [s]<th>lag "
        f"[s]{''.join(rows)}</table>"
    )


def _scatter_plot(name: str, fit: Fit) -> str:
    """Return an SVG scatter plot of both sides of an identity, with the ideal relation (grey) and
    the measured relation (red).
    """
    step = max(1, len(fit.right) // POINTS)
    x = fit.right[::step]
    y = fit.left[::step]
    low = float(np.percentile(x, 0.5))
    high = float(np.percentile(x, 99.5))
    bottom = float(np.percentile(y, 0.5))
    top = float(np.percentile(y, 99.5))
    if not (high > low and top > bottom):
        return ""

    def points_at(across: FloatArray, up: FloatArray) -> list[str]:
        right = EDGE + (across - low) / (high - low) * (SIDE - 2 * EDGE)
        down = SIDE - EDGE - (up - bottom) / (top - bottom) * (SIDE - 2 * EDGE)
        return [
            f"{px:.0f},{py:.0f}"
            for px, py in zip(np.clip(right, 0, SIDE), np.clip(down, 0, SIDE), strict=True)
        ]

    dots = "".join(
        f"<circle cx='{p.split(',')[0]}' cy='{p.split(',')[1]}' r='1.3'/>" for p in points_at(x, y)
    )
    ends = np.array([low, high])
    law = " ".join(points_at(ends, ends))
    found = " ".join(points_at(ends, fit.gain * ends))
    across, up = AXES[name]
    return (
        f"<figure><svg width='{SIDE}' height='{SIDE}' viewBox='0 0 {SIDE} {SIDE}' role='img'>"
        f"<g fill='#3465a4' fill-opacity='.5'>{dots}</g>"
        f"<polyline points='{law}' stroke='#999' fill='none'/><polyline points='{found}' "
        "stroke='#b00020' fill='none'/>"
        f"<text x='{SIDE / 2}' y='{SIDE - 8}' font-size='12' text-anchor='middle'>{across}</text>"
        f"<text x='12' y='{SIDE / 2}' font-size='12' text-anchor='middle' "
        f"transform='rotate(-90 12 {SIDE / 2})'>{up}</text>"
        f"</svg><figcaption>{name}: gain {fit.gain:.3g} (about 1 is right)</figcaption></figure>"
    )
