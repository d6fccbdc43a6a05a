"""Matplotlib figure that a notebook shows as a picture if the figure is the result of a cell."""

from __future__ import annotations

from io import BytesIO
from typing import Final

from matplotlib.figure import Figure

DPI: Final = 80


class NotebookFigure(Figure):
    """Matplotlib figure that notebooks can show as a picture. Ordinary figures that are made
    without `pyplot` lack the method `_repr_png_`, which notebooks call.
    """

    def _repr_png_(self) -> bytes:
        """Return the figure as PNG; IPython calls this method."""
        file = BytesIO()
        self.savefig(file, format="png", dpi=DPI)
        return file.getvalue()
