"""Test of the shared loop of the papers' filters: a process must reuse the machine code that an
earlier process compiled.
"""

from __future__ import annotations

import subprocess
import sys

import pytest

WORDS = """
import numpy as np
from edge_agent.estimators import sr_ukf
from edge_agent.lab.simulation.presets import PRESETS
from schemas.signals import CHANNELS
bank = sr_ukf.make_bank([PRESETS["sedan"].vehicle])
bank.advance(np.zeros((1, 1)), np.zeros((1, 1, len(CHANNELS))))
print(sum(sr_ukf.KERNEL.stats.cache_hits.values()))
"""


@pytest.mark.campaign
def test_a_new_process_finds_the_kernel_that_another_has_compiled() -> None:
    for process in range(2):
        out = subprocess.run(
            [sys.executable, "-c", WORDS], check=True, capture_output=True, text=True
        ).stdout
        assert process == 0 or out.strip() == "1"
