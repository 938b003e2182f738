"""`moonteam evaluate unfolding`: who decides best where not everything is known."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from moonteam import compilation
from moonteam.commands.evaluate_grid import deliver, load_any, options_of
from moonteam.commands.options import Limited, Many, Reported, Resumable, Seeded
from moonteam.errors import InputError
from moonteam.problem.timed import Timed

FILES = ("config.json", "rows.jsonl", "report.json", "summary.csv", "rows.csv", "table.md",
         "unfolding.png")
"""In --out."""
Search = Literal["nearest", "sweep", "places", "stay", "middle"]
Goal = Literal["makespan", "waiting"]


@dataclass(frozen=True)
class Args(Seeded, Limited, Resumable, Reported):
    """Missions that unfold, played by planners that are told only what is known.

    Targets arrive as others are solved or by a clock, are hidden until a robot with eyes is near,
    or a robot is lost on the way. All that will happen stands in the set, so that every row meets
    the same future. A planner plans anew at every event, and looks no further; over K futures it
    draws as many of what may still happen, tries several first moves in each, and takes the best.
    Rows are compared with the first, mission by mission. Beside them stands the least makespan in
    hindsight. Options marked "again" may be given several times.

    Where targets are hidden, robots that have nothing else to do look for them: nearest, to the
    nearest ground not seen yet, or sweep, up and down a strip each. With places, places to look
    from are planned for as if they were targets (by lns or a policy such as searching); over K
    futures the hidden targets of each are then planned for too, every one after the place that sees
    it, and what most of the plans begin with is done.

    Files in --out: report.json, summary.csv, rows.csv, table.md and unfolding.png; and rows.jsonl,
    to which each mission is added as it is played (a policy's as a whole), so that --resume goes
    on.

    Examples:
      moonteam evaluate unfolding unfolding/following --planner exact --planner greedy
      moonteam evaluate unfolding unfolding/arrivals --futures 16 --limit 100
      moonteam evaluate unfolding --planner policy --policy unfolding --futures 256 --limit 200
      moonteam evaluate unfolding unfolding/arrivals --planner exact --planner policy \
        --policy unfolding --futures 64 --foresee policies --goal waiting --limit 100
      moonteam evaluate unfolding --planner exact --planner policy --policy unfolding \
        --futures 2 --foresee planners --futures 64 --foresee policies
      moonteam evaluate unfolding unfolding/hidden --search nearest --search sweep
      moonteam evaluate unfolding unfolding/hidden --planner lns --time-limit 0.01 \
        --search nearest --search places --futures 32 --limit 100
      moonteam evaluate unfolding unfolding/losses --planner policy --policy any_team
    """

    set: tyro.conf.Positional[str] = "unfolding/following"
    """A set by the clock (.jsonl), or the name of a bundled one."""
    planner: Many[tuple[str, ...]] = ()
    """By the clock: auto, exact, greedy, lns, policy, another package's, or FILE.py:OBJECT; again
    for more rows. Default: exact."""
    futures: Many[tuple[int, ...]] = ()
    """Also over so many sampled futures; again for more rows. Policies, by argmax alone, go on by
    themselves in the futures; where ways take what is expected, thousands of them in one call, and
    what they try is then the plan of what is known beside their own choices, and once all is known
    they plan, which is all that 0 adds to a policy alone. Where targets are hidden, by places,
    what most futures ask for is done."""
    foresee: Many[tuple[Literal["all", "policies", "planners"], ...]] = ()
    """Rows that are repeated over futures: all (default), those of policies, or those of other
    planners. Again, as often as --futures: for each of these numbers in turn."""
    goal: Many[tuple[Goal, ...]] = ()
    """What is to be least over futures: makespan, or waiting, which is how long targets wait for
    their services; again for more rows. Default: makespan."""
    search: Many[tuple[Search, ...]] = ()
    """Where targets are hidden: nearest, sweep or places; default: the first two. Where they come:
    stay (default), or middle, where who has nothing to do goes to where the next target is soonest
    reached in the mean. Again for more rows."""
    policy: Many[tuple[str, ...]] = ()
    """Policy file (.safetensors) or the name of a bundled policy, for --planner policy; again for
    more."""
    decode: Many[tuple[str, ...]] = ()
    """argmax, sample or best-of-K such as best-of-16; again for more rows. Default: argmax."""
    time_limit: Many[tuple[float, ...]] = ()
    """Seconds a plan that anytime planners (exact, lns, auto) may take; again for more rows.
    Default: theirs."""


def _missions(args: Args) -> tuple[list[Timed], bool, bool]:
    """Those of the set, whether targets are hidden, and whether ways take what is expected.

    Raises InputError.
    """
    from moonteam.planners.unfolding.deciding.make import check_search

    found = [one for one in load_any(args.set, args.limit) if isinstance(one, Timed)]
    if not found:
        raise InputError(args.set, "is in steps; a set by the clock is needed, such as "
                         "unfolding/following")
    hidden = any(target.hidden for one in found for target in one.targets)
    for search in args.search:
        check_search(search, hidden)
    for option, given in (("--goal", args.goal), ("--foresee", args.foresee)):
        if given and not args.futures:
            raise InputError(option, "has no effect without --futures")
    others = any(one.expects is not None and one.expects.scatter for one in found)
    return found, hidden, not others


def run(args: Args) -> int:
    """Plays, compares, prints, saves; 0 whatever the planners achieved, 130 if interrupted."""
    compilation.enable_cache()
    from moonteam.evaluation import timed, unfolding
    from moonteam.planners.unfolding.deciding.make import PATTERNS
    from moonteam.report import command, journal

    found, hidden, ahead = _missions(args)
    patterns = args.search or (PATTERNS if hidden else ())
    rows = unfolding.rows_of(timed.contenders(options_of(args)), args.futures, patterns, args.goal,
                             ahead, args.foresee)
    kept = journal.Kept.of(args.out, args.resume, command.figures(args), FILES)
    title = f"{Path(args.set).stem}: {len(found)} missions that unfold"
    document = unfolding.evaluate(found, rows, args.seed, title,
                                  command.line("evaluate unfolding", args), kept)
    return deliver(args, document, unfolding, "unfolding.png")
