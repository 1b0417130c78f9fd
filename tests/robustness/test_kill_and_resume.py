"""Runs that are killed, damaged or changed half-way: what was finished is kept, the result is the same."""

import contextlib
import functools
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from multiprocessing import get_context

import numpy as np
import pytest
from scale import N_UNITS, SCENE, SMALL, assert_same_bits, run_logged

import helio_jax as hx
from helio_jax.errors import InputFileError, InterruptedRun, ResumeError, SceneError, StoppedRun
from helio_jax.formats.parts import Parts
from helio_jax.trace.scan import Executor
from helio_jax.workflows import pipeline
from helio_jax.workflows.file_info import file_info

KILLS = 20
UNIT_PIXELS = 360 // N_UNITS


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The scene simulated in one go, and how long tracing takes [s]."""
    output = tmp_path_factory.mktemp("whole") / "out.h5"
    options = pipeline.SimulateOptions(executor=Executor(1))
    pipeline.simulate_file(SCENE, output, overrides=SMALL, options=options)  # compiles
    start = time.perf_counter()
    pipeline.simulate(hx.load_scene(SCENE, SMALL), workers=1)
    assert list(output.parent.iterdir()) == [output]  # no litter
    return hx.read(output), time.perf_counter() - start


@pytest.fixture
def half(tmp_path):
    """Parts of a run that was interrupted in its middle."""
    output = tmp_path / "out.h5"
    stop_after(output, N_UNITS // 2)
    return Parts(output)


def stop_after(output, n_units: int, overrides=SMALL, error: type[BaseException] = KeyboardInterrupt) -> None:
    """Simulate, and interrupt once so many units are kept."""
    parts = Parts(output)

    def progress(done: int, total: int) -> None:
        if sum(parts.has(i) for i in range(N_UNITS)) >= n_units:
            raise error

    options = pipeline.SimulateOptions(executor=Executor(1), progress=progress)
    with pytest.raises(InterruptedRun, match=r"helio resume .*out\.h5"):
        pipeline.simulate_file(SCENE, output, overrides=overrides, options=options)
    assert not output.exists()


def n_kept(parts: Parts) -> int:
    return sum(parts.has(i) for i in range(N_UNITS))


@pytest.mark.skipif(os.name != "posix", reason="fork server")
@pytest.mark.parametrize("workers", [1, 2])
def test_kill_and_resume_at_random_times(whole, tmp_path, workers, monkeypatch):
    """kill -9 at 10 random times each on 1 and 2 threads, then resume: equal bits, at most one unit per worker lost.

    Catches parts that are half written, forgotten, or begun again although they are finished. Units that were begun
    and are not kept are counted by a log of the blocks that were begun.
    """
    monkeypatch.setenv("HELIO_TEST_FORK_SERVER", "1")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(SCENE.parents[1] / "tests"), str(SCENE.parents[1])]))
    context = get_context("forkserver")
    context.set_forkserver_preload(["scale"])
    stack, seconds = whole
    rng = random.Random(workers)
    output, log = tmp_path / "out.h5", tmp_path / "log"
    parts, n_killed, n_lost = Parts(output), 0, 0
    context.Process(target=time.sleep, args=(0,)).start()
    while n_killed < KILLS // 2:
        kept = {i for i in range(N_UNITS) if parts.has(i)}
        log.unlink(missing_ok=True)
        process = context.Process(target=run_logged, args=(str(output), str(log), workers))
        process.start()
        while not log.exists() and process.is_alive():
            time.sleep(0.005)
        process.join(rng.uniform(0.0, 0.6 * seconds))
        process.kill()
        process.join()
        begun = {int(line) // UNIT_PIXELS for line in log.read_text().split()} if log.exists() else set()
        assert not begun & kept, "a unit that was kept was traced again"
        n_killed += process.exitcode == -signal.SIGKILL
        if output.exists():
            assert_same_bits(hx.read(output), stack)
            pipeline.resume(output, say=lambda text: None)  # finishes the cleaning up, if that was killed
            output.unlink()
        else:
            lost = {unit for unit in begun if not parts.has(unit)}
            assert len(lost) <= workers
            n_lost += len(lost)
    assert n_lost > 0
    pipeline.simulate_file(SCENE, output, overrides=SMALL)
    assert_same_bits(hx.read(output), stack)
    assert {p.name for p in tmp_path.iterdir()} == {"out.h5", "log"}


def test_interrupted_run_goes_on(whole, half):
    """Ctrl-C keeps finished units and says how to go on; resume and the same command both do. Catches lost units."""
    assert n_kept(half) == N_UNITS // 2
    copy = half.output.with_name("copy.h5")
    shutil.copytree(half.folder, Parts(copy).folder)
    said = []
    assert pipeline.resume(half.output, say=said.append) == [half.output]
    assert said == [f"resuming: {N_UNITS // 2} of {N_UNITS} units are finished"]
    pipeline.simulate_file(SCENE, copy, overrides=SMALL)
    for path in (half.output, copy):
        assert_same_bits(hx.read(path), whole[0])
        assert not Parts(path).folder.exists()
    assert pipeline.resume(copy, say=said.append) == [] and "complete" in said[-1]
    with pytest.raises(ResumeError, match=r"no unfinished run of .*other\.h5"):
        pipeline.resume(copy.with_name("other.h5"))


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("trace.seed", 2, r"trace\.seed: 1 \(then\), 2 \(now\)"),
        (
            "sample.spheres.0.cap_height_um",
            700.0,
            r"sample\.spheres\.0\.cap_height_um: 720\.0 \(then\), 700\.0 \(now\)",
        ),
        ("scan.nx", 21, r"scan\.nx: 20 \(then\), 21 \(now\)"),
    ],
)
def test_changed_scene_is_refused(half, key, value, words):
    """Exit code 6, what differs, nothing lost; --restart starts afresh. Catches a file merged from two scenes."""
    with pytest.raises(ResumeError, match=words) as caught:
        pipeline.simulate_file(SCENE, half.output, overrides=SMALL | {key: value})
    assert caught.value.exit_code == 6 and "--restart" in str(caught.value)
    assert n_kept(half) == N_UNITS // 2
    options = pipeline.SimulateOptions(restart=True)
    found = pipeline.simulate_file(SCENE, half.output, overrides=SMALL | {key: value}, options=options)
    assert found is not None and not half.folder.exists()


def test_changed_mesh_and_program_are_refused(tmp_path, monkeypatch):
    """The mesh file and the program's sources are part of the key. Catches parts of two surfaces or versions in one."""
    from helio_jax.trace import job

    y, x = np.mgrid[-2000.0:2001.0:400.0, -2000.0:2001.0:400.0]
    bump = lambda h: np.savez(tmp_path / "bump.npz", x=x[0], y=y[:, 0], height=h * np.exp(-(x**2 + y**2) / 1e6))  # noqa: E731
    bump(100.0)
    overrides = SMALL | {"sample": {"kind": "height_map", "file": str(tmp_path / "bump.npz"), "size_um": 8000.0}}
    output = tmp_path / "out.h5"
    stop_after(output, 3, overrides)
    bump(101.0)
    with pytest.raises(ResumeError, match=r"the sample's surface: .*bump\.npz"):
        pipeline.resume(output)
    bump(100.0)
    with monkeypatch.context() as patch:
        patch.setattr(job, "_hash_program", lambda: "other")
        with pytest.raises(ResumeError, match=r"program\.helio_jax: .*sources other"):
            pipeline.resume(output)
    assert n_kept(Parts(output)) == 3
    assert pipeline.resume(output) == [output]


