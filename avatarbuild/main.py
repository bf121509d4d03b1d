"""The command line: verbs, options, exit codes, errors as one line."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import rich.console
import rich.markup
import typer

from avatarbuild import __version__
from avatarbuild import options as all_options
from avatarbuild.errors import InputError
from avatarbuild.progress import Task
from avatarbuild.project import Project, default_project, digest_files
from avatarbuild.template_files import SHIPPED, resolve
from avatarbuild.whole_file import whole_file

if TYPE_CHECKING:  # what is heavy is imported by the verb that uses it
    import rich.progress

    from avatarbuild import pipeline
    from avatarbuild.formats.corrections import Corrections

DONE, FAULT, BAD_INPUT, STOPPED = 0, 1, 2, 130
JSON_VERSION = 1

app = typer.Typer(add_completion=False, no_args_is_help=True, rich_markup_mode=None, pretty_exceptions_enable=False)
screen = rich.console.Console(stderr=True, highlight=False)
log = logging.getLogger(__name__)

CapturePath = Annotated[Path, typer.Argument(metavar="CAPTURE", help="Folder with photos and a video.")]
templates = typer.Typer(no_args_is_help=True, help="The shipped head, and heads imported from files that you have.")
app.add_typer(templates, name="template")

TemplateName = Annotated[
    str | None, typer.Option("--template", help="Head template: 'head', the shipped one, or an imported .npz.")
]
ProjectPath = Annotated[Path, typer.Argument(metavar="PROJECT", help="Project folder of an earlier run.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON for machines.")]


class Bars:
    """Progress on the screen: a bar with an estimate on a terminal, a line every ten seconds elsewhere."""

    @contextlib.contextmanager
    def task(self, label: str, total: float) -> Iterator[Task]:
        log.info("%s", label)
        if not screen.is_terminal:
            yield _Lines(label, total)
            return
        import rich.progress

        columns = (
            rich.progress.TextColumn("  {task.description}"),
            rich.progress.BarColumn(bar_width=30),
            rich.progress.TaskProgressColumn(),
            rich.progress.TimeRemainingColumn(compact=True),
        )
        with rich.progress.Progress(*columns, console=screen, transient=True) as bars:
            yield _Bar(bars, bars.add_task(label, total=total))


class _Bar:
    def __init__(self, bars: rich.progress.Progress, number: rich.progress.TaskID) -> None:
        self.bars, self.number = bars, number

    def advance(self, n: float = 1) -> None:
        self.bars.advance(self.number, n)


class _Lines:
    def __init__(self, label: str, total: float) -> None:
        self.label, self.total, self.done = label, total, 0.0
        self.started = self.told = time.monotonic()

    def advance(self, n: float = 1) -> None:
        self.done += n
        now = time.monotonic()
        if now - self.told < 10:
            return
        self.told = now
        share = self.done / self.total
        left = (now - self.started) * max(1 - share, 0) / max(share, 1e-9)
        estimate = f", about {left:.0f} s left" if share >= 0.03 else ""  # the first step may compile kernels
        screen.print(f"  {self.label}: {100 * share:.0f} %{estimate}")


def _settings(pairs: list[str]) -> dict[str, str]:
    values = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals or "." not in key:
            raise InputError(f"--set {pair} is not of the form stage.option=value, like --set points.window=6")
        values[key.strip()] = value.strip()
    return values


def _figures(line: pipeline.StageState) -> str:
    return ", ".join(f"{name} {value}" for name, value in line.figures.items() if not isinstance(value, dict | list))


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"avatarbuild {__version__}")
        raise typer.Exit


@app.callback()
def program(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Animatable 3D avatars from phone photos and a short video, on your own machine."""


