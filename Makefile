# Set-up, demonstration, tests. Everything is installed into .venv, in the versions of uv.lock.
PYTHON ?= python3
VENV ?= .venv
OTHER_VENVS := $(patsubst %,.venv-%,opencv4 lowest ray integrations docs)
DEMO_OUTPUT ?= demo-output
DATA ?= data
TORCH := torch==2.13.0
# Two processes, each with whole files (what a file sets up is set up once), on one thread each. One
# that crashes ends the run: with a new one in its place pytest-xdist may wait for ever.
PYTEST := -m pytest -q -n 2 --dist loadfile --max-worker-restart 0
export OMP_NUM_THREADS ?= 1
export UV_PYTHON_DOWNLOADS ?= never
# The tests start many interpreters: what one has compiled, the next should find.
unexport PYTHONDONTWRITEBYTECODE

# What calls the parts of OpenCV that moved between its versions 4 and 5.
TESTS_OPENCV4 ?= lab/tests/labels tests/features tests/geometry lab/tests/evaluation/baselines \
	tests/detector/onnx_files/test_export.py
# A quick part that touches most of the packages that these distributions depend on.
TESTS_LOWEST ?= tests/io tests/detector lab/tests/labels tests/features

PIP_FLAGS := --quiet --disable-pip-version-check
# Into an environment, from the lock file; what pip has put there stays.
sync = UV_PROJECT_ENVIRONMENT=$(1) $(VENV)/bin/uv sync --quiet --locked --inexact --python $(PYTHON) \
	--no-install-package torch
EVERYTHING := --all-packages --all-extras
export = $(VENV)/bin/uv export --quiet --locked --all-packages --all-extras --no-emit-workspace --format $(1)
install_torch = $(VENV)/bin/python -m pip --python $(1)/bin/python install $(PIP_FLAGS) --no-compile --no-deps $(TORCH)

.PHONY: demo test coverage test-all fuzz onnxruntime test-opencv4 test-ray test-integrations test-lowest web test-web hub lint spelling types contracts check \
	format lock upgrade check-lock audit sbom docs test-docs notebooks figures results release-check clean
demo: $(VENV)/.demo
	$(VENV)/bin/deepdetect demo -o $(DEMO_OUTPUT)

# The fast tests. Those marked as slow run with `make test-all`.
test: $(VENV)/.test
	$(VENV)/bin/python $(PYTEST)

# The fast tests, and the lines that they run.
coverage: $(VENV)/.test
	$(VENV)/bin/python $(PYTEST) --cov --cov-report term:skip-covered

# All tests, and ten minutes of wrong input and kills.
test-all: $(VENV)/.test test-opencv4 test-ray test-integrations onnxruntime
	$(VENV)/bin/python $(PYTEST) --runslow
	$(VENV)/bin/python -m fuzz --seconds 540 --kills 8

# All wrong input and all kills of docs/limits.md: a quarter of an hour on two cores.
fuzz: $(VENV)/.test
	$(VENV)/bin/python -m fuzz

# What the C++ example is built with, for its test: where Debian's archive cannot be reached the test
# is skipped, and says so.
onnxruntime: $(VENV)/.test
	bash examples/onnx_cpp/get_onnxruntime.sh $(VENV)/onnxruntime $(VENV)/bin/python || \
		echo "ONNX Runtime's headers cannot be fetched: the C++ example is not tested"

test-opencv4: .venv-opencv4/.test
	.venv-opencv4/bin/python $(PYTEST) -p no:cacheprovider $(TESTS_OPENCV4)

# Collections on a cluster of this machine.
test-ray: .venv-ray/.test
	.venv-ray/bin/python -m pytest -p no:cacheprovider --runslow tests/batch tests/detector/test_detector.py

# Drop-ins for other programs, with these installed.
test-integrations: .venv-integrations/.test
	.venv-integrations/bin/python $(PYTEST) -p no:cacheprovider tests/integrations

# The lowest versions that pyproject.toml allows, but for torch.
test-lowest: .venv-lowest/.test
	.venv-lowest/bin/python $(PYTEST) -p no:cacheprovider $(TESTS_LOWEST)

# The page for any web server, with ONNX Runtime, the network and the graph of the points, in web/dist.
web: web/node_modules/.package-lock.json $(VENV)/.test
	$(VENV)/bin/python tools/points_graph.py --candidates web/points.onnx
	cd web && npm run --silent build

# The page in Chromium: alone, and with `deepdetect app`.
test-web: web
	cd web && DEEPDETECT_PYTHON=$(abspath $(VENV))/bin/python npx playwright test $(TESTS_WEB)

lint: $(VENV)/.test spelling
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .

spelling: $(VENV)/.test
	$(VENV)/bin/codespell
	$(VENV)/bin/python tools/plain_english.py

types: $(VENV)/.test
	$(VENV)/bin/mypy

contracts: $(VENV)/.test
	$(VENV)/bin/lint-imports

# All that continuous integration runs.
check:
	bash .ci/run

format: $(VENV)/.test
	$(VENV)/bin/ruff check --fix .
	$(VENV)/bin/ruff format .

