"""The command line: `helio` (= `python -m helio_jax`). Parses, calls the pipeline, prints; holds no logic of its own.

Light at import (`helio --help` in under 0.3 s): every command imports what it needs. stdout carries results
(one JSON object with --json), stderr progress and messages. Exit codes: errors.py.
"""

import json
import sys
import traceback
from pathlib import Path
from typing import Annotated, Any

import typer

from helio_jax.errors import HelioError

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # plain help: rich alone takes 0.4 s to import
    help="Simulate scanning helium micrographs and turn three or more of them into a true-to-scale height map.",
)

SceneArg = Annotated[Path, typer.Argument(help="Scene file (TOML).", metavar="SCENE.toml")]
OutFile = Annotated[Path, typer.Option("--output", "-o", help="File to write.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
Rays = Annotated[int | None, typer.Option(min=8, help="Beam rays per pixel (default: the scene's).")]
Seed = Annotated[int | None, typer.Option(min=0, help="Seed of the tracer (default: the scene's).")]
Workers = Annotated[int | None, typer.Option(min=1, help="Threads, or processes (default: all CPUs).")]
Processes = Annotated[bool, typer.Option("--processes", help="Let the workers be processes instead of threads.")]
Scheduler = Annotated[str | None, typer.Option(help="Address of a dask scheduler whose workers trace (tcp://...).")]
Restart = Annotated[bool, typer.Option("--restart", help="Discard what an unfinished run left, and start afresh.")]
Method = Annotated[str | None, typer.Option(help="linear, nearfield or refine (default: the scene's, or refine).")]


def _say(message: str) -> None:
    print(message, file=sys.stderr, flush=True)


class _Bar:
    """A progress bar on a terminal; one line per stage elsewhere."""

    def __init__(self, label: str) -> None:
        self.label = label
        self.bar: Any = None
        _say(label) if not sys.stderr.isatty() else None

    def __enter__(self) -> "_Bar":
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

            columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
            self.bar = Progress(*columns, console=Console(stderr=True))
            self.bar.start()
            self.task = self.bar.add_task(self.label, total=None)
        return self

    def __exit__(self, *_: Any) -> None:
        if self.bar:
            self.bar.stop()

    def __call__(self, done: int, total: int, note: str = "") -> None:
        if self.bar:
            self.bar.update(self.task, completed=done, total=total, description=f"{self.label} {note}".strip())
        elif note:
            _say(f"  {self.label}: round {done + 1} of {total}, {note}")


def _print_table(rows: list[tuple[str, str, str]]) -> None:
    width = max(len(label) for label, _, _ in rows)
    for label, value, unit in rows:
        print(f"  {label:<{width}}  {value:>10} {unit}")


def _given(**values: Any) -> dict[str, Any]:
    """Return the options that were given."""
    return {key: value for key, value in values.items() if value is not None}


@app.command()
def run(
    scene: SceneArg,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Folder (default: helio-out/NAME).")] = None,
    rays: Rays = None,
    seed: Seed = None,
    method: Method = None,
    workers: Workers = None,
    processes: Processes = False,
    scheduler: Scheduler = None,
    restart: Restart = False,
    as_json: AsJson = False,
) -> None:
    """Simulate a scene, reconstruct its height map, score it against the truth and write a report."""
    from helio_jax.pipeline import Crew
    from helio_jax.pipeline import run as run_scene

    overrides = _given(**{"trace.rays": rays, "trace.seed": seed, "reconstruct.method": method})
    crew = Crew(workers, processes, scheduler)
    result = run_scene(scene, output, overrides=overrides, stage=_Bar, crew=crew, restart=restart, say=_say)
    if as_json:
        print(json.dumps(result.as_dict()))
        return
    print(f"\n{result.name}: {result.method}, {result.status}")
    _print_table(result.scores.as_table())
    print("\nfiles:")
    for label, path in result.files.items():
        print(f"  {label:<12} {path}")
    if result.status.startswith("interrupted"):
        raise KeyboardInterrupt


@app.command()
def simulate(
    scene: SceneArg,
    output: OutFile,
    rays: Rays = None,
    seed: Seed = None,
    workers: Workers = None,
    estimator: Annotated[str | None, typer.Option(help="expected or analog.")] = None,
    noise: Annotated[bool, typer.Option(help="Add the scene's counting noise and background.")] = False,
    processes: Processes = False,
    shard: Annotated[str | None, typer.Option(help="i/N: trace the i-th of N shares; the last one writes.")] = None,
    scheduler: Scheduler = None,
    restart: Restart = False,
) -> None:
    """Trace the micrographs of a scene and write them to an HDF5 file; if interrupted, give it again to go on."""
    from helio_jax.pipeline import Crew, SimulateOptions, simulate_file

    overrides = _given(**{"trace.rays": rays, "trace.seed": seed, "trace.estimator": estimator})
    with _Bar("tracing") as bar:
        options = SimulateOptions(noise, Crew(workers, processes, scheduler), shard, restart, bar, _say)
        stack = simulate_file(scene, output, overrides=overrides, options=options)
    if stack is not None:
        n, ny, nx = stack.shape
        print(f"{output}: {n} micrographs of {nx} x {ny} pixels ({stack.noise})")


@app.command()
def resume(
    path: Annotated[Path, typer.Argument(help="The file (OUT.h5) or folder of an unfinished simulate, run or study.")],
) -> None:
    """Go on with what was interrupted or killed; no unit that was finished is traced again."""
    from helio_jax.pipeline import resume as resume_run

    if (path / "study.json").is_file():
        from helio_jax.study import resume_study

        print(resume_study(path, say=_say))
        return
    for file in resume_run(path, stage=_Bar, say=_say):
        print(file)


@app.command()
def study(
    file: Annotated[Path, typer.Argument(help="Study file (TOML): a scene and what is varied.", metavar="STUDY.toml")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the points and their index.")],
    go_on: Annotated[bool, typer.Option("--resume", help="Go on in a folder that holds this study.")] = False,
    workers: Workers = None,
    processes: Processes = False,
    shard: Annotated[str | None, typer.Option(help="i/N: run every N-th point, beginning with the i-th.")] = None,
    scheduler: Scheduler = None,
) -> None:
    """Vary any values of a scene: every point in its own folder, with an index of values and scores."""
    from helio_jax.pipeline import Crew, SimulateOptions
    from helio_jax.study import run_study

    options = SimulateOptions(crew=Crew(workers, processes, scheduler), shard=shard, say=_say)
    print(run_study(file, output, resume=go_on, options=options))


@app.command("import")
def import_files(
    files: Annotated[list[Path], typer.Argument(help="Micrographs (.mat of B-SHeM, A-SHeM, the reference simulator).")],
    output: OutFile,
    instrument: Annotated[Path | None, typer.Option(help="Instrument or scene file: what the file lacks.")] = None,
) -> None:
    """Read measured or simulated micrographs of other programs and write them to an HDF5 file."""
    from helio_jax import MicrographSet, import_micrographs, write
    from helio_jax.config import load_instrument

    given = load_instrument(instrument) if instrument else None
    stacks = tuple(import_micrographs(path, given) for path in files)
    write(stacks[0] if len(stacks) == 1 else MicrographSet(stacks), output)
    for stack in stacks:
        print(f"{stack.name}: {stack.shape[0]} micrographs of {stack.shape[2]} x {stack.shape[1]} pixels, {stack.unit}")
    print(f"written to {output}")


@app.command()
def calibrate(
    stack: Annotated[Path, typer.Argument(help="Measured micrographs (.h5), from helio import.")],
    output: OutFile,
    drift: Annotated[bool, typer.Option(help="Take slow drift off, and leave it to the fit.")] = True,
    lines: Annotated[bool, typer.Option(help="Leave offsets of single scan lines to the fit.")] = True,
    noise_model: Annotated[bool, typer.Option(help="Let the variance follow the counts.")] = True,
    spike_limit: Annotated[float | None, typer.Option(help="Standard deviations of a spike; 0: none.")] = None,
    masked_share: Annotated[float | None, typer.Option(help="Multiple scattering in the darkest spot / flat.")] = None,
    as_json: AsJson = False,
) -> None:
    """Estimate background, gain, drift and noise of a measured scan; the fit goes on from these estimates."""
    from helio_jax.pipeline import calibrate_file

    given = _given(spike_limit=spike_limit, masked_share=masked_share)
    found = calibrate_file(stack, output, drift=drift, lines=lines, noise_model=noise_model, **given)
    record = found.provenance["calibrate"]
    if as_json:
        print(json.dumps(record | {"detectors": found.instrument.detector_names}))
        return
    heads = ("background", 11), ("flat", 9), ("noise", 8), ("SNR", 7), ("lines", 8), ("a + b counts", 17), ("spikes", 8)
    print(f"  {'detector':<12}" + "".join(f"{head:>{width}}" for head, width in heads))
    for k, name in enumerate(found.instrument.detector_names):
        flat, background, noise, snr, lines_, a, b, spikes = (
            record[key][k]
            for key in (
                "flat", "background", "pixel_std", "snr", "line_noise", "noise_constant", "noise_per_count", "spikes"
            )
        )  # fmt: skip
        law = f"{a:.0f} + {b:.2f}"
        print(
            f"  {name:<12}{background:>11.0f}{flat - background:>9.0f}{noise:>8.1f}{snr:>7.2f}{lines_:>8.1f}"
            f"{law:>17}{spikes:>8}"
        )
    print(f"flat: signal above the background, whose prior deviation is {record['priors']['offset_std']:.0%} of it")
    print(f"{output}\n{output.with_suffix('.png')}")


@app.command()
def reconstruct(
    stack: Annotated[Path, typer.Argument(help="Micrographs (.h5).")],
    output: OutFile,
    method: Method = None,
    settings: Annotated[Path | None, typer.Option(help="Scene file whose table [reconstruct] is used.")] = None,
    border: Annotated[str | None, typer.Option(help="flat: the image's border is the substrate; free.")] = None,
) -> None:
    """Turn three or more micrographs into a height map."""
    from helio_jax import pipeline, read, write
    from helio_jax.config import load_scene

    given = load_scene(settings).reconstruct if settings else None
    with _Bar("reconstructing") as bar:
        result = pipeline.reconstruct(read(stack), method, settings=given, report=bar, **_given(border=border))
    write(result, output)
    print(f"{output}: {result.method}, {result.status}; {result.is_valid.mean():.1%} of the pixels valid")
    for name, factor in result.provenance.get("sensitivity", {}).items():
        print(f"  the highest point moves by {factor:+.1f} % per % of signal in {name}")
    _print_instrument(result.provenance.get("instrument", {}))
    if result.status.startswith("interrupted"):
        raise KeyboardInterrupt


def _print_instrument(found: dict[str, Any]) -> None:
    """Print what a fit found out about the geometry, and what the data leave open of the instrument."""
    for name, (value, std, prior, unit) in found.get("values", {}).items():
        if unit in ("um", "deg"):
            print(f"  {name}: {value:+.2f} +- {std:.2f} {unit} beyond what the instrument says (prior {prior:g})")
    for weak in found.get("weak", [])[:3]:
        terms = ", ".join(f"{factor:+.2f} {name}" for name, factor in weak["of"].items())
        print(f"  weakly determined, {weak['left']:.0%} of the prior is left: {terms}")


@app.command()
def evaluate(
    height: Annotated[Path, typer.Argument(help="Height map (.h5).")],
    truth: Annotated[Path, typer.Option(help="Scene file, or a height map (.h5) on the same raster.")],
    fit_center: Annotated[bool, typer.Option(help="Fit the position of the scene's sphere first.")] = False,
    as_json: AsJson = False,
) -> None:
    """Score a height map against the true heights of the same rays."""
    from helio_jax import pipeline, read

    rec = read(height)
    found = pipeline.load_truth(truth, rec, fit_center=fit_center)
    scores = pipeline.evaluate(rec, found)
    if as_json:
        center = list(found.region.center) if found.region else None
        print(json.dumps(scores.as_dict() | {"center_um": center}))
        return
    if found.region and fit_center:
        print(f"  centre fitted at x = {found.region.center[0]:.1f} um, y = {found.region.center[1]:.1f} um")
    _print_table(scores.as_table())


@app.command()
def report(
    height: Annotated[Path, typer.Argument(help="Height map (.h5).")],
    output: OutFile,
    stack: Annotated[Path | None, typer.Option(help="Its micrographs (.h5).")] = None,
    truth: Annotated[Path | None, typer.Option(help="Scene file or height map to compare with.")] = None,
    fit_center: Annotated[bool, typer.Option(help="Fit the position of the scene's sphere first.")] = False,
) -> None:
    """Write one self-contained HTML report of a height map, and a PNG panel beside it."""
    from helio_jax import pipeline, read

    rec = read(height)
    known = pipeline.load_truth(truth, rec, fit_center=fit_center) if truth else None
    scores = pipeline.evaluate(rec, known) if known else None
    panel = pipeline.write_report_files(output, read(stack) if stack else None, rec, known, scores, title=height.stem)
    print(f"{output}\n{panel}")


@app.command()
def info(file: Annotated[Path, typer.Argument(help="File written by helio (.h5).")], as_json: AsJson = False) -> None:
    """Say what a file holds, where it came from and how it was made."""
    from helio_jax.formats.hdf5 import describe

    found = describe(file)
    if as_json:
        print(json.dumps(found))
        return
    print(f"{found['file']}: {found['kind']}, {found['bytes']:,} bytes, written {found['created']}")
    for name, entry in found["entries"].items():
        print(f"{name or 'entry'}:")
        for place, field in entry["fields"].items():
            shape = " x ".join(map(str, field.get("shape", ()))) or "scalar"
            print(f"  {place:<24} {shape:<18} {field.get('unit', ''):<10} {field.get('long_name', '')}".rstrip())
        for key in ("instrument", "provenance"):
            print(f"  {key}: {json.dumps(entry.get(key))[:600]}")


@app.command()
def validate(scene: SceneArg) -> None:
    """Check a scene file and its sample; list every error with place, value, limit and remedy."""
    from helio_jax.config import load_scene
    from helio_jax.scene.sample import check_body

    loaded = load_scene(scene)
    loaded.read_laws()
    for key, value in check_body(loaded.build_body()).items():
        print(f"  {key}: {value}")
    for warning in loaded.warnings():
        print(f"  warning: {warning}")
    print(f"{scene}: ok ({loaded.scan.nx} x {loaded.scan.ny} pixels, {len(loaded.detector)} detectors)")


@app.command()
def schema() -> None:
    """Print the JSON schema of scene files, for editors."""
    from helio_jax.config import json_schema

    print(json.dumps(json_schema(), indent=2))


@app.command()
def doctor(as_json: AsJson = False) -> None:
    """Check this installation: versions, ray engine, JAX devices, and a small trace."""
    from helio_jax.pipeline import diagnose

    found = diagnose()
    if as_json:
        print(json.dumps(found))
    else:
        for key, value in found.items():
            print(f"  {key:<14} {value}")
    if not found["ok"]:
        raise typer.Exit(4)


@app.command("fetch-data")
def fetch_data(
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Folder (default: the user's cache).")] = None,
) -> None:
    """Download the paper's public micrographs (CC BY-SA), check their SHA-256 and say where they are."""
    from helio_jax.formats.fetch import CITATION, fetch_pack

    for path in fetch_pack(output):
        print(path)
    print(CITATION)


@app.command()
def cite() -> None:
    """Print how to cite this program and the papers behind it."""
    from helio_jax.evaluate.report import CITATION

    print("\n".join(CITATION))


def main(args: list[str] | None = None) -> None:
    """Run the command line; ends the process with a documented exit code (errors.py)."""
    try:
        app(args=args, standalone_mode=True)
    except HelioError as e:
        _say(f"helio: {e}")
        sys.exit(e.exit_code)
    except KeyboardInterrupt:
        _say("helio: interrupted; files written so far are complete")
        sys.exit(130)
    except BrokenPipeError:
        sys.exit(0)
    except Exception:
        traceback.print_exc()
        _say("helio: this is a bug; please report it with the message above and the scene")
        sys.exit(1)


if __name__ == "__main__":
    main()
