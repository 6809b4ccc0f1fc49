"""What agents share: the learner, policy gradients, Q-learning, networks, replay, hooks, and the catalogue of agents.

A module belongs here if two agents need it, or an agent and the cells, methods or detectors.
"""
