"""Detectors of task changes, one file each: they give labels to tasks that have none.

`baselines.detectors.detector` says what a detector is, and what its labels are used for. A file of ``conf/detector``
names each with its settings.
"""
