"""Lifelong-learning methods, one in each file, and `method`, which they derive from; `parts` has what they share.

They import `baselines`' hooks, learner and networks, and no agent by name; runs build them by the ``_target_`` of
``conf/method``.
"""
