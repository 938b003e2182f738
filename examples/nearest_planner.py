"""A planner of one's own: all who can help go together to the target nearest to them all.

moonteam check planner examples/nearest_planner.py:NearestPlanner
moonteam plan outpost --planner examples/nearest_planner.py:NearestPlanner
"""

import numpy as np

from moonteam.planners.search.travel import UNREACHABLE, travel_times, walk


class NearestPlanner:
    """See `moonteam.planners.base.Planner`; whole plans are made of its decisions."""

    name = "nearest"

    def reset(self, snapshot, seed=0):
        """Forgets nothing, for it remembers nothing."""

    def act(self, snapshot):
        """Joint action [N]: 0 up, 1 down, 2 left, 3 right, 4 stay."""
        travel, kinds, ground = travel_times(snapshot), snapshot.agent_kinds, snapshot.passable
        helps = snapshot.agent_skills[:, None] & snapshot.target_skills != 0  # [N, M]
        helps &= snapshot.agent_mask[:, None] & (travel.start < UNREACHABLE)
        away = np.where(helps, travel.start, 0).sum(0)
        goal = np.where(~snapshot.solved & helps.any(0), away, UNREACHABLE).argmin()
        actions = np.full(len(snapshot.cells), 4, np.int32)
        for i in np.flatnonzero(helps[:, goal] & ~snapshot.solved[goal]):
            closed = (travel.fields[kinds[i], goal], ground[kinds[i]]) if ground is not None else ()
            way = walk(snapshot.cells[i], snapshot.target_cells[goal], *closed)
            actions[i] = way[0] if way else 4
        return actions
