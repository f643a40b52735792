# Set-up, demonstration, tests. All of it happens in .venv, with the versions of requirements/lock.txt.
PYTHON ?= python3
VENV ?= .venv
VENV_OPENCV4 ?= .venv-opencv4
DEMO_OUTPUT ?= demo-output
LOCK := requirements/lock.txt
OPENCV4 := opencv-contrib-python-headless==4.14.0.94
PIP_FLAGS := --quiet --disable-pip-version-check

.PHONY: demo test test-opencv4 lint format clean

demo: $(VENV)/.demo
	$(VENV)/bin/deepdetect demo -o $(DEMO_OUTPUT)

# Two processes, each with whole files: what a file sets up is set up once.
test: $(VENV)/.test test-opencv4
	$(VENV)/bin/python -m pytest -n 2 --dist loadfile

# The label detectors live in other modules of OpenCV 4 than of OpenCV 5.
test-opencv4: $(VENV_OPENCV4)/.test
	$(VENV_OPENCV4)/bin/python -m pytest -q -p no:cacheprovider tests/labels tests/descriptors tests/matchers tests/geometry tests/methods

lint: $(VENV)/.test
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .

format: $(VENV)/.test
	$(VENV)/bin/ruff check --fix .
	$(VENV)/bin/ruff format .

clean:
	rm -rf $(VENV) $(VENV_OPENCV4) demo-output

$(VENV)/bin/hatchling: $(LOCK)
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install $(PIP_FLAGS) -c $(LOCK) hatchling editables
	touch $@

$(VENV)/.demo: $(VENV)/bin/hatchling pyproject.toml
	$(VENV)/bin/python -m pip install $(PIP_FLAGS) -c $(LOCK) --no-build-isolation -e '.[demo]'
	touch $@

$(VENV)/.test: $(VENV)/bin/hatchling pyproject.toml
	$(VENV)/bin/python -m pip install $(PIP_FLAGS) -c $(LOCK) --no-build-isolation \
		-e '.[benchmark,data,demo,faiss,openvino,test,train]'
	touch $@

$(VENV_OPENCV4)/.test: $(LOCK) pyproject.toml
	$(PYTHON) -m venv $(VENV_OPENCV4)
	grep -v opencv $(LOCK) > $(VENV_OPENCV4)/lock.txt
	$(VENV_OPENCV4)/bin/python -m pip install $(PIP_FLAGS) -c $(VENV_OPENCV4)/lock.txt hatchling editables
	$(VENV_OPENCV4)/bin/python -m pip install $(PIP_FLAGS) -c $(VENV_OPENCV4)/lock.txt --no-build-isolation \
		-e '.[benchmark,demo,test]' $(OPENCV4)
	touch $@
