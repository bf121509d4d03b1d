"""Every figure of stage blendshapes.

    python benchmarks/blendshapes.py [itself] [truth] [contacts] [speed] [pictures] [--people 24] [--out docs/images]

itself    the template onto itself, before storing
truth     transferred shapes of simulated people against their own ones, beside the template's bare displacements
contacts  lids, lips, teeth of the same people: with the contacts kept, as transferred, and the bare displacements
speed     seconds of the stage (on an idle machine)
pictures  two people's expressions, blinks and mouths, for docs/blendshapes.md; not among those that run unnamed
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "templates" / "head")]

from avatarbuild.contacts import Contacts, Head  # noqa: E402
from avatarbuild.geometry.raster import project, rasterise  # noqa: E402
from avatarbuild.options import BlendshapesOptions  # noqa: E402
from avatarbuild.progress import Silent  # noqa: E402
from avatarbuild.simulation.subject import Subject, random_subject  # noqa: E402
from avatarbuild.stages.blendshapes import transferred  # noqa: E402
from avatarbuild.template import ARKIT_NAMES, EYE_PARTS, Template  # noqa: E402
from avatarbuild.template import expression_weights as weights  # noqa: E402

FIRST = 1000  # seed of the first person


def rig(t: Template, head: Head, contacts: bool = True) -> np.ndarray:
    """(e, n, 3) the stage's displacements in double precision."""
    with Silent().task("", 1) as task:
        return transferred(t, head, BlendshapesOptions(contacts=contacts), task)[0]


def people(t: Template, count: int) -> list[Subject]:
    return [random_subject(t, np.random.default_rng(FIRST + i)) for i in range(count)]


def itself(t: Template, _: int) -> None:
    """The largest difference to the template's own expressions."""
    for contacts in (True, False):
        worst = np.abs(rig(t, Head(t.mean, t.eye_centres), contacts) - t.expressions).max()
        print(f"itself: contacts {'kept' if contacts else 'left'}: largest difference {worst:.1e} mm")


def truth(t: Template, count: int) -> None:
    """Mean error on the face where a person's own shape moves by 0.1 mm, over all shapes."""
    face = t.regions["face"]
    errors: dict[str, list[float]] = {"transferred": [], "bare displacements": [], "nothing": []}
    for subject in people(t, count):
        own = subject.expressions
        made = rig(t, Head(subject.neutral, subject.eye_centres))
        for name, shapes in (("transferred", made), ("bare displacements", t.expressions), ("nothing", 0 * own)):
            apart = np.linalg.norm(shapes - own, axis=2)
            moving = (np.linalg.norm(own, axis=2) > 0.1) & face
            errors[name].append(float(np.mean([apart[j][moving[j]].mean() for j in range(51)])))
    for name, found in errors.items():
        print(f"truth: {name:18s} mean {np.mean(found):.3f}, worst person {max(found):.3f} mm over {count} people")


