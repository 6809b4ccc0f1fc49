"""Learning in memory: the loop over the blocks of a curriculum, the collection of batches, and evaluation.

It imports the environment and the log and knows no files; `ctgraph_rl.runs` calls it, and so may a user's own script.
"""
