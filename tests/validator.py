"""The Khronos glTF validator (npm package gltf-validator), where Node and the package are at hand."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from functools import cache
from pathlib import Path
from typing import Any

import pytest

VARIABLE = "AVATARBUILD_NODE_MODULES"
_SCRIPT = """
const validator = require(process.argv[1]);
const parts = [];
process.stdin.on('data', (part) => parts.push(part));
process.stdin.on('end', () => validator
  .validateBytes(new Uint8Array(Buffer.concat(parts)), {maxIssues: 100})
  .then((report) => console.log(JSON.stringify(report))));
"""


def report(glb: bytes) -> dict[str, Any]:
    """The validator's report on a file. Skips the test without Node or package; on CI that is a failure."""
    command = ["node", "-e", _SCRIPT, str(_package())]
    done = subprocess.run(command, input=glb, capture_output=True, timeout=120, check=True)
    return json.loads(done.stdout)


def issues(glb: bytes, worst: int = 1) -> list[str]:
    """Errors (severity 0), warnings (1), and infos (2) up to `worst`, as lines."""
    found = report(glb)["issues"]
    assert not found["truncated"]
    lines = [f"{m['code']} {m.get('pointer', '')}: {m['message']}" for m in found["messages"] if m["severity"] <= worst]
    assert len(lines) == sum(found[key] for key in ("numErrors", "numWarnings", "numInfos")[: worst + 1])
    return lines


@cache
def _package() -> Path:
    folders = [Path(os.environ[VARIABLE])] if VARIABLE in os.environ else []
    folders.append(Path(__file__).parent.parent / "node_modules")
    npm = shutil.which("npm")
    if npm is not None:
        done = subprocess.run([npm, "root", "-g"], capture_output=True, text=True, timeout=60)
        folders.append(Path(done.stdout.strip()))
    for folder in folders:
        if shutil.which("node") and (folder / "gltf-validator" / "package.json").is_file():
            return (folder / "gltf-validator").resolve()
    message = f"no gltf-validator: install Node, `npm install gltf-validator`, and name its node_modules in {VARIABLE}"
    if os.environ.get("CI", "").lower() in ("true", "1"):
        pytest.fail(message)
    pytest.skip(message)
