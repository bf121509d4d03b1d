"""Many captures: rows, resuming, limits, claims; a cluster whose workers die, scheduler goes, disk fills."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import psutil
import pytest
import rich.console
from captures import texture_photos
from test_main import call

from avatarbuild.batch import claims, cluster, subject, summary, workers
from avatarbuild.batch.jobs import Job, Outcome, find_captures
from avatarbuild.batch.run import Means, run_batch
from avatarbuild.errors import InputError

ROOT = Path(__file__).parent.parent
SCHEMAS = ROOT / "docs" / "schemas"

# in place of `avatarbuild run`: says when it works on what, and does as the capture's file `do` tells
IMITATION = """
import os, pathlib, sys, threading, time
def end_with_the_batch():
    while os.read(0, 99): pass
    os._exit(1)
threading.Thread(target=end_with_the_batch, daemon=True).start()
capture, project = pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[3])
ledger = project.parent / "ledger"
def note(word):
    with ledger.open("a") as file: file.write(f"{time.time()} {capture.name} {word}\\n")
project.mkdir(exist_ok=True)
if (project / "done").exists(): sys.exit(0)
note("begins")
(project / "avatarbuild.log").write_text("INFO avatarbuild.pipeline: stage capture begins\\n")
what = (capture / "do").read_text().split() if (capture / "do").exists() else []
if "full" in sys.argv[0]:
    print(f"error the disk of {project} is full: free some space and run again", file=sys.stderr)
    note("fails"); sys.exit(2)
if "eat" in what:
    eaten = bytearray(int(what[1]) * 1000000); time.sleep(1.0); note("ends"); sys.exit(0)