def test_damaged_parts_are_found(whole, half):
    """Cut short, emptied, a bit turned anywhere, another unit's: each is named, and traced again.

    Catches a part that is taken on trust: the bits would then differ, or the merge would crash.
    """
    rng = np.random.default_rng(3)
    first = half.path(0).read_bytes()
    half.path(0).write_bytes(first[: len(first) // 2])
    half.path(1).write_bytes(b"")
    turned = bytearray(half.path(2).read_bytes())
    turned[int(rng.integers(len(turned)))] ^= 16
    half.path(2).write_bytes(turned)
    half.path(3).write_bytes(half.path(4).read_bytes())
    said = []
    pipeline.resume(half.output, say=said.append)
    assert_same_bits(hx.read(half.output), whole[0])
    assert [s.split(" is ")[0].rpartition("/")[2] for s in said[:-1]] == [f"{i:06d}.npz" for i in range(4)]
    assert said[-1] == f"resuming: {N_UNITS // 2 - 4} of {N_UNITS} units are finished"


def test_any_turned_bit_is_harmless(half):
    """200 single bits turned at random in a part: an error that names the file, or the same numbers; never others."""
    rng = np.random.default_rng(5)
    whole, path = half.path(0).read_bytes(), half.path(0)
    right = half.load(0)
    n_noticed = 0
    for _ in range(200):
        turned = bytearray(whole)
        turned[int(rng.integers(len(turned)))] ^= 1 << int(rng.integers(8))
        path.write_bytes(turned)
        try:
            found = half.load(0)
        except InputFileError as e:
            assert "000000.npz" in str(e)
            n_noticed += 1
            continue
        if set(found) == set(right):
            assert all(np.array_equal(found[name], right[name]) for name in right)
    assert n_noticed > 150


def test_shards_make_the_same_file(whole, tmp_path):
    """Three shards in any order, one of them twice: the last one writes. Catches units that two or no shards take."""
    output, said = tmp_path / "out.h5", []
    for shard in ("3/3", "1/3", "1/3", "2/3"):
        options = pipeline.SimulateOptions(executor=Executor(1), shard=shard, say=said.append)
        assert not output.exists()
        pipeline.simulate_file(SCENE, output, overrides=SMALL, options=options)
    assert_same_bits(hx.read(output), whole[0])
    assert list(tmp_path.iterdir()) == [output]
    assert f"{N_UNITS // 3} of {N_UNITS // 3} units are finished" in said[2]


def test_shard_that_was_killed_while_it_wrote_is_repeated(whole, tmp_path, monkeypatch):
    """The last shard dies after it claimed the merge: the other one says whose turn it is, the same command writes.

    Catches a claim that outlives its owner: the command then ended with exit code 0 and never a file.
    """
    output, said = tmp_path / "out.h5", []

    def simulate(shard: str) -> None:
        options = pipeline.SimulateOptions(executor=Executor(1), shard=shard, say=said.append)
        pipeline.simulate_file(SCENE, output, overrides=SMALL, options=options)

    class Killed(BaseException):
        pass

    def die(self, write):
        raise Killed

    simulate("1/2")
    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(Parts, "finish", die)
        simulate("2/2")
    simulate("1/2")
    assert not output.exists() and "shard 2/2 writes" in said[-1] and "if it was killed, repeat it" in said[-1]
    simulate("2/2")
    assert_same_bits(hx.read(output), whole[0])
    assert list(tmp_path.iterdir()) == [output]


def test_killed_process_is_replaced(whole, tmp_path):
    """One of two worker processes killed half-way: the run ends well, with the same bits; twice nothing is traced.

    Catches a pool that hangs or gives up when a worker dies.
    """
    from multiprocessing import active_children

    output, victims = tmp_path / "out.h5", []

    def progress(done: int, total: int) -> None:
        workers = [p for p in active_children() if "Spawn" in type(p).__name__]
        if workers and not victims and done > total // 3:
            victims.append(workers[0].pid)
            workers[0].kill()

    options = pipeline.SimulateOptions(executor=Executor(2, processes=True), progress=progress)
    pipeline.simulate_file(SCENE, output, overrides=SMALL, options=options)
    assert victims
    assert_same_bits(hx.read(output), whole[0])


def test_processes_that_always_die_stop_the_run(tmp_path, monkeypatch):
    """Exit code 75 and the likely cause instead of an endless loop of new processes."""
    from helio_jax.trace import scan

    monkeypatch.setattr(scan, "_begin_worker", os._exit)
    monkeypatch.setattr(scan.ProcessPoolExecutor, "__init__", _with_arguments(scan.ProcessPoolExecutor.__init__))
    options = pipeline.SimulateOptions(executor=Executor(1, processes=True))
    with pytest.raises(StoppedRun, match="died 3 times") as caught:
        pipeline.simulate_file(SCENE, tmp_path / "out.h5", overrides=SMALL, options=options)
    assert caught.value.exit_code == 75 and list(tmp_path.iterdir()) == []


def _with_arguments(make):
    return lambda self, workers, context, begin: make(self, workers, context, begin, (3,))


def test_dask_cluster_with_a_killed_worker(whole, tmp_path):
    """A real cluster of two processes, one killed half-way: same bits. Catches code that only works in this process."""
    distributed = pytest.importorskip("distributed")
    output, victims = tmp_path / "out.h5", []
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        dashboard_address=None,
        local_directory=str(tmp_path / "dask"),
    ) as cluster:

        def progress(done: int, total: int) -> None:
            if not victims and done > total // 3:
                victims.append(next(iter(cluster.workers.values())).pid)
                os.kill(victims[0], signal.SIGKILL)

        options = pipeline.SimulateOptions(executor=Executor(scheduler=cluster.scheduler_address), progress=progress)
        pipeline.simulate_file(SCENE, output, overrides=SMALL, options=options)
    assert victims
    assert_same_bits(hx.read(output), whole[0])


def test_sigterm_keeps_what_is_finished(tmp_path):
    """A batch system's signal: StoppedRun (75), units kept, and the handler of before is back. Catches a lost run."""
    output, before = tmp_path / "out.h5", signal.getsignal(signal.SIGTERM)
    parts = Parts(output)

    def progress(done: int, total: int) -> None:
        if n_kept(parts) == 3:
            signal.raise_signal(signal.SIGTERM)

    options = pipeline.SimulateOptions(executor=Executor(1), progress=progress)
    with pytest.raises(StoppedRun, match="stopped by SIGTERM; 3 of 12 units are kept") as caught:
        pipeline.simulate_file(SCENE, output, overrides=SMALL, options=options)
    assert caught.value.exit_code == 75 and n_kept(parts) == 3
    assert signal.getsignal(signal.SIGTERM) is before


def test_wrong_shard_and_scheduler(tmp_path, monkeypatch):
    """Shares that do not exist and schedulers that do not answer: code 2, the remedy, and nothing left behind."""
    from helio_jax.trace import scan

    pytest.importorskip("distributed")
    monkeypatch.setattr(scan, "CONNECT_SECONDS", 0.5)
    cases = (
        (pipeline.SimulateOptions(shard="3/2"), "i from 1 to N"),
        (pipeline.SimulateOptions(shard="1/2", restart=True), "other shards"),
        (pipeline.SimulateOptions(executor=Executor(scheduler="tcp://127.0.0.1:9")), "dask scheduler"),
        (pipeline.SimulateOptions(executor=Executor(scheduler="nonsense://x")), "dask scheduler"),
    )
    for options, words in cases:
        with pytest.raises(SceneError, match=words) as caught:
            pipeline.simulate_file(SCENE, tmp_path / "out.h5", overrides=SMALL, options=options)
        assert caught.value.exit_code == 2 and list(tmp_path.iterdir()) == []


def test_interrupted_run_goes_on_in_its_folder(tmp_path):
    """`helio run` interrupted while it traces: resume of the folder reconstructs and scores, with noise and settings.

    Catches a resume that forgets what the command was, or its overrides.
    """
    folder = tmp_path / "run"
    overrides = SMALL | {"trace.rays": 16, "trace.paths_per_unit": 16 * 8 * 30, "reconstruct.method": "nearfield"}

    class Stage:
        def __init__(self, label: str) -> None: ...
        def __enter__(self):
            return self

        def __exit__(self, *_: object) -> None: ...
        def __call__(self, done: int, total: int, note: str = "") -> None:
            if n_kept(Parts(folder / "micrographs.h5")) >= 5:
                raise KeyboardInterrupt

    with pytest.raises(InterruptedRun, match="helio resume"):
        pipeline.run(SCENE, folder, overrides=overrides, stage=Stage, executor=Executor(1), report=False)
    said: list[str] = []
    pipeline.resume(folder, say=said.append)
    assert said == [f"resuming: 5 of {N_UNITS} units are finished"]
    assert not Parts(folder / "micrographs.h5").exist and (folder / "scores.json").is_file()
    stack, scene = hx.read(folder / "micrographs.h5"), hx.load_scene(SCENE, overrides)
    assert np.array_equal(stack.counts, pipeline.record(scene, pipeline.simulate(scene)).counts)
    assert hx.read(folder / "height.h5").method == "nearfield"


def test_manifest_of_an_older_version_is_refused(half):
    """A manifest without the keys of this version gives ResumeError and keeps the units. Catches a bare KeyError."""
    manifest = half.manifest()
    manifest["command"]["crew"] = manifest["command"].pop("executor")
    half.begin(manifest)
    with pytest.raises(ResumeError, match=r"manifest\.json is damaged .*executor"):
        pipeline.resume(half.output)
    assert n_kept(half) == N_UNITS // 2


def test_info_of_an_unfinished_run(half, tmp_path):
    """By its output and by the folder of its parts; not once it is finished. Catches "does not exist"."""
    for path in (half.output, half.folder):
        found = file_info(path)
        assert found.kind == "unfinished run" and found.details == {"units": N_UNITS, "done": n_kept(half)}
        assert dict(found.rows)["to go on"] == f"helio resume {half.output}"
    pipeline.resume(half.output, say=lambda text: None)
    assert file_info(half.output).kind == "micrographs"


def ends_within(group: int, seconds: float) -> bool:
    """Whether a group of processes has ended, workers included."""
    start = time.monotonic()
    while time.monotonic() - start < seconds:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.1)
    return False


@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.parametrize("delay", [0.0, 2.0])
def test_ctrl_c_twice_ends_worker_processes(tmp_path, delay):
    """Before the first unit and later, to the whole process group, as a terminal sends it: ended within 20 s.

    Catches a pool that waits for workers that never began, with which the program had to be killed.
    """
    words = ["simulate", "sphere_a_full", "-o", str(tmp_path / "out.h5"), "--processes", "--workers", "2"]
    heed = functools.partial(signal.signal, signal.SIGINT, signal.default_int_handler)
    process = subprocess.Popen(
        [sys.executable, "-m", "helio_jax", *words], stderr=subprocess.PIPE, text=True, preexec_fn=heed,
        start_new_session=True, cwd=SCENE.parents[1],
    )  # fmt: skip
    try:
        assert process.stderr and "tracing" in process.stderr.readline()
        time.sleep(delay)
        for _ in range(2):
            os.killpg(process.pid, signal.SIGINT)
            time.sleep(0.25)
        _, text = process.communicate(timeout=20.0)
        assert ends_within(process.pid, 5.0)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode in (130, -signal.SIGINT) and "Traceback" not in text
    assert text.count("interrupted") == 1
