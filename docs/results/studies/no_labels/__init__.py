"""What detectors of task changes find: the page no_labels.md.

`runs` collects raw results, and `learners` groups them; `page` makes the page.
"""
