"""
What the texture is worth: against the truth, at its seams, in photos it has not seen, in the video, and what it costs.

python benchmarks/albedo.py PROJECT [sizes] [score] [seams] [photos] [video] [--truth TRUTH --scorer score.py]
    [--glb avatar.glb] [--sizes 1024 2048 4096] [--texels 2048] [--pictures FOLDER]
AVATARBUILD_BENCHMARK=FOLDER stands for --truth FOLDER/truth_b --scorer FOLDER/score.py. The project's stages up to
neutral must have run. Without a word: all rows (score needs --glb). Score and video judge the largest of --sizes or,
where sizes is not asked for, the texture that the project has; seams and photos, textures of --texels. Six photos are
left out of the texture for the row of photos, none for the others. video needs the project's stages up to refinement.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
import relighting
from scoring import arguments

from avatarbuild.artefacts import Albedo, Cameras, Capture, Cloud, Neutral
from avatarbuild.formats.images import encode_png
from avatarbuild.geometry.mipmap import build_mipmap
from avatarbuild.options import AlbedoOptions
from avatarbuild.progress import Silent
from avatarbuild.sfm.metric import placed_photos
from avatarbuild.stages import albedo as stage
from avatarbuild.template import Template
from avatarbuild.texture.borders import border_pairs
from avatarbuild.texture.chart import draw_chart, seam_ties, texels_per_mm
from avatarbuild.texture.fusion import corrected, fuse
from avatarbuild.texture.observations import nodes_of
from avatarbuild.texture.photos import Photo, linear_picture, placed_in_head

LEFT_OUT = 6
ROWS = ("sizes", "score", "seams", "photos", "video")


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("rows", nargs="*", help=" ".join(ROWS))
    parser.add_argument("--glb", type=Path, help="the avatar with this neutral head, for the scorer")
    parser.add_argument("--sizes", type=int, nargs="+", default=[1024, 2048, 4096])
    parser.add_argument("--texels", type=int, default=2048)
    parser.add_argument("--pictures", type=Path)
    a = parser.parse_args()
    rows = set(a.rows or ROWS)
    if rows - set(ROWS):
        parser.error(f"no such row: {', '.join(sorted(rows - set(ROWS)))}; there are {', '.join(ROWS)}")
    if "score" in a.rows and not (a.truth and a.scorer and a.glb):
        parser.error("score needs --truth, --scorer and --glb")
    capture = Capture.load(a.project / "01-capture")
    cameras, cloud = Cameras.load(a.project / "02-cameras"), Cloud.load(a.project / "03-points")
    neutral = Neutral.load(a.project / "04-neutral")
    inputs = (capture, cameras, cloud, neutral)

    if rows != {"photos"}:
        kept = a.project / "05-albedo"
        made = sizes(inputs, sorted(a.sizes)) if "sizes" in rows or not kept.exists() else Albedo.load(kept)
        if "score" in rows and a.truth and a.scorer and a.glb:
            score(made, a.truth, a.scorer, a.glb)
        if "seams" in rows:
            seams(capture, cameras, neutral, made, a.texels)
        if "video" in rows and capture.clip is not None:
            relighting.video(a.project, capture, made, a.truth, a.pictures)
    if "photos" in rows:
        photos(*inputs, a.texels, a.pictures)


def sizes(inputs: tuple[Capture, Cameras, Cloud, Neutral], texels: list[int]) -> Albedo:
    """What the stage costs at each size, the smallest first; returns the largest's texture."""
    print("texels  seconds  core-seconds  peak GB")
    for size in texels:
        start, busy = time.perf_counter(), time.process_time()
        made = stage.run(*inputs, AlbedoOptions(size=size), Silent(), Template.load())
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        seconds, cores = time.perf_counter() - start, time.process_time() - busy
        print(f"{size:6d} {seconds:8.1f} {cores:13.1f} {peak:8.2f}", flush=True)
    return made


