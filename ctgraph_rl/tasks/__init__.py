"""Problems as frozen values: tasks with their images, observations and goals, curricula, and their measures.

It imports `ctgraph_rl.core` and no TorchRL; the environments, `curricula` and everything that learns import it.
"""
