"""Stage details: wrinkles of every good frame by shape from shading, and what makes them for any expression.

Source: method, sections 6 and 7 [Ichim et al. 2015, sections 5.2 and 6].
"""

from __future__ import annotations

import io
import logging
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from avatarbuild.artefacts import Albedo, Capture, Details, Performance, Refinement
from avatarbuild.details.ambient_occlusion import ambient_occlusion
from avatarbuild.details.synthesis import Synthesis, train
from avatarbuild.errors import InputError
from avatarbuild.formats import video
from avatarbuild.formats.details import details_files
from avatarbuild.geometry.meshes import vertex_normals
from avatarbuild.options import DetailsOptions
from avatarbuild.parallel import each_alone
from avatarbuild.progress import Progress
from avatarbuild.shading import maps
from avatarbuild.shading.clip import LEAST_FRAMES, good_frames, posed, watched_clip
from avatarbuild.shading.light import exposure
from avatarbuild.shading.observation import Seen, Watched, align, moved
from avatarbuild.shading.relief import FINE, Relief, light_seen, relief
from avatarbuild.shading.surface import FineSkin, draw, fine_skin, normals_of_all, picture
from avatarbuild.template import Template
from avatarbuild.texture.static_detail import plain_skin
from avatarbuild.tracking.lens import Lens
from avatarbuild.tracking.neck import UNBENT

log = logging.getLogger(__name__)

FLAT = np.array([0.0, 0, 1, 1])
_TILE = 65536  # texels whose medians are taken at a time


def run(
    capture: Capture,
    albedo: Albedo,
    performance: Performance,
    refinement: Refinement,
    options: DetailsOptions,
    progress: Progress,
    template: Template,
    source: Path,
) -> Details:
    """
    The dynamic detail maps of the video, none without enough good frames.

    Raises InputError where `save_frames` names frames that the video does not have, or the video is gone.
    """
    performance = replace(performance, neutral=refinement.neutral, deltas=refinement.deltas)
    saved = frame_numbers(options.save_frames, len(performance.times))
    rows = good_frames(performance)
    if capture.clip is None or len(rows) < LEAST_FRAMES:
        warnings = []
        if len(performance.times):
            warnings.append(f"{len(rows)} good frames: {LEAST_FRAMES} are needed for wrinkles; there are none")
        return Details({}, {"frames": 0}, warnings)
    lens = Lens(performance.focal, performance.k1, performance.size)
    skin = fine_skin(template, albedo.albedo)
    watched = watched_clip(capture, performance, rows, template, skin, options.pixel, progress, "The light on the skin")
    chart = maps.face_chart(template, options.side)
    heads = [posed(performance, int(performance.processed[row]), int(row)) for row in rows]
    avatar = replace(performance, neck=UNBENT)  # whose neck is the head's: what wrinkles it is its strain
    vertices = np.stack([posed(avatar, int(performance.processed[row]), int(row)).vertices for row in rows])
    open_ = occlusion_of(chart, maps.frames(chart, performance.neutral), performance.neutral, None)

    plain = plain_skin(template, chart.chart).reshape(-1)[chart.flat]

    def layers(k: int) -> tuple[np.ndarray, np.ndarray]:
        one, head = watched.frames[k], heads[k]
        found = wrinkles(one, watched, float(watched.light.gains[k]), lens)
        axes = maps.frames(chart, head.vertices)
        normal, sure, height = maps.tangent_normals(axes, one.drawn, found, lens, head.R, head.t)
        axes = maps.frames(chart, vertices[k])
        normal[:, :2] *= plain[:, None]
        bent = normal[:, :1] * axes.tangent + normal[:, 1:2] * axes.bitangent + normal[:, 2:] * axes.normal
        raised = axes.position + (height * sure * plain)[:, None] * axes.normal
        shade = occlusion_of(chart, axes, vertices[k], (raised, bent)) / np.maximum(open_, 0.1)
        return np.concatenate([normal, shade[:, None]], axis=1).astype(np.float16), sure.astype(np.float16)

    frames, sure = [], []
    with progress.task("Wrinkles of every frame", len(rows)) as task:
        for layer, known in each_alone(layers, range(len(rows))):
            frames.append(layer)
            sure.append(known)
            task.advance()
    made = dynamic(np.stack(frames))
    with progress.task("What makes them", 1) as task:
        synthesis = train(
            lambda f: chart.map(made[f].astype(np.float32), FLAT),
            lambda f: chart.map(sure[f].astype(np.float32), 0.0),
            *(vertices, performance.neutral, template),
            count=min(options.keyframes, len(rows)),
        )
        task.advance()
    numbers = performance.processed[rows][synthesis.keys.rows]  # of the video's frames, for whoever reads the files
    files = details_files(replace(synthesis, keys=replace(synthesis.keys, rows=numbers)))
    if saved:
        path = source / capture.clip.file
        if not path.is_file():
            raise InputError(f"the video {path} is gone: put it back, or run without details.save_frames")
        with progress.task("Normals of frames", len(saved)) as task:
            for number, normals in frame_normals(path, saved, performance, template, skin, watched, lens):
                files[f"frames/normals_{number:04d}.npz"] = _npz(normals)
                task.advance()
    figures = {
        "frames": len(rows),
        "pixel_frame_px": watched.frames[0].drawn.factor,
        "keyframes": synthesis.keys.count,
        "tilt_degrees": tilt(made, sure),
        "misfit_degrees": misfit(synthesis, chart, made, sure, vertices),
    }
    log.info("details: %s", figures)
    return Details(files, figures, [])


