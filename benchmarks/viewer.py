"""
What the viewer costs: seconds to the first and to the full picture, the page's size, milliseconds a picture in software
GL, the shader.

    PYTHONPATH=. python benchmarks/viewer.py PROJECT [--pictures 10] [--starts 3] [--keep FOLDER]

PROJECT has a finished avatar. Needs Chromium (AVATARBUILD_CHROMIUM names its program). The browser runs already and
rests; time counts from the command's start to the frame after the picture's, in a window of 640 x 640. FOLDER gets what
the window shows at both times. Then pictures are drawn at 640 x 640 with all 52 shapes at work and the shadow made
anew, and read back, so that nothing is left in a queue. On a machine that does other work too, core-seconds tell more
than seconds.
"""

from __future__ import annotations

import argparse
import contextlib
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import psutil

from avatarbuild.project import Project
from avatarbuild.viewer.view import export
from tests import devtools

READY = "document.documentElement.dataset.state === 'ready'"
WHOLE = "document.documentElement.dataset.whole"
FIRST = ("index", "viewer.css", "context", "main.js", "stage", "first", "environment", "surface.js", "three.js")
FULL = (*FIRST, ".js", ".glsl", "scene.json", "avatar.glb", "details/")
_REST = 2.0  # seconds after which a new browser has done what it does at its start
_CALLS = re.compile(r"\b([A-Za-z_]\w*)\s*\(")
_LOOP = re.compile(r"for\s*\([^;]*=\s*(-?\d+)[^;]*;[^;]*<\s*(\d+)[^;]*;[^)]*\)+\s*\{")
_HEAVY = {"exp": 4, "exp2": 4, "pow": 8, "sqrt": 4, "normalize": 8, "inversesqrt": 4, "log2": 4, "reflect": 6}
_LIGHT = ("dot", "mix", "clamp", "max", "min", "cross", "abs", "floor", "fract", "step", "smoothstep", "mod", "length")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("project", type=Path)
    parser.add_argument("--pictures", type=int, default=10)
    parser.add_argument("--starts", type=int, default=3)
    parser.add_argument("--keep", type=Path, metavar="FOLDER")
    args = parser.parse_args()
    project = Project(args.project)
    with tempfile.TemporaryDirectory() as folder:
        total = export(project, Path(folder) / "page", lambda _: None)
        sizes = {p.relative_to(folder).as_posix(): p.stat().st_size for p in Path(folder).rglob("*") if p.is_file()}
    first, full = (
        sum(size for name, size in sizes.items() if any(part in name for part in parts)) for parts in (FIRST, FULL)
    )
    print(
        f"page: {total / 1e6:.1f} MB in all; {first / 1e6:.1f} MB for the first picture, {full / 1e6:.1f} MB for the "
        "full one"
    )
    for name, size in sorted(sizes.items(), key=lambda item: -item[1])[:6]:
        print(f"  {size / 1e6:6.2f}  {name}")
    for _ in range(args.starts - 1):
        with started(args.project, args.keep):
            pass
    with started(args.project, args.keep) as page:
        page.press("h")
        page.wait("document.getElementById('canvas').width === 640", 30)
        for name, before in (
            ("all", ""),
            ("without details", "viewer.toggles.set('details', false)"),
            ("blendshapes only", "viewer.toggles.set('bare', true)"),
        ):
            page.evaluate(before)
            page.evaluate("viewer.measure(1)", 600)
            idle = busy()
            times = page.evaluate(f"viewer.measure({args.pictures})", 3000)
            spent = 1e3 * (busy() - idle) / args.pictures
            drawn, cpu = min(times["drawn"]), min(times["cpu"])
            print(
                f"640 x 640, {name}: {drawn:.0f} ms a picture at best, {cpu:.2f} ms of it weights and strain; "
                f"{spent:.0f} core-milliseconds"
            )
        source = page.evaluate(_SOURCE)
        for part in ("vertex", "fragment"):
            reads, work = cost(source[part])
            print(f"skin, {part} shader: at most {reads} texture reads, about {work} operations on vectors")


@contextlib.contextmanager
def started(project: Path, folder: Path | None) -> Iterator[devtools.Page]:
    """The page of `avatarbuild view`, loaded by a new browser; prints when its pictures were there."""
    with devtools.browser() as page:
        page.size(640, 640)
        time.sleep(_REST)
        begun, idle = time.time(), busy()
        command = [sys.executable, "-m", "avatarbuild", "view", str(project), "--no-browser", "--live", "0"]
        program = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        try:
            assert program.stderr is not None
            address = next(word for word in program.stderr.readline().split() if word.startswith("http"))
            served = time.time() - begun
            page.open(address)
            page.wait(READY, 300)
            spent = [busy() - idle]
            keep(page, folder, "first")
            page.wait(WHOLE, 300)
            spent.append(busy() - idle)
            first, full = (page.evaluate(_SHOWN.format(name)) / 1e3 - begun for name in ("first", "full"))
            print(
                f"the server answers after {served:.2f} s; first picture {first:.2f} s, full picture {full:.2f} s; "
                f"core-seconds of program and browser {spent[0]:.1f}, and {spent[1]:.1f} with all that is fetched later"
            )
            keep(page, folder, "full")
            yield page
        finally:
            program.terminate()
            program.wait(20)


