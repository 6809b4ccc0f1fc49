"""How fast environments and agents are: measured in a checkout, and no part of the wheel.

``python -m ctgraph_rl.benchmark`` runs `environments`, and ``python -m baselines.benchmark`` runs `agents`.
"""
