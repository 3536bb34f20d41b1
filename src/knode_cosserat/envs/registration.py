"""Names of the environments in Gymnasium's registry: `gymnasium.make("knode_cosserat/Follow-v0")`."""

from __future__ import annotations

#: names of the tasks; importing them would import JAX
NAMES = ("follow", "reach", "pillar", "gate", "payload", "adaptation")


def register() -> None:
    """Register an environment for each task; Gymnasium calls this by its entry point `gymnasium.envs`."""
    import gymnasium

    for name in NAMES:
        gymnasium.register(
            id=f"knode_cosserat/{name.capitalize()}-v0",
            entry_point="knode_cosserat.envs.single:made",
            kwargs={"task": name},
        )
