# One .venv for everything, brought up to date when pyproject.toml changes. `make demo` needs only r2p itself in it.

PYTHON ?= python3
BIN := .venv/bin
RUN := .venv/stamp-run
STAMP := .venv/stamp
LOWEST := .venv-lowest
PYTHONS := 3.12 3.13

# Tests start hundreds of Pythons, and each of them would compile all of r2p.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test test-lowest test-pythons lint bench soak docs docs-check pictures page-pictures clean

demo: $(RUN)
	$(BIN)/r2p demo

test: $(STAMP) system
	$(BIN)/pytest --numprocesses auto --maxprocesses 4 --dist loadgroup

# The tests with the lowest versions that pyproject.toml allows; `make test-lowest TESTS=tests/tools` runs some of them.
test-lowest: $(LOWEST)/stamp system
	$(if $(CI)$(PEERS),@$(LOWEST)/bin/uv pip install --quiet --python $(LOWEST)/bin/python --group browser)
	$(LOWEST)/bin/pytest --numprocesses auto --maxprocesses 4 --dist loadgroup $(TESTS)

# The tests with other Pythons, of those that this machine has: `make test-pythons PYTHONS=3.13 TESTS=tests/tools`.
test-pythons:
	@$(MAKE) --no-print-directory --keep-going $(PYTHONS:%=test-python-%)

# The names of its versions let the shims of pyenv find all of them; not for what makes .venv, where the first one counts.
test-python-%: $(BIN)/uv system
	@export PYENV_VERSION=$$(pyenv versions --bare 2>/dev/null | paste -sd :); \
	if $(BIN)/uv python find --quiet --no-python-downloads $* >/dev/null 2>&1; then \
		$(MAKE) --no-print-directory .venv-$*/stamp && \
		$(if $(CI)$(PEERS),$(BIN)/uv pip install --quiet --python .venv-$* --group browser &&) \
		.venv-$*/bin/pytest --numprocesses auto --maxprocesses 4 --dist loadgroup $(TESTS); \
	else echo "Python $* is not on this machine: skipped"; fi

lint: $(STAMP)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/pyright
	$(BIN)/lint-imports --no-cache
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

bench: $(STAMP)
	$(BIN)/python -m benchmarks $(ROW)

# Seconds, and messages a second (0: as many as are taken): `make soak SECONDS=600 RATE=2000`.
SECONDS := 3600
RATE := 0

soak: $(STAMP)
	$(BIN)/python -m benchmarks.soak $(SECONDS) --rate $(RATE)

docs: $(STAMP)
	$(BIN)/mkdocs build --strict

# The built site in Debian's chromium, at the width of a phone and of a desktop, light and dark. `SHOTS=folder` takes
# pictures of the pages.
docs-check: docs
	$(BIN)/python -m pip install --quiet --group browser
	$(BIN)/python docs/check_site.py $(if $(SHOTS),--shots $(SHOTS))

# The pictures of the documentation, from the code; tests say when that is due.
pictures: $(STAMP)
	$(BIN)/python docs/draw_architecture.py
	$(BIN)/python docs/draw_diagrams.py
	$(BIN)/python docs/draw_screens.py

# The page of `r2p dash`, in a browser (make test PEERS=1 gets that): figures differ from run to run, so no test compares.
page-pictures: $(STAMP)
	$(BIN)/python -m docs.draw_pages

clean:
	rm -rf .venv .venv-* site

$(RUN): pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --upgrade 'pip>=25.1'
	$(BIN)/python -m pip install --quiet --editable '.[all]'
	touch $@

$(STAMP): $(RUN)
	$(BIN)/python -m pip install --quiet --group test --group lint --group docs --group bench
	touch $@

$(BIN)/uv: | $(STAMP)
	$(BIN)/python -m pip install --quiet uv

.venv-%/stamp: pyproject.toml | $(BIN)/uv
	$(BIN)/uv venv --quiet --clear --no-python-downloads --python $* .venv-$*
	$(BIN)/uv pip install --quiet --python .venv-$* --editable '.[all]' --group test --group docs mypy types-pyserial types-pyyaml
	touch $@

$(LOWEST)/stamp: pyproject.toml
	$(PYTHON) -m venv --clear $(LOWEST)
	$(LOWEST)/bin/python -m pip install --quiet uv
	$(LOWEST)/bin/uv pip install --quiet --python $(LOWEST)/bin/python --resolution lowest-direct --editable '.[all]' --group test
	$(LOWEST)/bin/uv pip install --quiet --python $(LOWEST)/bin/python --group docs mypy types-pyserial types-pyyaml
	$(LOWEST)/bin/uv pip list --python $(LOWEST)/bin/python
	touch $@

# What the tests use of the system: installed for root, unpacked for others, else they say what they skip. Real ROS 2
# takes 275 MB, a browser 600 MB: they are installed with CI=1 or PEERS=1.
.PHONY: system
system: $(STAMP)
	@$(BIN)/python -m tests.debian
	@$(BIN)/python -m tests.ros.rclpy.install
	@$(BIN)/python -m tests.browser.install
