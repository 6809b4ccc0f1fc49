"""Test classes for your own tasks, environments, agents, methods and plasticities: inherit one, and pytest runs it.

It imports no pytest; our own tests inherit the same classes.
"""

from ctgraph_rl.testing.environments import EnvironmentContract as EnvironmentContract
from ctgraph_rl.testing.environments import TaskContract as TaskContract
from ctgraph_rl.testing.learners import AgentContract as AgentContract
from ctgraph_rl.testing.learners import MethodContract as MethodContract
from ctgraph_rl.testing.learners import PlasticityContract as PlasticityContract
