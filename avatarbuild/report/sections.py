"""The page's sections: what to do, the photos, the surface, the fit, the expressions, the figures."""

from __future__ import annotations

from html import escape
from typing import Any

import numpy as np

from avatarbuild.artefacts import Cameras, Capture, Cloud, Neutral
from avatarbuild.formats.colour import encode_srgb
from avatarbuild.report import diagrams, overlay, views, words
from avatarbuild.report.heads import Figure, coarse, expression
from avatarbuild.report.html import drawing, duration, legend, paragraph, picture, row, section
from avatarbuild.report.rendering import View
from avatarbuild.template import ARKIT_NAMES, Template

_SIDE = (264, 320)  # pixels of a picture from one side
_PHOTO = (480, 576)
_LIDS = tuple(f"lid_{half}_{side}" for side in ("left", "right") for half in ("upper", "lower"))
_LIPS = tuple(f"lips_{ring}_{half}" for ring in ("outer", "inner") for half in ("upper", "lower"))
_EYES_CLOSE = View(size=(560, 200), height=46.0, distance=700.0, centre=(0.0, 1.0, 8.0))
_MOUTH_CLOSE = View(size=(460, 330), height=84.0, distance=700.0, pitch=3.0)
_SHEET = View(yaw=10, size=(208, 224), height=190.0, centre=(0.0, -24.0, 0.0))
_DOTS = ("sharp", "softened", "blurred", "untrusted")


def advice(todo: list[words.Caution]) -> str:
    """Every warning with what to do."""
    if not todo:
        return section("advice", "What to do", paragraph("Nothing: no stage has anything to complain of."))
    items = "".join(
        f'<li><span class="stage">{escape(w.stage)}</span>{escape(w.found)}'
        f'<span class="do"><b>What to do:</b> {escape(w.advice)}</span></li>'
        for w in todo
    )
    return section("advice", "What to do", f'<ul class="todo">{items}</ul>')


def coverage(
    capture: Capture, cameras: Cameras, found: list[overlay.Shot], neutral: Neutral, template: Template
) -> str:
    """From where the photos see the face, and where their cameras stood."""
    dots = diagrams.dots(capture, found)
    above, side = diagrams.ring(dots, neutral, template)
    out = diagrams.left_out(capture, cameras)
    missing = "Every photo could be placed."
    if out:
        missing = f"Left out, because they could not be placed: {escape(', '.join(out))}."
    mark = lambda inner: f'<svg viewBox="0 0 14 14" aria-hidden="true">{inner}</svg>'  # noqa: E731
    said = ("sharp", "softer", "blurred", "from the side, or no sure face: good for the shape alone")
    marks = [(mark(f'<circle class="dot {kind}" cx="7" cy="7" r="5"/>'), word) for kind, word in zip(_DOTS, said)]
    if out:
        marks.append((mark('<path class="left-out" d="M2 2l10 10M2 12L12 2"/>'), "left out"))
    if 'class="lack"' in (plot := diagrams.coverage(dots)):
        marks.append((mark('<rect class="lack" width="14" height="14"/>'), "no trusted photo from here"))
    return section(
        "coverage",
        "Where the photos were taken from",
        paragraph(
            "Each dot is a photo, at the direction from which it sees the face. An even row from ear to ear, with some "
            "from above and below, shows all of a face."
        )
        + f'<div class="keyed"><div class="card">{plot}</div>{legend(marks)}</div><h3>The cameras around the head</h3>'
        + paragraph(f"The dashed line is the walk from photo to photo. {missing}")
        + row([drawing(above, "From above; the face looks down"), drawing(side, "From their left side")], "plans"),
    )