@app.command()
def run(
    capture: CapturePath,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Project folder; default CAPTURE.avatar.")
    ] = None,
    first: Annotated[str | None, typer.Option("--from", help="Run this stage and what follows again.")] = None,
    until: Annotated[str | None, typer.Option(help="Stop after this stage.")] = None,
    only: Annotated[str | None, typer.Option(help="Run this stage alone; its inputs must be fresh.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Run the chosen stages although they are fresh.")] = False,
    pairs: Annotated[
        list[str] | None, typer.Option("--set", help="stage.option=value; kept in the project; 'default' undoes.")
    ] = None,
    quality: Annotated[str | None, typer.Option(help="draft, standard or high; kept in the project.")] = None,
    template: TemplateName = None,
    as_json: Json = False,
) -> None:
    """Build the avatar of a capture; go on where the project left off."""
    from avatarbuild import pipeline
    from avatarbuild.capture_folder import open_capture

    what = pipeline.plan(first, until, only, force)
    changes = _settings(pairs or [])
    named = None if template is None else resolve(template)
    found = open_capture(capture)
    project = Project(output if output is not None else default_project(capture))
    with project.lock(), _log_into(project.log_file), _native_chatter_into(project.log_file):
        log.info("avatarbuild %s: run %s", __version__, what)
        kept = project.settings()
        quality = quality or kept.get("quality", "standard")
        settings = {**kept.get("options", {}), **changes}
        settings = {key: value for key, value in settings.items() if value != "default"}
        chosen = all_options.stage_options(quality, settings)
        head = named or project.template()
        project.write_settings(capture, head, quality, settings)
        project.require_space(int(2.0 * sum((found.root / photo).stat().st_size for photo in found.photos) + 5e8))
        ran: list[dict[str, Any]] = []

        def tell(line: pipeline.StageState, now: bool) -> None:
            ran.append(_line_json(line) | {"ran": now})
            if as_json:
                return
            time_ = f"{line.seconds:.0f} s" if now and line.seconds is not None else "fresh"
            screen.print(f"[bold]{line.name}[/]  {time_}  {_figures(line)}")
            for warning in line.warnings if now else []:
                screen.print(f"  [yellow]warning[/] {rich.markup.escape(warning)}")

        digest = digest_files(found.root, [found.root / name for name in found.files])
        error = None
        try:
            pipeline.run(project, capture, digest, head, chosen, what, Bars(), tell)
        except InputError as caught:
            error = caught
            log.error("%s", caught)
        except KeyboardInterrupt:
            screen.print("stopped: finished stages are kept, the same command goes on from there")
            raise
        if as_json:
            answer = {"version": JSON_VERSION, "project": str(project.root), "stages": ran}
            answer["error"] = None if error is None else str(error)
            typer.echo(json.dumps(answer, indent=1, ensure_ascii=False))
        if error is not None:
            raise error
        if not as_json:
            last = ran[-1]["stage"]
            if last == "avatar":
                screen.print(f"{project.folder('avatar')}: the avatar; begin with report.html")
            else:
                screen.print(f"{project.root}: done up to stage {last}")


def _line_json(line: pipeline.StageState) -> dict[str, Any]:
    return {
        "stage": line.name,
        "state": line.state,
        "figures": line.figures,
        "warnings": line.warnings,
        "timing": {"seconds": line.seconds},
    }


@app.command()
def status(project_folder: ProjectPath, as_json: Json = False) -> None:
    """A table of the stages: fresh, stale or missing, seconds, figures."""
    from rich.table import Table

    project = _existing(project_folder)
    lines = _states(project)
    if as_json:
        answer = {"version": JSON_VERSION, "project": str(project.root), "stages": [_line_json(line) for line in lines]}
        typer.echo(json.dumps(answer, indent=1, ensure_ascii=False))
        return
    table = Table("stage", "state", "seconds", "figures", box=None)
    for line in lines:
        seconds = "" if line.seconds is None else f"{line.seconds:.0f}"
        table.add_row(line.name, line.state, seconds, _figures(line))
    rich.console.Console().print(table)


def _states(project: Project, alone: bool = False) -> list[pipeline.StageState]:
    """
    The state of every stage; stale, with a warning, where the capture or the head template is gone. `alone`: a project
    whose capture is gone is as fresh as when it was last seen with it.
    """
    from avatarbuild import pipeline
    from avatarbuild.capture_folder import open_capture

    capture = project.root / project.settings().get("capture", "")
    digest = template = ""
    with _warned():
        template = project.template().digest
    stamp = project.stamp("capture") or {}
    known = stamp.get("key", "") if alone and not capture.exists() else ""
    if not known:
        with _warned():
            found = open_capture(capture)
            digest = digest_files(found.root, [found.root / name for name in found.files])
    return pipeline.states(project, pipeline.keys(digest, template, _chosen(project), project.corrections(), known))


