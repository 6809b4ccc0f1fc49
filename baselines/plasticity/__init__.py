"""Methods against lost plasticity, one in each file, and `plasticity`, which they derive from.

They combine with the lifelong-learning methods of `baselines.methods`, and act before these; runs build them by the
``_target_`` of ``conf/plasticity``.
"""