def cloud(points: Cloud, neutral: Neutral) -> str:
    """The cloud from five sides, in colours and as clay."""
    coloured, clay = views.cloud_pictures(points, neutral, _SIDE)
    return section(
        "cloud",
        "What the photos saw",
        paragraph(
            "The points that several photos agree on, before any head was fitted: in their colours, and as clay, which "
            "shows the shape alone. Holes are places that too few photos show, such as hair, the back of the head and "
            "beneath the chin. The eyes are left out on purpose: they shine and turn."
        )
        + _five(coloured, "The cloud")
        + _five(clay, "The cloud as clay"),
    )


def fit(capture: Capture, found: list[overlay.Shot], neutral: Neutral, template: Template) -> str:
    """The heat map from five sides, the head over six photos, and a close look at the frontal one."""
    scale = views.heat_scale(neutral, template)
    heat = [views.heat_picture(neutral, template, view, scale) for view in views.side_views(_SIDE)]
    stops = encode_srgb(views.heat_colour(np.linspace(-scale, scale, 81), scale))
    bar = diagrams.colour_bar(scale, [(int(r), int(g), int(b)) for r, g, b in stops])
    chosen, drawn = overlay.spread(found, capture), overlay.lines_of(template)
    photos, close = [], ""
    for shot in chosen:
        rgb = capture.photos.images[shot.photo].rgb()
        name = capture.photos.names[shot.photo]
        crop = overlay.mesh_over_photo(rgb, shot, neutral.vertices, template, drawn, _PHOTO)
        photos.append(picture(crop.image, f"The head over photo {name}", f"{name}, {_side(shot.yaw)}"))
        if shot.photo == capture.frontal:
            close = _close(rgb, shot, name, capture.photos.landmarks[shot.photo, :, :2], neutral, template)
    stroke = lambda colour: f'<i style="background:rgb{colour}"></i>'  # noqa: E731
    lines = [
        *((stroke(overlay.WIRE), "mesh"), (stroke(overlay.LIDS), "lids"), (stroke(overlay.LIPS), "lips")),
        *((stroke(overlay.BROWS), "brows"), (stroke(overlay.OUTLINE), "outline of face, nose and ears")),
    ]
    return section(
        "fit",
        "How well the head fits",
        paragraph(
            "How far the photos’ points lie from the fitted head. Red: outside the head; blue: inside; pale: on it. "
            "This says how closely the head follows the points, not how true they are: they have a noise of their own, "
            "about a tenth of a millimetre, and the scale its error."
        )
        + _five(heat, "Heat map of the fit")
        + f'<div class="bar"><div>{bar}</div><p>Millimetres. Hatched: the photos say little or nothing here, and '
        "experience with other heads decided. Grey: no distance could be measured.</p></div>"
        + "<h3>The head over the photos</h3>"
        + paragraph(
            "The coloured lines belong on the rims of lids and lips, on the upper edge of the brows and on the outline "
            "of the face. Over hair the mesh is the skull beneath."
        )
        + row(photos, "grid3 photos")
        + legend(lines)
        + close,
    )


def _close(
    rgb: np.ndarray, shot: overlay.Shot, name: str, landmarks: np.ndarray, neutral: Neutral, template: Template
) -> str:
    if not np.isfinite(landmarks).all():
        return ""
    parts = []
    pixels, _ = shot.project(neutral.vertices)
    for names, what, size in ((_LIDS, "lids", (760, 250)), (_LIPS, "lips", (760, 330))):
        crop = overlay.zoom(rgb, shot, neutral, template, landmarks, names, size)
        rims = overlay.rim_landmarks(template, names)
        off = overlay.contour_distance(landmarks[rims], pixels, template, names)
        said = (
            f"{what.capitalize()}: {len(rims)} points of the detector, {off.mean():.1f} px of the photo off the rims "
            f"on average, {off.max():.1f} px at most"
        )
        parts.append(picture(crop.image, f"Detail of the {what} in photo {name}", said))
    return (
        f"<h3>Eyes and mouth in {escape(name)}</h3>"
        + paragraph(
            "Lines: rims of the fitted head. White dots: where the face detector saw them. Where the two disagree, "
            "believe the photo."
        )
        + row(parts, "pair")
    )


