"""Reports of finished runs: a page of figures and tables, tables over seeds with intervals, and a run's summary.

It imports runs, figures and everything below them; the command line and `ctgraph_rl.run` use it.
"""
