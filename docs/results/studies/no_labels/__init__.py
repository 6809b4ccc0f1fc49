"""What detectors of task changes find: the page no_labels.md.

`learners` groups the raw results; all others show them.
"""
