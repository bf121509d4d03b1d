"""What the tracker's own flow makes of points while they are being dragged: its steps are computed once and kept."""

from __future__ import annotations

import logging
import threading

import numpy as np

from avatarbuild.errors import InputError
from avatarbuild.tracking.corrections import REACH, Clicked, Decode, Expected, Step, spread, steps

log = logging.getLogger(__name__)

_MOST = 1500  # steps kept, of about 170 kB each
_FIRST = 12  # frames on both sides of the one that is looked at, which come first


class LiveFlow:
    """
    The steps about the frame that somebody looks at, made by a thread of its own, the nearest first; then those about
    the other corrected frames.
    """

    def __init__(self, times: np.ndarray, expected: Expected, decode: Decode) -> None:
        self.times, self.fault = times, ""
        self._expected, self._decode = expected, decode
        self._steps: dict[int, Step] = {}
        self._tried = np.zeros(max(len(times) - 1, 0), bool)  # by the frame that a step begins in
        self._focus, self._corrected = -1, frozenset[int]()
        self._changed = threading.Condition()
        threading.Thread(target=self._work, daemon=True).start()

    def look(self, frame: int, corrected: frozenset[int]) -> None:
        """Somebody looks at a frame; `corrected` are those with points set by hand."""
        with self._changed:
            self._focus, self._corrected = frame, corrected
            self._changed.notify()

    def carried(self, clicked: Clicked) -> dict[int, tuple[np.ndarray, np.ndarray]]:
        """As `spread`, as far as the flow is known."""
        with self._changed:
            known = list(self._steps.values())
        return spread(clicked, known, self.times)

    def ready(self, frame: int) -> float:
        """The share of the steps about a frame that are known; 1 where no more come."""
        near = self._near(frame)
        return 1.0 if self.fault or not near.any() else float(self._tried[near].mean())

    def _near(self, frame: int) -> np.ndarray:
        """(f - 1,) bool: steps that carry points of this frame."""
        t = self.times
        return np.maximum(abs(t[:-1] - t[frame]), abs(t[1:] - t[frame])) <= REACH

    def _next(self) -> list[int]:
        """Frames to decode, rising: missing steps from the nearest on, the more the farther that is."""
        about = [self._focus, *sorted(self._corrected, key=lambda i: abs(i - self._focus))]
        for frame in about:
            if not 0 <= frame < len(self.times):
                continue
            missing = np.flatnonzero(self._near(frame) & ~self._tried)
            if len(missing):
                apart = np.abs(missing + 0.5 - frame)
                some = missing[apart <= 2 * apart.min() + _FIRST]
                runs = np.split(some, np.flatnonzero(np.diff(some) > 1) + 1)
                nearest = missing[apart.argmin()]
                run = next(run for run in runs if nearest in run)
                return [*run.tolist(), int(run[-1]) + 1]
        return []

    def _work(self) -> None:
        while True:
            with self._changed:
                while not (frames := self._next()):
                    self._changed.wait()
                focus = self._focus
            try:
                for step in steps(frames, self._expected, self._decode):
                    with self._changed:
                        self._steps[step.first] = step
                        self._tried[step.first : step.then] = True
                        if self._focus != focus:
                            break
                else:
                    self._tried[frames[:-1]] = True  # those that cannot be decoded
            except InputError as error:
                self.fault = str(error)
                return
            except Exception:  # nobody waits for this thread: it says so on the page
                log.exception("the flow ends")
                self.fault = "The flow has ended with a fault: points are not carried any more on this page."
                return
            self._forget()

    def _forget(self) -> None:
        with self._changed:
            spare = sorted(self._steps, key=lambda i: -abs(i - self._focus))[: max(len(self._steps) - _MOST, 0)]
            kept = self._corrected | {self._focus}
            for first in spare:
                if not any(0 <= i < len(self.times) and self._near(i)[first] for i in kept):
                    del self._steps[first]
                    self._tried[first] = False
