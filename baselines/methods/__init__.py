"""Lifelong-learning methods, one in each file, and their base classes.

They import `baselines`' hooks, learner and networks, and no agent by name; runs build them by the ``_target_`` of
``conf/method``.
"""
