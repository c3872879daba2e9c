"""Jobs in this process and in several: order, errors of one job, a process that dies."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from dataclasses import dataclass

import psutil
import pytest

import diffcloud.jobs.fork_server
import diffcloud.jobs.pool
from diffcloud.errors import ConfigError, DiffCloudError
from diffcloud.jobs.fork_server import asked_workers
from diffcloud.jobs.pool import Tell, run_all
from diffcloud.jobs.settings import load_config


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


def test_workers_end_with_a_process_that_is_killed(tmp_path):
    script = tmp_path / "killed.py"
    script.write_text(
        "import os, time\n"
        "from dataclasses import dataclass\n"
        "from diffcloud.jobs.pool import run_all\n"
        "@dataclass(frozen=True)\n"
        "class Endless:\n"
        "    label = 'endless'\n"
        "    def run(self, tell):\n"
        "        os.write(1, b'%d\\n' % os.getpid())\n"  # at once: print writes the end of a line apart
        "        time.sleep(600)\n"
        "if __name__ == '__main__':\n"
        "    list(run_all('endless', [Endless(), Endless()], 2))\n"
    )
    with subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True) as process:
        try:
            workers = [psutil.Process(int(process.stdout.readline())) for _ in range(2)]
            servers = {worker.parent() for worker in workers}
        finally:
            process.kill()
    _, alive = psutil.wait_procs([*workers, *servers], timeout=30)
    assert not alive


@pytest.mark.parametrize(
    ("arguments", "count"),
    [
        (["fit", "e.npz", "--workers", "2"], 2),
        (["fit", "--workers=3", "e.npz"], 3),
        (["fit", "--params", "params.yaml"], 4),
        (["fit", "e.npz"], 1),
        (["train", "--params=params.yaml"], 4),
        (["fit", "--params", "params.yaml", "--workers", "1"], 1),
        (["fit", "--workers"], 1),
        (["fit", "--workers", "many"], 1),
    ],
)
def test_the_server_of_workers_begins_where_the_command_line_asks_for_several(monkeypatch, arguments, count):
    monkeypatch.setattr(diffcloud.jobs.fork_server, "cores", lambda: 4)
    assert asked_workers(arguments) == count


@pytest.mark.skipif(sys.platform != "linux", reason="workers are spawned elsewhere")
def test_workers_have_imported_what_their_command_needs_and_no_interrupt_reaches_them(tmp_path):
    """In a process of its own: a server lasts as long as the process that began it."""
    script = tmp_path / "begins.py"
    script.write_text(
        "import sys, signal\n"
        "from concurrent.futures import ProcessPoolExecutor\n"
        "from diffcloud.jobs.fork_server import begin_importing, worker_context\n"
        "def told():\n"
        "    return 'diffcloud.jobs.fits' in sys.modules, signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, [])\n"
        "if __name__ == '__main__':\n"
        "    begin_importing('diffcloud.jobs.fits', ['fit', '--workers', '2'])\n"
        "    with ProcessPoolExecutor(1, mp_context=worker_context()) as pool:\n"
        "        print(*pool.submit(told).result(), signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, []))\n"
    )
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout.split() == ["True", "True", "False"]


def test_by_default_there_is_a_worker_for_each_core(monkeypatch):
    """A process of its own each, as the machine has cores; with one core, this process."""
    for count in (1, 3):
        monkeypatch.setattr(diffcloud.jobs.pool, "cores", lambda count=count: count)
        found = {pid for _, pid, _ in run_all("processes", [Process(seconds=0.3) for _ in range(6)], None)}
        assert (found == {os.getpid()}) == (count == 1)
        assert len(found) <= count


@dataclass(frozen=True)
class Process:
    """Tells its process."""

    seconds: float
    label: str = "process"

    def run(self, tell: Tell) -> int:
        time.sleep(self.seconds)
        return os.getpid()


@pytest.mark.parametrize(
    ("section", "name"),
    [*((one, "workers") for one in ("synthesize", "preprocess", "fit", "train", "evaluate")), ("train", "loaders")],
)
def test_a_number_of_workers_is_no_parameter(tmp_path, section, name):
    """It would make a stage stale, and change nothing but the time."""
    path = tmp_path / "params.yaml"
    path.write_text(f"{section}: {{{name}: 2}}\n")
    with pytest.raises(ConfigError, match=f"{section}: .*now only the option --{name}"):
        load_config(path)
