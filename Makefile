# Set-up, demonstration, tests. All of it happens in .venv, with the versions of requirements/lock.txt.
PYTHON ?= python3
VENV ?= .venv
OTHER_VENVS := $(patsubst %,.venv-%,opencv4 lowest ray integrations docs)
DEMO_OUTPUT ?= demo-output
DATA ?= data
# What installs the lock files: uv is eight times as fast as pip, which does the same.
INSTALLER ?= uv
# Two processes, each with whole files (what a file sets up is set up once), on one thread each. One
# that crashes ends the run: with a new one in its place pytest-xdist may wait for ever.
PYTEST := -m pytest -n 2 --dist loadfile --max-worker-restart 0
# Parts of the package with their tests; those that take long come first, those not named together.
LONG := matching detector evaluation app reconstruction training
MEDIUM := features+labels benchmarks+integrations _shared+viz
OTHERS := $(filter-out cli $(subst +, ,$(LONG) $(MEDIUM)),$(notdir $(patsubst %/,%,$(wildcard tests/[!_]*/))))
parts = $(foreach part,$(1),tests/$(part) $(wildcard src/deepdetect/$(part)))
TESTS := "$(call parts,$(OTHERS))" $(foreach part,$(LONG),"$(call parts,$(part))") \
	"tests/test_*.py src/deepdetect/*.py" "tests/cli/test_[a-e]*.py" "tests/cli/test_[f-s]*.py" \
	$(foreach both,$(MEDIUM),"$(call parts,$(subst +, ,$(both)))") \
	"tests/cli/test_[t-z]*.py src/deepdetect/cli"
# Each part in a process of its own, two at a time: what it has loaded goes with it.
run_parts = printf '"%s"\n' $(TESTS) | xargs -P 2 -n 1 sh -c \
	'output=$$($(VENV)/bin/python -m pytest -q $(1) $$0 2>&1); status=$$?; echo "$$output"; exit $$status'
export OMP_NUM_THREADS ?= 1
# The tests start many interpreters: what one has compiled, the next should find.
unexport PYTHONDONTWRITEBYTECODE

# What calls the parts of OpenCV that moved between its versions 4 and 5.
TESTS_OPENCV4 ?= tests/labels tests/features tests/geometry tests/evaluation/baselines \
	tests/detector/network/test_onnx_export.py
# A quick part that touches most of the packages that this one depends on.
TESTS_LOWEST ?= tests/io tests/detector tests/labels tests/features

PIP_FLAGS := --quiet --disable-pip-version-check
ifeq ($(INSTALLER),uv)
install = $(1)/bin/uv pip install --quiet --python $(1)/bin/python
else
install = $(1)/bin/python -m pip install $(PIP_FLAGS)
endif
# The lock files are complete, so that nothing is resolved anew.
install_locked = $(call install,$(1)) --no-deps --require-hashes -r $(2)
install_torch = $(1)/bin/python -m pip install $(PIP_FLAGS) --no-compile -r requirements/torch.txt
install_package = $(call install,$(1)) --no-deps --no-build-isolation --editable .

.PHONY: demo test test-all fuzz onnxruntime test-opencv4 test-ray test-integrations test-lowest web test-web coverage hub lint spelling types contracts check \
	format lock upgrade check-lock audit sbom docs test-docs notebooks figures results release-check clean

demo: $(VENV)/.demo
	$(VENV)/bin/deepdetect demo -o $(DEMO_OUTPUT)

# The fast tests. Those marked as slow run with `make test-all`.
test: $(VENV)/.test
	@$(call run_parts,)

# All tests, and ten minutes of wrong input and kills.
test-all: $(VENV)/.test test-opencv4 test-ray test-integrations onnxruntime
	@$(call run_parts,--runslow)
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

coverage: $(VENV)/.test
	$(VENV)/bin/python $(PYTEST) --cov --cov-report term:skip-covered --cov-report html

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

lock: $(VENV)/bin/uv
	$(VENV)/bin/python requirements/lock.py

upgrade: $(VENV)/bin/uv
	$(VENV)/bin/python requirements/lock.py --upgrade

check-lock: $(VENV)/bin/uv
	$(VENV)/bin/python requirements/lock.py --check

# Known vulnerabilities of the locked packages, where data can be reached.
audit: $(VENV)/bin/uv
	$(VENV)/bin/python requirements/audit.py

# A bill of materials of the locked packages, as CycloneDX JSON.
sbom: $(VENV)/bin/uv
	$(VENV)/bin/uvx --from cyclonedx-bom==7.5.0 cyclonedx-py requirements requirements/lock.txt \
		--pyproject pyproject.toml --output-format JSON --output-reproducible --output-file sbom.json

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

%/bin/uv: requirements/uv.txt
	$(PYTHON) -m venv $*
	$*/bin/python -m pip install $(PIP_FLAGS) --require-hashes -r requirements/uv.txt
	@touch $@

$(VENV)/.demo: $(VENV)/bin/uv requirements/demo.txt pyproject.toml
	$(call install_locked,$(VENV),requirements/demo.txt)
	$(call install_package,$(VENV))
	@touch $@

# It holds what the demonstration needs, too.
$(VENV)/.test: $(VENV)/bin/uv requirements/lock.txt requirements/torch.txt pyproject.toml
	$(call install_locked,$(VENV),requirements/lock.txt)
	$(call install_torch,$(VENV))
	$(call install_package,$(VENV))
	@touch $(VENV)/.demo $@

# An environment for each of the other lock files.
$(OTHER_VENVS:%=%/.test): .venv-%/.test: .venv-%/bin/uv requirements/%.txt requirements/torch.txt pyproject.toml
	$(call install_locked,.venv-$*,requirements/$*.txt)
	$(if $(filter lowest integrations,$*),$(call install_torch,.venv-$*))
	$(call install_package,.venv-$*)
	@touch $@

# The notebooks also map and train.
.venv-docs/.notebooks: .venv-docs/.test requirements/lock.txt requirements/torch.txt
	$(call install_locked,.venv-docs,requirements/lock.txt)
	$(call install_torch,.venv-docs)
	$(call install_package,.venv-docs)
	@touch $@
