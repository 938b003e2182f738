#!/usr/bin/env bash
# What only an accelerator can do, in one command: MAPPO on macro-decisions at 50 times the batch,
# a chunk of the paper's five-target recipe, and the throughput tables. All of it goes on where it
# stopped when it is run again with the same OUT.
#
#   bash examples/accelerator.sh                  # 20 minutes of any_team, 5 of pi_5t, benchmarks
#   SMALL=1 OUT=runs/trial bash examples/accelerator.sh    # the same at toy size (quick), on a CPU
set -euo pipefail
cd "$(dirname "$0")/.."
out=${OUT:-runs/accelerator}
moonteam=${MOONTEAM:-.venv/bin/moonteam}
if [ -n "${SMALL:-}" ]; then
  minutes=1 paper=1 rounds=2 preset=quick
  macro="--vine.episodes 32 --vine.moments 128 --chunk-rounds 1 --eval-every 2 --eval-scenarios 32"
  mappo="--bootstrap.updates 2 --refinement.updates 0 --bootstrap.num-envs 32 --chunk-updates 1 --eval-scenarios 8"
else
  minutes=${MINUTES:-20} paper=${PAPER_MINUTES:-5} rounds=${ROUNDS:-400} preset=any_team
  # All that passes the network together: there is no small cache to fit.
  macro="--vine.episodes 25600 --vine.moments 102400 --vine.minibatches 16 --hyper.part 3000000
    --lr 2e-3 --precision tf32"
  mappo=""
fi

# Stops between two chunks, with everything saved, when its minutes are over.
for_minutes() {
  local limit=$1; shift
  timeout --signal INT "${limit}m" "$@" || { code=$?; [ $code = 124 ] || [ $code = 130 ] || exit $code; }
}

resume() { if [ -e "$1/config.json" ]; then echo --resume; fi; }

mkdir -p "$out"
$moonteam doctor | tee "$out/doctor.txt"
# shellcheck disable=SC2046,SC2086
for_minutes "$minutes" $moonteam train $preset --rounds "$rounds" $macro --out "$out/$preset" $(resume "$out/$preset")
# shellcheck disable=SC2046,SC2086
for_minutes "$paper" $moonteam train pi_5t $mappo --out "$out/pi_5t" $(resume "$out/pi_5t")
if [ -z "${SMALL:-}" ]; then
  for what in grid train physics; do $moonteam bench $what --json > "$out/bench-$what.json"; done
fi
