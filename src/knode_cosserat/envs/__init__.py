"""Environments for learning controllers: tasks of robots as pure functions, and for Gymnasium and others.

`SingleEnv` and `VectorEnv` need Gymnasium (extra `rl`); `StableBaselinesEnv` needs the extra `sb3`. The
classes of tasks are in `tasks`.
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
    from knode_cosserat.envs.policy import PolicyController, controller_scores, policy_scores
    from knode_cosserat.envs.stable_baselines import StableBaselinesEnv as StableBaselinesEnv
    from knode_cosserat.envs.tasks import Factor, Randomisation, TaskError, Uniform

__all__ = [
    "Ending",
    "Environment",
    "Factor",
    "PolicyController",
    "Randomisation",
    "TaskError",
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
        "knode_cosserat.envs.policy": "PolicyController controller_scores policy_scores",
        "knode_cosserat.envs.stable_baselines": "StableBaselinesEnv",
        "knode_cosserat.envs.tasks": "Factor Randomisation TaskError Uniform",
    },
)
