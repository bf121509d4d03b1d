"""The project folder: where each stage's artefact lives, whether it is fresh, how it is saved whole or not at all."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import logging
import os
import shutil
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from avatarbuild.errors import InputError
from avatarbuild.options import STAGE_OPTIONS
from avatarbuild.template_files import SHIPPED, TemplateFile, resolve
from avatarbuild.whole_file import whole_file

if TYPE_CHECKING:
    from avatarbuild.formats.corrections import Corrections

log = logging.getLogger(__name__)

T = TypeVar("T")
_PARTIAL, _OLD = ".saving-", ".replaced-"
_STAGE_ORDER = tuple(STAGE_OPTIONS)
STAMP_VERSION = 1


def default_project(capture: Path) -> Path:
    """CAPTURE.avatar beside CAPTURE."""
    capture = Path(os.path.abspath(capture))
    return capture.with_name(capture.name + ".avatar")


def stage_folder_name(stage: str) -> str:
    """'01-capture' … '09-details', and 'avatar' for the deliverables."""
    return stage if stage == "avatar" else f"{_STAGE_ORDER.index(stage) + 1:02d}-{stage}"


def digest_files(root: Path, files: list[Path]) -> str:
    """SHA-256 over names (relative to root, POSIX) and bytes of files, in the order of their names."""
    total = hashlib.sha256()
    for name, path in sorted((path.relative_to(root).as_posix(), path) for path in files):
        with path.open("rb") as f:
            total.update(f"{name}\0{hashlib.file_digest(f, 'sha256').hexdigest()}\n".encode())
    return total.hexdigest()


@dataclass(frozen=True)
class Project:
    """One person's project folder."""

    root: Path

    @property
    def log_file(self) -> Path:
        """What the last runs wrote of themselves."""
        return self.root / "avatarbuild.log"

    @property
    def clip_folder(self) -> Path:
        """Where the viewer keeps the video as browsers play it."""
        return self.root / "view"

    def folder(self, stage: str) -> Path:
        """Where a stage's artefact lives."""
        return self.root / stage_folder_name(stage)

    @property
    def corrections_file(self) -> Path:
        """What the user has set by hand; it need not exist."""
        return self.root / "corrections.json"

    def corrections(self) -> Corrections:
        """Raises InputError where the file is not what docs/formats.md describes."""
        from avatarbuild.formats.corrections import Corrections, read_corrections

        try:
            data = self.corrections_file.read_bytes()
        except FileNotFoundError:
            return Corrections()
        return read_corrections(data, str(self.corrections_file))

    def save_corrections(self, corrections: Corrections) -> None:
        """Raises InputError where the file cannot be written; what was there before stays."""
        from avatarbuild.formats.corrections import corrections_bytes

        advice = "free some space, or ask for permission"
        with whole_file(self.corrections_file, advice) as partial, partial.open("wb") as f:
            f.write(corrections_bytes(corrections))
            f.flush()
            os.fsync(f.fileno())

    def stamp(self, stage: str) -> dict[str, Any] | None:
        """What a finished stage left in its stamp.json; None where it has not been run, or the stamp is damaged."""
        try:
            stamp = json.loads((self.folder(stage) / "stamp.json").read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError):
            return None
        return stamp if _sound(stamp) else None

    def read(self, stage: str, kind: type[T]) -> T:
        """
        What a stage made, as an artefact of `kind`.

        Raises InputError where a file of it has changed since it was made, is gone or cannot be read.
        """
        folder = self.folder(stage)
        again = f"make it again: avatarbuild run CAPTURE -o {self.root} --from {stage}"
        try:
            now = _digests(folder)
            changed = [
                name for name, digest in (self.stamp(stage) or {}).get("files", {}).items() if now.get(name) != digest
            ]
            if changed:
                gone = "is gone" if changed[0] not in now else "has changed since it was made"
                raise InputError(f"{folder / changed[0]} {gone}; {again}")
            return kind.load(folder)  # type: ignore[attr-defined]
        except InputError:
            raise
        except OSError as error:
            raise InputError(f"{folder} cannot be read ({error.strerror or error}); {again}") from None
        except Exception as error:  # whatever a decoder makes of a damaged file that no stamp vouches for
            log.debug("%s", folder, exc_info=True)
            raise InputError(f"{folder} is damaged ({type(error).__name__}: {error}); {again}") from None

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """
        Keeps two runs out of one project; sweeps up what a killed run left.

        Raises InputError where another run holds the project or the folder cannot be written.
        """
        try:
            self.root.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError):
            raise InputError(f"{self.root} is a file: name a folder for the project with -o") from None
        except OSError as error:
            raise InputError(f"the project folder {self.root} cannot be made: {error.strerror}") from None
        import filelock

        held = filelock.FileLock(self.root / ".lock", timeout=0)
        try:
            held.acquire()
        except filelock.Timeout:
            raise InputError(f"another run is working in {self.root}: wait for it, or use another project") from None
        except OSError as error:
            raise InputError(f"the project folder {self.root} cannot be written: {error.strerror}") from None
        try:
            self._sweep()
            yield
        finally:
            held.release()

    def _sweep(self) -> None:
        # A run killed between the two renames of `save` leaves the old artefact aside: it goes back.
        for path in sorted(self.root.glob(f"{_OLD}*")):
            place = self.root / path.name.removeprefix(_OLD)
            if place.exists():
                shutil.rmtree(path)
            else:
                path.rename(place)
        for path in sorted(self.root.glob(f"{_PARTIAL}*")):
            shutil.rmtree(path)

    def save(self, stage: str, artefact: Any, stamp: dict[str, Any]) -> None:
        """
        Saves an artefact and its stamp: into a temporary folder first, then renamed into place.

        Raises InputError where the disk is full or the folder cannot be written; what was there before stays.
        """
        place = self.folder(stage)
        partial, old = self.root / (_PARTIAL + place.name), self.root / (_OLD + place.name)
        try:
            shutil.rmtree(partial, ignore_errors=True)
            artefact.save(partial)
            stamp = {
                "version": STAMP_VERSION,
                **stamp,
                "files": _digests(partial, getattr(artefact, "shows_seconds", ())),
            }
            stamp["seal"] = _seal(stamp)
            text = json.dumps(stamp, indent=1, ensure_ascii=False, sort_keys=True)
            (partial / "stamp.json").write_text(text + "\n", encoding="utf-8")
            _flush(partial)
            if place.exists():
                place.rename(old)
            partial.rename(place)
            shutil.rmtree(old, ignore_errors=True)
        except OSError as error:
            shutil.rmtree(partial, ignore_errors=True)
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                raise InputError(f"the disk of {self.root} is full: free some space and run again") from None
            raise InputError(f"stage {stage} cannot be saved in {self.root}: {error.strerror or error}") from None

    def require_space(self, needed: int) -> None:
        """Raises InputError where less than `needed` bytes are free on the project's disk."""
        free = shutil.disk_usage(self.root).free
        if free < needed:
            message = f"{free / 1e9:.1f} GB are free for {self.root}, about {needed / 1e9:.1f} GB are needed"
            raise InputError(f"{message}: free some space, or name another disk with -o")

    def settings(self) -> dict[str, Any]:
        """
        What project.toml says: capture and template (paths relative to the project), quality, options.

        Raises InputError where it is not what `write_settings` writes.
        """
        path = self.root / "project.toml"
        try:
            settings = tomllib.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return {}
        except (OSError, ValueError, RecursionError) as error:
            raise InputError(f"{path} is not valid TOML ({error}): mend or delete it") from None
        kinds = {"capture": str, "template": str, "quality": str, "options": dict}
        wrong = [key for key, kind in kinds.items() if not isinstance(settings.get(key, kind()), kind)]
        if wrong or not all(isinstance(value, str) for value in settings.get("options", {}).values()):
            raise InputError(
                f"{path}: {(wrong or ['options'])[0]} is not of the kind that `run` writes: delete the file"
            )
        return settings

    def template(self) -> TemplateFile:
        """
        The head template that project.toml names, or the shipped one.

        Raises InputError where its file is not there any more.
        """
        kept = self.settings().get("template", SHIPPED)
        return resolve(kept if kept == SHIPPED else self.root / kept)

    def write_settings(self, capture: Path, template: TemplateFile, quality: str, options: dict[str, str]) -> None:
        """Writes project.toml: capture and template relative to the project, and the options that differ."""
        quote = lambda text: json.dumps(text, ensure_ascii=False)  # noqa: E731
        named = SHIPPED if template.shipped else self._from_here(template.path)
        lines = [f"capture = {quote(self._from_here(capture))}", f"template = {quote(named)}"]
        lines += [f"quality = {quote(quality)}", "", "[options]"]
        lines += [f"{quote(key)} = {quote(value)}" for key, value in sorted(options.items())]
        partial = self.root / f"{_PARTIAL}project.toml"
        try:
            partial.mkdir(exist_ok=True)
            (partial / "project.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
            (partial / "project.toml").replace(self.root / "project.toml")
            partial.rmdir()
        except OSError as error:
            raise InputError(f"the project folder {self.root} cannot be written: {error.strerror}") from None

    def _from_here(self, path: Path) -> str:
        try:
            return Path(os.path.relpath(path, self.root)).as_posix()
        except ValueError:  # another drive on Windows
            return Path(os.path.abspath(path)).as_posix()

    def sizes(self) -> dict[str, int]:
        """Bytes of every stage folder that exists, and of the viewer's."""
        folders = [*(self.folder(stage) for stage in _STAGE_ORDER), self.clip_folder]
        return {
            folder.name: sum(p.stat().st_size for p in folder.rglob("*") if p.is_file())
            for folder in folders
            if folder.is_dir()
        }

    def remove(self, stage: str) -> None:
        """Deletes a stage's artefact."""
        shutil.rmtree(self.folder(stage), ignore_errors=True)


def _digests(folder: Path, without: tuple[str, ...] = ()) -> dict[str, str]:
    """Of every file of a stage's folder but the stamp, by its name there, the first half of its SHA-256."""
    made = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_file() and name not in ("stamp.json", *without):
            with path.open("rb") as f:
                made[name] = hashlib.file_digest(f, "sha256").hexdigest()[:32]
    return made


def _seal(stamp: dict[str, Any]) -> str:
    told = {key: value for key, value in stamp.items() if key not in ("timing", "seal")}
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()


def _sound(stamp: Any) -> bool:
    """Whether a stamp is as it was written; of one without a seal, whether it has the right form."""
    timing = stamp.get("timing") if isinstance(stamp, dict) else None
    if not isinstance(timing, dict) or not isinstance(timing.get("seconds"), int | float):
        return False
    if "seal" in stamp:
        return stamp["seal"] == _seal(stamp)
    form = {"key": str, "versions": dict, "options": dict, "figures": dict, "warnings": list}
    return all(isinstance(stamp.get(key), kind) for key, kind in form.items())


def _flush(folder: Path) -> None:
    # A rename may reach the disk before the bytes do: a power cut would leave a stamped, empty artefact.
    if os.name != "posix":
        return
    for path in [*folder.rglob("*"), folder]:
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
