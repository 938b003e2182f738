"""Planning by the clock: one problem, exact search, local search."""