def frame_numbers(text: str, count: int) -> list[int]:
    """The frames named in a list with commas, in order. Raises InputError for what is no frame of the video."""
    numbers = []
    for word in (part.strip(" []") for part in text.split(",")):
        if not word:
            continue
        if not word.isdigit() or int(word) >= max(count, 1):
            raise InputError(f"details.save_frames names '{word}': numbers from 0 to {count - 1} are needed")
        numbers.append(int(word))
    return sorted(set(numbers))


def wrinkles(one: Seen, watched: Watched, gain: float, lens: Lens) -> Relief:
    """The fine relief of a frame."""
    return relief(one.drawn, light_seen(one.drawn, one.grey, gain, watched.more(one.drawn)), watched.light, lens, FINE)


def occlusion_of(
    chart: maps.FaceChart, axes: maps.Frames, vertices: np.ndarray, raised: tuple[np.ndarray, np.ndarray] | None
) -> np.ndarray:
    """(t,) equation (15) at the face's texels of a posed head, with positions and normals (t, 3) that stand there."""
    template, whole = chart.template, chart.chart
    skin = whole.part == 1
    position = whole.field(vertices.astype(np.float32), template.triangles)
    normal = whole.field(vertex_normals(vertices, template.triangles).astype(np.float32), template.triangles)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    if raised is not None:
        position.reshape(-1, 3)[chart.flat], normal.reshape(-1, 3)[chart.flat] = raised
    wanted = np.zeros(whole.size * whole.size, bool)
    wanted[chart.flat] = True
    return ambient_occlusion(position, normal, skin, wanted.reshape(skin.shape)).reshape(-1)[chart.flat]


def frame_normals(
    path: Path,
    numbers: list[int],
    performance: Performance,
    template: Template,
    skin: FineSkin,
    watched: Watched,
    lens: Lens,
) -> Iterator[tuple[int, np.ndarray]]:
    """Number and (H, W, 3) float16 normals in OpenCV's camera axes of decoded frames, zero where there is no head."""
    factor = watched.frames[0].drawn.factor
    for number, _, rgb in video.decode_frames(path, numbers):
        head = posed(performance, number, 0)
        drawn = draw(skin, head.vertices, lens, head.R, head.t, factor)
        grey = picture(drawn, rgb)
        more = watched.more(drawn)
        gain = exposure(watched.light, drawn, grey, more)
        seen = align(0, drawn, grey, watched.light, gain, more)
        found = wrinkles(seen, watched, gain, lens)
        whole = draw(skin, head.vertices, lens, head.R, head.t, 1, whole=True)
        change = moved((found.normal - drawn.normal) * drawn.on[..., None], -seen.flow)
        (w, h), (x, y) = drawn.size, drawn.corner.astype(int)
        normal = normals_of_all(template, whole, head.vertices, lens, head.R, head.t)
        part = normal[y : y + h * factor, x : x + w * factor]
        part += cv2.resize(change, (part.shape[1], part.shape[0]), interpolation=cv2.INTER_LINEAR) * (
            np.abs(part).sum(axis=-1, keepdims=True) > 0
        )
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
        yield number, normal.astype(np.float16)


def dynamic(layers: np.ndarray) -> np.ndarray:
    """
    (f, t, 4) what expressions add: normals less the median of all frames, which is the face's own, as are brows that
    look like relief; occlusion over its median, at most open.
    """
    out = np.empty_like(layers)
    for first in range(0, layers.shape[1], _TILE):
        part = slice(first, first + _TILE)
        here = layers[:, part].astype(np.float32)
        here[..., :2] -= np.median(here[..., :2], axis=0)
        here[..., :3] /= np.linalg.norm(here[..., :3], axis=-1, keepdims=True)
        here[..., 3] = np.clip(here[..., 3] / np.maximum(np.median(here[..., 3], axis=0), 0.1), 0, 1)
        out[:, part] = here
    return out


def tilt(made: np.ndarray, sure: list[np.ndarray]) -> float:
    """Degrees: how far the maps' normals (f, t, 4) lean, mean over what is seen."""
    lean = [np.degrees(np.arccos(np.clip(layers[:, 2].astype(np.float32), -1, 1))) for layers in made]
    return _mean(lean, sure)


def misfit(
    synthesis: Synthesis, chart: maps.FaceChart, made: np.ndarray, sure: list[np.ndarray], vertices: np.ndarray
) -> float:
    """Degrees between the frames' own normals and the synthesised ones, mean over what is seen."""
    off = []
    for layers, head in zip(made, vertices, strict=True):
        again = synthesis.evaluate(synthesis.strain_of(head)).reshape(-1, 4)[chart.flat, :3]
        own = layers[:, :3].astype(np.float32)
        cosine = (again * own).sum(axis=1) / np.maximum(np.linalg.norm(own, axis=1), 1e-9)
        off.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    return _mean(off, sure)


def _mean(values: list[np.ndarray], weights: list[np.ndarray]) -> float:
    total = sum(float((v * w.astype(np.float32)).sum()) for v, w in zip(values, weights, strict=True))
    return round(total / max(sum(float(w.astype(np.float32).sum()) for w in weights), 1e-9), 2)


def _npz(normals: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.savez_compressed(out, normal=normals)
    return out.getvalue()
