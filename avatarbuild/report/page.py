"""report.html: one page that stands alone, for the person who took the photos."""

from __future__ import annotations

from collections.abc import Callable
from html import escape
from typing import Any

from avatarbuild.artefacts import Albedo, Blendshapes, Cameras, Capture, Cloud, Details, Neutral, Performance
from avatarbuild.parallel import each_alone
from avatarbuild.report import heads, overlay, sections, words
from avatarbuild.report.html import duration, paragraph, picture, row, style
from avatarbuild.report.performance import performance_section
from avatarbuild.report.rendering import View
from avatarbuild.report.wrinkles import wrinkles_section
from avatarbuild.template import Template

_HERO = View(size=(460, 560), height=305.0, centre=(0.0, -18.0, -30.0))
_SMILE = {
    **dict.fromkeys(("mouthSmileLeft", "mouthSmileRight"), 0.75),
    **dict.fromkeys(("cheekSquintLeft", "cheekSquintRight"), 0.5),
    **dict.fromkeys(("eyeSquintLeft", "eyeSquintRight"), 0.25),
    "jawOpen": 0.16,
    "browInnerUp": 0.25,
}
_ELSEWHERE = (
    "To see it move, with its wrinkles and any light: <code>avatarbuild view PROJECT</code>. To put contours and "
    "points right by hand: <code>avatarbuild annotate PROJECT</code>. PROJECT is the folder above this page’s."
)
_PLACES = (
    *(("advice", "What to do"), ("coverage", "Photos"), ("cloud", "Surface"), ("fit", "Fit")),
    *(("expressions", "Expressions"), ("performance", "Performance"), ("details", "Wrinkles")),
    ("figures", "Figures"),
)


def page(
    capture: Capture,
    cameras: Cameras,
    points: Cloud,
    neutral: Neutral,
    albedo: Albedo,
    blendshapes: Blendshapes,
    performance: Performance,
    details: Details,
    template: Template,
    stages: list[dict[str, Any]],
) -> bytes:
    """
    The page as UTF-8: pictures inside it, nothing fetched, no script.

    stages: the stamps of the finished stages, in order: stage, figures, warnings, versions, timing. Equal inputs give
    equal bytes.
    """
    own = Blendshapes(performance.neutral, performance.deltas, performance.eye_centres)
    figure = heads.figure(own, albedo.albedo, template, 1)
    filmed = len(performance.times) > 0
    found = overlay.shots(capture, cameras, neutral)
    todo = words.cautions(stages)
    absent = {"performance": not filmed, "details": not details.files}
    links = "".join(f'<li><a href="#{key}">{name}</a></li>' for key, name in _PLACES if not absent.get(key))
    parts: list[Callable[[], str]] = [
        lambda: _opening(capture, cameras, figure),
        lambda: _verdict(capture, cameras, points, neutral, template, stages, len(todo)),
        lambda: f'</header><nav aria-label="Sections"><ul>{links}</ul></nav><main>',
        lambda: sections.advice(todo),
        lambda: sections.coverage(capture, cameras, found, neutral, template),
        lambda: sections.cloud(points, neutral),
        lambda: sections.fit(capture, found, neutral, template),
        lambda: sections.expressions(figure),
        lambda: performance_section(capture, performance, blendshapes, figure, template) if filmed else "",
        lambda: wrinkles_section(details, performance, albedo, own, template),
        lambda: sections.figures(stages),
        lambda: "</main>",
        lambda: _closing(stages, template),
    ]
    body = list(each_alone(lambda make: make(), parts, ahead=len(parts)))
    head = (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>Avatar report</title>'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<style>{style()}</style></head>\n<body>"
    )
    return (head + "\n".join(body) + "</body></html>\n").encode()


def _opening(capture: Capture, cameras: Cameras, figure: heads.Figure) -> str:
    """Who and what, and the head."""
    clip = capture.clip
    video = ", without a video"
    if clip is not None:
        video = f" and {len(clip.processed)} frames of a video of {clip.times[-1]:.0f} s"
    origin, error = words.scale_words(cameras)
    shown = [
        picture(figure.picture({}, _HERO), "The neutral head from the front", "Neutral"),
        picture(figure.picture({}, _HERO._replace(yaw=38, pitch=4)), "The neutral head, half left", "From their left"),
        picture(figure.picture(_SMILE, _HERO._replace(yaw=-20)), "The head, smiling", "Smiling"),
    ]
    said = f"A head made from {cameras.model.num_reg_images()} photos{video}. {origin} {error}"
    return (
        f'<header id="top"><h1>Avatar report</h1>{paragraph(escape(said), "lead")}{row(shown, "grid3 hero")}'
        + paragraph(
            "The avatar’s shape in the skin’s own colours, without the photos’ light; what none shows is filled in.",
            "note",
        )
        + paragraph(_ELSEWHERE, "note")
    )


def _verdict(
    capture: Capture,
    cameras: Cameras,
    points: Cloud,
    neutral: Neutral,
    template: Template,
    stages: list[dict[str, Any]],
    todo: int,
) -> str:
    """One line, and the figures behind it."""
    fit = words.fit(neutral, template)
    grade, line = words.verdict(fit, todo)
    placed, total = cameras.model.num_reg_images(), len(capture.photos)
    sd = cameras.scale.get("relative_sd")
    facts = [
        ("Photos used", f"{placed} of {total}", "the others are marked below" if placed < total else "all of them"),
        ("Points of the surface", words.value(len(points.points)), "that photos agree on"),
        ("Distance to them", *_distance(fit)),
        ("Scale", "unknown" if sd is None else f"± {100 * sd:.1f} %", f"from the {cameras.scale.get('source')}"),
    ]
    seconds = [s for s in ((stage.get("timing") or {}).get("seconds") for stage in stages) if s is not None]
    if seconds:
        facts.append(("Computed in", duration(sum(seconds)), f"{len(seconds)} stages"))
    cells = "".join(
        f"<div><dt>{escape(name)}</dt><dd>{escape(text)}<small>{escape(small)}</small></dd></div>"
        for name, text, small in facts
    )
    return f'<div class="verdict {grade}"><p>{escape(line)}</p></div><dl class="facts">{cells}</dl>'


def _distance(fit: dict[str, float]) -> tuple[str, str]:
    if not fit["share"]:
        return "unknown", "no point lies on the face"
    return f"{fit['median']:.2f} mm", f"median of the face; 90 % within {fit['p90']:.2f} mm"


def _closing(stages: list[dict[str, Any]], template: Template) -> str:
    """Versions and dates."""
    versions = [(stage["stage"], stage.get("versions") or {}) for stage in stages]
    program = sorted({str(v["avatarbuild"]) for _, v in versions if "avatarbuild" in v})
    numbers = ", ".join(f"{name} {v['stage']}" for name, v in versions if "stage" in v)
    begun = sorted(str(t["started"]) for t in (stage.get("timing") or {} for stage in stages) if "started" in t)
    when = f" Made from {begun[0][:16].replace('T', ' ')} to {begun[-1][:16].replace('T', ' ')} UTC." if begun else ""
    said = (
        f"avatarbuild {', '.join(program) or 'of unknown version'}; template {template.name} {template.version}; "
        f"stages’ versions: {numbers or 'unknown'}.{when} This page fetches nothing."
    )
    return f"<footer>{escape(said)}</footer>"
