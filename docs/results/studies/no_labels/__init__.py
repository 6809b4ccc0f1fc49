"""What detectors of task changes find: the page no_labels.md."""
