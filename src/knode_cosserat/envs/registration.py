"""Names of the environments in Gymnasium's registry: `gymnasium.make("knode_cosserat/Follow-v0")`."""

from __future__ import annotations

from knode_cosserat.envs.tasks import TASKS


def register() -> None:
    """Register an environment for each task in Gymnasium's registry; it needs the extra `rl`.

    An entry point of Gymnasium would do it at each `import gymnasium`, and import JAX with it.
    """
    import gymnasium

    for name in TASKS:
        gymnasium.register(
            id=f"knode_cosserat/{name.capitalize()}-v0",
            entry_point="knode_cosserat.envs.single:made",
            kwargs={"task": name},
        )