def score(made: Albedo, truth: Path, scorer: Path, glb: Path) -> None:
    """The scorer's albedo row for the fused texture and for the albedo; normals are not looked at."""
    with tempfile.TemporaryDirectory() as folder:
        slim = Path(folder) / "truth"
        slim.mkdir()
        for file in truth.iterdir():
            if not file.name.startswith("normals_"):
                (slim / file.name).symlink_to(file.resolve())
        for name in ("fused", "albedo"):
            (Path(folder) / "texture.png").write_bytes(encode_png(getattr(made, name)))
            command = [sys.executable, str(scorer), "--gt", str(slim), "--glb", str(glb), "--step", "300"]
            done = subprocess.run(
                [*command, "--albedo", str(Path(folder) / "texture.png")], capture_output=True, text=True, check=True
            )
            print(f"{name:8s}", next(line for line in done.stdout.splitlines() if line.startswith("albedo")))


def seams(capture: Capture, cameras: Cameras, neutral: Neutral, made: Albedo, size: int) -> None:
    """
    Gradients of the fused texture across borders of patches, over those of pairs 3 to 8 texels away in the same
    direction; of fused texture and completed albedo across the chart's seam; and how far the two photos' pictures are
    shifted against each other at the borders.
    """
    template = Template.load()
    shots, still = fused_from(capture, cameras, neutral)
    eyes = (neutral.eye_centres, neutral.eye_radius)
    result, choice, _ = fuse(template, neutral.vertices, neutral.seen, shots, still, size, 8.0, eyes, lambda _: None)
    grey = result.colour.mean(axis=2).reshape(-1)
    label = result.label.reshape(-1)
    pairs = border_pairs(result.label)

    def steps(at: np.ndarray) -> np.ndarray:
        use = (label[at] >= 0).all(axis=1)
        p, q = at[use].T
        return np.abs(grey[p] - grey[q]) / np.maximum(grey[p] + grey[q], 1e-3)

    across = steps(pairs)
    lying = pairs[:, 1] - pairs[:, 0] == 1
    beside = []
    for off in (-8, -5, -3, 3, 5, 8):
        moved = np.clip(pairs + np.where(lying, off, off * size)[:, None], 0, size * size - 1)
        same = label[moved[:, 0]] == label[moved[:, 1]]
        beside.append(steps(moved[same]))
    near = np.concatenate(beside)
    ratio = across.mean() / near.mean()
    print(f"borders of patches: gradient {across.mean():.5f}, beside them {near.mean():.5f}, ratio {ratio:.2f}")

    nodes = nodes_of(template, neutral.vertices, neutral.seen, eyes)
    chart = draw_chart(template, nodes.uv, nodes.uv_triangles, size)
    ties = seam_ties(template, chart)
    of_photos = chart_seam(grey, result.position, ties, label >= 0)
    print(f"the chart's seam, where photos see it: {of_photos}")
    albedo = cv2.resize(linear_picture(made.albedo), (size, size), interpolation=cv2.INTER_AREA).mean(axis=2)
    everywhere = chart_seam(albedo.reshape(-1), result.position, ties, chart.part.reshape(-1) == 1)
    print(f"the chart's seam in the completed albedo: {everywhere}")

    shift = misalignment(
        shots, choice, nodes, chart, result.label, result.position, texels_per_mm(template, neutral.vertices, size)
    )
    if len(shift):
        mm = texels_per_mm(template, neutral.vertices, size)
        print(
            f"misalignment at {len(shift)} places on borders: median {np.median(shift):.2f} texels of {size} = "
            f"{np.median(shift) / mm:.2f} mm, 90 % below {np.percentile(shift, 90) / mm:.2f} mm"
        )


def chart_seam(grey: np.ndarray, position: np.ndarray, ties: np.ndarray, known: np.ndarray) -> str:
    """Gradient per mm of log brightness across the chart's seam, over that between neighbours beside it."""
    ties = ties[known[ties].all(axis=1)]
    inner = np.concatenate([ties[:, :1], ties[:, :1] + 1], axis=1)
    inner = inner[known[inner].all(axis=1)]
    if not len(ties) or not len(inner):
        return "none"
    place = position.reshape(-1, 3)

    def per_mm(at: np.ndarray) -> float:
        p, q = at.T
        step = 2 * np.abs(grey[p] - grey[q]) / np.maximum(grey[p] + grey[q], 1e-3)
        return float(np.mean(step / np.maximum(np.linalg.norm(place[p] - place[q], axis=1), 0.1)))

    return f"{len(ties)} pairs of texels, ratio {per_mm(ties) / per_mm(inner):.2f}"


