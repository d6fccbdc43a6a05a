"""Figure that a notebook shows as a picture when it is the value of a cell."""

from __future__ import annotations

from io import BytesIO
from typing import Final

from matplotlib.figure import Figure

DPI: Final = 80


class NotebookFigure(Figure):
    """Matplotlib figure with a picture for notebooks. Figures made without `pyplot` have none."""

    def _repr_png_(self) -> bytes:
        """Return the figure as PNG; IPython calls this method."""
        file = BytesIO()
        self.savefig(file, format="png", dpi=DPI)
        return file.getvalue()
