"""Jobs in this process and in several: order, errors of one job, a process that dies."""

from __future__ import annotations

import os
from dataclasses import dataclass

import pytest

from diffcloud.errors import ConfigError, DiffCloudError
from pipeline.workers import Tell, run_all


@dataclass(frozen=True)
class Square:
    """Squares a number; 3 is an error, 7 kills the process."""

    number: int
    luggage: bytes = b""

    @property
    def label(self) -> str:
        return str(self.number)

    def run(self, tell: Tell) -> int:
        tell(0.5, "half")
        if self.number == 3:
            raise ConfigError("not 3")
        if self.number == 7:
            os._exit(1)
        return self.number**2


@pytest.mark.parametrize("workers", [1, 2])
def test_results_come_in_order_and_an_error_stops_no_other(workers):
    jobs = [Square(number) for number in (1, 2, 3, 4)]
    assert list(run_all("squares", jobs, workers)) == [
        (jobs[0], 1, None),
        (jobs[1], 4, None),
        (jobs[2], None, "not 3"),
        (jobs[3], 16, None),
    ]


@pytest.mark.parametrize("luggage", [b"", bytes(10_000_000)], ids=["light", "heavy"])
def test_a_process_that_dies_is_an_error(luggage):
    """Also where the other jobs are too large to wait in a pipe."""
    with pytest.raises(DiffCloudError, match="A worker process died"):
        list(run_all("squares", [Square(number, luggage) for number in (7, 1, 2, 4, 5, 6)], 2))
