"""Environments for learning controllers: tasks of robots as pure functions, and for Gymnasium and others.

`SingleEnv` and `VectorEnv` need Gymnasium (extra `rl`); `StableBaselinesEnv` needs the extra `sb3`.
"""

from __future__ import annotations

from knode_cosserat._lazy import make_lazy

make_lazy(
    __name__,
    {
        "knode_cosserat.envs.environment": "Environment make",
        "knode_cosserat.envs.errors": "TaskError",
        "knode_cosserat.envs.randomisation": "Factor Randomisation Uniform",
        "knode_cosserat.envs.spec": "Ending",
        "knode_cosserat.envs.policy": "Policy",
        "knode_cosserat.envs.pictures": "animate_episode",
        "knode_cosserat.envs.plant": "EpisodePlant",
        "knode_cosserat.envs.policy_controller": "PolicyController",
        "knode_cosserat.envs.scores": "controller_scores policy_scores",
        "knode_cosserat.envs.registration": "register",
        "knode_cosserat.envs.single": "SingleEnv",
        "knode_cosserat.envs.vector": "VectorEnv",
        "knode_cosserat.envs.stable_baselines": "StableBaselinesEnv",
        "knode_cosserat.envs.ppo": "PPOSettings Training",
        "knode_cosserat.envs.dynamics": "EpisodeState Transition",
        "knode_cosserat.envs.tasks": "TASKS",
        "knode_cosserat.envs.tasks.base": "Outcome Task Tip",
        "knode_cosserat.envs.tasks.survey": "Survey",
        "knode_cosserat.envs.tasks.following": "Adaptation Follow Payload",
        "knode_cosserat.envs.tasks.obstacles": "Gate Pillar",
        "knode_cosserat.envs.tasks.reaching": "Reach",
    },
)

__all__ = [
    "TASKS",
    "Adaptation",
    "Ending",
    "Environment",
    "EpisodePlant",
    "EpisodeState",
    "Factor",
    "Follow",
    "Gate",
    "Outcome",
    "PPOSettings",
    "Payload",
    "Pillar",
    "Policy",
    "PolicyController",
    "Randomisation",
    "Reach",
    "Survey",
    "Task",
    "TaskError",
    "Tip",
    "Training",
    "Transition",
    "Uniform",
    "animate_episode",
    "controller_scores",
    "make",
    "policy_scores",
    "register",
]