def expressions(figure: Figure) -> str:
    """Eyes and mouth close, and all 52 shapes."""
    lips = figure.posed({})[: figure.template.vertex_count][figure.template.regions["lips"]].mean(axis=0)
    mouth = _MOUTH_CLOSE._replace(centre=(0.0, float(lips[1]) - 4.0, float(lips[2]) - 8.0))
    both = lambda name, v: {f"{name}Left": v, f"{name}Right": v}  # noqa: E731
    eyes = [({}, "Neutral"), (both("eyeBlink", 0.5), "Half a blink"), (both("eyeBlink", 1.0), "Closed")]
    teeth = {**both("mouthSmile", 0.7), **both("mouthUpperUp", 0.6), **both("mouthLowerDown", 0.6)}
    mouths = [({"jawOpen": 0.7}, "Jaw open"), (teeth, "Teeth"), ({"tongueOut": 1.0, "jawOpen": 0.5}, "Tongue")]
    close = [picture(figure.picture(w, _EYES_CLOSE), f"Eyes: {name}", name) for w, name in eyes]
    close += [picture(figure.picture(w, mouth), f"Mouth: {name}", name) for w, name in mouths]
    small = coarse(figure)
    sheet = [picture(small.picture(expression(name), _SHEET), name, name, lazy=True) for name in ARKIT_NAMES]
    return section(
        "expressions",
        "Expressions",
        row(close, "grid3 close")
        + "<h3>All 52</h3>"
        + paragraph(
            "Each at full strength, named as in ARKit; left and right are the person’s own. <code>mouthClose</code> "
            "and <code>tongueOut</code> are shown with the jaw open, as they are meant."
        )
        + row(sheet, "sheet"),
    )


def figures(stages: list[dict[str, Any]]) -> str:
    """A table a stage with a sentence for each figure that has one, and the stages' times."""
    tables = []
    for stage in stages:
        known, given = words.FIGURES.get(stage["stage"], {}), stage.get("figures") or {}
        rows = []
        for key in [*(k for k in known if k in given), *(k for k in given if k not in known)]:
            about = known.get(key)
            label = f"<code>{escape(key)}</code>" if about is None else escape(about.label)
            text = words.value(given[key], "" if about is None else about.unit)
            rows.append(
                f'<tr><th scope="row">{label}</th><td class="number{" long" if len(text) > 28 else ""}">{escape(text)}'
                f"</td><td>{'' if about is None else escape(about.sentence)}</td></tr>"
            )
        if rows:
            tables.append(
                f'<h3>{escape(stage["stage"].capitalize())}</h3><table class="figures">{"".join(rows)}</table>'
            )
    return section("figures", "Figures", "".join(tables) + _times(stages))


def _times(stages: list[dict[str, Any]]) -> str:
    timed = [(stage["stage"], (stage.get("timing") or {}).get("seconds")) for stage in stages]
    known = [(name, float(seconds)) for name, seconds in timed if seconds is not None]
    if not known:
        return ""
    most = max(max(seconds for _, seconds in known), 1e-3)
    rows = "".join(
        f'<tr><th scope="row">{escape(name.capitalize())}</th><td class="number">{duration(seconds)}</td>'
        f'<td><i style="width:{100 * seconds / most:.1f}%"></i></td></tr>'
        for name, seconds in known
    )
    return f'<h3>Time</h3><table class="times">{rows}</table>'


def _five(pictures: list[np.ndarray], what: str) -> str:
    named = zip(pictures, (name for name, _ in views.SIDES))
    return row([picture(image, f"{what}: {name}", name.capitalize()) for image, name in named], "grid5")


def _side(yaw: float) -> str:
    return "from the front" if abs(yaw) < 8 else f"{abs(yaw):.0f}° from their {'left' if yaw > 0 else 'right'}"