# Only what the files pyproject.toml ask for changes; `make upgrade` takes the newest versions.
lock upgrade: $(VENV)/bin/uv
	$(VENV)/bin/uv lock $(if $(filter upgrade,$@),--upgrade)
	$(VENV)/bin/uv pip compile --quiet --generate-hashes --resolution lowest-direct --no-emit-package torch \
		--python-version 3.11 --custom-compile-command "make lock" --extra all --group build --group test \
		--no-emit-package deepdetect --output-file requirements/lowest.txt pyproject.toml lab/pyproject.toml

check-lock: $(VENV)/bin/uv
	$(VENV)/bin/uv lock --check

# Known vulnerabilities of the locked packages, where data can be reached.
audit: $(VENV)/bin/uv
	$(call export,requirements.txt) | $(VENV)/bin/python requirements/audit.py

# A bill of materials of the locked packages, as CycloneDX JSON.
sbom: $(VENV)/bin/uv
	$(call export,cyclonedx1.5) > sbom.json

# The site, in build/site; what is wrong with a link or a docstring ends it.
docs: .venv-docs/.test
	NO_MKDOCS_2_WARNING=1 .venv-docs/bin/mkdocs build

# The site asks for nothing on other servers, and the notebooks run: five minutes on two cores.
test-docs: .venv-docs/.notebooks
	.venv-docs/bin/python -m pytest -p no:cacheprovider --runslow tests/docs

# Runs the notebooks and keeps their output.
notebooks: .venv-docs/.notebooks
	.venv-docs/bin/python docs/notebooks/run.py

# Draws the pictures of the README, of docs/method.md and of docs/points.md again.
figures: $(VENV)/.test
	$(VENV)/bin/python docs/figures/day_dark_blurred.py
	$(VENV)/bin/python docs/figures/day_to_dark.py
	$(VENV)/bin/python docs/figures/uses.py
	$(VENV)/bin/python docs/figures/method.py
	$(VENV)/bin/python docs/figures/times.py

# The tables that README.md and the pages quote, from the data sets in DATA: hours on two cores, and
# what was interrupted goes on. ONLY="density times" makes some; DATA= fills the pages alone.
results: $(VENV)/.test
	$(VENV)/bin/python benchmarks/results.py $(DATA) $(if $(PUBLISHED),--published $(PUBLISHED)) \
		$(if $(ONLY),--only $(ONLY))

# A folder for each of the weights, as model hubs take them.
hub: $(VENV)/.test
	rm -rf dist/hub
	$(VENV)/bin/python tools/hub dist/hub

# The wheel and the source archive are made, looked at, and installed without a network into empty
# environments of each Python that is here. With VERSION=0.2.0 all files must name this version.
release-check: .venv-docs/.test
	.venv-docs/bin/python .ci/check_release.py $(if $(VERSION),--version $(VERSION))

clean:
	rm -rf $(VENV) $(OTHER_VENVS) $(DEMO_OUTPUT)
	rm -rf web/dist web/node_modules web/points.onnx web/test-results
	rm -rf build dist sbom.json htmlcov .coverage .coverage.* .pytest_cache .ruff_cache .mypy_cache .import_linter_cache

web/node_modules/.package-lock.json: web/package-lock.json
	cd web && npm ci --ignore-scripts --no-audit --no-fund

$(VENV)/bin/uv: requirements/uv.txt
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install $(PIP_FLAGS) --require-hashes -r requirements/uv.txt
	@touch $@

$(VENV)/.demo: $(VENV)/bin/uv uv.lock
	$(call sync,$(VENV)) --group demo --group opencv5
	@touch $@

# It holds what the demonstration needs, too.
$(VENV)/.test: $(VENV)/bin/uv uv.lock
	$(call sync,$(VENV)) $(EVERYTHING) --group dev --group opencv5
	$(call install_torch,$(VENV))
	@touch $(VENV)/.demo $@

# An environment for each of the other targets.
.venv-opencv4/.test: GROUPS := $(EVERYTHING) --group test --group opencv4
.venv-ray/.test: GROUPS := --group test --group opencv5 --group ray
.venv-integrations/.test: GROUPS := $(EVERYTHING) --group test --group opencv5 --group integrations
.venv-docs/.test: GROUPS := --group opencv5 --group docs --group test --group release --group build
.venv-opencv4/.test .venv-ray/.test .venv-integrations/.test .venv-docs/.test: .venv-%/.test: $(VENV)/bin/uv uv.lock
	$(call sync,.venv-$*) $(GROUPS)
	$(if $(filter opencv4 integrations,$*),$(call install_torch,.venv-$*))
	@touch $@

.venv-lowest/.test: $(VENV)/bin/uv requirements/lowest.txt
	$(VENV)/bin/uv venv --quiet --clear --python $(PYTHON) .venv-lowest
	$(VENV)/bin/uv pip install --quiet --python .venv-lowest/bin/python --no-deps --require-hashes -r requirements/lowest.txt
	$(call install_torch,.venv-lowest)
	$(VENV)/bin/uv pip install --quiet --python .venv-lowest/bin/python --no-deps --editable . --editable lab
	@touch $@

# The notebooks also map and train.
.venv-docs/.notebooks: .venv-docs/.test
	$(call sync,.venv-docs) $(GROUPS) $(EVERYTHING) --group opencv5
	$(call install_torch,.venv-docs)
	@touch $@
.venv-docs/.notebooks: GROUPS := --group docs --group test
