"""`avatarbuild transfer-details`: one person's details on another's avatar, since all of them share one texture."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from avatarbuild.animation.clip import rig_of
from avatarbuild.artefacts import Avatar
from avatarbuild.details.edges import lengths
from avatarbuild.errors import InputError
from avatarbuild.formats.details import JSON_FILE, details_in, read_details
from avatarbuild.project import Project

_FOLDER = "details/"


def transfer_details(source: Project, target: Project) -> int:
    """
    Puts source's avatar/details into target's and returns how many files they are: the avatar keeps its own normal
    map, and strain is measured by its own head at rest. The avatar's folder is replaced as a whole or not at all.

    Raises InputError where one of them has no finished avatar, source no details, or the templates differ.
    """
    if source.root.resolve() == target.root.resolve():
        raise InputError(f"{source.root}: FROM and TO are the same project; name two")
    files = _details(source)
    with target.lock():
        stamp = target.stamp("avatar")
        if stamp is None:
            raise InputError(f"{target.root} has no finished avatar: run `avatarbuild run` on its capture first")
        made = read_details(files, target.template().load())
        about = json.loads(files[JSON_FILE])
        about["rest_mm"] = [round(float(x), 5) for x in lengths(rig_of(target).neutral, made.edges)]
        about["from"] = source.root.resolve().name
        files[JSON_FILE] = (json.dumps(about, ensure_ascii=False, allow_nan=False) + "\n").encode()
        old = Avatar.load(target.folder("avatar")).files
        new = {name: data for name, data in old.items() if not name.startswith(_FOLDER)}
        new |= {_FOLDER + name: data for name, data in files.items()}
        if "avatar.json" in new:
            new["avatar.json"] = _listed(new)
        target.save("avatar", Avatar(new), _without_version(stamp))
    return len(files)


def _details(project: Project) -> dict[str, bytes]:
    """File name -> bytes of a project's details."""
    if project.stamp("avatar") is None:
        raise InputError(f"{project.root} has no finished avatar: run `avatarbuild run` on its capture first")
    files = details_in(project.folder("avatar") / _FOLDER)
    if not files:
        raise InputError(f"{project.root} has no details: they come from a capture with a video; run it again")
    return files


def _listed(files: dict[str, bytes]) -> bytes:
    """avatar.json with the bytes and hashes of the details as they are now."""
    about = json.loads(files["avatar.json"])
    listed = {name: row for name, row in about["files"].items() if not name.startswith(_FOLDER)}
    for name, data in files.items():
        if name.startswith(_FOLDER):
            listed[name] = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    about["files"] = listed
    return (json.dumps(about, indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode()


def _without_version(stamp: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in stamp.items() if key != "version"}