def misalignment(shots, choice, nodes, chart, label, position, texels) -> np.ndarray:  # type: ignore[no-untyped-def]
    """Texels by which two photos' windows of 33 texels around places on borders are shifted, by phase correlation."""
    size = chart.size
    pairs = border_pairs(label)
    rng = np.random.default_rng(0)
    places = pairs[rng.permutation(len(pairs))[:400]]
    half = 16
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    flat, out = label.reshape(-1), []
    windows, labels = [], []
    for p, q in places:
        r, c = p // size, p % size
        if half <= r < size - half and half <= c < size - half:
            at = ((r + y) * size + c + x).reshape(-1)
            if (flat[at] >= 0).all():
                windows.append(at)
                labels.append((flat[p], flat[q]))
    if not windows:
        return np.zeros(0)
    at = np.concatenate(windows)
    seen = [
        corrected(
            shots,
            choice,
            nodes,
            chart,
            np.repeat([pair[k] for pair in labels], len(windows[0])).astype(np.int16),
            at,
            position.reshape(-1, 3),
            texels,
        )
        for k in range(2)
    ]
    side = 2 * half + 1
    hann = cv2.createHanningWindow((side, side), cv2.CV_32F)
    for i in range(len(windows)):
        part = slice(i * side * side, (i + 1) * side * side)
        one, two = (np.log(np.maximum(s[part].mean(axis=1), 1e-3)).reshape(side, side).astype(np.float32) for s in seen)
        one, two = (w - cv2.GaussianBlur(w, (0, 0), 5) for w in (one, two))
        (dx, dy), sure = cv2.phaseCorrelate(one, two, hann)
        if sure > 0.3:
            out.append(np.hypot(dx, dy))
    return np.array(out)


def fused_from(capture: Capture, cameras: Cameras, neutral: Neutral) -> tuple[list[Photo], np.ndarray]:
    """The placed photos, and which of them have the common expression."""
    placed = placed_photos(cameras.model, [f"{name}.jpg" for name in capture.photos.names])
    return placed_in_head(capture.photos, placed, neutral.head_from_cloud), capture.neutral[placed.index]


def photos(
    capture: Capture, cameras: Cameras, cloud: Cloud, neutral: Neutral, texels: int, pictures: Path | None
) -> None:
    """PSNR on the face in photos that the texture has not seen, after one gain per channel."""
    shots, _ = fused_from(capture, cameras, neutral)
    order = np.argsort([photo.yaw for photo in shots])
    out = [shots[i] for i in order[np.linspace(0, len(shots) - 1, LEFT_OUT + 2).astype(int)[1:-1]]]
    names = ",".join(photo.name for photo in out)
    made = stage.run(
        capture, cameras, cloud, neutral, AlbedoOptions(size=texels, leave_out=names), Silent(), Template.load()
    )
    light = linear_picture(made.illumination)
    textures = {
        "fused, lit": linear_picture(made.fused),
        "albedo under the estimated light": linear_picture(made.albedo) * light,
    }
    head = relighting.head_of(Template.load(), neutral.vertices)
    print("PSNR on the face in photos left out:")
    for name, texture in textures.items():
        values, levels = [], build_mipmap(texture)
        for photo in out:
            shot = relighting.Shot(photo.K, photo.dist, photo.R, photo.t, photo.size)
            picture, shown, cosine, _, _ = relighting.rendered(head, levels, shot)
            real = linear_picture(photo.image.rgb())
            use = shown & (cosine > 0.3) & (real.max(axis=2) < 0.95)
            gain = np.median(real[use] / np.maximum(picture[use], 1e-3), axis=0)
            values.append(relighting.psnr(picture * gain, real, use))
            if pictures is not None:
                relighting.side_by_side(
                    pictures / f"{photo.name}-{name.split()[0].strip(',')}.png", picture * gain, real, shown
                )
        print(f"  {name:34s} {np.mean(values):5.1f} dB ({', '.join(f'{v:.1f}' for v in values)})")


if __name__ == "__main__":
    main()
