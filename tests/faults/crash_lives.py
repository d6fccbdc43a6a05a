"""Histories of an archive on a disk with power loss. A history consists of a few lives (runs of the
program). Each life except the last ends by power loss at a random operation, and the next life
starts from the surviving files.
"""

from __future__ import annotations

import random
from abc import ABC, abstractmethod
from contextlib import suppress
from pathlib import Path
from typing import ClassVar, Generic, TypeVar

from tests.faults.crash_disk import CrashDisk, PowerLoss

BatchType = TypeVar("BatchType")


class Lives(ABC, Generic[BatchType]):
    """Simulated history of an archive in an empty folder. A history consists of several lives (runs
    of the program), which power losses separate.

    Args:
        number: number of the history; it is the seed of all random choices.
        folder: folder of the history.

    Attributes:
        lives: number of lives (runs of the program) in the history.
        operations: largest number of operations before the power loss.
        full_after: largest number of operations before the disk is full for a short time.
        acknowledged: batches that were acknowledged.
        at_stake: number of batches that were acknowledged before a power loss and might therefore
            have been lost.
    """

    lives: ClassVar[int]
    operations: ClassVar[int]
    full_after: ClassVar[int]

    def __init__(self, number: int, folder: Path) -> None:
        self.random = random.Random(number)
        self.folder = folder
        self.acknowledged: set[BatchType] = set()
        self.at_stake = 0

    def find_violations(self) -> list[str]:
        """Run the program several times on the same archive, with a power loss after each run
        except the last. Return a message for each broken promise, such as a lost acknowledged row.
        """
        live = self.folder / "life-0"
        live.mkdir()
        found: list[str] = []
        for life in range(self.lives):
            last = life == self.lives - 1
            start = self.random.randint(0, self.full_after)
            full = range(start, start + self.random.choice((0, 0, 3, 10)))
            power = None if last else self.random.randint(0, self.operations)
            disk = CrashDisk(live, self.random, power, range(0) if last else full)
            with disk.intercept_calls(), suppress(PowerLoss):
                self._run_life(live, last)
            if not last:
                self.at_stake = len(self.acknowledged)
                live = self.folder / f"life-{life + 1}"
                disk.write_image(live)
            found += [f"life {life}: {problem}" for problem in self._find_problems(live, last)]
            self._pass_time()
        return found

    @abstractmethod
    def _run_life(self, root: Path, last: bool) -> None:
        """Run the program on the archive in the folder `root` of the simulated disk, until the
        power fails. In the `last` life (run of the program) the power does not fail.
        """

    @abstractmethod
    def _find_problems(self, root: Path, last: bool) -> list[str]:
        """Read the archive as the next life (run of the program) finds it. Return a message for
        each error in it. After the `last` life, every batch must be present.
        """

    def _pass_time(self) -> None:
        """Change the archive between two lives (runs of the program), for example by letting days
        pass or by an operator's erasure.
        """
