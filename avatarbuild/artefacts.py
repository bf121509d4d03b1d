"""The data that travels between stages. Each artefact saves itself into a folder and loads itself from it."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from avatarbuild.formats import ply
from avatarbuild.formats.images import decode_jpeg, decode_png, encode_png
from avatarbuild.formats.light import read_light, write_light

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True)
class StoredImage:
    """An upright sRGB JPEG, in memory while its stage runs, on disk afterwards."""

    source: bytes | Path

    def data(self) -> bytes:
        """The JPEG file's bytes."""
        return self.source if isinstance(self.source, bytes) else self.source.read_bytes()

    def rgb(self) -> np.ndarray:
        """(h, w, 3) uint8 sRGB."""
        return decode_jpeg(self.data())


# the arrays of Views: name -> what follows the k of the images
_VIEW_ARRAYS = {
    "size": (2,),
    "focal": (),
    "lens": (),
    "time": (),
    "sharpness": (),
    "exposure": (),
    "white_balance": (2,),
    "clipped": (),
    "landmarks": (478, 3),
    "presence": (),
    "scores": (52,),
    "pose": (3,),
}


@dataclass(frozen=True)
class Views:
    """
    k upright images, and what a look at each of them tells. NaN where nothing is known.

    names, files   k unique stems ('IMG_0001', '000123'), k paths relative to the capture folder
    size           (k, 2) int: width, height
    focal          (k,) pixels, from EXIF or the format
    lens           (k,) int: images of equal number share one camera
    time           (k,) s: shooting time of photos, presentation time of frames
    sharpness      (k,) a focus measure on the face (else the image), comparable within one set
    exposure       (k,) median linear luminance of the face (else the image)
    white_balance  (k, 2) log(R/G), log(B/G) of the same pixels' means, linear
    clipped        (k,) share of these pixels that are saturated
    landmarks      (k, 478, 3) pixels (centre of the first pixel at 0.5), depth in pixels about the face's mean
    presence       (k,) probability of a face; NaN where none was found
    scores         (k, 52) ARKit expression scores of the detector
    pose           (k, 3) degrees: yaw (positive: the subject looks to their left), pitch (positive: up), roll
    """

    names: list[str]
    files: list[str]
    images: list[StoredImage]
    size: np.ndarray
    focal: np.ndarray
    lens: np.ndarray
    time: np.ndarray
    sharpness: np.ndarray
    exposure: np.ndarray
    white_balance: np.ndarray
    clipped: np.ndarray
    landmarks: np.ndarray
    presence: np.ndarray
    scores: np.ndarray
    pose: np.ndarray

    def __post_init__(self) -> None:
        for name, tail in _VIEW_ARRAYS.items():
            shape = getattr(self, name).shape
            assert shape == (len(self.names), *tail), f"Views.{name} has shape {shape}"

    def __len__(self) -> int:
        return len(self.names)

    def trusted(self, presence: float, max_yaw: float) -> np.ndarray:
        """(k,) bool: a face was found whose landmarks can be trusted."""
        with np.errstate(invalid="ignore"):
            return (self.presence >= presence) & (np.abs(self.pose[:, 0]) <= max_yaw)

    def save(self, folder: Path) -> None:
        folder.mkdir(parents=True)
        for name, image in zip(self.names, self.images):
            (folder / f"{name}.jpg").write_bytes(image.data())
        with (folder / "views.npz").open("wb") as f:
            np.savez(f, **{name: getattr(self, name) for name in _VIEW_ARRAYS})
        _write_json(folder / "views.json", {"names": self.names, "files": self.files})

    @staticmethod
    def load(folder: Path) -> Views:
        about = _read_json(folder / "views.json")
        with np.load(folder / "views.npz") as arrays:
            values = {name: arrays[name] for name in _VIEW_ARRAYS}
        images = [StoredImage(folder / f"{name}.jpg") for name in about["names"]]
        return Views(names=about["names"], files=about["files"], images=images, **values)


@dataclass(frozen=True)
class Clip:
    """
    The video that the avatar learns from.

    file       path relative to the capture folder
    size       upright width, height;  fps nominal;  times (f,) s of every decoded frame, first 0
    focal      pixels, from metadata or the format's usual lens, a prior only
    processed  (j,) int: the decoded frames that `frames` holds
    frames     their images and landmarks
    """

    file: str
    size: tuple[int, int]
    fps: float
    times: np.ndarray
    focal: float
    processed: np.ndarray
    frames: Views


