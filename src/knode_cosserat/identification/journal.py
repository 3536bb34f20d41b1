"""Journal of an identification: what was told, the searches that are finished, and the time that is left."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.learning.training.checkpoint import CheckpointError, Checkpoints, hashed

clock = time.monotonic

#: stages of an identification by effects
STAGES = (
    "first answer",
    "all effects",
    "selection of effects",
    "held-out recordings",
    "trials",
    "next experiment and band of predictions",
)


class OutOfTimeError(KnodeCosseratError):
    """The time of an identification is over."""

    code = "out-of-time"


class SearchError(KnodeCosseratError, RuntimeError):
    """A search cannot go on; one line says why."""

    code = "search"


class Journal:
    """Course of an identification; finished searches are kept, so that an interrupted one resumes.

    Args:
        tell: called with a line of progress.
        folder: where finished searches are kept; None: nowhere.
        minutes: time that the identification may take.
    """

    def __init__(
        self,
        tell: Callable[[str], None] = lambda line: None,
        folder: str | Path | None = None,
        minutes: float = np.inf,
    ):
        self._tell, self._folder = tell, None if folder is None else Checkpoints(folder)
        self.deadline = clock() + 60.0 * minutes
        #: lines that belong to the result, and the stage that has begun
        self.steps: list[str] = []
        self.stage = ""
        #: the last search in all recordings with its end, and the result, if there are any
        self.last: Any = None
        self.result: Any = None

    def tell(self, line: str) -> None:
        """Tell a line, with the time left."""
        left = self.deadline - clock()
        self._tell(f"{line}, {max(left, 0.0):.0f} s left" if left < np.inf else line)

    def step(self, line: str) -> None:
        """Tell a line that belongs to the result."""
        self.steps.append(line)
        self.tell(line)

    def begin(self, stage: str) -> None:
        """Begin a stage, if there is time.

        Raises:
            OutOfTimeError: the deadline is over.
        """
        self.stage = stage
        self.tell(f"stage {STAGES.index(stage) + 1} of {len(STAGES)}, {stage}")
        self.require_time()

    def require_time(self) -> None:
        """Raise `OutOfTimeError` if the deadline is over."""
        if clock() > self.deadline:
            raise OutOfTimeError

    def finished(self, solve: Callable[[], dict[str, Any]], *identity: Any) -> dict[str, Any]:
        """Return the facts of a search with this identity, from the folder if they are there.

        Raises:
            SearchError: the search failed, now or before.
        """
        if self._folder is None:
            return solve()
        key = hashed(*identity)
        try:
            facts = self._folder.load(key)
        except CheckpointError:  # a damaged file counts as missing
            facts = None
        if facts is None:
            try:
                facts = solve()
            except SearchError as error:
                facts = {"failed": str(error)}
            self._folder.save(key, facts)
        if "failed" in facts:
            raise SearchError(facts["failed"])
        return facts
