# Every target sets up what it needs: python3 >= 3.11 with venv, git and make are enough.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
PIP := $(BIN)/python -m pip --disable-pip-version-check -qq
WORKERS ?= 2

# Many small matrices: threads inside NumPy and OpenCV only get in each other's way.
export OMP_NUM_THREADS ?= 1
# Without bytecode on disk each worker rewrites all tests, and each command that a test starts compiles the package.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: setup test test-slow lint demo bench tables guard mutate release-check ros-check image docs browser lock clean

setup: $(INSTALLED)

$(INSTALLED): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(v < (3, 11) and "Python 3.11 or newer is needed, found %d.%d (try make PYTHON=python3.12)" % v[:2])'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(PIP) install -c constraints.txt setuptools setuptools-scm
	$(PIP) install -c constraints.txt --no-build-isolation -e '.[test]'
	@touch $@

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/mypy

test: lint
	$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal -m 'not slow'

# Whole drives, kills, notebooks: what takes more than about three seconds a test.
test-slow: $(INSTALLED)
	$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal -m slow

demo: $(INSTALLED)
	$(BIN)/sst-graph demo --out out/demo --overwrite

# Timings of single functions, the hot paths beside other ways, cost against size, and the tracker's frames;
# small ones, in a few minutes.
bench: $(INSTALLED)
	$(PIP) install -c constraints.txt --no-build-isolation -e '.[bench]'
	$(BIN)/python -m pytest benchmarks --benchmark-enable -n 0
	$(BIN)/python -m benchmarks.ratios --frames 10 --rounds 20
	$(BIN)/python -m benchmarks.scaling --only frames --frames 1 5 20
	$(BIN)/python -m benchmarks.tracker_run --frames 200 --markdown

# The tables of the documentation that this code has not made yet: hours. DATA="STOP=DIR PARKED=DIR" names the
# real drives, TABLES="accuracy" chooses by page or command.
DATA ?=
TABLES ?=

tables: $(INSTALLED)
	$(BIN)/python docs/make_tables.py $(TABLES) $(addprefix --data ,$(DATA))

# Fails when a hot path takes more than 1.2 times the instructions that benchmarks/guard.json says. Without
# valgrind it says that nothing was checked; GUARD=--required makes that a failure.
GUARD ?=

guard: $(INSTALLED)
	$(BIN)/python -m benchmarks.guard $(GUARD)

# How many small faults in factors/ its tests find; SAMPLE mutants, at random.
SAMPLE ?= 600

mutate: $(INSTALLED)
	$(PIP) install -c constraints.txt --no-build-isolation -e '.[mutation]'
	$(BIN)/python checks/mutation.py --sample $(SAMPLE) --out out/mutants.jsonl

# Builds sdist and wheel and uses them in empty environments, with the newest and the oldest dependencies
# that pyproject.toml allows, on every Python 3.11 to 3.13 that is found. Takes some minutes.
release-check: $(INSTALLED)
	$(PIP) install -c constraints.txt --no-build-isolation -e '.[release]'
	$(BIN)/python checks/release_smoke.py

# The ROS 2 node over DDS, on a ROS 2 installation of wheels in build/ros-kilted (ROS=jazzy: that one).
# Needs cmake and a C++ compiler; takes four minutes, then two.
ROS ?= kilted

ros-check: $(INSTALLED)
	$(BIN)/python checks/ros_check.py --distribution $(ROS)

image: $(INSTALLED)
	docker build --build-arg VERSION=$$($(BIN)/python -m setuptools_scm) -t sst-graph .

# Pages that programs write, then the site in build/site. A warning is an error.
docs: $(INSTALLED)
	$(BIN)/sst-graph settings --markdown > docs/reference/settings.md
	$(BIN)/python docs/make_api.py > docs/reference/api.md
	$(BIN)/python -m sphinx -W --keep-going -q -d build/doctrees docs build/site
	@echo 'open build/site/index.html'

# Chromium, in which tests/report opens a report; on Debian and its kin as root, else install it yourself.
browser:
	@command -v chromium || command -v chromium-browser || command -v google-chrome \
	    || (apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends chromium)

# Fresh versions of everything, in a throw-away environment.
lock:
	rm -rf build/lock && $(PYTHON) -m venv build/lock
	build/lock/bin/python -m pip --disable-pip-version-check -q install 'setuptools>=77' 'setuptools-scm>=8.1' -e '.[test]'
	(sed -n '/^#/p' constraints.txt; build/lock/bin/python -m pip freeze --all --exclude-editable | grep -v '^pip==' | sort -f) > build/constraints.txt
	mv build/constraints.txt constraints.txt && rm -rf build/lock

clean:
	rm -rf $(VENV) out build .mypy_cache .ruff_cache .pytest_cache .benchmarks