if "fault" in what: print("fault ValueError: no", file=sys.stderr); sys.exit(1)
if "die" in what: os.kill(os.getpid(), 9)
time.sleep(float(what[1]) if "sleep" in what else 0.2)
(project / "done").touch()
note("ends")
"""


@pytest.fixture
def imitation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    script = tmp_path / "imitation.py"
    script.write_text(IMITATION)
    monkeypatch.setattr(subject, "COMMAND", (sys.executable, str(script)))
    return script


def made_up(folder: Path, **what: str) -> Path:
    for name, do in what.items():
        (folder / name / "sub").mkdir(parents=True)
        (folder / name / "do").write_text(do)
    return folder


def quiet() -> rich.console.Console:
    return rich.console.Console(file=io.StringIO(), width=300)


def go(folder: Path, output: Path, **means: Any) -> dict[str, summary.Row]:
    return {row.subject: row for row in run_batch(folder, output, [], None, Means(**means), quiet())}


def table(output: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO((output / "summary.csv").read_text())))


def ledger(output: Path) -> list[tuple[float, str, str]]:
    lines = [line.split() for line in (output / "ledger").read_text().splitlines()]
    return [(float(at), name, word) for at, name, word in lines]


def test_a_batch_with_a_bad_capture_resumes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, output = tmp_path / "captures", tmp_path / "out"
    for number, name in enumerate(["Zoë 2", "b10"]):
        texture_photos(folder / name, 8 + number, seed=100 * number)
    (folder / "a nobody").mkdir()
    for passed_over in ("b10.truth", "old.avatar", ".hidden"):
        (folder / passed_over).mkdir()
    words = ["batch", folder, "-o", output, "--until", "capture", "--workers", 2, "--memory", 0.8]
    assert call(monkeypatch, *words, "--json") == 2
    told = json.loads(capsys.readouterr().out)
    jsonschema.validate(told, json.loads((SCHEMAS / "batch.schema.json").read_text()))
    assert (told["subjects"][0]["subject"], told["subjects"][0]["state"]) == ("a nobody", "failed")
    lines = table(output)
    assert [line["subject"] for line in lines] == ["a nobody", "Zoë 2", "b10"]  # fewer photos are worse
    assert "holds no photos" in lines[0]["message"]
    assert [line["photos"] for line in lines[1:]] == ["8", "9"]
    page = (output / "index.html").read_text()
    assert page.count("<img") == 2
    assert "http" not in page

    first = (output / "summary.csv").read_bytes()
    stamps = {path: path.stat().st_mtime_ns for path in output.rglob("stamp.json")}
    assert len(stamps) == 2
    (folder / "a nobody").rmdir()
    assert call(monkeypatch, *words) == 0
    assert {path: path.stat().st_mtime_ns for path in output.rglob("stamp.json")} == stamps
    again = [line for line in (output / "summary.csv").read_bytes().splitlines() if not line.startswith(b"a nobody")]
    assert again == [line for line in first.splitlines() if not line.startswith(b"a nobody")]
    assert not list((output / ".claims").iterdir())


def test_misuse_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    texture_photos(tmp_path / "one", 2)
    (tmp_path / "two" / "photos").mkdir(parents=True)
    (tmp_path / "three").mkdir()
    (tmp_path / "four" / "me").mkdir(parents=True)
    for words, said in (
        ([tmp_path / "one"], "looks like one capture"),
        ([tmp_path / "two"], "looks like one capture"),
        ([tmp_path / "three"], "no sub-folder"),
        ([tmp_path / "nowhere"], "is no folder"),
        ([tmp_path / "four", "--until", "camera"], "no stage 'camera'"),
        ([tmp_path / "four", "--set", "points.windw=6"], "windw"),
        ([tmp_path / "four", "--workers", "0"], "--workers must be"),
        ([tmp_path / "four", "--memory", "0"], "above 0"),
        ([tmp_path / "four", "--scheduler", "tcp://x:1", "--workers", "2"], "give one of the two"),
        ([tmp_path / "four", "--scheduler", "nonsense"], "no Dask scheduler answers"),
    ):
        assert call(monkeypatch, "batch", *words, "-o", tmp_path / "out") == 2
        text = capsys.readouterr().err
        assert said in text, text
        assert "Traceback" not in text
    assert find_captures(tmp_path / "four", tmp_path / "out") == [tmp_path / "four" / "me"]


def test_without_distributed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    job = Job("me", tmp_path, tmp_path / "me.avatar")
    with pytest.raises(InputError, match="pip install"):
        next(cluster.on_cluster([job], "tcp://127.0.0.1:1"))


def test_every_end_has_its_row(tmp_path: Path, imitation: Path) -> None:
    folder = made_up(tmp_path / "in", ok="", slow="sleep 60", bad="fault", gone="die")
    made = go(folder, tmp_path / "out", workers=2, memory=10**9, seconds=3.0)
    assert {name: row.reason for name, row in made.items()} == {
        "ok": "",
        "slow": "time",
        "bad": "fault",
        "gone": "died",
    }
    assert list(made)[-1] == "ok"
    assert "time limit" in made["slow"].message
    assert made["bad"].message == "ValueError: no"
    # what ran out of time goes on next time
    (folder / "slow" / "do").write_text("sleep 0.1")
    again = go(folder, tmp_path / "out", workers=2, memory=10**9, seconds=30.0)
    assert again["slow"].state == "done"
    assert [name for _, name, word in ledger(tmp_path / "out") if word == "ends"] == ["ok", "slow"]


def test_a_run_that_outgrows_its_share_is_tried_alone(
    tmp_path: Path, imitation: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = made_up(tmp_path / "in", small="eat 10", large="eat 300", huge="eat 900", other="sleep 3")
    monkeypatch.setattr(workers, "free_memory", lambda: 600_000_000)
    made = go(folder, tmp_path / "out", workers=2, memory=150_000_000)
    assert {name: row.reason for name, row in made.items()} == {"small": "", "large": "", "other": "", "huge": "memory"}
    assert "share of memory" in made["huge"].message
    events = ledger(tmp_path / "out")
    began = [at for at, name, word in events if name == "large" and word == "begins"]
    assert len(began) == 2
    assert began[1] > max(at for at, name, word in events if name in ("small", "other") and word == "ends")


def test_no_more_workers_than_memory_allows(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.setattr(workers, "free_memory", lambda: 20_000_000_000)
    monkeypatch.setattr(workers, "cores", lambda: 16)
    assert workers.share(None, None, None, 100) == (3, 5, 6_000_000_000, 18_000_000_000)
    assert workers.share(None, None, 2_000_000_000, 100)[:3] == (9, 1, 2_000_000_000)
    assert workers.share(8, 2, None, 100)[:2] == (3, 2)
    assert "instead of 8" in caplog.text
    assert workers.share(None, None, None, 1)[:3] == (1, 16, 18_000_000_000)


def test_claims(tmp_path: Path) -> None:
    held = claims.claim(tmp_path, "me.avatar", "x")
    assert held is not None
    assert claims.claim(tmp_path, "me.avatar", "x") is None
    assert claims.claim(tmp_path, "me", "x") is not None  # another name
    held.release()
    held = claims.claim(tmp_path, "me.avatar", "x")
    assert held is not None

    # another host's, renewed a moment ago; then not renewed for long
    held.path.write_text(json.dumps({"host": "elsewhere", "process": [1, 1.0], "batch": "x"}))
    assert claims.claim(tmp_path, "me.avatar", "y") is None
    long_ago = time.time() - claims.STALE - 5
    os.utime(held.path, (long_ago, long_ago))
    taken = claims.claim(tmp_path, "me.avatar", "y")
    assert taken is not None
    assert taken.number == held.number + 1
    held.renewed -= 2 * claims.RENEWED
    assert not held.holds()
    taken.renewed -= 2 * claims.RENEWED
    assert taken.holds()
    held.release()  # a former holder takes nothing away
    assert taken.path.exists()
    taken.release()
    assert not list(tmp_path.glob("me.avatar.*"))


@pytest.mark.parametrize("waited_for", [True, False])
def test_a_claim_whose_process_has_ended_is_taken_over(tmp_path: Path, waited_for: bool) -> None:
    """Also where nobody has waited for it, as in a container whose first process does not."""
    gone = subprocess.Popen([sys.executable, "-c", ""])
    born = psutil.Process(gone.pid).create_time()
    if waited_for:
        gone.wait()
    while psutil.pid_exists(gone.pid) and psutil.Process(gone.pid).status() != psutil.STATUS_ZOMBIE:
        time.sleep(0.05)
    (tmp_path / "me.avatar.0").write_text(
        json.dumps({"host": socket.gethostname(), "process": [gone.pid, born], "batch": "x"})
    )
    won: list[claims.Claim | None] = []
    threads = [threading.Thread(target=lambda: won.append(claims.claim(tmp_path, "me.avatar", "z"))) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sum(one is not None for one in won) == 1
    claims.revoke(tmp_path, "z")
    assert [path.name for path in tmp_path.glob("me.avatar.*")] == ["me.avatar.0"]


def test_the_file_system_s_clock_is_read_by_many_threads_at_once(tmp_path: Path) -> None:
    times: list[float] = []
    threads = [
        threading.Thread(target=lambda: times.extend(claims._now(tmp_path) for _ in range(200))) for _ in range(8)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(times) == 1600
    assert not list(tmp_path.iterdir())


def test_two_batches_share_the_work(tmp_path: Path, imitation: Path) -> None:
    folder = made_up(tmp_path / "in", **{f"s{number}": "sleep 0.5" for number in range(3)})
    threads = [
        threading.Thread(target=go, args=(folder, tmp_path / "out"), kwargs={"workers": 1, "memory": 10**8})
        for _ in range(2)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    once(tmp_path / "out", 3)


def once(output: Path, count: int) -> None:
    """Every subject was finished, exactly once, and nobody began it while it was open, but after a death."""
    events = sorted(ledger(output))
    ends = [name for _, name, word in events if word == "ends"]
    assert len(ends) == len(set(ends)) == count
    for name in ends:
        words = [word for _, subject_, word in events if subject_ == name]
        assert words[-2:] == ["begins", "ends"]


def _heeding() -> None:
    """Ctrl-C reaches the program, also where the tests run in a shell's background, which ignores it."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_an_interrupted_batch_leaves_nothing_behind(tmp_path: Path, how: signal.Signals) -> None:
    for number in range(2):
        texture_photos(tmp_path / "in" / f"s{number}", 8, seed=number)
    words = ["batch", tmp_path / "in", "-o", tmp_path / "out", "--until", "capture", "--workers", "1", "--memory", "1"]
    command = [sys.executable, str(ROOT / "cli.py"), *map(str, words)]
    with (tmp_path / "said").open("wb") as said:
        batch = subprocess.Popen(command, stdout=said, stderr=said, start_new_session=True, preexec_fn=_heeding)
    children: list[psutil.Process] = []
    deadline = time.monotonic() + 60
    while not (tmp_path / "out" / "s0.avatar" / "avatarbuild.log").exists() and time.monotonic() < deadline:
        time.sleep(0.1)
    with contextlib.suppress(psutil.Error):
        children = psutil.Process(batch.pid).children(recursive=True)
    assert children
    batch.send_signal(how)
    assert batch.wait(timeout=30) == (130 if how == signal.SIGINT else -9)
    assert not psutil.wait_procs(children, timeout=10)[1]
    text = (tmp_path / "said").read_text()
    assert "Traceback" not in text
    if how == signal.SIGINT:
        assert {line["state"] for line in table(tmp_path / "out")} == {"unfinished"}
        assert not list((tmp_path / "out" / ".claims").iterdir())
    else:  # a dead holder's claim is in nobody's way
        assert claims.claim(tmp_path / "out" / ".claims", "s0.avatar", "") is not None


