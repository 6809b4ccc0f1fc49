"""Test classes for tasks, environments, agents and methods of your own: inherit one, and pytest runs its tests.

It imports no pytest; our own tests inherit the same classes.
"""

from ctgraph_rl.testing.environments import EnvironmentContract as EnvironmentContract
from ctgraph_rl.testing.environments import TaskContract as TaskContract
from ctgraph_rl.testing.learners import AgentContract as AgentContract
from ctgraph_rl.testing.learners import MethodContract as MethodContract