@dataclass(frozen=True)
class Capture:
    """
    What was recorded, made upright and sRGB, with landmarks.

    photos   k photos, in shooting order
    clip     the expression video, or None
    frontal  index of the most frontal photo, -1 where no face was found
    neutral  (k,) bool: photos with the common, neutral expression, eyes open
    face     True where enough photos show a face for a metric head
    settings what capture.toml says: {'known_length': {...}, ...}
    digest   SHA-256 over the names and bytes of the capture's files; the runner fills it in
    """

    photos: Views
    clip: Clip | None
    frontal: int
    neutral: np.ndarray
    face: bool
    settings: dict[str, Any] = field(default_factory=dict)
    figures: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    digest: str = ""

    def save(self, folder: Path) -> None:
        self.photos.save(folder / "photos")
        about: dict[str, Any] = {"frontal": self.frontal, "face": self.face, "settings": self.settings, "clip": None}
        about["neutral"] = [bool(v) for v in self.neutral]
        if self.clip is not None:
            self.clip.frames.save(folder / "frames")
            with (folder / "clip.npz").open("wb") as f:
                np.savez(f, times=self.clip.times, processed=self.clip.processed)
            about["clip"] = {
                "file": self.clip.file,
                "size": list(self.clip.size),
                "fps": self.clip.fps,
                "focal": self.clip.focal,
            }
        _write_json(folder / "capture.json", about)

    @staticmethod
    def load(folder: Path) -> Capture:
        about = _read_json(folder / "capture.json")
        clip = None
        if about["clip"] is not None:
            c = about["clip"]
            with np.load(folder / "clip.npz") as arrays:
                times, processed = arrays["times"], arrays["processed"]
            frames = Views.load(folder / "frames")
            clip = Clip(c["file"], (c["size"][0], c["size"][1]), c["fps"], times, c["focal"], processed, frames)
        neutral = np.array(about["neutral"], bool)
        photos = Views.load(folder / "photos")
        return Capture(photos, clip, about["frontal"], neutral, about["face"], about["settings"])


@dataclass(frozen=True)
class Cameras:
    """
    Where the photos were taken from.

    model    a COLMAP model: in millimetres and the head frame where `metric`, else in COLMAP's own units;
             images are named like the stored photos ('IMG_0001.jpg'), cameras are for their full size
    metric   whether the scale is known
    scale    where the scale comes from: {'source': 'iris' | 'known length' | 'none', 'relative_sd': …, …}
    """

    model: pycolmap.Reconstruction
    metric: bool
    scale: dict[str, Any]
    figures: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def save(self, folder: Path) -> None:
        (folder / "sparse").mkdir(parents=True)
        self.model.write_binary(str(folder / "sparse"))
        _write_json(folder / "scale.json", {"metric": self.metric, "scale": self.scale})

    @staticmethod
    def load(folder: Path) -> Cameras:
        import pycolmap

        about = _read_json(folder / "scale.json")
        model = pycolmap.Reconstruction()
        model.read_binary(str(folder / "sparse"))
        return Cameras(model, about["metric"], about["scale"])


@dataclass(frozen=True)
class Cloud:
    """
    Oriented, coloured points of the head, in the cameras' units and frame.

    points (n, 3) float32, normals (n, 3) float32 unit, outward, colours (n, 3) uint8 sRGB, views (n,) uint8: photos
    that agree on the point.
    """

    points: np.ndarray
    normals: np.ndarray
    colours: np.ndarray
    views: np.ndarray
    figures: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def save(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "points.ply").write_bytes(ply.cloud_bytes(self.points, self.normals, self.colours, self.views))

    @staticmethod
    def load(folder: Path) -> Cloud:
        return Cloud(*ply.read_cloud((folder / "points.ply").read_bytes()))


_NEUTRAL_ARRAYS = (
    *("vertices", "coefficients", "model", "eye_centres", "eye_radius", "head_from_cloud", "seen", "distance"),
)


