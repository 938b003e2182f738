# Needs Python 3.11 or 3.12, make and the network; everything else is set up here.
FITS := import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))
# The first that runs and fits: a name on the PATH may be a shim with nothing behind it.
PYTHON ?= $(shell for p in python3 python3.12 python3.11; do \
  $$p -c '$(FITS)' >/dev/null 2>&1 && { echo $$p; break; }; done)
BIN := .venv/bin
RUNS := .venv/.runs
STAMP := .venv/.installed
# What is imported is compiled then: most of what is installed never is.
PIP := $(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check -c constraints.txt

.PHONY: demo test soak fuzz hashes lint docs tutorials check wheel clean

# Needs no more than a user does; small enough to be there in three minutes, installing included.
demo: $(RUNS)
	$(BIN)/moonteam rollout outpost --planner policy --policy any_team_mappo --decode best-of-16 \
	  --size 960 540 --fps 24 --seconds 18 --out runs/demo --force
	@echo "Watch runs/demo/video.mp4; the report is runs/demo/report.html"

test: $(STAMP)
	$(BIN)/python -m pytest -q -n 2 --dist loadfile --durations=15

soak: $(STAMP)
	$(BIN)/python -m pytest -q -n 2 --dist loadfile -m soak --durations=15

# 100,000 files that are almost right, in ten minutes; says how many of each kind came out how.
fuzz: $(STAMP)
	$(BIN)/python -m pytest -q -m soak tests/fuzz --durations=7

# hashes.txt, for `pip install --require-hashes -r hashes.txt`; from whatever index pip is set to.
hashes: $(STAMP)
	mkdir -p build
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --dry-run --ignore-installed \
	  --report build/report.json -c constraints.txt '.[ortools]'
	$(BIN)/python .ci/hashes build/report.json >hashes.txt

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/pyright
	$(BIN)/lint-imports

# site/index.html, pages that link to nothing that is not there; the variable leaves an advertisement out.
docs: $(STAMP)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet

# Executes the tutorials and stores what they show.
tutorials: $(STAMP)
	$(BIN)/python docs/run_tutorials.py

wheel: $(STAMP)
	PYTHON=$(PYTHON) BIN=$(BIN) sh .ci/wheel

check: lint docs test demo wheel

$(RUNS): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" && $(PYTHON) -c '$(FITS)' || \
	  { echo "moonteam needs Python 3.11 or 3.12; say which with: make PYTHON=/path/to/python3.12"; exit 2; }
	$(PYTHON) -m venv .venv
	$(PIP) -e .
	@$(BIN)/moonteam doctor
	@touch $(RUNS)

$(STAMP): $(RUNS)
	$(PIP) -e '.[test,docs,ortools]'
	@touch $(STAMP)

clean:
	rm -rf .venv build dist runs out site
