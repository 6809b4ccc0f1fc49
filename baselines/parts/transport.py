"""Exact optimal transport between weighted sets of points, as NumPy has no solver and SciPy is optional."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ctgraph_rl.checks import require

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def optimal_plan(cost: Floats, supply: Ints, demand: Ints) -> Ints:
    """Return a transport plan of least cost by successive shortest paths, int64 [rows, columns].

    Units are whole numbers, without rounding errors. Time grows mostly with the columns: about 10 ms for 50 rows and 25
    columns, 60 ms for 128 columns.

    Args:
        cost: of one unit from a row to a column, float64 [rows, columns].
        supply: units of each row, int64 [rows], at least 0.
        demand: units of each column, int64 [columns], at least 0.

    Raises:
        ValueError: if the sums of supply and demand differ.
    """
    offered = int(supply.sum())
    wanted = int(demand.sum())
    require((offered == wanted, f"supply and demand must have equal sums, got {offered} and {wanted}"))
    transport = _Transport(cost, demand)
    for row, units in enumerate(supply.tolist()):
        while units:
            units -= transport.send(row, units)
    return transport.plan


class _Transport:
    """A plan that grows along shortest paths, and reduced costs, at least 0, and 0 where it sends.

    Args:
        cost: float64 [rows, columns].
        demand: int64 [columns].
    """

    def __init__(self, cost: Floats, demand: Ints) -> None:
        self.plan = np.zeros(cost.shape, dtype=np.int64)
        self.left = demand.copy()
        self.reduced = cost - cost.min(axis=0)
        self.reduced -= self.reduced.min(axis=1, keepdims=True)
        self.columns = np.arange(cost.shape[1])

    def send(self, row: int, most: int) -> int:
        """Send units from a row along the shortest path to a column that needs more; return how many.

        The path takes units away from arcs of the plan that it passes backwards.
        """
        column, came_from, came_by = self._shortest_path(row)
        place = int(came_from[column])
        forward = [(place, column)]
        backward: list[tuple[int, int]] = []
        while place != row:
            before = int(came_by[place])
            backward.append((place, before))
            place = int(came_from[before])
            forward.append((place, before))
        units = min([most, int(self.left[column]), *(int(self.plan[arc]) for arc in backward)])
        for arc in forward:
            self.plan[arc] += units
        for arc in backward:
            self.plan[arc] -= units
        self.left[column] -= units
        return units

    def _shortest_path(self, source: int) -> tuple[int, Ints, Ints]:
        """Return the nearest column that needs more, the row that each column came from, and each row's column.

        Potentials change so that the path has reduced costs of 0.
        """
        rows, columns = self.reduced.shape
        distance = self.reduced[source].copy()
        came_from = np.full(columns, source)
        row_distance = np.full(rows, np.inf)
        came_by = np.zeros(rows, dtype=np.int64)
        row_distance[source] = 0.0
        ahead = distance.copy()
        done = np.zeros(columns, dtype=bool)
        while True:  # Dijkstra's algorithm
            column = int(ahead.argmin())
            least = distance[column]
            ahead[column] = np.inf
            done[column] = True
            if self.left[column]:
                break
            new = np.flatnonzero((self.plan[:, column] > 0) & (row_distance == np.inf))
            if len(new):
                row_distance[new] = least
                came_by[new] = column
                onwards = least + self.reduced[new]
                best = onwards.argmin(axis=0)
                through = onwards[best, self.columns]
                shorter = through < distance  # never a column that is done
                distance[shorter] = ahead[shorter] = through[shorter]
                came_from[shorter] = new[best[shorter]]
        self.reduced -= (least - row_distance).clip(min=0.0)[:, None]  # of rows that were not reached it is -inf
        self.reduced += np.where(done, least - distance, 0.0)
        self.reduced.clip(min=0.0, out=self.reduced)  # rounding
        return column, came_from, came_by