def _chosen(project: Project) -> dict[str, Any]:
    """The options of every stage that a project keeps."""
    kept = project.settings()
    return all_options.stage_options(kept.get("quality", "standard"), kept.get("options", {}))


@contextlib.contextmanager
def _warned() -> Iterator[None]:
    try:
        yield
    except InputError as error:
        screen.print(f"[yellow]warning[/] {rich.markup.escape(str(error))}")


@app.command()
def batch(
    captures: Annotated[Path, typer.Argument(metavar="CAPTURES_DIR", help="Folder whose sub-folders are captures.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="OUT", help="Folder for projects and summary.")],
    workers: Annotated[
        int | None, typer.Option(help="Runs at once; default: as many as memory allows, at most one a core.")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Run on the Dask cluster of this scheduler, tcp://HOST:PORT.")
    ] = None,
    threads: Annotated[int | None, typer.Option(help="Threads a run; default: the cores divided by the runs.")] = None,
    memory: Annotated[
        float | None, typer.Option(help="GB a run may take; default: free memory divided by the runs.")
    ] = None,
    time_limit: Annotated[float | None, typer.Option(help="Minutes after which a run is stopped.")] = None,
    until: Annotated[str | None, typer.Option(help="Stop after this stage.")] = None,
    pairs: Annotated[list[str] | None, typer.Option("--set", help="stage.option=value, for all.")] = None,
    quality: Annotated[str | None, typer.Option(help="draft, standard or high, for all.")] = None,
    template: TemplateName = None,
    as_json: Json = False,
) -> None:
    """Build the avatars of many captures; go on where an earlier batch left off."""
    from avatarbuild import pipeline
    from avatarbuild.batch.run import Means, run_batch

    pipeline.plan(None, until, None, False)  # what is wrong for all is said once
    settings = {key: value for key, value in _settings(pairs or []).items() if value != "default"}
    all_options.stage_options(quality or "standard", settings)
    if scheduler is not None and workers is not None:
        raise InputError("--workers was given with --scheduler: the cluster has its own workers, give one of the two")
    if any(value is not None and not 0 < value < 1e6 for value in (memory, time_limit)):
        raise InputError("--memory and --time-limit must be above 0, in GB and minutes")
    words = [word for pair in pairs or [] for word in ("--set", pair)]
    words += ["--until", until] if until else []
    words += ["--quality", quality] if quality else []
    words += ["--template", template if template == SHIPPED else str(resolve(template).path)] if template else []
    means = Means(
        *(workers, threads, None if memory is None else int(memory * 1e9)),
        *(None if time_limit is None else 60 * time_limit, scheduler),
    )
    made = run_batch(captures, output, words, until, means, screen)
    if as_json:
        typer.echo(json.dumps(_batch_json(output, made), indent=1, ensure_ascii=False))
    undone = [row for row in made if row.state != "done"]
    screen.print(f"{output}: {len(made) - len(undone)} of {len(made)} done; begin with index.html", soft_wrap=True)
    if undone:
        raise typer.Exit(FAULT if any(row.reason == "fault" for row in undone) else BAD_INPUT)


def _batch_json(output: Path, made: list[Any]) -> dict[str, Any]:
    subjects = [
        {
            "subject": row.subject,
            "state": row.state,
            "reason": row.reason,
            "message": row.message,
            "stage": row.stage,
            "figures": row.figures,
            "warnings": [f"{stage}: {text}" for stage, text in row.warnings],
            "timing": {"seconds": row.seconds},
        }
        for row in made
    ]
    return {"version": JSON_VERSION, "output": str(output), "subjects": subjects}


@app.command()
def track(
    project_folder: ProjectPath,
    video: Annotated[Path, typer.Argument(metavar="VIDEO", help="New footage of the same person.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="The file to write: .csv or .json.")],
    as_json: Json = False,
) -> None:
    """The performance in new footage on a built avatar, as track.csv or track.json."""
    from avatarbuild import new_footage, pipeline
    from avatarbuild.formats.track import track_bytes

    writer = track_bytes(output)
    project = _existing(project_folder)
    needed = ("capture", "cameras", "neutral", "albedo", "blendshapes", "tracking", "refinement")
    stale = [line for line in _states(project, alone=True) if line.name in needed and line.state != "fresh"]
    if stale:
        found = ", ".join(f"stage {line.name} is {line.state}" for line in stale)
        raise InputError(f"{project.root}: {found}: bring the avatar up to date with `avatarbuild run` first")
    template = project.template().load()
    inputs = {name: pipeline.load_artefact(project, name) for name in needed}
    with whole_file(output) as place:
        chosen = _chosen(project)["capture"]
        made = new_footage.track(**inputs, options=chosen, progress=Bars(), template=template, path=video)
        place.write_bytes(writer(made))
    if as_json:
        answer = {"version": JSON_VERSION, "track": str(output), "figures": made.figures, "warnings": made.warnings}
        typer.echo(json.dumps(answer, indent=1, ensure_ascii=False))
        return
    for warning in made.warnings:
        screen.print(f"[yellow]warning[/] {rich.markup.escape(warning)}")
    frames, good = made.figures["frames"], made.figures["good"]
    screen.print(f"{output}: {frames} frames, {good} of them tracked well", soft_wrap=True)


@app.command()
def annotate(
    project_folder: ProjectPath,
    port: Annotated[int, typer.Option(help="Of the page's address; 0: any free one.")] = 0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page.")] = True,
) -> None:
    """Put contours on the frontal photo and points in the video right by hand, on a page in the browser."""
    from avatarbuild import pipeline
    from avatarbuild.viewer import annotate as page

    project = _existing(project_folder)
    template, stamp = project.template().digest, project.stamp("capture") or {}

    def stale(told: Corrections) -> list[str]:
        made_of = pipeline.keys("", template, _chosen(project), told, stamp.get("key", ""))
        return [line.name for line in pipeline.states(project, made_of) if line.state != "fresh"]

    tell = lambda address: screen.print(f"{address}: the page of corrections; Ctrl-C ends it", soft_wrap=True)  # noqa: E731
    page.annotate(project, stale, port, browser, tell)


@app.command()
def clean(
    project_folder: ProjectPath,
    stages: Annotated[
        list[str] | None, typer.Option("--stage", help="Delete this stage's folder; may be repeated.")
    ] = None,
) -> None:
    """Show what a project takes on disk; with --stage, delete that."""
    from rich.table import Table

    from avatarbuild import pipeline

    project = _existing(project_folder)
    for stage in stages or []:
        if stage not in pipeline.NAMES:
            raise InputError(f"no stage '{stage}', {all_options.nearest(stage, pipeline.NAMES)}")
    with project.lock():
        for stage in stages or []:
            project.remove(stage)
        table = Table("folder", "MB", box=None)
        for name, size in project.sizes().items():
            table.add_row(name, f"{size / 1e6:.1f}")
        rich.console.Console().print(table)


@app.command()
def options(as_json: Json = False) -> None:
    """Every option of every stage: default, unit, sentence."""
    from rich.table import Table

    rows = all_options.described()
    if as_json:
        typer.echo(json.dumps({"version": JSON_VERSION, "options": rows}, indent=1, ensure_ascii=False))
        return
    table = Table("option", "default", "draft", "high", "unit", "what it does", box=None)
    for row in rows:
        values = [row["default"], row["draft"], row["high"]]
        table.add_row(row["option"], *[str(v) for v in values], row["unit"], row["sentence"])
    rich.console.Console().print(table)


@app.command()
def check(
    capture: CapturePath,
    picture: Annotated[Path | None, typer.Option(help="Where the picture of the coverage goes (PNG).")] = None,
    as_json: Json = False,
) -> None:
    """Look at a capture before heavy work: what is good, usable, to be shot again."""
    from avatarbuild import doctor

    checkup = doctor.examine(capture, Bars())
    place = picture if picture is not None else default_project(capture).with_suffix(".check.png")
    with whole_file(place) as partial:
        partial.write_bytes(checkup.picture)
    if as_json:
        typer.echo(json.dumps(checkup.as_json(), indent=1, ensure_ascii=False))
        return
    rich.console.Console().print(doctor.table(checkup))
    screen.print(f"picture of the coverage: {place}")


@app.command()
def animate(
    project_folder: ProjectPath,
    table: Annotated[
        Path, typer.Argument(metavar="WEIGHTS.csv", help="Weights of every frame; track.csv and its kin.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="The video to write (.mp4, .mov).")],
    fps: Annotated[float, typer.Option(help="Frames a second.")] = 30.0,
    light: Annotated[
        str, typer.Option(help="'estimated' from the photos, 'lamp', or a JSON file of 9 x 3 harmonics.")
    ] = "estimated",
    size: Annotated[str, typer.Option(help="Width x height in pixels.")] = "720x900",
    still: Annotated[bool, typer.Option("--still", help="Leave out the details that follow the expression.")] = False,
) -> None:
    """The avatar driven by weights, as a video."""
    from avatarbuild.animation import clip

    width, cross, height = size.lower().partition("x")
    if not (cross and width.strip().isdigit() and height.strip().isdigit()):
        raise InputError(f"--size {size} is not of the form 720x900")
    project, pixels = _existing(project_folder), (int(width), int(height))
    frames = clip.animate(project, table, output, Bars(), fps=fps, light=light, size=pixels, still=still)
    screen.print(f"{output}: {frames} frames")


@app.command()
def view(
    project_folder: ProjectPath,
    folder: Annotated[
        Path | None, typer.Option("--export", metavar="FOLDER", help="Write the page there, for any web server.")
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the page; 0: any free one.")] = 0,
    live: Annotated[int, typer.Option(min=0, max=65535, help="UDP port of live input, VMC and OSC; 0: none.")] = 39539,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")] = True,
) -> None:
    """Look at the avatar in a browser: sliders, light, the tracked performance, live input. Ctrl-C ends it."""
    from avatarbuild.viewer import view as page

    project = _existing(project_folder)
    tell = lambda text: screen.print(text, soft_wrap=True)  # noqa: E731
    if folder is not None:
        size = page.export(project, folder, tell)
        tell(f"{folder}: {size / 1e6:.1f} MB; any web server can serve it")
        return
    page.view(project, port, live, browser, lambda address: tell(f"{address}  Ctrl-C ends it"))


@app.command("transfer-details")
def transfer_details(
    source: Annotated[Path, typer.Argument(metavar="FROM", help="Project whose details are taken.")],
    target: Annotated[Path, typer.Argument(metavar="TO", help="Project whose avatar gets them.")],
) -> None:
    """Put one person's details on another's avatar; TO keeps its own neutral normal map."""
    from avatarbuild.details import transfer

    count = transfer.transfer_details(_existing(source), _existing(target))
    screen.print(f"{target}: {count} files of details from {source}")


@app.command()
def simulate(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="CAPTURE", help="New folder for the capture.")],
    seed: Annotated[int, typer.Option(help="Another number, another person.")] = 0,
    truth: Annotated[Path | None, typer.Option(help="Folder for the ground truth; default CAPTURE.truth.")] = None,
    pairs: Annotated[list[str] | None, typer.Option("--set", help="option=value, like photos=12.")] = None,
    template: TemplateName = None,
) -> None:
    """Render a capture from the head template, with its ground truth."""
    from avatarbuild.simulation import capture as simulation

    chosen = {}
    for pair in pairs or []:
        name, _, text = pair.partition("=")
        chosen[name.strip()] = all_options.parse_field(simulation.SimulationOptions, name.strip(), text.strip())
    options_ = simulation.SimulationOptions(**chosen)
    head = resolve(template or SHIPPED).load()
    place = simulation.simulate(output, seed, options_, truth_folder=truth, template=head, progress=Bars())
    screen.print(f"capture: {output}, truth: {place}")


@templates.command("list")
def template_list(
    folder: Annotated[Path | None, typer.Argument(help="Folder with imported templates.")] = None, as_json: Json = False
) -> None:
    """The shipped head and the templates of a folder."""
    from avatarbuild import template_commands

    entries = template_commands.list_templates(folder)
    if as_json:
        rows = [entry._asdict() | {"path": str(entry.path)} for entry in entries]
        typer.echo(json.dumps({"version": JSON_VERSION, "templates": rows}, indent=1, ensure_ascii=False))
        return
    rich.console.Console().print(template_commands.list_table(entries))


@templates.command("info")
def template_info(
    name: Annotated[str, typer.Argument(metavar="NAME", help="'head' for the shipped one, or a file.")] = "head",
    as_json: Json = False,
) -> None:
    """What a template holds."""
    from avatarbuild import template_commands

    facts = template_commands.describe(name)
    if as_json:
        about = facts._asdict() | {"path": str(facts.path)}
        typer.echo(json.dumps({"version": JSON_VERSION, "template": about}, indent=1, ensure_ascii=False))
        return
    rich.console.Console().print(template_commands.facts_table(facts))


@templates.command("import")
def template_import(
    source: Annotated[Path, typer.Argument(help="ICT-FaceKit's folder, or a FLAME or BFM file.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="The template file to write (.npz).")],
    kind: Annotated[str | None, typer.Option(help="ict, flame or bfm; told from the files by default.")] = None,
) -> None:
    """Make a template of a head model that you hold a licence for."""
    from avatarbuild import template_commands

    made = template_commands.import_template(source, kind, output)
    screen.print(f"{output}: template {made.name}, {len(made.mean)} vertices")


def _existing(folder: Path) -> Project:
    if not (folder / "project.toml").is_file():
        raise InputError(f"{folder} holds no project.toml: name a project folder made by `avatarbuild run`")
    return Project(folder)


@contextlib.contextmanager
def _native_chatter_into(file: Path) -> Iterator[None]:
    """Sends what compiled libraries write to the process's standard error into a file; our own lines stay visible."""
    try:
        ours = sys.stderr.fileno() == 2
    except (AttributeError, OSError, ValueError):
        ours = False
    if not ours:
        yield
        return
    sys.stderr.flush()
    kept = os.dup(2)
    with file.open("ab") as log_file, open(kept, "w", encoding=sys.stderr.encoding, closefd=False) as terminal:
        os.dup2(log_file.fileno(), 2)
        screen.file = terminal
        try:
            yield
        finally:
            terminal.flush()
            os.dup2(kept, 2)
            os.close(kept)
            screen.file = sys.stderr


@contextlib.contextmanager
def _log_into(file: Path) -> Iterator[None]:
    root = logging.getLogger("avatarbuild")
    handler = logging.FileHandler(file, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    root.addHandler(handler)
    root.setLevel(logging.INFO)
    root.propagate = False
    try:
        yield
    except Exception:
        root.exception("the run ends")
        raise
    finally:
        root.removeHandler(handler)
        handler.close()


def run_program() -> None:
    """The console script: runs a verb, turns exceptions into one line and an exit code."""
    logging.getLogger("avatarbuild").addHandler(logging.NullHandler())
    try:
        code = app(standalone_mode=False)
    except InputError as error:
        screen.print(f"[red]error[/] {rich.markup.escape(str(error))}", soft_wrap=True)
        code = BAD_INPUT
    except (KeyboardInterrupt, typer.Abort):
        code = STOPPED
    except typer.TyperException as error:  # a misspelt verb or flag
        error.show() if hasattr(error, "show") else screen.print(f"[red]error[/] {error}")
        code = BAD_INPUT
    except Exception as error:
        if os.environ.get("AVATARBUILD_TRACEBACK"):
            raise
        kind = type(error).__name__
        screen.print(
            f"[red]fault[/] {kind}: {rich.markup.escape(str(error))} — a fault of this program, not of your input; the "
            "project's avatarbuild.log tells more, and AVATARBUILD_TRACEBACK=1 shows where",
            soft_wrap=True,
        )
        code = FAULT
    sys.exit(code if isinstance(code, int) else DONE)