def keep(page: devtools.Page, folder: Path | None, name: str) -> None:
    """Writes what the window shows as NAME.png."""
    if folder is not None:
        folder.mkdir(exist_ok=True)
        (folder / f"{name}.png").write_bytes(page.picture())


_SHOWN = "performance.timeOrigin + performance.getEntriesByName('{} picture')[0].startTime"
_SOURCE = """(() => {
    const gl = viewer.stage.context;
    const program = viewer.stage.renderer.properties.get(viewer.surface.skin).currentProgram;
    return { vertex: gl.getShaderSource(program.vertexShader), fragment: gl.getShaderSource(program.fragmentShader) };
})()"""


def busy() -> float:
    """Core-seconds of everything that this process has started."""
    total = 0.0
    for process in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):
            times = process.cpu_times()
            total += times.user + times.system
    return total


def preprocessed(source: str) -> str:
    """GLSL without comments and directives: conditions decided, names of numbers replaced."""
    names: dict[str, str] = {"GL_ES": "1", "__VERSION__": "300"}
    taken: list[list[bool]] = []  # of each open #if: whether its branch is taken now, and whether one was
    lines = []

    def true(condition: str) -> bool:
        text = re.sub(r"defined\s*\(?\s*(\w+)\s*\)?", lambda m: str(int(m[1] in names)), condition)
        text = _put(text, names)
        text = re.sub(r"[A-Za-z_]\w*(\s*\([^)]*\))?", "0", text).replace("&&", " and ").replace("||", " or ")
        return bool(eval(re.sub(r"!(?!=)", " not ", text), {}))

    for line in re.sub(r"/\*.*?\*/|//[^\n]*", "", source, flags=re.DOTALL).splitlines():
        word = re.match(r"\s*#\s*(\w+)\s*(.*)", line)
        on = all(now for now, _ in taken)
        if word is None:
            if on:
                lines.append(_put(line, names))
        elif word[1] in ("if", "ifdef", "ifndef"):
            known = on and (true(word[2]) if word[1] == "if" else (word[2].strip() in names) == (word[1] == "ifdef"))
            taken.append([known, known])
        elif word[1] in ("else", "elif"):
            known = not taken[-1][1] and (word[1] == "else" or true(word[2]))
            taken[-1] = [known, taken[-1][1] or known]
        elif word[1] == "endif":
            taken.pop()
        elif on and word[1] == "define" and (found := re.match(r"(\w+)(?!\w|\()\s*(.*)", word[2])):
            names[found[1]] = found[2].strip()
        elif on and word[1] == "undef":
            names.pop(word[2].strip(), None)
    return "\n".join(lines)


def _put(text: str, names: dict[str, str]) -> str:
    for _ in range(3):
        text = re.sub(r"\b[A-Za-z_]\w*\b", lambda m: names.get(m[0], m[0]), text)
    return text


def cost(source: str) -> tuple[int, int]:
    """Texture reads and operations of main(), every branch taken, loops by their counts, calls followed."""
    bodies = dict(_functions(preprocessed(source)))
    known: dict[str, tuple[int, int]] = {}

    def of(name: str) -> tuple[int, int]:
        if name not in known:
            known[name] = (0, 0)
            known[name] = walk(bodies[name])
        return known[name]

    def walk(text: str) -> tuple[int, int]:
        reads = work = 0
        while loop := _LOOP.search(text):
            end = _closing(text, loop.end() - 1)
            inner = walk(text[loop.end() : end])
            times = int(loop[2]) - int(loop[1])
            reads, work = reads + times * inner[0], work + times * inner[1]
            text = text[: loop.start()] + text[end + 1 :]
        work += len(re.findall(r"(?<![\w(,=+*/-])\s*[-+*/](?!=)|[-+*/]=", text))
        for call in _CALLS.findall(text):
            if call in bodies:
                inner = of(call)
                reads, work = reads + inner[0], work + inner[1]
            elif call.startswith("tex") and call != "textureSize":
                reads += 1
            else:
                work += _HEAVY.get(call, 1 if call in _LIGHT else 0)
        return reads, work

    return of(next(name for name in bodies if name.endswith("main")))


def _functions(source: str) -> list[tuple[str, str]]:
    found = []
    for head in re.finditer(r"^[\w \t]+?\b(\w+)\s*\(([^;{}]*)\)\s*\{", source, re.MULTILINE):
        if head[1] not in ("if", "for", "while", "switch"):
            end = _closing(source, head.end() - 1)
            found.append((head[1], source[head.end() : end]))
    return found


def _closing(text: str, at: int) -> int:
    depth = 0
    for i in range(at, len(text)):
        depth += (text[i] == "{") - (text[i] == "}")
        if depth == 0:
            return i
    raise ValueError("a brace is not closed")


if __name__ == "__main__":
    main()
