"""Map of cells as one HTML file that needs no network. It can show several maps next to each other
(panels), an animation of frames (maps of several moments), and a colour scale.

It can be used with mouse, touch and keyboard. Unmeasured cells are hatched and have no colour.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from schemas.runtime.palette import GRIP, GRIP_RANGE, SURFACES, UNKNOWN

_TEMPLATE: Final = Path(__file__).with_name("map.html")
Value = float | None


@dataclass(frozen=True)
class Scale:
    """Colour scale of the map.

    Attributes:
        label: label of the scale, with its unit.
        low, high: values at the two ends of the scale.
        ticks: values and their labels.
        dark_is_high: True if large values are dark, False if small values are dark.
        unknown: text for a hatched (unmeasured) place.
    """

    label: str
    low: float
    high: float
    ticks: Sequence[tuple[float, str]]
    dark_is_high: bool = False
    unknown: str = UNKNOWN


GRIP_SCALE: Final = Scale(
    "peak adhesion mu [1], darker is more slippery",
    *GRIP_RANGE,
    [(mu, f"{mu:g} {name}") for name, mu in SURFACES.items()],
)


@dataclass(frozen=True)
class DrawnCells:
    """Rows to draw; each row is drawn as one or more squares of the map.

    Attributes:
        boxes: west, south, east, north [deg] of each square.
        row_of_box: for each square, the index of its row; None if every row has one square.
        sector: heading sector of each row: 0 east, 1 north, 2 west, 3 south.
        panels: for each panel (map), its name and one value per row; None means 'not measured'.
        names: labels of the texts that the page shows about a row when its place is selected.
        rows: texts of each row, in the order of `names`.
        frames: label of each frame; a frame is the map at one moment of an animation.
        frame: for each row, the index of its frame; None if there is only one frame.
        lasting: for each row, True if its value will still grow, such as the duration of a slippery
            spell that has not ended.
    """

    boxes: Sequence[Sequence[float]]
    sector: Sequence[int]
    panels: Mapping[str, Sequence[Value]]
    names: Sequence[str]
    rows: Sequence[Sequence[str]]
    row_of_box: Sequence[int] | None = None
    frames: Sequence[str] = ("",)
    frame: Sequence[int] | None = None
    lasting: Sequence[bool] | None = None


def render_page(
    title: str,
    cells: DrawnCells,
    scale: Scale,
    *,
    about: str = "",
    table: Sequence[Sequence[str]] | None = None,
) -> str:
    """Return the HTML page as text. `table` contains the rows of a table below the map; the first
    row is the header.
    """
    data: dict[str, Any] = {
        "title": title,
        "about": about,
        "table": table,
        "scale": {
            "label": scale.label,
            "low": scale.low,
            "high": scale.high,
            "ticks": list(scale.ticks),
            "stops": GRIP[::-1] if scale.dark_is_high else GRIP,
            "unknown": scale.unknown,
        },
        "boxes": cells.boxes,
        "part": cells.row_of_box,
        "sector": cells.sector,
        "panels": [{"name": name, "values": values} for name, values in cells.panels.items()],
        "names": cells.names,
        "rows": cells.rows,
        "frames": cells.frames,
        "frame": cells.frame if cells.frame is not None else [0] * len(cells.sector),
        "lasting": cells.lasting,
    }
    # Without "<", no value can begin or end an HTML tag.
    text = json.dumps(data, allow_nan=False).replace("<", "\\u003c")
    return _TEMPLATE.read_text(encoding="utf-8").replace("/*DATA*/null", text)
