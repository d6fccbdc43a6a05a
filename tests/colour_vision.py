"""Distances between colours (CIEDE2000) for four kinds of colour vision: normal, and three
simulated dichromats (Machado et al. 2009).
"""

from __future__ import annotations

from typing import Final

import numpy as np

from schemas.numeric import FloatArray

# Colour vision deficiencies after Machado, Oliveira and Fernandes (2009), table 1, severity 1.0,
# for linear RGB.
SIGHTS: Final[dict[str, FloatArray]] = {
    "normal": np.eye(3),
    "protanopia": np.array(
        [
            [0.152286, 1.052583, -0.204868],
            [0.114503, 0.786281, 0.099216],
            [-0.003882, -0.048116, 1.051998],
        ]
    ),
    "deuteranopia": np.array(
        [
            [0.367322, 0.860646, -0.227968],
            [0.280085, 0.672501, 0.047413],
            [-0.011820, 0.042940, 0.968881],
        ]
    ),
    "tritanopia": np.array(
        [
            [1.255528, -0.076749, -0.178779],
            [-0.078411, 0.930809, 0.147602],
            [0.004733, 0.691367, 0.303900],
        ]
    ),
}
# Matrix from sRGB to XYZ and white point for D65 (IEC 61966-2-1).
_XYZ: Final = np.array(
    [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
)
_WHITE: Final = _XYZ.sum(axis=1)


def to_lab(colour: str, sight: str = "normal") -> FloatArray:
    """Return the CIELAB coordinates (3,) of a colour #rrggbb as seen with a kind of
    colour vision.
    """
    rgb = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255.0
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    seen = np.clip(SIGHTS[sight] @ linear, 0.0, 1.0)
    ratio = _XYZ @ seen / _WHITE
    f = np.where(ratio > (6 / 29) ** 3, np.cbrt(ratio), ratio / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def colour_difference(first: FloatArray, second: FloatArray) -> float:
    """Return the CIEDE2000 difference of two CIELAB colours (Sharma, Wu and Dalal 2005, eqs. 2 to
    22).
    """
    (l1, a1, b1) = first
    (l2, a2, b2) = second
    seven = (np.hypot(a1, b1) + np.hypot(a2, b2)) ** 7 / 2.0**7
    g = 0.5 * (1 - np.sqrt(seven / (seven + 25.0**7)))
    a1 = (1 + g) * a1
    a2 = (1 + g) * a2
    c1 = np.hypot(a1, b1)
    c2 = np.hypot(a2, b2)
    h1, h2 = (np.degrees(np.arctan2(b, a)) % 360 for a, b in ((a1, b1), (a2, b2)))
    grey = c1 * c2 == 0
    turn = 0.0 if grey else (h2 - h1 + 180) % 360 - 180
    dl = l2 - l1
    dc = c2 - c1
    dh = 2 * np.sqrt(c1 * c2) * np.sin(np.radians(turn / 2))
    light = (l1 + l2) / 2
    chroma = (c1 + c2) / 2
    hue = h1 + h2 if grey else (h1 + turn / 2) % 360
    t = (
        1
        - 0.17 * np.cos(np.radians(hue - 30))
        + 0.24 * np.cos(np.radians(2 * hue))
        + 0.32 * np.cos(np.radians(3 * hue + 6))
        - 0.20 * np.cos(np.radians(4 * hue - 63))
    )
    turned = 30 * np.exp(-(((hue - 275) / 25) ** 2))
    rotation = -2 * np.sqrt(chroma**7 / (chroma**7 + 25.0**7)) * np.sin(np.radians(2 * turned))
    sl = 1 + 0.015 * (light - 50) ** 2 / np.sqrt(20 + (light - 50) ** 2)
    sc = 1 + 0.045 * chroma
    sh = 1 + 0.015 * chroma * t
    x = dl / sl
    y = dc / sc
    z = dh / sh
    return float(np.sqrt(x * x + y * y + z * z + rotation * y * z))
