"""Errors of environments."""

from __future__ import annotations

from knode_cosserat.errors import KnodeCosseratError


class TaskError(KnodeCosseratError, ValueError):
    """An environment that cannot be set up or used as asked; one line says why."""

    code = "environment"
