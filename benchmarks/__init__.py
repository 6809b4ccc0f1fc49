"""Speed of environments and agents, measured in a checkout.

``python -m benchmarks.environments`` and ``python -m benchmarks.agents`` run them.
"""
