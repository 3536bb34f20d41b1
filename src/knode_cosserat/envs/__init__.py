"""Environments for learning controllers: tasks of robots as pure functions, and for Gymnasium and others.

`SingleEnv` and `VectorEnv` need Gymnasium (extra `rl`); `StableBaselinesEnv` needs the extra `sb3`.
"""

from typing import TYPE_CHECKING

from knode_cosserat._lazy import make_lazy

if TYPE_CHECKING:
    from knode_cosserat.envs.dynamics import Ending
    from knode_cosserat.envs.environment import Environment, make
    from knode_cosserat.envs.gymnasium_envs import SingleEnv as SingleEnv
    from knode_cosserat.envs.gymnasium_envs import VectorEnv as VectorEnv
    from knode_cosserat.envs.gymnasium_envs import register
    from knode_cosserat.envs.pictures import animate_episode
    from knode_cosserat.envs.policy import (
        EpisodePlant,
        Policy,
        PolicyController,
        controller_scores,
        policy_scores,
    )
    from knode_cosserat.envs.ppo import PolicyTraining, PPOSettings
    from knode_cosserat.envs.stable_baselines import StableBaselinesEnv as StableBaselinesEnv
    from knode_cosserat.envs.tasks import (
        TASKS,
        Adaptation,
        Factor,
        Follow,
        Gate,
        Outcome,
        Payload,
        Pillar,
        Randomisation,
        Reach,
        Survey,
        Task,
        TaskError,
        Tip,
        Uniform,
    )

__all__ = [
    "TASKS",
    "Adaptation",
    "Ending",
    "Environment",
    "EpisodePlant",
    "Factor",
    "Follow",
    "Gate",
    "Outcome",
    "PPOSettings",
    "Payload",
    "Pillar",
    "Policy",
    "PolicyController",
    "PolicyTraining",
    "Randomisation",
    "Reach",
    "Survey",
    "Task",
    "TaskError",
    "Tip",
    "Uniform",
    "animate_episode",
    "controller_scores",
    "make",
    "policy_scores",
    "register",
]

make_lazy(
    __name__,
    {
        "knode_cosserat.envs.dynamics": "Ending",
        "knode_cosserat.envs.environment": "Environment make",
        "knode_cosserat.envs.gymnasium_envs": "SingleEnv VectorEnv register",
        "knode_cosserat.envs.pictures": "animate_episode",
        "knode_cosserat.envs.policy": "EpisodePlant Policy PolicyController controller_scores policy_scores",
        "knode_cosserat.envs.ppo": "PPOSettings PolicyTraining",
        "knode_cosserat.envs.stable_baselines": "StableBaselinesEnv",
        "knode_cosserat.envs.tasks": "Adaptation Factor Follow Gate Outcome Payload Pillar Randomisation "
        "Reach Survey TASKS Task TaskError Tip Uniform",
    },
)
