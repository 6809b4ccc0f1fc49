"""Registers `ctgraph_rl.runs.sweep` with Hydra, which takes sweepers only from packages below ``hydra_plugins``.

``conf/hydra/sweeper/cells.yaml`` chooses it.
"""

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper

from ctgraph_rl.runs.sweep import Sweeper


class CellSweeper(Sweeper, BasicSweeper):
    """Sweeps over the cells of a grid; see `ctgraph_rl.runs.sweep.Sweeper`."""
