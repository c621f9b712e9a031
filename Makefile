# make demo    one closed-loop episode in simulation; writes out/demo with report.html
# make test    all tests, in a fresh .venv
# make test-ray  the benchmark on a Ray cluster of this machine
# make lint    ruff and pyright
# make bench-loop  single grasps and the benchmark of offline and oracle in simulation (hours; see docs/benchmark.md)
# make fuzz    thousands of requests to the HTTP server, made from its own schema (some minutes)
# make bench   speed and memory stage by stage, perception and language on rendered scenes;
#              FRAMES=DIR adds the real frames of a folder (see docs/measurements.md)

PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt
PYTEST_ARGS ?= -n auto --dist loadfile

.PHONY: help demo test test-ray lint bench bench-loop fuzz browser clean

help:
	@sed -n 's/^# //p' Makefile

demo: $(VENV)/.sim
	@code=0; $(BIN)/thinkgrasp demo --out out/demo || code=$$?; [ $$code -le 1 ] || exit $$code

test: $(VENV)/.test browser
	$(BIN)/python -m pytest $(PYTEST_ARGS)

# The benchmark on a Ray cluster of this machine.
test-ray: $(VENV)/.test
	$(PIP) --editable '.[ray]'
	$(BIN)/python -m pytest tests/benchmark/test_ray_runner.py

lint: $(VENV)/.lint
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

bench: $(VENV)/.test
	$(BIN)/python benchmarks/latency.py
	$(BIN)/python benchmarks/perception.py
	$(BIN)/python benchmarks/grounding.py --split test
	$(BIN)/python benchmarks/motion.py
	$(BIN)/python benchmarks/rendering.py
	$(BIN)/python benchmarks/settling.py
	$(BIN)/python benchmarks/attempts.py
ifdef FRAMES
	$(BIN)/python benchmarks/latency.py --frames $(FRAMES)
	$(BIN)/python benchmarks/real_frames.py $(FRAMES)
	$(BIN)/python benchmarks/real_frames.py $(FRAMES) --instructions tests/data/real_rephrased.json
	$(BIN)/python benchmarks/leave_one_out.py $(FRAMES)
	$(BIN)/python benchmarks/stability.py $(FRAMES)
endif

fuzz: $(VENV)/.test
	$(BIN)/python -m pytest tests/server/test_fuzz.py -m fuzz -s

bench-loop: $(VENV)/.test
	$(BIN)/python benchmarks/grasping.py
	$(BIN)/thinkgrasp bench run --suite clutter --preset offline oracle --workers 2 --out out/bench/clutter
	$(BIN)/thinkgrasp bench run --suite heavy --preset offline oracle --workers 2 --out out/bench/heavy

# The tests of the 3-D view drive a browser; without one they are skipped, and say so.
browser:
	@command -v chromium chromium-browser google-chrome >/dev/null 2>&1 && exit 0; \
	if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
	  echo "installing chromium for the tests of the 3-D view"; \
	  { apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends chromium; } >/dev/null \
	    || echo "chromium could not be installed: the tests of the 3-D view will be skipped"; \
	else \
	  echo "no chromium found: the tests of the 3-D view will be skipped (on Debian: sudo apt-get install chromium)"; \
	fi

$(VENV)/.created:
	@test -n "$(PYTHON)" || { echo "no python3 found; install Python 3.11 or newer, or run: make PYTHON=/path/to/python3.11"; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "$(PYTHON) is older than Python 3.11; run: make PYTHON=/path/to/python3.11"; exit 1; }
	@$(PYTHON) -m venv $(VENV) \
	  || { echo "a virtual environment could not be made; on Debian: sudo apt-get install python3-venv"; rm -rf $(VENV); exit 1; }
	@$(PIP) --upgrade 'pip>=25.1'
	@touch $@

$(VENV)/.base: $(VENV)/.created pyproject.toml constraints.txt
	@echo "installing thinkgrasp into $(VENV)"
	@$(PIP) --editable .
	@touch $@

$(VENV)/.sim: $(VENV)/.base
	@echo "installing the simulator"
	@$(PIP) --editable '.[sim]'
	@touch $@

$(VENV)/.test: $(VENV)/.sim
	@echo "installing what the tests need"
	@$(PIP) --editable '.[sim,convex,viz,ompl,vlm,graspnet,langsam,calibration,server]' --group test
	@touch $@

$(VENV)/.lint: $(VENV)/.test
	@$(PIP) --group lint
	@touch $@

clean:
	rm -rf $(VENV) out build dist