def test_worst_first() -> None:
    good = {column.name: 1.0 for column in summary.COLUMNS}

    def row(name: str, state: str = "done", warnings: int = 0, **figures: float) -> summary.Row:
        return summary.Row(name, state, "", "", "avatar", {**good, **figures}, [("capture", "x")] * warnings, 1.0, "")

    made = [row("fine"), row("far", face_to_cloud_p90_mm=2.0), row("unplaced", placed=0.5, good_frames=0.5)]
    bad = summary._badness(made)
    assert bad["unplaced"] > bad["far"] > bad["fine"]
    assert (
        summary.table([row('a "b", c', warnings=2)]).decode().splitlines()[1].startswith('"a ""b"", c",done,,avatar,2,')
    )


# ---- a cluster


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Cluster:
    """A scheduler and workers started apart, each a process that can be killed."""

    def __init__(self, folder: Path, preload: dict[str, Path] | None = None) -> None:
        self.folder, self.port, self.preload = folder, free_port(), preload or {}
        self.processes: dict[str, subprocess.Popen[bytes]] = {}

    @property
    def address(self) -> str:
        return f"tcp://127.0.0.1:{self.port}"

    def start(self, name: str) -> None:
        if name == "scheduler":
            words = ["scheduler", "--host", "127.0.0.1", "--port", str(self.port), "--no-dashboard", "--no-show"]
        else:
            words = ["worker", self.address, "--nthreads", "1", "--no-nanny", "--no-dashboard", "--name", name]
            words += ["--death-timeout", "60", "--local-directory", str(self.folder)]
            words += ["--preload", str(self.preload[name])] if name in self.preload else []
        script = "import sys; from dask.__main__ import main; sys.argv[0] = 'dask'; main()"
        with (self.folder / f"{name}.log").open("ab") as said:
            environment = {**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"}
            self.processes[name] = subprocess.Popen(
                [sys.executable, "-c", script, *words], stdout=said, stderr=said, env=environment
            )

    def kill(self, name: str) -> None:
        self.processes[name].kill()
        self.processes[name].wait()

    def __enter__(self) -> Cluster:
        return self

    def __exit__(self, *_: object) -> None:
        for process in self.processes.values():
            process.kill()
            process.wait()


@pytest.fixture
def apart(tmp_path: Path) -> Iterator[Cluster]:
    """Workers that imitate runs; everything fails on the one called `full`, whose disk is."""
    preload = {}
    for name in ("one", "two", "three", "full"):
        script = tmp_path / f"imitation {name}.py"
        script.write_text(IMITATION)
        preload[name] = tmp_path / f"preload_{name}.py"
        preload[name].write_text(
            f"import sys\nfrom avatarbuild.batch import subject\nsubject.COMMAND = (sys.executable, {str(script)!r})\n"
        )
    with Cluster(tmp_path, preload) as made:
        yield made


def listening(cluster: Cluster) -> None:
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", cluster.port), timeout=1):
            return
        time.sleep(0.1)


def test_worker_killed_scheduler_restarted_disk_full(tmp_path: Path, apart: Cluster) -> None:
    distributed = pytest.importorskip("distributed")
    folder = made_up(tmp_path / "in", **{f"s{number}": "sleep 1.5" for number in range(5)})
    for name in ("scheduler", "one", "full"):
        apart.start(name)
    with distributed.Client(apart.address, timeout=60, set_as_default=False) as client:
        client.wait_for_workers(2, timeout=60)
    made: dict[str, summary.Row] = {}
    batch = threading.Thread(
        target=lambda: made.update(go(folder, tmp_path / "out", scheduler=apart.address, threads=1))
    )
    batch.start()

    def reach(word: str) -> None:
        """Some subject's last word is this."""
        while batch.is_alive():
            with contextlib.suppress(OSError):
                if word in {name: last for _, name, last in sorted(ledger(tmp_path / "out"))}.values():
                    return
            time.sleep(0.1)

    reach("fails")
    reach("begins")
    apart.kill("one")
    apart.start("two")
    reach("ends")
    apart.kill("scheduler")
    time.sleep(0.5)
    apart.start("scheduler")
    apart.start("three")  # while the others, which have lost their scheduler, still finish what they do
    batch.join(timeout=300)
    assert not batch.is_alive()
    assert {row.state for row in made.values()} == {"done"}, {name: row.message for name, row in made.items()}
    assert len(made) == 5
    once(tmp_path / "out", 5)
    words = [word for _, _, word in ledger(tmp_path / "out")]
    assert "fails" in words  # the full disk was met
    assert words.count("begins") - words.count("ends") - words.count("fails") >= 1  # a run was cut off


def test_a_local_cluster(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    texture_photos(tmp_path / "in" / "s0", 8)
    (tmp_path / "in" / "nobody").mkdir()
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, local_directory=str(tmp_path)
    ) as local:
        means = Means(scheduler=local.scheduler_address, threads=1)
        made = run_batch(tmp_path / "in", tmp_path / "out", ["--until", "capture"], "capture", means, quiet())
    assert [(row.subject, row.reason) for row in made] == [("nobody", "input"), ("s0", "")]
    assert [line["photos"] for line in table(tmp_path / "out")] == ["", "8"]


def test_board_reads_where_a_run_is(tmp_path: Path) -> None:
    from avatarbuild.batch.board import Board

    screen = quiet()
    job = Job("me", tmp_path, tmp_path / "me.avatar")
    job.project.mkdir()
    log = job.project / "avatarbuild.log"
    log.write_text("INFO avatarbuild.pipeline: stage avatar begins\n")  # an earlier run's
    with Board([job], screen) as board:
        board.look()
        assert board.lines["me"].state == "waiting"
        with log.open("a") as file:
            file.write("INFO avatarbuild.pipeline: stage cameras begins\n")
        board.look()
        assert (board.lines["me"].state, board.lines["me"].stage) == ("running", "cameras")
        board.ended(Outcome("me", "input", "no [photos]", 1.0, 10**9))
    text = screen.file.getvalue()  # type: ignore[attr-defined]
    assert "me: cameras" in text
    assert "no [photos]" in text
    assert "me" in "".join(str(cell) for cell in board._table().columns[0].cells)


# ---- the long proof


@pytest.fixture(scope="module")
def eight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight small rendered captures with a video."""
    folder = tmp_path_factory.mktemp("eight")
    size = {"photos": 22, "photo_width": 540, "video_seconds": 2.0, "video_width": 360, "texture": 512}
    words = [word for name, value in size.items() for word in ("--set", f"{name}={value}")]
    for seed in range(1, 9):
        place = folder / "captures" / f"seed{seed}"
        place.parent.mkdir(exist_ok=True)
        command = [sys.executable, str(ROOT / "cli.py"), "simulate", "-o", str(place), "--seed", str(seed)]
        command += ["--truth", str(folder / f"truth{seed}"), *words]
        assert subprocess.run(command, capture_output=True).returncode == 0
    return folder / "captures"


DRAFT = ["--quality", "draft", "--set", "points.min_views=2"]


def all_there(made: list[summary.Row], output: Path) -> None:
    assert {row.state for row in made} == {"done"}, {row.subject: row.message for row in made}
    assert len(made) == 8
    for row in made:
        project = output / f"{row.subject}.avatar"
        assert (project / "avatar" / "avatar.glb").is_file()
        log = (project / "avatarbuild.log").read_text()
        for stage in ("capture", "points", "tracking", "details", "avatar"):
            assert log.count(f"INFO avatarbuild.pipeline: stage {stage}: ") == 1  # finished once
    assert not list((output / ".claims").iterdir())


@pytest.mark.slow
@pytest.mark.timeout(10800)
def test_eight_captures_on_a_local_cluster(tmp_path: Path, eight: Path) -> None:
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, local_directory=str(tmp_path), memory_limit=None
    ) as local:
        means = Means(scheduler=local.scheduler_address, threads=1)
        all_there(run_batch(eight, tmp_path / "out", DRAFT, None, means, quiet()), tmp_path / "out")


@pytest.mark.slow
@pytest.mark.timeout(10800)
def test_eight_captures_on_workers_apart_with_faults(tmp_path: Path, eight: Path) -> None:
    """A worker is killed and another comes, the scheduler is restarted: nothing lost, nothing twice."""
    pytest.importorskip("distributed")
    made: list[summary.Row] = []
    with Cluster(tmp_path) as apart:
        for name in ("scheduler", "one", "two"):
            apart.start(name)
        listening(apart)
        means = Means(scheduler=apart.address, threads=1)
        batch = threading.Thread(
            target=lambda: made.extend(run_batch(eight, tmp_path / "out", DRAFT, None, means, quiet()))
        )
        batch.start()
        for stage, doomed, risen in (
            ("points", ["one"], ["three"]),
            ("tracking", ["scheduler"], ["scheduler", "four"]),
        ):
            while batch.is_alive() and not any(
                f"stage {stage} begins" in log.read_text()
                for log in (tmp_path / "out").glob("*.avatar/avatarbuild.log")
            ):
                time.sleep(1)
            for name in doomed:
                apart.kill(name)
            for name in risen:
                apart.start(name)
        batch.join()
    all_there(made, tmp_path / "out")
