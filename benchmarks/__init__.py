"""How fast environments and agents are: measured in a checkout, and no part of the wheel.

``python -m benchmarks.environments`` runs `environments`, and ``python -m benchmarks.agents`` runs `agents`.
"""
