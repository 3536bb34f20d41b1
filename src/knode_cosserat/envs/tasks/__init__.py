"""Tasks of environments, and their names."""

from __future__ import annotations

from knode_cosserat.envs.tasks.base import Task
from knode_cosserat.envs.tasks.following import Adaptation, Follow, Payload
from knode_cosserat.envs.tasks.obstacles import Gate, Pillar
from knode_cosserat.envs.tasks.reaching import Reach

#: tasks by name
TASKS: dict[str, type[Task]] = {
    task.name: task for task in (Follow, Reach, Pillar, Gate, Payload, Adaptation)
}