@dataclass(frozen=True)
class Neutral:
    """
    The person's neutral head in the template's topology (n vertices of all parts), millimetres, in the head frame:
    x to the subject's left, y up, z out of the face, origin midway between the eyeballs' centres.

    vertices         (n, 3); triangles (m, 3) int32
    coefficients     (p,) of the morphable model's fit, in standard deviations
    model            (n, 3) the morphable model alone, before the thin shell
    eye_centres      (2, 3) of the left and right eyeball;  eye_radius (2,) mm
    head_from_cloud  (4, 4) takes the cameras' and the cloud's frame to this one, without scaling
    seen             (n,) in [0, 1]: how far the cloud, and not the prior, decided where a vertex lies
    distance         (n,) mm from the vertex to the cloud along its normal, NaN where the cloud says nothing
    eye_texture      (s, s, 3) uint8 sRGB, the eyeballs' in the template's UV of one eye, scaled to the whole square
    """

    vertices: np.ndarray
    triangles: np.ndarray
    coefficients: np.ndarray
    model: np.ndarray
    eye_centres: np.ndarray
    eye_radius: np.ndarray
    head_from_cloud: np.ndarray
    seen: np.ndarray
    distance: np.ndarray
    eye_texture: np.ndarray
    figures: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    @property
    def stamped(self) -> dict[str, Any]:
        """What stamp.json says of this artefact besides its figures."""
        return {"head_from_cloud": self.head_from_cloud.tolist()}

    def save(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / "neutral.npz").open("wb") as f:
            np.savez(f, **{name: getattr(self, name) for name in _NEUTRAL_ARRAYS})
        (folder / "neutral.ply").write_bytes(ply.mesh_bytes(self.vertices, self.triangles))
        (folder / "eye.png").write_bytes(encode_png(self.eye_texture))

    @staticmethod
    def load(folder: Path) -> Neutral:
        with np.load(folder / "neutral.npz") as arrays:
            values = {name: arrays[name] for name in _NEUTRAL_ARRAYS}
        values["triangles"] = ply.mesh_triangles((folder / "neutral.ply").read_bytes())
        return Neutral(**values, eye_texture=decode_png((folder / "eye.png").read_bytes()))


_ALBEDO_PICTURES = ("albedo", "fused", "illumination", "coverage", "normal", "occlusion")