def seen(t: Template, vertices: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """(450, 900) the triangle in each pixel of a frontal picture about `centre`, 8 pixels a millimetre."""
    K = np.array([[9600.0, 0, 450], [0, 9600.0, 225], [0, 0, 1]])
    R = np.diag([1.0, -1, -1])
    pixels, depth = project(vertices, K, np.zeros(5), R, np.array([0, 0, 1200]) - R @ centre)
    return rasterise(pixels, depth, t.triangles, (900, 450)).triangle


def contacts(t: Template, count: int) -> None:
    """Figures of the stage, eyeball pixels of closed eyes and mouth pixels of closed lips: worst of all people."""
    balls = np.concatenate([np.arange(len(t.triangles))[t.parts[n].triangles] for n in EYE_PARTS])
    inner = [np.arange(len(t.triangles))[t.parts[n].triangles] for n in ("teeth_upper", "teeth_lower", "tongue")]
    inside = np.concatenate([*inner, np.flatnonzero(t.regions["mouth"][t.triangles].all(axis=1))])
    sealed = [weights(**{n: 1.0}) for n in ("mouthSmile", "mouthPucker", "mouthLeft", "mouthStretch", "cheekPuff")]
    sealed.append(weights(jawOpen=1.0, mouthClose=1.0))
    poses = t.expressions.copy()
    close, jaw = (t.expression_index[name] for name in ("mouthClose", "jawOpen"))
    poses[close] += poses[jaw]
    table: dict[str, dict[str, list[float]]] = {}
    for subject in people(t, count):
        head = Head(subject.neutral, subject.eye_centres)
        known = Contacts(t, head)
        shapes = {"contacts kept": rig(t, head), "as transferred": rig(t, head, False)}
        for name, deltas in (*shapes.items(), ("bare displacements", t.expressions)):
            row = table.setdefault(name, {})
            posed = deltas.copy()
            posed[close] += posed[jaw]
            found = known.figures(posed, poses)
            shut = head.vertices + np.tensordot(weights(eyeBlink=1.0), deltas, 1)
            found["eye_pixels"] = int(np.isin(seen(t, shut, head.eye_centres.mean(axis=0)), balls).sum())
            mouth = head.vertices[t.contours["lips_inner_upper"]].mean(axis=0)
            heads = [head.vertices + np.tensordot(w, deltas, 1) for w in sealed]
            found["mouth_pixels"] = max(int(np.isin(seen(t, x, mouth), inside).sum()) for x in heads)
            for key, value in found.items():
                row.setdefault(key, []).append(value)
    for name, row in table.items():
        worst = ", ".join(f"{key} {np.median(v):.2f} / {max(v):.2f}" for key, v in row.items())
        print(f"contacts: {name:18s} (median / worst of {count} people; 64 pixels are 1 mm^2) {worst}")


def speed(t: Template, _: int) -> None:
    """Seconds of three runs."""
    subject = people(t, 1)[0]
    for _ in range(3):
        start = time.perf_counter()
        rig(t, Head(subject.neutral, subject.eye_centres))
        print(f"speed: {time.perf_counter() - start:.1f} s for 52 expressions of {t.vertex_count} vertices")


def pictures(t: Template, out: Path) -> None:
    """Sheets of two simulated people: all expressions, blinks, mouths."""
    import cv2
    from sketch import View, draw, paint, sheet

    colours = paint(t)

    def posed(subject: Subject, deltas: np.ndarray, w: np.ndarray) -> np.ndarray:
        x = subject.neutral + np.tensordot(w, deltas, 1)
        t.turn_eyes(x, w, subject.eye_centres)
        return x

    everything, blinks, mouths, labels = [], [], [], []
    named = ({"jawOpen": 1.0}, {"jawOpen": 1.0, "mouthClose": 1.0}, {"mouthFunnel": 1.0}, {"mouthPucker": 1.0})
    named = (*named, {"mouthSmile": 1.0}, {"mouthSmile": 0.8, "jawOpen": 0.25})
    for subject in people(t, 2):
        deltas = rig(t, Head(subject.neutral, subject.eye_centres))
        for name in ARKIT_NAMES:
            w = weights(**{name: 1.0})
            if name in ("mouthClose", "tongueOut"):
                w[ARKIT_NAMES.index("jawOpen")] = 1.0 if name == "mouthClose" else 0.35
            view = View(yaw=12, size=(160, 185), height=250.0, centre=(0, -10, 0))
            everything.append(draw(posed(subject, deltas, w), t.triangles, colours, view))
        eye, lips = subject.eye_centres[0], subject.neutral[t.contours["lips_inner_upper"]].mean(axis=0)
        for amount in (0, 0.25, 0.5, 0.75, 1):
            view = View(yaw=8, size=(300, 170), height=42.0, centre=tuple(eye + [0, 0, 10]), distance=600.0)
            blinks.append(draw(posed(subject, deltas, weights(eyeBlink=amount)), t.triangles, colours, view))
        for w in named:
            view = View(yaw=12, pitch=4, size=(260, 220), height=90.0, centre=tuple(lips - [0, 6, 30]), distance=600.0)
            mouths.append(draw(posed(subject, deltas, weights(**w)), t.triangles, colours, view))
            labels.append(" ".join(f"{key} {value}" for key, value in w.items()))
    sheets = {"expressions": sheet(everything, 13, list(ARKIT_NAMES) * 2), "blink": sheet(blinks, 5)}
    sheets["mouth"] = sheet(mouths, len(named), labels)
    for name, page in sheets.items():
        cv2.imwrite(str(out / f"blendshapes-{name}.jpg"), page[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 82])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="*", choices=["itself", "truth", "contacts", "speed", "pictures", []], default=[])
    parser.add_argument("--people", type=int, default=24)
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "images")
    given = parser.parse_args()
    t = Template.load()
    for part in (itself, truth, contacts, speed):
        if not given.what or part.__name__ in given.what:
            part(t, given.people)
    if "pictures" in given.what:
        pictures(t, given.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
