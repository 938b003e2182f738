"""Grid state in, joint action or whole plan out.

`base` has the words (Snapshot, Plan, Planner); `registry` has every planner by name: exact
(certified), greedy, lns, cpsat, routing, exhaustive, policy, and your own. `kind.PlannerOptions`
is what they are made from. Each plans whole missions (`plan`) and decides step by step (`reset`,
`act`). `batch.solve_batch` labels many states at once; `best_of` says which of many rollouts
counts; `contract` checks what a planner promises. Nothing is imported here, so that a command loads
only the planner it uses.
"""