@dataclass(frozen=True)
class Albedo:
    """
    The person's skin without the light, in the template's UV (row 0 on top: v = 1), s texels along a side.

    albedo        (s, s, 3) uint8 sRGB, complete
    fused         (s, s, 3) uint8 sRGB, the photos' fused texture with the light still in it, complete
    illumination  (s, s, 3) uint8 sRGB of the light s_ij, scaled so that its 99th percentile is white
    coverage      (s, s) uint8, how well the photos saw each texel: 0 not at all (completed), 255 from straight ahead
    normal        (d, d, 3) uint8 tangent-space normals of the static detail, +Y up, (128, 128, 255) flat
    occlusion     (d, d) uint8 ambient occlusion of the head at rest with its static detail, 255 open
    harmonics     (9, 3) y of equation (1) in the head frame, linear RGB
    skin_colour   (3,) linear RGB, the prior r of equation (3)
    gains         (k, 3) linear factors that each placed photo's colours were multiplied by
    """

    albedo: np.ndarray
    fused: np.ndarray
    illumination: np.ndarray
    coverage: np.ndarray
    normal: np.ndarray
    occlusion: np.ndarray
    harmonics: np.ndarray
    skin_colour: np.ndarray
    gains: np.ndarray
    figures: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def save(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        for name in _ALBEDO_PICTURES:
            (folder / f"{name}.png").write_bytes(encode_png(getattr(self, name)))
        write_light(folder, self.harmonics, self.skin_colour, self.gains)

    @staticmethod
    def load(folder: Path) -> Albedo:
        pictures: dict[str, Any] = {n: decode_png((folder / f"{n}.png").read_bytes()) for n in _ALBEDO_PICTURES}
        return Albedo(**pictures | read_light(folder))


@dataclass(frozen=True)
class Blendshapes:
    """
    The person's rig: x(w) = neutral + sum_j w_j deltas_j, then each eyeball turned about its centre.

    neutral (n, 3) mm in the head frame; deltas (52, n, 3) float32 mm at weight 1, in ARKit's order; eye_centres (2, 3).
    """

    neutral: np.ndarray
    deltas: np.ndarray
    eye_centres: np.ndarray
    figures: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def save(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / "blendshapes.npz").open("wb") as f:
            deltas = self.deltas.astype(np.float32)
            np.savez(f, neutral=self.neutral, deltas=deltas, eye_centres=self.eye_centres)

    @staticmethod
    def load(folder: Path) -> Blendshapes:
        with np.load(folder / "blendshapes.npz") as arrays:
            return Blendshapes(arrays["neutral"], arrays["deltas"], arrays["eye_centres"])


GOOD = 0.5  # quality from which a tracked frame is good
_PERFORMANCE_ARRAYS = (
    *("times", "weights", "rotation", "translation", "torso_rotation", "torso_translation", "neck"),
    *("quality", "gaze", "processed", "modelled"),
    *("neutral", "deltas", "depth", "eye_centres", "evidence"),
)


@dataclass(frozen=True)
class Performance:
    """
    What the video shows: f decoded frames, and the rig that it taught. Without a video f = 0 and the rig is the
    transferred one.

    video        the clip's path in the capture folder, "" without one;  size upright width, height;  fps nominal
    focal, k1    the clip's lens: pixels, radial distortion (the principal point is the middle of the picture)
    times        (f,) s, first 0;  weights (f, 52) in ARKit's order, 0..1
    rotation, translation  (f, 3, 3), (f, 3): x_cam = R x + t, mm, head frame to OpenCV camera axes
    torso_rotation, torso_translation  the same of a head that had not moved on its body;  neck (2,) mm: the heights, in
                 the head frame, between which the neck bends from the head's pose to this one
    quality      (f,) in 0..1: 0 lost, its pose interpolated and its weights held
    gaze         (f, 2, 2) radians: left and right eye, yaw (positive: to the subject's left), pitch (positive: up)
    processed    (j,) int: the frames that were tracked in full;  modelled (j,) bool: those that taught the shapes
    neutral (n, 3), deltas (52, n, 3) float32 mm, eye_centres (2, 3): the person's own rig, as in Blendshapes
    depth        (52, n, 3) float32 mm: that part of the deltas which the light on the skin told
    evidence     (52,) in 0..1: how far the video, and not the transfer, decided a shape
    """

    video: str
    size: tuple[int, int]
    fps: float
    focal: float
    k1: float
    times: np.ndarray
    weights: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray
    torso_rotation: np.ndarray
    torso_translation: np.ndarray
    neck: np.ndarray
    quality: np.ndarray
    gaze: np.ndarray
    processed: np.ndarray
    modelled: np.ndarray
    neutral: np.ndarray
    deltas: np.ndarray
    depth: np.ndarray
    eye_centres: np.ndarray
    evidence: np.ndarray
    figures: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    @property
    def good(self) -> np.ndarray:
        """(f,) bool: frames of quality GOOD and more, which may be shown and whose light may be read."""
        return np.asarray(self.quality >= GOOD)

    def save(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / "performance.npz").open("wb") as f:
            np.savez(f, **{name: getattr(self, name) for name in _PERFORMANCE_ARRAYS})
        about = {"video": self.video, "size": list(self.size), "fps": self.fps, "focal": self.focal, "k1": self.k1}
        _write_json(folder / "clip.json", about)

    @staticmethod
    def load(folder: Path) -> Performance:
        about = _read_json(folder / "clip.json")
        about["size"] = tuple(about["size"])
        with np.load(folder / "performance.npz") as arrays:
            return Performance(**about, **{name: arrays[name] for name in _PERFORMANCE_ARRAYS})


@dataclass(frozen=True)
class Refinement:
    """
    The person's shapes after shape from shading. Without a video they are those that came in, and there is no light.

    neutral (n, 3), deltas (52, n, 3) float32 mm: as in Blendshapes
    light        (9,) y of equation (1) for the video's grey, in camera axes; zeros without a video
    exposure     (j,) of each processed frame, beside their mean
    moved        (52,) mm: how far each shape moved at most
    """

    neutral: np.ndarray
    deltas: np.ndarray
    light: np.ndarray
    exposure: np.ndarray
    moved: np.ndarray
    figures: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def save(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / "refinement.npz").open("wb") as f:
            arrays = {name: getattr(self, name) for name in ("neutral", "light", "exposure", "moved")}
            np.savez(f, deltas=self.deltas.astype(np.float32), **arrays)

    @staticmethod
    def load(folder: Path) -> Refinement:
        with np.load(folder / "refinement.npz") as arrays:
            return Refinement(**{name: arrays[name] for name in arrays.files})


@dataclass(frozen=True)
class Files:
    """Finished files: name, with folders, -> bytes."""

    files: dict[str, bytes]
    figures: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def save(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        for name, data in self.files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(data)

    @classmethod
    def load(cls, folder: Path) -> Self:
        files = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != "stamp.json"]
        return cls({path.relative_to(folder).as_posix(): path.read_bytes() for path in files})


class Details(Files):
    """
    The dynamic details in their written form (docs/formats.md): details.json and its pictures, and
    frames/normals_%04d.npz on request; no files without a video.
    """


class Avatar(Files):
    """The deliverables: avatar.glb, avatar.json, report.html, …; what shows seconds is not in the stamp."""

    shows_seconds = ("report.html",)


def _write_json(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value, indent=1, ensure_ascii=False, sort_keys=True) + "\n", encoding="utf-8")


def _read_json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))
