"""Grid state in, joint action or whole plan out.

`base` has the words (Snapshot, Plan, Planner). The planners: `exact.ExactPlanner` (certified),
`greedy.GreedyPlanner`, `large.LnsPlanner`, `cpsat.CpSatPlanner`, `exhaustive.ExhaustivePlanner`
and `learned.LearnedPlanner`; `batch.solve_batch` labels many states at once, and
`rollout.plan_from_planner` turns any planner's decisions into a plan. Nothing is imported
here, so that a command loads only the planner it uses.
"""
