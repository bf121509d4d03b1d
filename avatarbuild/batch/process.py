"""The process of one subject: `avatarbuild run`, which ends when the batch that began it is gone."""

from __future__ import annotations

import os
import sys
import threading

from avatarbuild.main import run_program


def _end_with_the_batch() -> None:
    # the batch holds the other end of the pipe, however it ends
    while os.read(0, 4096):
        pass
    os._exit(1)


if __name__ == "__main__":
    threading.Thread(target=_end_with_the_batch, daemon=True).start()
    sys.argv[0] = "avatarbuild"
    run_program()
